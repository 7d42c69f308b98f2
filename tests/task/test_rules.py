"""Laws of the rule book that hold for every problem, in both architectures."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from marl_handover.config import TaskConfig
from marl_handover.task.rules import Outcome, Rules, Transition
from tests.symmetries import GROUP

COUNT = 20_000
architectures = pytest.mark.parametrize("architecture", ["A", "B"])


def flat(result: Transition) -> dict[str, np.ndarray]:
    """Every field of a transition as a numpy array."""
    fields = {**result._asdict(), **result.command._asdict()}
    del fields["command"]
    return {name: np.asarray(value) for name, value in fields.items()}


@architectures
def test_every_outcome_occurs_in_these_problems(architecture, cell, rules_of, draw):
    """Guards the laws below against problems that exercise nothing."""
    result = rules_of(cell, architecture, epsilon_deg=20.0).step(*draw(cell, COUNT, 0))
    expected = {Outcome.NONE, Outcome.SUCCESS} if architecture == "A" else set(Outcome) - {Outcome.TIMEOUT}
    assert set(np.unique(result.outcome)) == expected
    assert 0.2 < np.mean(result.feasible) < 0.95
    if architecture == "A":
        assert set(np.unique(result.transfers)) == {1, 2}
        assert set(np.unique(result.external_arm)) == {-1, 0, 1}


@architectures
@pytest.mark.parametrize("element", GROUP)
def test_the_transition_commutes_with_every_symmetry(element, architecture, cell, rules_of, draw, assert_same_angle):
    """step(g s, g a) = g step(s, a)."""
    rules = rules_of(cell, architecture, epsilon_deg=20.0)
    pose, goal, previous, action = draw(cell, COUNT, 1)
    result = rules.step(pose, goal, previous, action)
    image = rules.step(element.pose(pose), element.pose(goal), element.arm(previous), element.action(action))
    for field in ("reward", "terminated", "outcome", "feasible", "transfers"):
        np.testing.assert_array_equal(getattr(image, field), getattr(result, field), err_msg=field)
    for field in ("external_arm", "previous_arm"):
        np.testing.assert_array_equal(getattr(image, field), element.arm(getattr(result, field)), err_msg=field)
    for field in ("placed", "pose"):
        expected = element.pose(getattr(result, field))
        np.testing.assert_allclose(getattr(image, field)[:, :2], expected[:, :2], atol=1e-9, err_msg=field)
        assert_same_angle(getattr(image, field)[:, 2], expected[:, 2])


@architectures
def test_numpy_equals_torch(architecture, cell, rules_of, draw):
    rules = rules_of(cell, architecture, epsilon_deg=20.0, motion_weight=0.3, symmetry_order=2)
    problem = draw(cell, COUNT, 2)
    left = np.random.default_rng(0).integers(1, 4, COUNT)
    noise = np.random.default_rng(1).normal(size=(COUNT, 3)) * (2, 2, 0.02)
    ours = flat(rules.step(*problem, transfers_left=left, noise=noise))
    theirs = flat(rules.step(*map(torch.as_tensor, problem), transfers_left=torch.as_tensor(left), noise=torch.as_tensor(noise)))
    for name, value in ours.items():
        np.testing.assert_allclose(theirs[name], value, atol=1e-9, err_msg=name)


@architectures
def test_float32_equals_float64(architecture, paper, rules_of, draw):
    """But for the few problems that lie within rounding of a threshold."""
    rules = rules_of(paper, architecture, epsilon_deg=20.0)
    pose, goal, previous, action = (torch.as_tensor(array) for array in draw(paper, COUNT, 3))
    fine = rules.step(pose, goal, previous, action)
    coarse = rules.step(pose.float(), goal.float(), previous, action.float())
    assert coarse.pose.dtype == coarse.reward.dtype == torch.float32
    assert (coarse.outcome == fine.outcome).double().mean() > 0.9995
    apart = torch.remainder(coarse.pose - fine.pose + math.pi, 2 * math.pi) - math.pi
    same = (coarse.transfers == fine.transfers) & (coarse.feasible == fine.feasible) & (coarse.external_arm == fine.external_arm)
    assert (apart[same].abs() < 1e-3).all()


@architectures
def test_a_batch_equals_its_problems_one_by_one(architecture, paper, rules_of, draw):
    rules = rules_of(paper, architecture, epsilon_deg=20.0)
    problem = draw(paper, 200, 4)
    batch = flat(rules.step(*problem))
    rows = [flat(rules.step(*(array[row] for array in problem))) for row in range(200)]
    for name, value in batch.items():
        np.testing.assert_allclose(np.stack([row[name] for row in rows]), value, atol=1e-12, err_msg=name)


@architectures
def test_epsilon_a_problem_equals_a_loop_of_scalars(architecture, paper, rules_of, draw):
    rules = rules_of(paper, architecture)
    pose, goal, previous, action = (torch.as_tensor(array) for array in draw(paper, 300, 5))
    epsilon = torch.linspace(0.02, 2.0, 300, dtype=torch.float64)
    batch = flat(rules.step(pose, goal, previous, action, epsilon_rad=epsilon))
    rows = [flat(rules.step(pose[[i]], goal[[i]], previous[[i]], action[[i]], epsilon_rad=float(epsilon[i]))) for i in range(300)]
    for name, value in batch.items():
        np.testing.assert_allclose(np.concatenate([row[name] for row in rows]), value, atol=1e-12, err_msg=name)
    assert not np.array_equal(batch["outcome"], rules.step(pose, goal, previous, action).outcome)


def test_a_larger_epsilon_never_turns_success_into_failure(cell, rules_of, draw):
    problem = draw(cell, COUNT, 6)
    successes = [rules_of(cell).step(*problem, epsilon_rad=epsilon).outcome == Outcome.SUCCESS for epsilon in (0.02, 0.1, 0.5, 4.0)]
    for tight, loose in pairwise(successes):
        assert (loose | ~tight).all()
        assert loose.sum() > tight.sum()


def test_two_hand_overs_by_one_arm_equal_one(cell, rules_of, draw, assert_same_angle):
    """Composition: an arm that puts the object down on its way changes nothing."""
    rules = rules_of(cell)
    pose, goal, previous, action = draw(cell, COUNT, 7)
    action[:, 0] = -1
    detour = action.copy()
    detour[:, 2:] = np.random.default_rng(0).uniform(-1, 1, (COUNT, 2))
    direct = rules.step(pose, goal, previous, action)
    between = rules.step(pose, goal, previous, detour)
    after = rules.step(between.pose, goal, between.previous_arm, action)
    np.testing.assert_array_equal(after.feasible[direct.feasible], True)
    np.testing.assert_allclose(after.pose[direct.feasible, :2], direct.pose[direct.feasible, :2])
    assert_same_angle(after.pose[direct.feasible, 2], direct.pose[direct.feasible, 2])


def test_a_transfer_can_be_undone(cell, rules_of, draw, assert_same_angle):
    rules = rules_of(cell)
    pose, goal, previous, action = draw(cell, COUNT, 8)
    action[:, 0] = -1
    there = rules.step(pose, goal, previous, action)
    action[:, 0] = 1
    back = rules.step(there.pose, pose, there.previous_arm, action)
    assert (back.outcome[there.feasible] == Outcome.SUCCESS).all()
    assert_same_angle(back.pose[there.feasible, 2], pose[there.feasible, 2])


@architectures
def test_a_refused_transfer_leaves_the_object_and_the_arm(architecture, cell, rules_of, draw):
    pose, goal, previous, action = draw(cell, COUNT, 9)
    result = rules_of(cell, architecture).step(pose, goal, previous, action, noise=np.ones((COUNT, 3)))
    refused = ~result.feasible
    assert refused.sum() > 1000
    np.testing.assert_array_equal(result.placed[refused], pose[refused])
    if architecture == "B":
        np.testing.assert_array_equal(result.previous_arm[refused], previous[refused])
        assert (result.reward[refused] == -30).all()
        assert (result.outcome[refused] == Outcome.WRONG_POSITION).all()


@architectures
def test_actions_beyond_the_box_are_clipped(architecture, paper, rules_of, draw):
    rules = rules_of(paper, architecture)
    action = draw(paper, 1000, 10)[-1]
    wide = action * 5
    for one, other in zip(rules.decode(wide), rules.decode(np.clip(wide, -1, 1)), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("order", [1, 4])
def test_hindsight_is_true(dtype, order, cell, rules_of, draw):
    """A feasible placement, run again as the final transfer to where it left the object, earns the success it is relabelled to."""
    rules = rules_of(cell, epsilon_deg=1.0, symmetry_order=order)
    pose, goal, previous, action = (torch.as_tensor(array) for array in draw(cell, COUNT, 11))
    pose, goal, action = pose.to(dtype), goal.to(dtype), action.to(dtype)
    action[:, 0] = -1
    action[:100, 2:] = action[:100, 2:].sign()  # the corners of the chart
    real = rules.step(pose, goal, previous, action)
    judged = rules.judge(real.placed, real.placed, torch.ones_like(real.feasible), real.feasible)
    action[:, 0] = 1
    again = rules.step(pose, real.placed, previous, action)
    assert real.feasible.sum() > 1000
    for verdict in (judged, again):
        assert (verdict.reward[real.feasible] == 20).all()
        assert verdict.terminated[real.feasible].all()
        assert (verdict.outcome[real.feasible] == Outcome.SUCCESS).all()
    assert torch.equal(again.placed[real.feasible, :2], real.placed[real.feasible, :2])


def test_hindsight_of_a_later_state_is_true(cell, rules_of, draw):
    """With another goal a feasible placement still earns -1, and goes on."""
    rules = rules_of(cell)
    pose, goal, previous, action = draw(cell, COUNT, 12)
    action[:, 0] = -1
    first, second = rules.step(pose, goal, previous, action), rules.step(pose, goal[::-1], previous, action)
    np.testing.assert_array_equal(first.placed, second.placed)
    judged = rules.judge(first.placed, goal[::-1], np.zeros(COUNT, bool), first.feasible)
    np.testing.assert_array_equal(judged.reward, second.reward)
    assert (second.reward[first.feasible] == -1).all()
    assert not second.terminated[first.feasible].any()


@architectures
def test_a_step_is_what_its_pieces_make(architecture, cell, rules_of, draw):
    """Who executes transfers elsewhere composes them; here the place is measured to be where the rules put it."""
    rules = rules_of(cell, architecture, epsilon_deg=20.0, motion_weight=0.3)
    pose, goal, previous, action = draw(cell, COUNT, 13)
    left = np.random.default_rng(0).integers(1, 4, COUNT)
    whole = rules.step(pose, goal, previous, action, transfers_left=left)
    command = rules.decode(action)
    placed, feasible = rules.transfer(pose, goal, command)
    if architecture == "B":
        verdict = rules.judge(placed, goal, command.final, feasible)
    else:
        early = rules.external(pose, goal)
        placed = np.where(early.arm[:, None] >= 0, pose, placed)
        external = rules.external(placed, goal, (early.arm >= 0) | (left > 1))
        np.testing.assert_array_equal(external.arm, whole.external_arm)
        verdict = rules.external_verdict(external.pose, goal, external.arm)
        np.testing.assert_array_equal(external.pose, whole.pose)
    np.testing.assert_array_equal(placed, whole.placed)
    np.testing.assert_array_equal(verdict.reward - rules.motion_penalty(command.arm, pose, placed), whole.reward)
    np.testing.assert_array_equal(verdict.terminated, whole.terminated)
    np.testing.assert_array_equal(verdict.outcome, whole.outcome)


@architectures
def test_measured_placements_count_within_the_tolerance(architecture, paper):
    """3 mm off the goal: missed on exact hardware, at the goal where it is measured; 6 mm off: missed on both."""
    goal = np.array([100.0, 50.0, 0.2])
    for physical, off_mm, expected in (
        (False, 3.0, Outcome.WRONG_POSITION),
        (True, 3.0, Outcome.SUCCESS),
        (True, 6.0, Outcome.WRONG_POSITION),
    ):
        rules = Rules(paper, TaskConfig(architecture=architecture), physical=physical)
        pose = goal + [0.0, off_mm, 0.01]
        if architecture == "B":
            verdict = rules.judge(pose, goal, np.bool_(True), np.bool_(True))
        else:
            verdict = rules.external_verdict(pose, goal, np.int64(0))
        assert (verdict.outcome, bool(verdict.terminated)) == (expected, True)


@pytest.mark.parametrize("element", GROUP)
def test_the_external_choice_commutes_with_every_symmetry(element, cell, rules_of, draw, assert_same_angle):
    rules = rules_of(cell, "A", epsilon_deg=20.0)
    pose, goal = draw(cell, COUNT, 14)[:2]
    here, there = rules.external(pose, goal), rules.external(element.pose(pose), element.pose(goal))
    np.testing.assert_array_equal(there.arm, element.arm(here.arm))
    np.testing.assert_allclose(there.pose[:, :2], element.pose(here.pose)[:, :2], atol=1e-9)
    assert_same_angle(there.pose[:, 2], element.pose(here.pose)[:, 2])
    assert set(np.unique(here.arm)) == {-1, 0, 1}
