"""The rewards and outcomes of the method's page, by examples computed by hand on the paper's cell.

Bases at (0, +-180) mm. From the middle of the table, where the left arm has yaw 0, to (200, 180), where it has +90 degrees, the object
turns by +90 degrees; so it does with the right arm from the middle to (-200, -180).
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.config import NoiseConfig, TaskConfig
from marl_handover.errors import InvalidSetting, UnknownChoice
from marl_handover.task.rules import Outcome

QUARTER = math.pi / 2
MIDDLE = (0.0, 0.0)
LEFT_END, RIGHT_END = (200.0, 180.0), (-200.0, -180.0)
L, R, PLACE, FINAL = -1.0, 1.0, -1.0, 1.0
NOISY = NoiseConfig(position_mm=1.0, yaw_deg=1.0)


def pose(position, theta=0.0):
    return np.array([*position, theta])


def step(rules, start, goal, arm, final=PLACE, previous=-1, **keywords):
    """One command; a placement goes to the middle of the table."""
    return rules.step(start, goal, np.int64(previous), np.array([final, arm, 0.0, 0.0]), **keywords)


@pytest.mark.parametrize("off_deg", [-4.9, 0.0, 4.9])
def test_b_success(paper, rules_of, off_deg):
    result = step(rules_of(paper), pose(MIDDLE), pose(LEFT_END, QUARTER + math.radians(off_deg)), L, FINAL)
    assert (result.reward, result.terminated, result.outcome) == (20, True, Outcome.SUCCESS)
    np.testing.assert_allclose(result.pose, pose(LEFT_END, QUARTER), atol=1e-12)
    assert (result.previous_arm, result.transfers, result.feasible) == (0, 1, True)


@pytest.mark.parametrize("off_deg", [-5.1, 5.1, 180.0])
def test_b_wrong_orientation(paper, rules_of, off_deg):
    result = step(rules_of(paper), pose(MIDDLE), pose(LEFT_END, QUARTER + math.radians(off_deg)), L, FINAL)
    assert (result.reward, result.terminated, result.outcome) == (-30, True, Outcome.WRONG_ORIENTATION)
    np.testing.assert_allclose(result.pose, pose(LEFT_END, QUARTER), atol=1e-12)


def test_b_goal_out_of_that_arms_reach(paper, rules_of):
    result = step(rules_of(paper), pose(MIDDLE, 0.5), pose(LEFT_END, QUARTER), R, FINAL, previous=0)
    assert (result.reward, result.terminated, result.outcome) == (-30, True, Outcome.WRONG_POSITION)
    assert (result.feasible, result.previous_arm) == (False, 0)
    np.testing.assert_array_equal(result.pose, pose(MIDDLE, 0.5))


@pytest.mark.parametrize("final", [PLACE, FINAL])
def test_b_pick_up_out_of_reach(paper, rules_of, final):
    result = step(rules_of(paper), pose(LEFT_END, 0.5), pose(RIGHT_END), R, final)
    assert (result.reward, result.terminated, result.outcome) == (-30, True, Outcome.WRONG_POSITION)
    assert not result.feasible
    np.testing.assert_array_equal(result.pose, pose(LEFT_END, 0.5))


def test_b_a_placement_goes_on(paper, rules_of):
    result = step(rules_of(paper), pose(LEFT_END, 0.5), pose(RIGHT_END), L)
    assert (result.reward, result.terminated, result.outcome) == (-1, False, Outcome.NONE)
    np.testing.assert_allclose(result.pose, pose(MIDDLE, 0.5 - QUARTER), atol=1e-12)
    assert (result.previous_arm, result.external_arm, result.transfers) == (0, -1, 1)


def test_b_two_arms_solve_what_one_cannot(paper, rules_of):
    rules, goal = rules_of(paper), pose(RIGHT_END, QUARTER)
    first = step(rules, pose(LEFT_END, QUARTER), goal, L)
    second = step(rules, first.pose, goal, R, FINAL, previous=first.previous_arm)
    assert (first.reward, second.reward, second.outcome) == (-1, 20, Outcome.SUCCESS)
    assert second.previous_arm == 1


def test_a_finishes_externally_after_the_placement(paper, rules_of):
    result = step(rules_of(paper, "A"), pose(LEFT_END, QUARTER), pose(RIGHT_END, QUARTER), L)
    assert (result.reward, result.terminated, result.outcome) == (0, True, Outcome.SUCCESS)
    assert (result.transfers, result.external_arm, result.previous_arm) == (2, 1, 1)
    np.testing.assert_allclose(result.placed, pose(MIDDLE), atol=1e-12)
    np.testing.assert_allclose(result.pose, pose(RIGHT_END, QUARTER), atol=1e-12)


@pytest.mark.parametrize(("start", "goal", "arm"), [(LEFT_END, RIGHT_END, L), (LEFT_END, RIGHT_END, R)])
def test_a_goes_on_where_no_arm_can_finish(paper, rules_of, start, goal, arm):
    """A goal turned by half a turn; and a command that the arm refuses."""
    result = step(rules_of(paper, "A"), pose(start, QUARTER), pose(goal, -QUARTER), arm)
    assert (result.reward, result.terminated, result.outcome) == (-1, False, Outcome.NONE)
    assert (result.transfers, result.external_arm, bool(result.feasible)) == (1, -1, arm == L)


def test_a_solved_at_the_start_ignores_the_action(paper, rules_of):
    rules = rules_of(paper, "A")
    goal = pose(LEFT_END, QUARTER)
    actions = np.concatenate([np.random.default_rng(0).uniform(-1, 1, (60, 4)), [[1, 1, 1, 1], [-1, -1, -1, -1]]])
    for action in actions:  # R could not even reach the goal
        result = rules.step(pose(MIDDLE), goal, np.int64(-1), action, transfers_left=np.int64(20))
        assert (result.reward, result.terminated, result.outcome) == (0, True, Outcome.SUCCESS)
        assert (result.transfers, result.external_arm, result.previous_arm) == (1, 0, 0)
        np.testing.assert_allclose(result.placed, pose(MIDDLE))
        np.testing.assert_allclose(result.pose, goal, atol=1e-12)


@pytest.mark.parametrize(("left", "transfers"), [(1, 1), (2, 2)])
def test_a_needs_room_for_the_external_transfer(paper, rules_of, left, transfers):
    result = step(rules_of(paper, "A"), pose(LEFT_END, QUARTER), pose(RIGHT_END, QUARTER), L, transfers_left=np.int64(left))
    assert (result.transfers, bool(result.terminated), result.reward) == (transfers, left == 2, 0 if left == 2 else -1)
    assert result.outcome == (Outcome.SUCCESS if left == 2 else Outcome.NONE)
    if left == 1:
        np.testing.assert_allclose(result.pose, pose(MIDDLE), atol=1e-12)


def test_a_solved_at_the_start_needs_room_for_one_only(paper, rules_of):
    result = step(rules_of(paper, "A"), pose(MIDDLE), pose(LEFT_END, QUARTER), R, transfers_left=np.int64(1))
    assert (result.transfers, result.outcome) == (1, Outcome.SUCCESS)


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize(
    ("order", "turned_deg", "solved"), [(1, 90, False), (2, 180, True), (2, 90, False), (4, 90, True), (4, 45, False), (3, 240, True)]
)
def test_symmetric_blocks(paper, rules_of, architecture, order, turned_deg, solved):
    """A block of order k looks the same when turned by 360 / k degrees."""
    goal = pose(LEFT_END, QUARTER + math.radians(turned_deg))
    result = step(rules_of(paper, architecture, symmetry_order=order), pose(MIDDLE), goal, L, FINAL)
    assert (result.outcome == Outcome.SUCCESS) == solved


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_orientation_error_wraps(paper, rules_of, architecture):
    """A degree on either side of half a turn is two degrees, not 358."""
    start = pose(MIDDLE, QUARTER - math.radians(1))  # arrives at 179 degrees
    assert step(rules_of(paper, architecture), start, pose(LEFT_END, math.radians(-179)), L, FINAL).outcome == Outcome.SUCCESS
    assert rules_of(paper).orientation_error(math.radians(179), math.radians(-179)) == pytest.approx(math.radians(-2))


def test_motion_weight_subtracts_the_cost(paper, rules_of):
    """reward -= weight x cost [mm] / 100; the cost sees the cell, the arm and both ends, and nothing is paid for nothing."""

    def cost(cell, arm, start_mm, end_mm):
        assert cell is paper
        return 100.0 * (arm + 1) + abs(end_mm - start_mm).sum(-1)

    rules = rules_of(paper, motion_weight=0.5, motion_cost=cost)
    left = step(rules, pose(LEFT_END), pose(RIGHT_END), L)
    right = step(rules, pose(RIGHT_END), pose(LEFT_END), R)
    final = step(rules, pose(MIDDLE), pose(LEFT_END, QUARTER), L, FINAL)
    assert (left.reward, right.reward) == (pytest.approx(-1 - 0.5 * 4.8), pytest.approx(-1 - 0.5 * 5.8))
    assert final.reward == pytest.approx(20 - 0.5 * 4.8)
    assert step(
        rules_of(paper, "A", motion_weight=0.5, motion_cost=cost), pose(LEFT_END), pose(RIGHT_END, QUARTER), L
    ).reward == pytest.approx(-3.4)


def test_the_default_motion_cost_is_the_straight_line(paper, rules_of):
    result = step(rules_of(paper, motion_weight=2.0), pose(LEFT_END), pose(RIGHT_END), L)
    assert result.reward == pytest.approx(-1 - 2 * math.hypot(200, 180) / 100)


def test_noise_displaces_what_is_placed_but_nothing_that_was_refused(paper, rules_of):
    rules, noise = rules_of(paper, noise=NOISY), np.array([1.0, -2.0, 0.1])
    placed = step(rules, pose(LEFT_END, 0.5), pose(RIGHT_END), L, noise=noise)
    np.testing.assert_allclose(placed.pose, [1.0, -2.0, 0.6 - QUARTER], atol=1e-12)
    refused = step(rules, pose(LEFT_END, 0.5), pose(RIGHT_END), R, noise=noise)
    np.testing.assert_array_equal(refused.pose, pose(LEFT_END, 0.5))


@pytest.mark.parametrize(
    ("offset", "outcome"),
    [((3, 3.9, 0), Outcome.SUCCESS), ((3, 4.1, 0), Outcome.WRONG_POSITION), ((0, 0, 0.1), Outcome.WRONG_ORIENTATION)],
)
def test_a_noisy_external_finish_is_judged_by_what_came_of_it(paper, rules_of, offset, outcome):
    rules, start, goal = rules_of(paper, "A", noise=NOISY), pose(LEFT_END, QUARTER), pose(RIGHT_END, QUARTER)
    exact = step(rules, start, goal, L, noise=np.zeros(3), final_noise=np.zeros(3))
    shift = np.array(offset, float) - [0, 0, float(rules.orientation_error(exact.pose[2], goal[2]))]
    result = step(rules, start, goal, L, noise=np.zeros(3), final_noise=shift if offset[2] == 0 else np.array(offset, float))
    assert (result.outcome, result.terminated) == (outcome, True)
    assert result.reward == (0 if outcome == Outcome.SUCCESS else -1)
    np.testing.assert_allclose(result.pose[:2], np.add(RIGHT_END, offset[:2]), atol=1e-12)


@pytest.mark.parametrize(
    ("offset", "outcome"),
    [((3, 3.9, 0), Outcome.SUCCESS), ((3, 4.1, 0), Outcome.WRONG_POSITION), ((0, 0, 0.1), Outcome.WRONG_ORIENTATION)],
)
def test_noisy_final_placements_have_five_millimetres(paper, rules_of, offset, outcome):
    result = step(rules_of(paper, noise=NOISY), pose(MIDDLE), pose(LEFT_END, QUARTER), L, FINAL, noise=np.array(offset, float))
    assert result.outcome == outcome
    assert result.reward == (20 if outcome == Outcome.SUCCESS else -30)


@pytest.mark.parametrize(
    "bad",
    [{"epsilon_deg": value} for value in (math.nan, math.inf, 0.0, -1.0)]
    + [{"max_steps": 0}, {"symmetry_order": 0}, {"position_tolerance_mm": 0.0}, {"noise": NoiseConfig(position_mm=-1.0)}]
    + [{"noise": NoiseConfig(yaw_deg=math.nan)}, {"motion_weight": -0.1}, {"motion_weight": math.inf}],
)
def test_bad_settings_are_named(paper, rules_of, bad):
    with pytest.raises(InvalidSetting, match=next(iter(bad))):
        rules_of(paper, **bad)


@pytest.mark.parametrize(("name", "value"), [("architecture", "C"), ("layout", "pixels")])
def test_unknown_choices_are_named(name, value):
    with pytest.raises(UnknownChoice, match=f"{name} = '{value}'"):
        TaskConfig(**{name: value}).validate()
