"""Arms that follow servos: a cycle played to them ends where the same cycle ends when the cell runs it itself."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.config import MotionConfig
from marl_handover.motion.planner import MotionPlanner
from marl_handover.simulation.follower import ServoFollower, ServoState
from marl_handover.simulation.world import SimulatedCell
from tests.canonical_arms import PARKED_DEG

START = np.array([20.0, 10.0, 0.4])
END_MM = np.array([-40.0, -15.0])


@pytest.fixture(scope="module")
def played(model):
    planner = MotionPlanner(model, MotionConfig())
    motion = planner.pick_place(0, START[:2], END_MM, planner.home_rad, planner.home_rad)
    t_s = np.concatenate([phase.t_s for phase in motion.phases])
    joints = np.concatenate([phase.joints_rad for phase in motion.phases])
    fingers = np.concatenate([phase.gripper_mm for phase in motion.phases])
    parked, wide = planner.home_rad, MotionConfig().finger_travel_mm

    def servos(now_s):
        own = np.array([np.interp(now_s, t_s, column) for column in joints.T])
        return ServoState(np.stack([own, parked]), np.array([np.interp(now_s, t_s, fingers), wide]))

    return motion, servos, t_s[-1]


def test_the_block_goes_where_the_cell_itself_would_take_it(model, played, engine):
    motion, servos, duration_s = played
    with SimulatedCell(model, MotionConfig(), engine=engine) as cell:
        cell.reset(START)
        follower = ServoFollower(cell, servos)
        follower.advance(duration_s + 0.5)
        followed = cell.object_pose()
        assert [arm for arm, _ in follower.grasps] == [0]
        assert not follower.collisions
        cell.reset(START)
        cell.run(0, motion.phases)
        ran = cell.object_pose()
    assert np.abs(followed[:2] - ran[:2]).max() < 1.0
    assert abs(followed[2] - ran[2]) < np.radians(0.5)
    assert np.abs(followed[:2] - END_MM).max() < 2.0


def test_a_world_at_rest_is_not_computed_until_somebody_moves(model, engine):
    parked = np.tile(np.radians(PARKED_DEG), (2, 1))
    state = ServoState(parked, np.full(2, MotionConfig().finger_travel_mm))
    with SimulatedCell(model, MotionConfig(), engine=engine) as cell:
        cell.reset(START)
        follower = ServoFollower(cell, lambda now_s: state)
        follower.advance(100.0)
        assert follower.now_s == pytest.approx(100.0, abs=0.005)
        assert cell.engine.time_s < 2.0
        before = cell.engine.time_s
        follower.disturbed()
        follower.advance(101.0)
        assert cell.engine.time_s > before
