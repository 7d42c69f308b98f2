"""The grid of places, what policies see of goals, and the optimum on the grid."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover.arrays import wrap
from marl_handover.baselines.dqn_grid import finishing_potential, goal_reach, grid_actions, grid_points, grid_transfers, seen_by_finishers
from marl_handover.errors import InvalidSetting
from marl_handover.learning.evaluation import random_problems
from marl_handover.task.observations import ARM_FIELDS, observe
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Outcome
from tests.symmetries import GROUP, mirror

layouts = pytest.mark.parametrize("layout", ["raw", "relative"])


@settings(max_examples=25)
@given(spacing=st.floats(6, 120), inset=st.floats(0.85, 1.0))
def test_the_grid_is_all_lattice_points_of_the_chart(paper, spacing, inset):
    cell = paper.with_inset(inset)
    points = grid_points(cell.chart, spacing)
    assert cell.reaches(points).all()
    lattice = points / spacing
    np.testing.assert_allclose(lattice, np.round(lattice), atol=1e-9)
    assert len(np.unique(np.round(lattice), axis=0)) == len(points)
    assert (abs(np.stack(cell.chart.from_table(points))) <= 1 + 1e-9).all()
    missing = [
        (x, y)
        for x in np.arange(-20, 21) * spacing
        for y in np.arange(-5, 6) * spacing
        if abs(x) < 0.999 * inset * cell.chart.x_max_mm and abs(y) < 0.999 * inset * cell.chart.y_max_mm(np.float64(x))
        if not (abs(points - [x, y]).max(-1) < 1e-6).any()
    ]
    assert not missing


def test_a_grid_of_one_place_is_named(paper):
    with pytest.raises(InvalidSetting, match=r"grid_mm.*143"):
        grid_points(paper.chart, 144.0)
    assert len(grid_points(paper.chart, 143.0)) == 3
    assert len(grid_points(paper.chart, 20.0)) == 41


@pytest.mark.parametrize("can_finish", [True, False])
def test_choices_are_every_arm_with_every_place_and_every_arm_that_finishes(paper, rules_of, can_finish):
    points = grid_points(paper.chart, 25.0)
    rules = rules_of(paper, "B" if can_finish else "A")
    command = rules.decode(grid_actions(paper.chart, points, can_finish))
    count = len(points)
    assert len(command.arm) == 2 * count + 2 * can_finish
    for arm in (0, 1):
        rows = slice(arm * count, (arm + 1) * count)
        assert (command.arm[rows] == arm).all()
        assert not command.final[rows].any()
        np.testing.assert_allclose(command.place_mm[rows], points, atol=1e-9)
    if can_finish:
        assert command.final[-2:].all()
        assert command.arm[-2:].tolist() == [0, 1]


@layouts
def test_what_finishers_see_is_the_same_in_numpy_and_torch_and_row_by_row(paper, rules_of, draw, layout):
    rules = rules_of(paper, "A")
    start, goal, previous, _ = draw(paper, 200, 1)
    vector = observe(rules, layout, start, goal, previous)
    seen, reach = seen_by_finishers(rules, layout, vector), goal_reach(rules, layout, vector)
    assert seen.shape == (200, 2, vector.shape[-1])
    np.testing.assert_array_equal(reach, paper.reaches(goal))
    np.testing.assert_allclose(seen_by_finishers(rules, layout, torch.tensor(vector)).numpy(), seen, atol=1e-9)
    np.testing.assert_array_equal(goal_reach(rules, layout, torch.tensor(vector)).numpy(), reach)
    for row in range(20):
        np.testing.assert_allclose(seen_by_finishers(rules, layout, vector[row]), seen[row], atol=1e-12)


def test_a_raw_goal_is_shown_as_the_finishing_arm_has_it(paper, rules_of, draw, assert_same_angle):
    rules = rules_of(paper, "A")
    start, goal, previous, _ = draw(paper, 1000, 2)
    vector = observe(rules, "raw", start, goal, previous)
    seen = seen_by_finishers(rules, "raw", vector)
    np.testing.assert_allclose(seen[..., :3], np.broadcast_to(vector[:, None, :3], seen[..., :3].shape))
    np.testing.assert_allclose(seen[..., 6], np.broadcast_to(vector[:, None, 6], seen.shape[:2]))
    square, yaw = paper.polar(goal)
    np.testing.assert_allclose(seen[..., 3] * paper.r_max_mm, np.sqrt(square))
    np.testing.assert_allclose(seen[..., 4] * math.pi, yaw)
    # What an arm leaves by finishing is how it holds the object against how it should hold it.
    held = start[:, 2:] - paper.gripper_yaw(paper.polar(start)[1])
    assert_same_angle(held - seen[..., 5] * math.pi, rules.finishing_error(start, goal), atol=1e-9)


def test_relative_finishers_see_one_problem_in_mirrored_frames(paper, rules_of, draw):
    rules, swap = rules_of(paper, "A"), mirror(y=True)
    start, goal, previous, _ = draw(paper, 300, 3)
    seen = seen_by_finishers(rules, "relative", observe(rules, "relative", start, goal, previous))
    image = seen_by_finishers(rules, "relative", observe(rules, "relative", swap.pose(start), swap.pose(goal), swap.arm(previous)))
    np.testing.assert_allclose(image, seen[:, ::-1], atol=1e-9)
    assert seen.shape[-1] == 2 * len(ARM_FIELDS)


def test_potential_is_the_share_of_half_a_turn_that_is_left(cell, rules_of, draw):
    rules = rules_of(cell, symmetry_order=2)
    start, goal, _, _ = draw(cell, 1000, 4)
    potential = finishing_potential(rules, start, goal)
    reach = cell.reaches(start) & cell.reaches(goal)
    np.testing.assert_array_equal(potential[~reach], -1)
    np.testing.assert_allclose(potential[reach], -abs(rules.finishing_error(start, goal))[reach] / math.pi)
    able = rules.can_finish(start, goal, 0.2)
    np.testing.assert_array_equal(able, potential >= -0.2 / math.pi)
    for symmetry in GROUP:
        image = finishing_potential(rules, symmetry.pose(start), symmetry.pose(goal))
        np.testing.assert_allclose(image[:, ::-1] if symmetry.swaps else image, potential, atol=1e-9)


def brute_force(rules, actions, start, goal, depth):
    """Fewest transfers by trying every sequence of choices through the rule book; 0 where ``depth`` is not enough."""
    poses, best = start[None], 0
    for transfers in range(1, depth + 1):
        count = len(poses)
        action = np.tile(actions, (count, 1))
        pose = np.repeat(poses, len(actions), 0)
        result = rules.step(pose, np.broadcast_to(goal, pose.shape), np.full(len(pose), -1), action)
        if (result.outcome == int(Outcome.SUCCESS)).any():
            return transfers
        poses = result.pose[~result.terminated]
    return best


@pytest.mark.parametrize(("spacing", "order"), [(70.0, 1), (100.0, 2), (55.0, 1)])
def test_grid_transfers_are_those_of_brute_force(paper, rules_of, draw, spacing, order):
    rules = rules_of(paper, epsilon_deg=12.0, symmetry_order=order)
    points = grid_points(paper.chart, spacing)
    start, goal, _, _ = draw(paper, 60, 5)
    found = grid_transfers(rules, points, start, goal)
    actions = grid_actions(paper.chart, points, True)
    expected = np.array([brute_force(rules, actions, *problem, 4) for problem in zip(start, goal, strict=True)])
    np.testing.assert_array_equal(np.where(found <= 4, found, 0), expected)
    assert len(set(expected)) >= 4, "problems of several lengths"


def test_no_grid_beats_the_exact_planner_and_20_mm_is_nearly_as_good(paper, rules_of):
    rules = rules_of(paper)
    problems = random_problems(rules, 500, 0)
    exact = ExactPlanner(rules).plan(*problems).transfers
    means = []
    for spacing in (100.0, 40.0, 20.0):
        found = grid_transfers(rules, grid_points(paper.chart, spacing), *problems)
        assert (found[found > 0] >= exact[found > 0]).all()
        means.append(found.mean())
        assert (found > 0).mean() > (0.9 if spacing == 100.0 else 0.999)
    assert means[2] < 1.02 * exact.mean()
    assert means[2] < means[1] < means[0]


def test_turns_wrap(paper, rules_of, draw):
    """A whole turn more or less of start or goal changes nothing."""
    rules = rules_of(paper)
    start, goal, _, _ = draw(paper, 100, 6)
    points = grid_points(paper.chart, 30.0)
    turned = start + [0, 0, 2 * math.pi], goal - [0, 0, 4 * math.pi]
    np.testing.assert_array_equal(grid_transfers(rules, points, *turned), grid_transfers(rules, points, start, goal))
    np.testing.assert_allclose(wrap(turned[0][:, 2]), wrap(start[:, 2]), atol=1e-9)
