from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.cell.symmetry import LEFT
from marl_handover.control.interactive.world_state import lying
from marl_handover.viewer.trace import Motions
from marl_handover.viewer.trace_file import Recorded, Step

START = np.array([-160.0, 90.0, 0.5])
PLACE = np.array([-60.0, 0.0])


@pytest.fixture(scope="module")
def motions(model):
    motions = Motions(model, kept=2)
    yield motions
    motions.close()


@pytest.fixture(scope="module")
def step(model):
    """A hand-over by the left arm that ends as the rule book says."""
    yaw = model.cell.polar(np.stack([START[:2], PLACE]))[1][:, LEFT]
    placed = np.array([*PLACE, START[2] + yaw[1] - yaw[0]])
    return Step(START, np.array([50.0, 0.0, 1.0]), LEFT, False, PLACE, placed, "", 0.087, "")


def test_a_planned_transfer_carries_the_block_with_the_hand_from_where_it_was_to_where_it_came(motions, step):
    motion = motions.ask(0, step).result()
    np.testing.assert_allclose(motion.T_world_block[0], lying(step.state))
    np.testing.assert_allclose(motion.T_world_block[-1], lying(step.next_state))
    shifts = np.linalg.norm(np.diff(motion.T_world_block[:, :3, 3], axis=0), axis=1)
    seconds = np.diff(motion.t_s)
    assert shifts.max() < 30.0  # no jump, at its release either: 20 ms at what a hand can do
    moving = shifts > 1e-6
    assert not motion.grip_open[:-1][moving].all(axis=-1).any()  # nothing moves but in a closed hand
    assert (seconds >= 0).all()
    assert motion.T_world_block[:, 2, 3].max() > 10.0  # over the table
    np.testing.assert_array_equal(motion.joints_rad[:, 1], np.tile(motions.planner.home_rad, (len(motion.t_s), 1)))


def test_the_sample_of_a_time_is_the_last_one_before(motions, step):
    motion = motions.ask(0, step).result()
    for t_s in (-1.0, 0.0, 1.234, motion.duration_s, 1e9):
        index = motion.at(t_s)
        assert motion.t_s[index] <= max(t_s, 0.0)
        assert index == len(motion.t_s) - 1 or motion.t_s[index + 1] > t_s


def test_what_cannot_be_planned_slides_straight_and_what_was_refused_stays(motions, step):
    far = step._replace(next_state=np.array([900.0, 0.0, -3.0]), state=np.array([0.0, 0.0, 3.0]))
    motion = motions.ask(1, far).result()
    np.testing.assert_allclose(motion.T_world_block[-1], lying(far.next_state), atol=1e-9)
    turns = np.unwrap(np.arctan2(motion.T_world_block[:, 1, 0], motion.T_world_block[:, 0, 0]))
    assert abs(turns[-1] - turns[0]) == pytest.approx(2 * math.pi - 6.0)  # the short way round
    refused = motions.ask(2, step._replace(trouble="declined", next_state=step.state)).result()
    np.testing.assert_allclose(refused.T_world_block, np.tile(lying(step.state), (len(refused.t_s), 1, 1)))


def test_a_recorded_transfer_moves_as_it_was_sent(motions, step):
    planned = motions.ask(0, step).result()
    fingers = np.where(planned.grip_open, 12.0, 1.5)
    recorded = Recorded(planned.t_s, planned.joints_rad + 0.001, fingers)
    motion = motions.ask(3, step._replace(recorded=recorded)).result()
    np.testing.assert_array_equal(motion.joints_rad, recorded.joints_rad)
    np.testing.assert_array_equal(motion.grip_open, planned.grip_open)
    np.testing.assert_allclose(motion.T_world_block[:, :3, 3], planned.T_world_block[:, :3, 3], atol=1.0)


def test_a_recorded_transfer_of_another_cells_arms_is_shown_straight(motions, step):
    recorded = Recorded(np.array([0.0, 1.0]), np.zeros((2, 1, 5)), np.zeros((2, 1)))
    motion = motions.ask(5, step._replace(arm=1, recorded=recorded)).result()
    np.testing.assert_allclose(motion.T_world_block[[0, -1]], [lying(step.state), lying(step.next_state)])
    assert motion.joints_rad.shape[1:] == (2, 5)


def test_only_so_many_motions_are_kept(motions, step):
    for number in range(10, 20):
        motions.ask(number, step._replace(trouble="x")).result()
    assert len(motions._made) == 2


def test_a_place_holds_the_arm_that_put_the_block_there(model, motions, step):
    joints = motions.placed(step)
    base = model.cell.bases[LEFT]
    grip = model.arm.fk(joints[LEFT])[:3, 3]
    cos, sin = base.facing
    world = np.array([[cos, -sin], [sin, cos]]) @ grip[:2] + (base.x_mm, base.y_mm)
    np.testing.assert_allclose(world, PLACE, atol=1e-6)
    np.testing.assert_array_equal(joints[1], motions.planner.home_rad)
    for other in (step._replace(next_state=np.array([900.0, 0.0, 0.0])), step._replace(trouble="dropped")):
        np.testing.assert_array_equal(motions.placed(other), np.tile(motions.planner.home_rad, (2, 1)))


def test_a_block_that_was_dropped_stays_in_sight_and_ends_where_it_fell(motions, step):
    planned = motions.ask(0, step).result()
    recorded = Recorded(planned.t_s, planned.joints_rad, np.where(planned.grip_open, 12.0, 1.5))
    motion = motions.ask(4, step._replace(recorded=recorded, trouble="dropped")).result()
    np.testing.assert_allclose(motion.T_world_block[:-1], np.tile(lying(step.state), (len(motion.t_s) - 1, 1, 1)))
    np.testing.assert_allclose(motion.T_world_block[-1], lying(step.next_state))
