"""Policies that need no training, in cells of 2 to 8 arms: exact, greedy, random, and a shield over each."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_handover import policies
from marl_handover.config import TaskConfig
from marl_handover.errors import TwoArmsOnly
from marl_handover.task.episode import play
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome
from tests.layouts import line, model_of, ring

NAMES = ("exact", "greedy", "random")
cells = pytest.mark.parametrize(("count", "layout"), [(2, ring), (3, ring), (4, line), (6, ring), (8, line)])


def problems_of(cell, count, seed=0):
    return tuple(part.numpy() for part in sample_problems(cell, count, torch.Generator().manual_seed(seed)))


def success(policy, problems):
    outcome = play(policy.rules, policy.act, *problems).outcome
    return (outcome == int(Outcome.SUCCESS)).mean()


@cells
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_exact_beats_greedy_beats_random(count, layout, architecture):
    cell, task = model_of(count, layout).cell, TaskConfig(architecture=architecture)
    problems = problems_of(cell, 300)
    exact, greedy, random = (success(policies.load(name, cell, task), problems) for name in NAMES)
    assert exact == 1.0
    assert exact > greedy > random


@cells
@pytest.mark.parametrize("name", NAMES)
def test_one_problem_is_a_batch_of_one_and_is_answered_as_an_observation_is(count, layout, name):
    cell = model_of(count, layout).cell
    start, goal = problems_of(cell, 20, 1)
    previous = np.arange(20) % (count + 1) - 1
    one, batch, called = (policies.load(name, cell, seed=4) for _ in range(3))
    rows = batch.act(start, goal, previous)
    assert rows.shape == (20, 4 if count == 2 else 2 * count + 3)
    for row in range(20):
        np.testing.assert_array_equal(one.act(start[row], goal[row], previous[row]), rows[row])
        action = called({"state": start[row], "goal": goal[row], "previous_arm": previous[row] + 1})
        assert set(action) == {"final", "arm", "place", *(() if count == 2 else ("receiver",))}
        assert action["arm"] in range(count)
        assert action.get("receiver", 0) in range(count)
        assert action["place"].dtype == np.float32


@cells
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_no_shielded_episode_ends_wrong(count, layout, architecture):
    cell = model_of(count, layout).cell
    policy = policies.load("shielded:random", cell, TaskConfig(architecture=architecture))
    results = []
    outcome = play(policy.rules, policy.act, *problems_of(cell, 200), observer=lambda decision: results.append(decision.result)).outcome
    assert np.isin(outcome, [Outcome.SUCCESS, Outcome.TIMEOUT]).all()
    assert all((result.feasible | (result.external_arm >= 0)).all() for result in results)
    assert policy.repaired > 20


def test_the_greedy_object_comes_nearer_to_the_goal_by_the_graph():
    """Along a row of arms it is handed on, not to and fro, until an arm that reaches the goal has it."""
    cell = model_of(6, line).cell
    policy = policies.load("greedy", cell)
    start = np.append(cell.arms[0].at(200.0, 0.3), 0.0)
    goal = np.append(cell.arms[5].at(200.0, 0.3), 1.0)
    pose, previous, arms = start[None], np.array([-1]), []
    while len(arms) < 5:
        result = policy.rules.step(pose, goal[None], previous, policy.act(pose, goal[None], previous))
        pose, previous = result.pose, result.previous_arm
        arms.append(int(previous[0]))
    assert arms == [0, 1, 2, 3, 4]


def test_a_trained_pair_policy_given_three_arms_is_refused_in_one_line():
    for name in ("pretrained_a", "pretrained_b", "pretrained_twin", "shielded:pretrained_b"):
        with pytest.raises(TwoArmsOnly, match=r"is for two arms; this cell has 3: a0, a1, a2") as caught:
            policies.load(name, model_of(3).cell)
        assert "\n" not in str(caught.value)
