"""Clearances along a motion agree with the planner's own, which come from other functions."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.motion.planner import MotionPlanner
from marl_handover.report.motion import NoMotion, clearances_mm, grip_mm, motion_row, plan_motions

ORDERS = [
    (0, np.array([-120.0, 60.0]), np.array([100.0, 5.0])),
    (1, np.array([100.0, 5.0]), np.array([-60.0, -12.0])),
    (1, np.array([10.0, 20.0]), np.array([12.0, -28.0])),
    (0, np.array([0.0, -40.0]), np.array([0.0, -45.0])),
]


@pytest.fixture(scope="module")
def planner():
    return MotionPlanner(build_cell(cell_config("paper")))


@pytest.fixture(scope="module")
def model(planner):
    return planner.model


@pytest.fixture(scope="module")
def motions(planner):
    return plan_motions(planner, ORDERS)


def test_the_least_clearance_is_the_planners(planner, model, motions):
    """It looks at 1001 points of each path, the motion at one every 20 ms, so that the two are not at the same points."""
    for motion in motions:
        to_arm, to_table = clearances_mm(model, planner.motion, motion)
        assert len(to_arm) == len(to_table) == sum(len(phase.t_s) for phase in motion.phases)
        assert motion.min_clearance_mm - 0.05 <= to_arm.min() <= motion.min_clearance_mm + 2.0
        assert to_table.min() >= planner.motion.ground_clearance_mm


def test_the_grip_is_at_pick_and_place(model, motions):
    for motion in motions:
        phases = {phase.name: phase.joints_rad for phase in motion.phases}
        height = model.cell.pick_height_mm
        np.testing.assert_allclose(grip_mm(model, motion.arm, phases["grasp"][-1]), [*motion.from_mm, height], atol=1e-6)
        np.testing.assert_allclose(grip_mm(model, motion.arm, phases["release"][0]), [*motion.to_mm, height], atol=1e-6)


def test_rows_hold_numbers_only(motions):
    for motion in motions:
        row = motion_row(motion)
        assert row["arm"] == "LR"[motion.arm]
        assert [len(phase["t_s"]) for phase in row["phases"]] == [len(phase["joints_rad"]) for phase in row["phases"]]
        assert all(isinstance(value, float) for value in (row["path_length_mm"], row["min_clearance_mm"], row["planning_ms"]))


def test_a_transfer_out_of_reach_is_refused(planner):
    with pytest.raises(NoMotion, match="transfer 2, arm R, has no motion"):
        plan_motions(planner, [*ORDERS[:1], (1, np.array([0.0, 180.0]), np.array([0.0, 0.0]))])
