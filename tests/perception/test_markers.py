import cv2
import numpy as np
import pytest

from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.detector import OPENED, PLAIN, MarkerFinder, opening_px

EDGE_PX = 40.0


def grey(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


@pytest.fixture(scope="module")
def finder():
    return MarkerFinder("36h11", EDGE_PX, 5)


def test_the_pin_cuts_the_marker_far_off_the_axis_and_the_second_stage_heals_it(finder, painter, truth):
    stages = {}
    for radius in (0.0, 220.0):
        for yaw in (0.2, 1.9, 3.4):
            T = flat_pose(-radius, 40, yaw)
            found = finder.find(grey(painter.picture(T)), [0])[0]
            stages.setdefault(radius, set()).add(found.stage)
            corners = np.array([[-15, 15, 15, 1], [15, 15, 15, 1], [15, -15, 15, 1], [-15, -15, 15, 1]])
            np.testing.assert_allclose(found.pixels, truth.project((corners @ T.T)[:, :3]), atol=1.0)
    assert stages == {0.0: {PLAIN}, 220.0: {OPENED}}


def test_only_what_is_wanted_is_found_and_nothing_in_clutter(finder, painter):
    image = painter.picture(flat_pose(30, 20, 1), goal=(-100, 50, 2))
    assert set(finder.find(grey(image), [0, 1])) == {0, 1}
    assert set(finder.find(grey(image), [1])) == {1}
    random = np.random.default_rng(0)
    clutter = np.full((720, 1280), 220, np.uint8)
    for _ in range(300):
        points = random.uniform(0, 1, 2) * (1280, 720) + random.normal(0, 30, (4, 2))
        cv2.fillConvexPoly(clutter, cv2.convexHull(points.astype(np.int32).reshape(-1, 1, 2)), int(random.integers(0, 255)))
    assert finder.find(clutter, range(50)) == {}


@pytest.mark.parametrize(
    ("pin_px", "cell_px", "kernel"),
    [(3.35, 5.02, 5), (5.5, 8.4, 7), (2.7, 5.1, 5), (1.0, 3.0, 3), (4.0, 4.0, 5)],
)
def test_the_opening_is_wider_than_the_pin_and_spares_cells(pin_px, cell_px, kernel):
    assert opening_px(pin_px, cell_px) == kernel
