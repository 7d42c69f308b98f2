"""What the twin's camera shows of a simulated cell, and that boards are held where a camera can see them."""

import numpy as np
import pytest

from marl_handover.config import MotionConfig
from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.detector import Detector
from marl_handover.perception.printables import board_corners_mm
from marl_handover.perception.scene import block_shapes, held_boards
from marl_handover.simulation.world import SimulatedCell
from tests.canonical_arms import PARKED_DEG


def test_the_detector_sees_a_simulated_cell_as_it_is(model, engine, painter, calibration):
    detector = Detector(calibration, model.cell.config.block)
    with SimulatedCell(model, MotionConfig(), engine=engine) as cell:
        for pose in ((-190.0, 110.0, 2.5), (60.0, -40.0, -1.0)):
            cell.reset(pose)
            image = painter.picture(cell.block.transform(), cell.joints_rad(), gripper_mm=[arm.gripper_mm() for arm in cell.arms])
            found = detector.detect(image).block
            np.testing.assert_allclose(found.pose[:2], cell.object_pose()[:2], atol=0.5)
            assert found.pose[2] == pytest.approx(cell.object_pose()[2], abs=0.015)


def test_an_arm_over_the_block_hides_it(model, painter, calibration):
    detector = Detector(calibration, model.cell.config.block)
    base, place = model.cell.bases[0], np.array([0.0, -10.0])
    above = model.arm.ik([base.y_mm - place[1] + 60.0, 0.0, 90.0])[0]
    joints = np.stack([above, np.radians(PARKED_DEG)])
    assert detector.detect(painter.picture(flat_pose(*place, 0.3))).block is not None
    assert detector.detect(painter.picture(flat_pose(*place, 0.3), joints)).block is None


def test_only_faces_towards_the_eye_are_drawn(model):
    block = model.cell.config.block
    straight_above = block_shapes(block, flat_pose(0, 0, 0.4), np.array([0.0, 0.0, 700.0]), (0.0, 0.0, 255.0))
    aside = block_shapes(block, flat_pose(200, 100, 1.2), np.array([0.0, 0.0, 700.0]), (0.0, 0.0, 255.0))
    on_its_head = np.diag([1.0, -1.0, -1.0, 1.0])
    below = block_shapes(block, on_its_head, np.array([0.0, 0.0, 700.0]), (0.0, 0.0, 255.0))
    pin = 5
    assert len(straight_above) - pin == 1
    assert len(aside) - pin == 3
    assert [shape.colour == (0.0, 0.0, 255.0) for shape in below].count(True) == 0


def test_held_boards_fill_the_view_and_face_the_camera(truth, board):
    corners = np.column_stack([board_corners_mm(board), np.ones((board.columns - 1) * (board.rows - 1))])
    seen = []
    for T in held_boards(truth, 20, seed=5):
        assert T[:3, 2] @ (truth.eye_mm() - T[:3, 3]) > 0
        seen.append(truth.project((corners @ T.T)[:, :3]))
    inside = [((pixels > 0) & (pixels < (1279, 719))).all(axis=1).mean() for pixels in seen]
    assert min(inside) > 0.4
    every = np.concatenate(seen)
    assert every.min(axis=0).max() < 100
    assert (every.max(axis=0) > (1180, 620)).all()
