import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.errors import InvalidSetting
from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.calibration import CalibrationMismatch
from marl_handover.perception.detector import Detector, fit_square
from marl_handover.perception.scene import CellPainter
from marl_handover.perception.settings import DetectorConfig, LookConfig, TargetConfig

angles = st.floats(-math.pi, math.pi)
places = st.floats(-200, 200)


@pytest.fixture(scope="module")
def detector(calibration, model):
    return Detector(calibration, model.cell.config.block)


def square(x, y, theta, side):
    half = side / 2
    corners = np.array([[-half, half], [half, half], [half, -half], [-half, -half]])
    return corners @ flat_pose(0, 0, theta)[:2, :2].T + (x, y)


@given(x=places, y=places, theta=angles, corner=st.integers(0, 3), away=st.floats(-3, 3))
def test_a_square_with_one_corner_astray_is_placed_by_the_other_three(x, y, theta, corner, away):
    corners = square(x, y, theta, 30.0)
    pose, confidence = fit_square(corners, 30.0)
    np.testing.assert_allclose(pose[:2], (x, y), atol=1e-9)
    assert math.cos(pose[2] - theta) == pytest.approx(1)
    assert confidence == pytest.approx(1)
    corners[corner] += away
    pose, spoiled = fit_square(corners, 30.0)
    # Below the size of noise a corner is not suspected, and the mean is taken of all.
    np.testing.assert_allclose(pose[:2], (x, y), atol=0.25)
    assert math.degrees(math.acos(min(1.0, math.cos(pose[2] - theta)))) < 0.7
    assert spoiled > 0.75


def test_the_whole_reach_is_seen_within_the_bar(detector, model, truth, parked, reachable, turned_deg):
    """96 pictures in twelve kinds of light, the pin in place, through the calibration's file; bench/perception.py has 1,200."""
    random, errors, turns, lost = np.random.default_rng(8), [], [], 0
    poses, goals = reachable(96, 1), reachable(96, 2)
    assert np.hypot(*poses[:, :2].T).max() > 270
    for part in range(0, 96, 8):
        look = LookConfig(*(float(random.uniform(*span)) for span in ((0.5, 1.3), (2, 5), (0, 0.5), (0.5, 1.1))))
        painter = CellPainter(model, truth, look=look, seed=part)
        for pose, goal in zip(poses[part : part + 8], goals[part : part + 8], strict=True):
            found = detector.detect(painter.picture(flat_pose(*pose), parked, goal)).block
            if found is None:
                lost += 1
                continue
            errors.append(math.hypot(*(found.pose[:2] - pose[:2])))
            turns.append(turned_deg(found.pose[2], pose[2]))
    assert lost == 0
    assert np.median(errors) < 0.25
    assert max(errors) < 0.75
    assert np.median(turns) < 0.2
    assert max(turns) < 0.85


def test_block_and_goal_are_told_apart_and_a_covered_goal_is_not_seen(detector, painter, turned_deg):
    sighting = detector.detect(painter.picture(flat_pose(60, -80, 1.2), goal=(-70, 90, -2.0)))
    np.testing.assert_allclose(sighting.block.pose, (60, -80, 1.2), atol=0.5)
    np.testing.assert_allclose(sighting.goal.pose, (-70, 90, -2.0), atol=0.5)
    assert turned_deg(sighting.goal.pose[2], -2.0) < 0.7
    covered = detector.detect(painter.picture(flat_pose(60, -80, 1.2), goal=(62, -79, 0.3)))
    assert covered.goal is None
    assert covered.block is not None
    empty = detector.detect(painter.picture(None))
    assert empty.block is None
    assert empty.goal is None


def test_looking_around_the_last_place_finds_the_same(detector, painter):
    image = painter.picture(flat_pose(-150, 120, 0.4), goal=(100, 0, 1.0))
    everywhere = detector.detect(image)
    near = detector.detect(image, (-140, 130, 0.0), (105, 5, 0.0), everywhere=False)
    np.testing.assert_allclose(near.block.pose, everywhere.block.pose, atol=0.1)
    np.testing.assert_allclose(near.goal.pose, everywhere.goal.pose, atol=0.1)
    elsewhere = (150, -150, 0.0)
    assert detector.detect(image, elsewhere, elsewhere, everywhere=False).block is None
    np.testing.assert_allclose(detector.detect(image, elsewhere, elsewhere).block.pose, everywhere.block.pose, atol=1e-9)


def test_grey_pictures_do_and_pictures_of_another_size_do_not(detector, painter):
    image = painter.picture(flat_pose(0, 100, 2.0))
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(detector.detect(grey).block.pose, detector.detect(image).block.pose)
    with pytest.raises(CalibrationMismatch):
        detector.detect(image[:600])


def test_a_block_in_the_air_inspires_less_confidence_and_at_last_none(detector, painter):
    lying, low, high = (detector.detect(painter.picture(flat_pose(90, 60, 0.5, z))).block for z in (0.0, 15.0, 60.0))
    assert lying.confidence > 0.9
    assert low.confidence < lying.confidence - 0.1
    assert high is None


def test_a_marker_glued_askew_is_allowed_for(calibration, model, painter):
    pose = np.array([40.0, 30.0, 0.9])
    offset = [2.0, -1.5, 10.0]
    marker = flat_pose(*pose) @ flat_pose(offset[0], offset[1], math.radians(offset[2]))
    glued = Detector(calibration, model.cell.config.block, TargetConfig(block_offset=offset))
    found = glued.detect(painter.picture(marker)).block
    np.testing.assert_allclose(found.pose, pose, atol=0.3)


def test_settings_that_cannot_be_are_refused(calibration, model):
    block = model.cell.config.block
    with pytest.raises(InvalidSetting, match="goal_id"):
        Detector(calibration, block, TargetConfig(goal_id=0))
    with pytest.raises(InvalidSetting, match="block_offset"):
        Detector(calibration, block, TargetConfig(block_offset=[1, 2]))
    with pytest.raises(InvalidSetting, match="window_mm"):
        Detector(calibration, block, config=DetectorConfig(window_mm=1))
