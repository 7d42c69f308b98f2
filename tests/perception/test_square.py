import math

import numpy as np
import pytest

from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.detector import Detector
from marl_handover.perception.scene import Renderer, block_shapes
from marl_handover.perception.settings import LookConfig, TargetConfig

RED, GREEN = (40.0, 35.0, 205.0), (60.0, 180.0, 50.0)


def picture(truth, block, pose, colour=RED, **look):
    return Renderer(truth, LookConfig(**look)).picture(block_shapes(block, flat_pose(*pose), truth.eye_mm(), colour))


def test_a_plain_red_block_is_placed_by_its_edges(calibration, truth, model, reachable, turned_deg):
    block = model.cell.config.block
    detector = Detector(calibration, block, TargetConfig(object="square"))
    errors, turns = [], []
    for number, pose in enumerate(reachable(24, 3)):
        found = detector.detect(picture(truth, block, pose, noise=3.0, gradient=0.1 * (number % 4))).block
        errors.append(math.hypot(*(found.pose[:2] - pose[:2])))
        turns.append(turned_deg(found.pose[2], pose[2], math.pi / 2))
        assert found.stage == "square"
    assert np.median(errors) < 0.25
    assert max(errors) < 0.75
    assert np.median(turns) < 0.2
    assert max(turns) < 0.85


@pytest.mark.parametrize("quarter", range(4))
def test_the_quarter_that_nobody_can_see_is_taken_from_the_last_pose(calibration, truth, model, quarter, turned_deg):
    block = model.cell.config.block
    detector = Detector(calibration, block, TargetConfig(object="square"))
    image = picture(truth, block, (60, 70, 0.3))
    last = 0.5 + quarter * math.pi / 2
    found = detector.detect(image, (55, 75, last)).block
    assert turned_deg(found.pose[2], 0.3 + quarter * math.pi / 2) < 0.5


def test_another_colour_is_another_thing(calibration, truth, model):
    block = model.cell.config.block
    image = picture(truth, block, (60, 70, 0.3), GREEN)
    assert Detector(calibration, block, TargetConfig(object="square")).detect(image).block is None
    assert Detector(calibration, block, TargetConfig(object="square", colour_hue_deg=120)).detect(image).block is not None
