"""The exact planner in random cells of 2 to 8 arms, with discs and without: nothing shorter exists, and every plan comes true."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest

from marl_handover.cell import layout_cell
from marl_handover.config import TaskConfig
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Rules
from tests.oracles.angle_sums import AngleSums, moved
from tests.oracles.layouts import layout_with_a_sliver, random_layout, wrapped

EPSILONS_DEG = (5.0, 1.0)
REACH_MM = 1e-3
PROBLEMS = 25
"""In one layout."""


def faults_of(layout, draw):
    """What is wrong with the plans for random problems in a layout, in words."""
    cell = layout_cell(layout.arms, layout.obstacles)
    said, sums = [], AngleSums(layout)
    for i, j in combinations(range(layout.count), 2):
        if sums.inner[i, j].any() and (i, j) not in cell.graph.edges:
            shared = layout.sample_shared(i, j, 100_000, draw)
            size = layout.margin(shared, (i, j)).min(-1).max(initial=0)
            said.append(f"arms {i} and {j} share places, up to {size} mm from an edge, and have no edge in the graph")
        if (i, j) in cell.graph.edges and not sums.outer[i, j].any():
            said.append(f"arms {i} and {j} have an edge in the graph and share nothing")
    epsilon_deg = float(draw.choice(EPSILONS_DEG))
    start, goal = layout.sample_problems(PROBLEMS, draw)
    rules = Rules(cell, TaskConfig(layout="raw", epsilon_deg=epsilon_deg))
    planner = ExactPlanner(rules)
    planned = np.asarray(planner.plan(start, goal).transfers)
    known, least = (sums.fewest(start, goal, rules.epsilon_rad, rules.config.max_steps, outer=outer) for outer in (False, True))
    for row in np.flatnonzero((known > 0) & ((planned == 0) | (planned > known))):
        said.append(
            f"{known[row]} transfers are enough, planned are {planned[row]}: {start[row].tolist()} to {goal[row].tolist()} at {epsilon_deg}"
        )
    for row in np.flatnonzero((planned > 0) & ((least == 0) | (planned < least))):
        said.append(f"{planned[row]} transfers cannot be enough, {least[row]} are needed: {start[row].tolist()} to {goal[row].tolist()}")
    return said + faults_in_execution(layout, rules, planner, start, goal, planned)


def faults_in_execution(layout, rules, planner, start, goal, planned):
    """Play the plans by the definitions: theta' = theta + psi(p') - psi(p)."""
    said, pose, rows = [], start.copy(), np.arange(len(start))
    for step in range(int(planned.max(initial=0))):
        running = planned > step
        command = rules.decode(planner.act(pose, goal))
        final, arm = np.asarray(command.final, bool), np.asarray(command.arm, int)
        place = np.where(final[:, None], goal[:, :2], np.nan_to_num(np.asarray(command.place_mm, float), nan=1e9))
        receiver = np.asarray(command.receiver, int)
        margin = np.minimum(layout.margin(pose)[rows, arm], layout.margin(place)[rows, arm])
        margin = np.where(final, margin, np.minimum(margin, layout.margin(place)[rows, receiver]))
        pose = np.where(running[:, None], moved(layout, pose, arm, place), pose)
        error = np.abs(wrapped(pose[:, 2] - goal[:, 2]))
        for row in np.flatnonzero(running):
            words = f"step {step + 1} of {planned[row]}, arm {arm[row]}: {start[row].tolist()} to {goal[row].tolist()}: "
            if final[row] != (step + 1 == planned[row]):
                said.append(words + ("is final" if final[row] else "is not final"))
            if margin[row] < -REACH_MM:
                said.append(words + f"out of reach by {-margin[row]} mm")
            if not final[row] and arm[row] == receiver[row]:
                said.append(words + "it hands over to itself")
            if final[row] and error[row] > rules.epsilon_rad + 1e-8:
                said.append(words + f"leaves {math.degrees(error[row])} deg")
    return said


@pytest.mark.parametrize(
    ("count", "mixed", "close", "discs"),
    [
        (2, 1, 1, 2),
        (2, 0, 0, 1),
        (2, 1, 0, 4),
        (3, 0, 1, 3),
        (3, 1, 1, 1),
        (4, 0, 0, 1),
        (4, 1, 1, 0),
        (6, 0, 1, 0),
        (6, 1, 0, 4),
        (8, 1, 1, 2),
    ],
)
def test_nothing_shorter_is_found_and_every_plan_comes_true(count, mixed, close, discs):
    judge(1, count, mixed, close, discs, 0)


SLIVER_MM = np.array(
    [(367.00045913304876, 381.7194980734307), (367.0005074763817, 381.7195869444416), (367.00043380843704, 381.7195529444902)]
)
"""Corners of the triangle of :func:`layout_with_a_sliver`."""


def test_a_plan_through_a_place_narrower_than_a_micrometre_is_none():
    """Arms 0, 2 and 1 turn the block as it has to be within 0.01 degrees, by plane geometry; but the first place is 16 nm inside."""
    layout = layout_with_a_sliver()
    start = np.array([[547.0192711551852, 139.31583000350327, 0.7086563385119176]])
    goal = np.array([[477.78644788515464, 523.4686260235636, -0.3067902217114207]])
    middle, ample = SLIVER_MM.mean(0, keepdims=True), np.array([[260.84865971846625, 178.56259474102598]])
    assert 1.6e-5 < layout.margin(middle, (0, 2)).min() < 2e-5
    assert layout.margin(ample, (1, 2)).min() > 15
    pose = start
    for arm, place in ((0, middle), (2, ample), (1, goal)):
        pose = moved(layout, pose, np.array([arm]), place[:, :2])
    assert abs(wrapped(pose[0, 2] - goal[0, 2])) < math.radians(0.01)
    rules = Rules(layout_cell(layout.arms, layout.obstacles), TaskConfig(layout="raw"))
    assert ExactPlanner(rules).plan(start, goal).transfers == [5]
    sums = AngleSums(layout)
    assert [sums.fewest(start, goal, rules.epsilon_rad, outer=outer).tolist() for outer in (False, True)] == [[5], [3]]


@pytest.mark.parametrize("less_mm", [0.0, 1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.1, 1.0])
def test_nothing_shorter_is_found_where_a_place_hardly_is_one(less_mm):
    said = faults_of(layout_with_a_sliver(less_mm), np.random.default_rng(1))
    assert not said


@pytest.mark.slow
@pytest.mark.parametrize("discs", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("close", [0, 1], ids=["apart", "close"])
@pytest.mark.parametrize("mixed", [0, 1], ids=["equal", "mixed"])
@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 8])
def test_nothing_shorter_is_found_in_many_layouts(count, mixed, close, discs):
    judge(20, count, mixed, close, discs, 1)


def judge(layouts, count, mixed, close, discs, seed):
    """Random layouts of the kind, 25 problems in each."""
    draw = np.random.default_rng([count, mixed, close, discs, seed])
    for number in range(layouts):
        layout = random_layout(draw, count, mixed=bool(mixed), close=bool(close), discs=discs)
        said = faults_of(layout, draw)
        assert not said, (number, said, layout)
