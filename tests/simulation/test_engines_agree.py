"""The two engines against each other: the same transfers put the block to the same places."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.cell.build import build_cell, cell_config
from marl_handover.config import TaskConfig
from marl_handover.envs.backends import make_backend
from marl_handover.motion.planner import MotionPlanner

USUALLY, AT_MOST = (0.5, 0.5), (2.0, 2.0)
"""How far they may be apart, in mm and degrees: half of the transfers, and the worst, half a turn at the outer edge of the ring."""


def placed(name, planner, problems):
    """Poses (n, 3) after transfers from ``problems``: arm, pick and place."""
    backend = make_backend(name, planner.model, TaskConfig(), planner.motion)
    try:
        poses = []
        for arm, pick, place in problems:
            backend.reset(np.array([*pick, 0.4]), 0)
            paths = planner.plan_paths(arm, pick, place, planner.homes_rad[arm], planner.others_home_rad(arm)).paths
            done = backend.execute(arm, paths)
            assert done.refusal is None, name
            poses.append(done.pose)
        return np.array(poses)
    finally:
        backend.close()


def drawn(model, count, seed):
    """Transfers between places all over the rings."""
    random, problems = np.random.default_rng(seed), []
    for number in range(count):
        arm = number % model.cell.num_arms
        ring = model.cell.arms[arm]
        radii, yaws = random.uniform(ring.r_min_mm, ring.r_max_mm, 2), 0.97 * random.uniform(*ring.yaw_rad, 2)
        problems.append((arm, *ring.at(radii, yaws)))
    return problems


def apart(one, other):
    """How far poses (n, 3) are apart: mm and degrees (n,)."""
    turned = [abs(math.degrees(math.remainder(angle, 2 * math.pi))) for angle in one[:, 2] - other[:, 2]]
    return np.hypot(*(one - other)[:, :2].T), np.array(turned)


@pytest.mark.parametrize("robot", ["al5a", "so101", "px100"])
def test_two_engines_put_the_block_to_the_same_places(robot):
    for package in ("pybullet", "mujoco"):
        pytest.importorskip(package)
    model = build_cell(cell_config(robot))
    planner, problems = MotionPlanner(model), drawn(model, 6, 5)
    away_mm, turned_deg = apart(*(placed(name, planner, problems) for name in ("bullet", "mujoco")))
    assert np.median(away_mm) < USUALLY[0]
    assert np.median(turned_deg) < USUALLY[1]
    assert max(away_mm) < AT_MOST[0]
    assert max(turned_deg) < AT_MOST[1]
