from __future__ import annotations

from copy import copy

import motion_weight
import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.motion.planner import MotionPlanner
from marl_handover.policies import load


@pytest.fixture(scope="module")
def planner() -> MotionPlanner:
    return MotionPlanner(build_cell(cell_config("paper")))


def test_lengths_are_those_of_the_episodes_transfers(planner):
    """The exact policy solves all; straight is the least a path can be, and both sums are over the same transfers."""
    row = motion_weight.judged(load("exact"), planner, 15)
    assert row["success_rate"] == 1.0
    assert row["transfers"] == pytest.approx(15 * row["mean_steps_success"], abs=1e-3)
    assert row["refused"] == 0
    assert row["straight_mm_an_episode"] < min(row["path_mm_an_episode"].values())
    assert row["path_mm_an_episode"]["tabulated"] == pytest.approx(row["path_mm_an_episode"]["planned"], rel=0.05)


def test_a_transfer_the_planner_refuses_has_no_length(planner):
    """The other arm does not park: it grasps where the second transfer is to end."""
    standing = copy(planner)
    standing.homes_rad = np.stack([planner.grasp_joints(0, "hold", np.zeros(2)), planner.homes_rad[1]])
    start, end = np.array([[200.0, -180.0]] * 2), np.array([[190.0, -100.0], [0.0, 0.0]])
    lengths, refused = motion_weight.planned_mm(standing, np.array([1, 1]), start, end)
    assert refused == 1
    assert lengths[0] > 80.0
    assert np.isnan(lengths[1])


def test_the_table_names_each_policy():
    row = {"success_rate": 0.5, "mean_steps_success": 3.0, "path_mm_an_episode": {"tabulated": 10.0, "planned": 11.0}}
    text = motion_weight.show([{"name": "one", **row, "straight_mm_an_episode": 9.0}])
    assert text.splitlines()[-1].split() == ["one", "50.00", "%", "3.000", "10", "11", "9"]
