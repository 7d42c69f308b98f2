"""The renderer against the closed form of a pinhole, and against PyBullet's picture of the same cell."""

import cv2
import numpy as np
import pytest

from marl_handover.config import MotionConfig
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.calibration import CameraCalibration, Intrinsics, looking_down
from marl_handover.perception.scene import CellPainter, Renderer, Shape
from marl_handover.perception.settings import LookConfig
from marl_handover.simulation.world import SimulatedCell

CLEAN = LookConfig(blur_px=0, noise=0, gradient=0)
PYBULLET_NOISE = 12
"""What differs by more from the colour of the table is something on it."""


def straight():
    return CameraCalibration(Intrinsics.pinhole(917.0, (1280, 720)), looking_down((0.0, 0.0, 700.0)))


@pytest.mark.parametrize("seed", range(6))
def test_a_triangle_lies_where_a_pinhole_has_it_to_a_tenth_of_a_pixel(truth, seed):
    random = np.random.default_rng(seed)
    angles = random.uniform(0, 1) + np.array([0.0, 2.0, 4.3])
    points = random.uniform(-150, 150, 2) + random.uniform(15, 40, (3, 1)) * np.column_stack([np.cos(angles), np.sin(angles)])
    points = np.column_stack([points, random.uniform(0, 60, 3)])
    image = Renderer(truth, CLEAN).picture([Shape(points, (0, 0, 0), window="it")])
    weight = 229.0 - image[..., 1].astype(float)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    corners = truth.project(points)
    (a, b), (c, d) = corners[1] - corners[0], corners[2] - corners[0]
    np.testing.assert_allclose(found, corners.mean(axis=0), atol=0.1)
    # What OpenCV fills is half of a fine pixel larger on every side.
    assert weight.sum() / 229 == pytest.approx(abs(a * d - b * c) / 2, rel=0.05)


def test_textures_lie_with_their_upper_left_corner_on_the_first_point(truth):
    texture = np.full((40, 40), 255, np.uint8)
    texture[:20, :20] = 0
    points = flat_pose(50, 30, 0.7)[:3, :3] @ (np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]).T * 20)
    points = points.T + [50, 30, 0]
    image = Renderer(truth, CLEAN).picture([Shape(points, (255, 255, 255), texture, "it")])
    inside = np.rint(truth.project(points * 0.5 + points.mean(axis=0) * 0.5)).astype(int)
    assert [int(image[row, column, 0]) for column, row in inside] == [0, 255, 255, 255]


def test_equal_seeds_give_equal_pictures_and_other_noise_each_time(model, truth, parked):
    first, second = (CellPainter(model, truth, seed=3) for _ in range(2))
    pictures = [painter.picture(flat_pose(50, 60, 1), parked, (-50, 0, 0)) for painter in (first, second, first)]
    assert np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])
    with pytest.raises(InvalidSetting, match="noise"):
        LookConfig(noise=-1).validate()


def test_noise_and_light_are_as_the_settings_say(truth):
    plain = Renderer(truth, CLEAN).picture([])
    noisy = Renderer(truth, LookConfig(blur_px=0, noise=4, gradient=0, light=0.8)).picture([])
    assert noisy.mean() / plain.mean() == pytest.approx(0.8, abs=0.01)
    assert noisy[..., 0].std() == pytest.approx(4, abs=0.2)


@pytest.mark.parametrize("carried", [False, True])
def test_arms_and_block_cover_what_they_cover_in_pybullets_picture(model, carried):
    pytest.importorskip("pybullet")  # MuJoCo's pictures have shadows
    random = np.random.default_rng(4)
    low, high = model.arm.lower_rad, model.arm.upper_rad
    painter = CellPainter(model, straight(), look=CLEAN)
    with SimulatedCell(model, MotionConfig(), engine="bullet") as cell:
        for _ in range(2):
            cell.reset((*random.uniform(-100, 100, 2), random.uniform(-3, 3)))
            for arm in cell.arms:
                arm.place((low + high) / 2 + random.uniform(-0.2, 0.2, 5) * (high - low), 12.0)
            if carried:
                cell.engine.put_block((30.0, -40.0, 70.0), (0.5, -0.4, 1.0))
            ours = painter.picture(cell.block.transform(), cell.joints_rad(), gripper_mm=[arm.gripper_mm() for arm in cell.arms])
            masks = [on_the_table(image) for image in (ours, cell.camera_image()[..., ::-1])]
            assert (masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum() > 0.93


def on_the_table(image):
    """Where a picture is not like the empty table in its corner."""
    return np.abs(image.astype(int) - cv2.mean(image[:40, :40])[:3]).max(axis=2) > PYBULLET_NOISE
