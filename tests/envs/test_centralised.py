"""The rule book with motions: the base rules where a motion may be made, a refusal where it may not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_handover.config import CentralisedConfig, RewardConfig, TaskConfig
from marl_handover.envs.centralised import CentralisedRules, MotionCommand
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.errors import InvalidSetting, UnknownChoice
from marl_handover.policies import load
from marl_handover.task.episode import play
from marl_handover.task.rules import Command, Outcome, Rules

NUMBERS = 20


@pytest.fixture(scope="module", params=["flat", "offset"])
def rules(paper, request):
    return CentralisedRules(paper, TaskConfig(), CentralisedConfig(motion=request.param))


@pytest.fixture(scope="module")
def offset_rules(paper):
    return CentralisedRules(paper, TaskConfig(), CentralisedConfig())


@pytest.fixture(scope="module")
def decisions(paper, draw):
    """Starts, goals, previous arms, and actions with small motions of arms that mostly reach the object."""
    start, goal, previous, action = draw(paper, 600, 3)
    action[:, 1] = np.where(paper.reaches(start)[:, 0], -1.0, 1.0)
    motion = np.random.default_rng(4).uniform(-0.1, 0.1, (600, NUMBERS))
    return start, goal, previous, np.concatenate([action, motion], -1)


def test_an_action_is_a_decision_and_a_motion(rules, decisions):
    action = decisions[3]
    command, base = rules.decode(action), Rules.decode(rules, action[:, :4])
    assert rules.action_size == 4 + NUMBERS
    assert isinstance(command, Command)
    for found, expected in zip(command, base, strict=True):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(command.motion, action[:, 4:])
    assert abs(rules.decode(3 * action).motion).max() <= 1


def test_a_step_is_the_base_step_or_a_refusal(offset_rules, paper, decisions):
    start, goal, previous, action = decisions
    base = Rules(paper, offset_rules.config).step(start, goal, previous, action[:, :4])
    found = offset_rules.step(start, goal, previous, action)
    spoilt = base.feasible & ~found.feasible
    assert 20 < spoilt.sum() < base.feasible.sum() - 20
    assert not (found.feasible & ~base.feasible).any()
    for name in ("pose", "previous_arm", "reward", "terminated", "outcome"):
        np.testing.assert_array_equal(getattr(found, name)[~spoilt], getattr(base, name)[~spoilt])
    np.testing.assert_array_equal(found.pose[spoilt], start[spoilt])
    np.testing.assert_array_equal(found.previous_arm[spoilt], previous[spoilt])
    assert (found.reward[spoilt] == offset_rules.config.reward.failure).all()
    assert found.terminated[spoilt].all()
    assert (found.outcome[spoilt] == int(Outcome.WRONG_POSITION)).all()


def test_only_the_motion_decides_what_is_spoilt(offset_rules, decisions):
    """The verdict is the check's own, of the acting arm's spline from pick to place, or to the goal if the action is final."""
    start, goal, previous, action = decisions
    found = offset_rules.step(start, goal, previous, action)
    still = action.copy()
    still[:, 4:] = 0.0
    guess = offset_rules.step(start, goal, previous, still)
    assert guess.feasible.sum() > found.feasible.sum()
    swapped = action.copy()
    swapped[:, 2:4] = swapped[::-1, 2:4]
    final = action[:, 0] > 0
    moved = offset_rules.step(start, goal, previous, swapped)
    np.testing.assert_array_equal(moved.feasible[final], found.feasible[final])
    assert (moved.feasible != found.feasible)[~final].any()


def test_numpy_and_torch_agree_and_single_problems_are_rows(rules, decisions):
    start, goal, previous, action = decisions
    rows = rules.step(start, goal, previous, action)
    tensors = rules.step(*(torch.tensor(part) for part in decisions))
    np.testing.assert_array_equal(tensors.feasible.numpy(), rows.feasible)
    np.testing.assert_allclose(tensors.pose.numpy(), rows.pose, atol=1e-9)
    for number in range(20):
        one = rules.step(start[number], goal[number], previous[number], action[number])
        assert bool(one.feasible) == bool(rows.feasible[number])
        np.testing.assert_allclose(one.pose, rows.pose[number], atol=1e-9)


def test_the_batched_environment_takes_it(paper, rules):
    env = SupervisorEnv(32, paper, rules.config, seed=1, rules=rules)
    assert env.action_spec.shape == (32, 4 + NUMBERS)
    rollout = env.rollout(5, break_when_any_done=False)
    following = rollout["next"]
    refused = ~following["feasible"] & ~following["truncated"]
    assert refused.any()
    assert (following["reward"][refused] == -30.0).all()
    assert following["terminated"][refused].all()


def test_the_exact_planners_decisions_with_straight_guesses_mostly_succeed(paper, offset_rules, draw):
    """With the executors' first guess for every motion, most problems are solved: the formulation itself is not what fails."""
    start, goal, _, _ = draw(paper, 300, 5)
    exact = load("exact", paper, offset_rules.config)

    def act(pose, goal, previous):
        decision = exact.act(pose, goal, previous)
        return np.concatenate([decision, np.zeros((len(decision), NUMBERS))], -1)

    episodes = play(offset_rules, act, start, goal)
    assert 0.6 < (episodes.outcome == int(Outcome.SUCCESS)).mean() < 1.0


def test_what_it_cannot_do_is_refused_by_name(paper, offset_rules, decisions):
    start, goal, _, action = decisions
    with pytest.raises(InvalidSetting, match="architecture"):
        CentralisedRules(paper, TaskConfig(architecture="A"), CentralisedConfig())
    with pytest.raises(InvalidSetting, match="motion_weight"):
        CentralisedRules(paper, TaskConfig(reward=RewardConfig(motion_weight=1.0)), CentralisedConfig())
    with pytest.raises(UnknownChoice, match="bent"):
        CentralisedRules(paper, TaskConfig(), CentralisedConfig(motion="bent"))
    with pytest.raises(InvalidSetting, match="motion"):
        offset_rules.transfer(start, goal, Rules.decode(offset_rules, action))
    assert isinstance(offset_rules.decode(action), MotionCommand)
