"""The exact planner solves everything, and nothing shorter does: the latter by brute force that shares no code with it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from marl_handover.cell import LEFT, RIGHT, load_cell
from marl_handover.cell.arm import mirrored_pair
from marl_handover.errors import InvalidSetting
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome
from tests.symmetries import GROUP, flips_x

MANY, SOME = 100_000, 1000


def problems(cell, count, seed=0):
    return tuple(array.numpy() for array in sample_problems(cell, count, torch.Generator().manual_seed(seed)))


def distance_on_circle(values, sorted_angles):
    """Distance of ``values`` (n,) to the nearest of ``sorted_angles`` (m,), all in [0, 2 pi), on the circle."""
    ring = np.concatenate([sorted_angles[-1:] - 2 * math.pi, sorted_angles, sorted_angles[:1] + 2 * math.pi])
    after = np.clip(np.searchsorted(ring, values), 1, len(ring) - 1)
    return np.minimum(np.abs(ring[after] - values), np.abs(values - ring[after - 1]))


def psi(points, side, cell):
    """World direction of points from the base at y = side * d / 2."""
    return np.arctan2(points[..., 1] - side * cell.config.base_distance_mm / 2, points[..., 0])


def in_sector(points, side, cell):
    """Definition of an arm's reach, without its tolerance."""
    dx, dy = points[..., 0], points[..., 1] - side * cell.config.base_distance_mm / 2
    radius, yaw = np.hypot(dx, dy), np.arctan2(side * dx, -side * dy)
    return (radius >= cell.r_min_mm) & (radius <= cell.r_max_mm) & (yaw >= cell.yaw_rad[0]) & (yaw <= cell.yaw_rad[1])


