"""The exact planner on pairs of any two arms: every plan comes true, and plain geometry finds no shorter one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from marl_handover.cell import Cell
from marl_handover.config import CellConfig, TaskConfig
from marl_handover.errors import NoSharedSpace
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules
from tests.cell.test_angle_chart import pair, sectors

COUNT = 1500
SO101 = (269.0, 165.0, 12.0, 1.9, 1.9, 0.0)
AL5A = (150.0, 80.0, 0.0, math.pi / 2, math.pi / 2, 0.0)


def psi(arm, points):
    """World direction of an arm's gripper at points (..., 2)."""
    dx, dy = points[..., 0] - arm.base.x_mm, points[..., 1] - arm.base.y_mm
    return np.arctan2(dy, dx) - np.arcsin(arm.lateral_mm / np.maximum(np.hypot(dx, dy), 50.0))


def in_sector(arm, points):
    """Definition of an arm's reach, without its tolerance."""
    radius = np.hypot(points[..., 0] - arm.base.x_mm, points[..., 1] - arm.base.y_mm)
    yaw = np.remainder(psi(arm, points) - arm.base.facing_rad + math.pi, 2 * math.pi) - math.pi
    return (radius >= arm.r_min_mm) & (radius <= arm.r_max_mm) & (yaw >= arm.yaw_rad[0]) & (yaw <= arm.yaw_rad[1])


def distance_on_circle(values, angles):
    """Distance of ``values`` (n,) to the nearest of ``angles`` (m,) on the circle."""
    ring = np.sort(np.remainder(angles, 2 * math.pi))
    ring = np.concatenate([ring[-1:] - 2 * math.pi, ring, ring[:1] + 2 * math.pi])
    values = np.remainder(values, 2 * math.pi)
    after = np.clip(np.searchsorted(ring, values), 1, len(ring) - 1)
    return np.minimum(np.abs(ring[after] - values), np.abs(values - ring[after - 1]))


def brute_force(arms, start, goal, epsilon_rad):
    """Fewest transfers found, breadth first, among dense hand-overs: 1, 2, 3, or 4 where none of these does. Plain numpy."""
    radius, yaw = np.meshgrid(np.linspace(arms[0].r_min_mm, arms[0].r_max_mm, 301), np.linspace(-math.pi, math.pi, 1201))
    base = arms[0].base.position_mm
    grid = base + np.stack([radius * np.cos(yaw), radius * np.sin(yaw)], -1).reshape(-1, 2)
    shared = grid[in_sector(arms[0], grid) & in_sector(arms[1], grid)]
    assume(len(shared) > 300)
    angles = np.sort(np.remainder(psi(arms[0], shared) - psi(arms[1], shared), 2 * math.pi))
    bins = np.floor(angles / 0.005)  # the first and the last angle of each 0.3 degrees: ends of intervals are among them
    some = angles[np.r_[True, bins[1:] != bins[:-1]] | np.r_[bins[1:] != bins[:-1], True]]
    sums = {1: {0: np.zeros(1), 1: np.zeros(1)}, 2: {0: angles, 1: -angles}}
    sums[3] = dict.fromkeys((0, 1), (some[:, None] - some[None, :]).ravel())
    best = np.full(len(start), 4)
    for transfers in (3, 2, 1):
        for first in (0, 1):
            last = first if transfers % 2 else 1 - first
            needed = goal[:, 2] - start[:, 2] + psi(arms[first], start) - psi(arms[last], goal)
            miss = distance_on_circle(needed, sums[transfers][first])
            best[(miss <= epsilon_rad) & in_sector(arms[first], start) & in_sector(arms[last], goal)] = transfers
    return best


def pair_rules(one, other, share, turn, **task) -> Rules:
    try:
        return Rules(Cell(pair(one, other, share, turn), replace(CellConfig(), chart="angle", arms=[])), TaskConfig(layout="raw", **task))
    except NoSharedSpace:
        assume(False)
        raise


@settings(max_examples=25, suppress_health_check=list(HealthCheck))
@given(sectors, sectors, st.floats(0.5, 0.95), st.floats(-3, 3), st.sampled_from([4.0, 8.0]))
@example(SO101, AL5A, 0.78, -math.pi / 2, 5.0)
@example(AL5A, AL5A, 0.7, -math.pi / 2, 5.0)  # in two pieces
@example(AL5A, SO101, 0.9, 0.5, 8.0)
def test_no_shorter_plan_exists_in_plain_geometry(one, other, share, turn, epsilon_deg):
    rules = pair_rules(one, other, share, turn, epsilon_deg=epsilon_deg)
    start, goal = (part.numpy() for part in sample_problems(rules.cell, COUNT, torch.Generator().manual_seed(1)))
    planner, epsilon_rad = ExactPlanner(rules), math.radians(epsilon_deg)
    found = brute_force(rules.cell.arms, start, goal, epsilon_rad)
    planned, careful = (planner.plan(start, goal, epsilon).transfers for epsilon in (epsilon_rad, epsilon_rad / 2))
    planned, careful = (np.where(count == 0, 4, np.minimum(count, 4)) for count in (planned, careful))
    assert (planned <= found).all()
    assert np.mean(found <= careful) > 0.999  # half of epsilon is more than what lies between the points of the brute force


@settings(max_examples=25, suppress_health_check=list(HealthCheck))
@given(sectors, sectors, st.floats(0.5, 0.95), st.floats(-3, 3), st.sampled_from([1, 2, 3]))
@example(SO101, AL5A, 0.78, -math.pi / 2, 1)
@example(AL5A, AL5A, 0.7, -math.pi / 2, 1)
def test_every_plan_succeeds_in_closed_loop(one, other, share, turn, order):
    rules = pair_rules(one, other, share, turn, symmetry_order=order)
    planner = ExactPlanner(rules)
    pose, goal = (part.numpy() for part in sample_problems(rules.cell, COUNT, torch.Generator().manual_seed(2)))
    planned = planner.plan(pose, goal).transfers
    pose, goal, left = pose[planned > 0], goal[planned > 0], planned[planned > 0]
    previous = np.full(len(pose), -1)
    for _ in range(int(left.max(initial=0))):
        result = rules.step(pose, goal, previous, planner.act(pose, goal))
        assert result.feasible.all()
        assert (result.outcome[left == 1] == Outcome.SUCCESS).all()
        pose, goal, previous, left = (part[left > 1] for part in (result.pose, goal, result.previous_arm, left))
        left = left - 1
        assert (planner.plan(pose, goal).transfers == left).all()