def brute_force(cell, start, goal, epsilon_rad):
    """Fewest transfers found among dense hand-overs: 1, 2, 3, or 4 where none of these does. Plain numpy."""
    extent = np.array([cell.r_max_mm, cell.config.base_distance_mm / 2])
    grid = np.stack(np.meshgrid(*(np.linspace(-e, e, 301) for e in extent), indexing="ij"), -1).reshape(-1, 2)
    shared = grid[in_sector(grid, 1, cell) & in_sector(grid, -1, cell)]
    from_left = np.sort(np.remainder(psi(shared, 1, cell) - psi(shared, -1, cell), 2 * math.pi))
    from_right = np.sort(np.remainder(-from_left, 2 * math.pi))
    some = from_left[:: max(1, len(from_left) // 1200)]
    some = np.concatenate([some, from_left[-1:]])
    pairs = np.sort(np.remainder(some[:, None] - some[None, :], 2 * math.pi).ravel())
    best = np.full(len(start), 4)
    for transfers, sums in ((3, {1: pairs, -1: pairs}), (2, {1: from_left, -1: from_right}), (1, {1: np.zeros(1), -1: np.zeros(1)})):
        for first in (1, -1):
            last = first if transfers % 2 else -first
            needed = goal[:, 2] - start[:, 2] + psi(start, first, cell) - psi(goal, last, cell)
            miss = distance_on_circle(np.remainder(needed, 2 * math.pi), sums[first])
            found = (miss <= epsilon_rad) & in_sector(start, first, cell) & in_sector(goal, last, cell)
            best[found] = transfers
    return best


@pytest.mark.parametrize("epsilon_deg", [1.0, 5.0])
def test_no_shorter_plan_exists_in_plain_geometry(cell, rules_of, epsilon_deg):
    start, goal = problems(cell, 20 * SOME, 1)
    planned = ExactPlanner(rules_of(cell, epsilon_deg=epsilon_deg)).plan(start, goal).transfers
    found = brute_force(cell, start, goal, math.radians(epsilon_deg))
    assert set(np.unique(found)) == {1, 2, 3, 4}
    assert planned.max() > 3
    planned = np.minimum(planned, 4)
    assert (planned <= found).all()
    assert np.mean(planned == found) > 0.995  # the brute force itself misses what lies between its points


def test_no_shorter_plan_exists_under_the_rules(paper, rules_of):
    """One and two transfers tried out in full: every arm, a grid of hand-overs, every final arm."""
    rules = rules_of(paper)
    start, goal = problems(paper, SOME, 2)
    planned = ExactPlanner(rules).plan(start, goal).transfers
    none = np.full(SOME, -1)
    one = np.zeros(SOME, bool)
    for arm in (-1.0, 1.0):
        one |= rules.step(start, goal, none, np.tile([1.0, arm, 0, 0], (SOME, 1))).outcome == Outcome.SUCCESS
    np.testing.assert_array_equal(one, planned == 1)
    two = np.zeros(SOME, bool)
    for alpha in np.linspace(-1, 1, 41):
        for beta in (-1.0, 0.0, 1.0):
            for arm in (-1.0, 1.0):
                middle = rules.step(start, goal, none, np.tile([-1.0, arm, alpha, beta], (SOME, 1)))
                last = rules.step(middle.pose, goal, middle.previous_arm, np.tile([1.0, -arm, 0, 0], (SOME, 1)))
                two |= middle.feasible & (last.outcome == Outcome.SUCCESS)
    assert (planned[two] <= 2).all()
    assert two[planned == 2].mean() > 0.98  # hand-overs on a grid find all but the tightest


@pytest.mark.parametrize("order", [1, 2])
def test_every_plan_succeeds_open_loop(cell, rules_of, order):
    rules = rules_of(cell, symmetry_order=order)
    planner = ExactPlanner(rules)
    start, goal = problems(cell, MANY, 3)
    plan = planner.plan(start, goal)
    assert (plan.transfers >= 1).all()
    pose, previous = start, np.full(MANY, -1)
    solved = np.zeros(MANY, bool)
    for index in range(plan.transfers.max()):
        last = plan.transfers == index + 1
        alpha, beta = cell.chart.from_table(planner.hand_over_mm(plan, index))
        arm = np.where((plan.first_arm + index) % 2 == RIGHT, 1.0, -1.0)
        result = rules.step(pose, goal, previous, np.stack([np.where(last, 1.0, -1.0), arm, alpha, beta], -1))
        running = plan.transfers > index
        expected = np.where(last, Outcome.SUCCESS, Outcome.NONE)
        np.testing.assert_array_equal(result.outcome[running], expected[running])
        error = rules.orientation_error(result.pose[:, 2], goal[:, 2])
        np.testing.assert_allclose(np.abs(error)[last], np.abs(plan.error_rad)[last], atol=1e-9)
        solved |= last & (result.outcome == Outcome.SUCCESS)
        pose, previous = result.pose, result.previous_arm
    assert solved.all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("inset", [1.0, 0.95])
def test_every_problem_is_solved_in_closed_loop(paper, rules_of, dtype, inset):
    """Re-planning at every step takes exactly the planned number of steps."""
    rules = rules_of(paper.with_inset(inset))
    planner = ExactPlanner(rules)
    start, goal = sample_problems(rules.cell, MANY, torch.Generator().manual_seed(4), dtype)
    planned = planner.plan(start, goal).transfers
    pose, previous, steps = start, torch.full((MANY,), -1), torch.zeros(MANY, dtype=torch.int64)
    solved = torch.zeros(MANY, dtype=torch.bool)
    for _ in range(planned.max()):
        result = rules.step(pose, goal, previous, planner.act(pose, goal))
        assert not (result.terminated & ~solved & (result.outcome != Outcome.SUCCESS)).any()
        steps += ~solved
        solved = solved | (result.outcome == Outcome.SUCCESS)
        pose, previous = torch.where(solved[:, None], pose, result.pose), result.previous_arm
    assert solved.all()
    assert torch.equal(steps, planned)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_mean_transfers_of_the_paper_cell(paper, rules_of, dtype):
    start, goal = sample_problems(paper, MANY, torch.Generator().manual_seed(5), dtype)
    assert ExactPlanner(rules_of(paper)).plan(start, goal).transfers.double().mean() == pytest.approx(2.94, abs=0.01)


def test_a_smaller_epsilon_never_shortens(cell, rules_of):
    planner = ExactPlanner(rules_of(cell))
    start, goal = problems(cell, 20_000, 6)
    counts = [planner.plan(start, goal, math.radians(epsilon)).transfers for epsilon in (20.0, 5.0, 2.0, 1.0, 0.1)]
    for loose, tight in pairwise(counts):
        assert (tight >= loose).all()
        assert tight.sum() > loose.sum()


def test_a_more_symmetric_block_never_lengthens(cell, rules_of):
    start, goal = problems(cell, 20_000, 7)
    counts = [ExactPlanner(rules_of(cell, symmetry_order=order)).plan(start, goal).transfers for order in (1, 2, 4, 8)]
    for plain, symmetric in pairwise(counts):
        assert (symmetric <= plain).all()
        assert symmetric.sum() < plain.sum()


def test_a_smaller_chart_never_shortens(paper, rules_of):
    start, goal = problems(paper, 20_000, 8)
    counts = [ExactPlanner(rules_of(paper.with_inset(inset))).plan(start, goal).transfers for inset in (1.0, 0.9, 0.5)]
    for whole, part in pairwise(counts):
        assert (part >= whole).all()
        assert part.sum() > whole.sum()


@pytest.mark.parametrize("element", GROUP)
def test_plans_are_symmetric(element, cell, rules_of):
    planner = ExactPlanner(rules_of(cell))
    start, goal = problems(cell, 20_000, 9)
    plan, image = planner.plan(start, goal), planner.plan(element.pose(start), element.pose(goal))
    np.testing.assert_array_equal(image.transfers, plan.transfers)
    np.testing.assert_allclose(np.abs(image.error_rad), np.abs(plan.error_rad), atol=1e-9)
    # Plans of no slack at all may tie; none of these do.
    np.testing.assert_array_equal(image.first_arm, element.arm(plan.first_arm))
    longer = plan.transfers > 1
    place, place_image = planner.hand_over_mm(plan, 0)[longer], planner.hand_over_mm(image, 0)[longer]
    np.testing.assert_allclose(place_image, place * (-1 if flips_x(element) else 1, 1), atol=1e-6)


def test_reversed_problems_are_as_long(cell, rules_of):
    """Every transfer can be undone, so that the way back is as long as the way there."""
    planner = ExactPlanner(rules_of(cell))
    start, goal = problems(cell, 20_000, 10)
    np.testing.assert_array_equal(planner.plan(goal, start).transfers, planner.plan(start, goal).transfers)


def test_numpy_equals_torch(cell, rules_of):
    planner = ExactPlanner(rules_of(cell, symmetry_order=2))
    start, goal = problems(cell, 5000, 11)
    ours, theirs = planner.plan(start, goal), planner.plan(torch.as_tensor(start), torch.as_tensor(goal))
    for name in ours._fields:
        np.testing.assert_allclose(getattr(theirs, name).numpy(), getattr(ours, name), atol=1e-9, err_msg=name)
    np.testing.assert_allclose(planner.act(torch.as_tensor(start), torch.as_tensor(goal)).numpy(), planner.act(start, goal), atol=1e-9)


def test_a_single_problem_equals_its_row(paper, rules_of):
    planner = ExactPlanner(rules_of(paper))
    start, goal = problems(paper, 50, 12)
    batch = planner.plan(start, goal)
    for row in range(50):
        single = planner.plan(start[row], goal[row])
        for name in batch._fields:
            assert getattr(single, name) == pytest.approx(getattr(batch, name)[row], abs=1e-12)


def test_max_steps_bounds_the_plan(paper, rules_of):
    """Zero transfers say that there is no plan that short."""
    start, goal = problems(paper, 20_000, 13)
    free, bound = (ExactPlanner(rules_of(paper, max_steps=steps)).plan(start, goal).transfers for steps in (20, 2))
    np.testing.assert_array_equal(bound, np.where(free <= 2, free, 0))


def test_intervals_by_hand(paper, rules_of):
    """gamma fills [gamma_min, 2 pi - gamma_min]; a sum takes + from L to R and - from R to L."""
    planner = ExactPlanner(rules_of(paper))
    low = 2 * math.atan2(180, math.sqrt(230**2 - 180**2))
    high = 2 * math.pi - low
    assert planner.interval((LEFT,)) == (0, 0)
    assert planner.interval((LEFT, RIGHT)) == pytest.approx((low, high))
    assert planner.interval((RIGHT, LEFT)) == pytest.approx((-high, -low))
    assert planner.interval((LEFT, RIGHT, LEFT)) == planner.interval((RIGHT, LEFT, RIGHT)) == pytest.approx((low - high, high - low))
    assert planner.interval((LEFT, RIGHT, LEFT, RIGHT)) == pytest.approx((2 * low - high, 2 * high - low))


def test_charts_for_which_it_would_not_be_exact_are_refused(rules_of):
    """A shared space that reaches behind the bases has smaller hand-over angles than at its tips; the angle chart has them all."""
    cell = load_cell("al5a")
    arms = [replace(arm, base=base, r_min_mm=100.0) for arm, base in zip(cell.arms, mirrored_pair(250.0), strict=True)]
    wide = replace(cell, arms=tuple(arms), config=replace(cell.config, base_distance_mm=250.0, chart="paper"))
    with pytest.raises(InvalidSetting, match=r"base_distance_mm = 250\.0: must be at least 296\.6"):
        ExactPlanner(rules_of(wide))
    assert ExactPlanner(rules_of(replace(wide, config=replace(wide.config, chart=None)))).walks
