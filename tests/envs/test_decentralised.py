"""Arms that take turns: a thin skin over the rule book, the same for both arms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs.utils import check_env_specs, step_mdp

from marl_handover.config import DecentralisedConfig, NoiseConfig, TaskConfig
from marl_handover.envs.decentralised import VIEW_SIZE, DecentralisedEnv, TurnRules, own_view
from marl_handover.errors import InvalidSetting
from marl_handover.task.observations import ARM_FIELDS, observe
from marl_handover.task.rules import Outcome, Rules
from tests.symmetries import GROUP, flips_x

FIELDS = len(ARM_FIELDS)


def make(num_envs=16, seed=0, settings=None, **task):
    return DecentralisedEnv(num_envs, task=TaskConfig(**task), seed=seed, settings=settings)


def turn_rules(cell, **task):
    return TurnRules(cell, TaskConfig(**task), DecentralisedConfig())


def decisions(draw, cell, count, seed):
    """Starts, goals, turns and decisions, numpy; half of the arms reach their object."""
    start, goal, _, action = draw(cell, count, seed)
    turn = np.random.default_rng(seed).integers(0, 2, count)
    return start, goal, turn, action[:, [0, 2, 3]]


def rollout(env, steps=30, seed=0):
    torch.manual_seed(seed)
    return env.rollout(steps, auto_reset=True, break_when_any_done=False)


@pytest.mark.parametrize("num_envs", [1, 5])
def test_specs(num_envs):
    env = make(num_envs, noise=NoiseConfig(1.0, 1.0))
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (num_envs, VIEW_SIZE)
    assert env.action_spec.shape == (num_envs, 3)


def test_either_arm_begins():
    state = make(200).reset()
    assert set(state["previous_arm"][:, 0].tolist()) == {0, 1}
    assert 60 < int(state["previous_arm"].sum()) < 140
    assert not state["decisions"].any()
    assert not state["transfers"].any()


def test_architecture_a_has_no_decision_to_finish(paper):
    with pytest.raises(InvalidSetting, match="variant=decentralised"):
        turn_rules(paper, architecture="A")


@pytest.mark.parametrize("noisy", [False, True])
def test_a_decision_is_the_supervisors_command_to_the_arm_whose_turn_it_is(paper, draw, noisy):
    """The rule book itself as the oracle; passes leave the object, cost their price and end nothing."""
    rules = turn_rules(paper, epsilon_deg=40.0)
    start, goal, turn, action = decisions(draw, paper, 4000, 1)
    noise = np.random.default_rng(2).normal(size=(4000, 3)) if noisy else None
    found = rules.take_turn(start, goal, turn, action, noise=noise)
    final = np.where(action[:, 0] > 1 / 3, 1.0, -1.0)
    beta = action[:, 2] * np.where(turn == 1, 1.0, -1.0)  # L is the mirrored arm
    told = np.stack([final, 2.0 * turn - 1.0, action[:, 1], beta], -1)
    truth = Rules(paper, rules.config).step(start, goal, 1 - turn, told, noise=noise)
    passed = action[:, 0] < -1 / 3
    for name in ("placed", "feasible", "reward", "terminated", "outcome"):
        np.testing.assert_array_equal(getattr(found, name)[~passed], getattr(truth, name)[~passed])
    assert set(found.outcome[~passed].tolist()) == ({0, 3} if noisy else {0, 1, 2, 3})  # noise misses every goal without a tolerance
    np.testing.assert_array_equal(found.placed[passed], start[passed])
    assert (found.reward[passed] == -0.5).all()
    assert not found.terminated[passed].any()
    assert found.feasible[passed].all()


@given(seed=st.integers(0, 10_000), element=st.sampled_from(GROUP[1:]))
@settings(max_examples=25)
def test_both_arms_live_in_one_problem(paper, draw, seed, element):
    """Under a mirror of the table the same numbers do the mirrored thing, and are asked for by the same view."""
    rules = turn_rules(paper)
    start, goal, turn, action = decisions(draw, paper, 60, seed)
    mirrored = action * np.array([1.0, -1.0 if flips_x(element) else 1.0, 1.0])
    there = rules.take_turn(element.pose(start), element.pose(goal), element.arm(turn), mirrored)
    here = rules.take_turn(start, goal, turn, action)
    np.testing.assert_array_equal(there.feasible, here.feasible)
    np.testing.assert_array_equal(there.reward, here.reward)
    np.testing.assert_allclose(there.placed[:, :2], element.pose(here.placed)[:, :2], atol=1e-9)
    if not flips_x(element):
        both = (
            observe(rules, "relative", start, goal, 0 * turn - 1),
            observe(rules, "relative", element.pose(start), element.pose(goal), 0 * turn - 1),
        )
        views = [own_view(torch.tensor(seen), torch.tensor(arm), torch.zeros(60)) for seen, arm in zip(both, (turn, 1 - turn), strict=True)]
        torch.testing.assert_close(views[0][:, :FIELDS], views[1][:, :FIELDS])
        assert torch.equal(views[0][:, FIELDS], -views[1][:, FIELDS])


def test_numpy_and_torch_agree(paper, draw):
    rules = turn_rules(paper)
    problem = decisions(draw, paper, 1000, 3)
    for one, other in zip(rules.take_turn(*problem), rules.take_turn(*map(torch.tensor, problem)), strict=True):
        np.testing.assert_allclose(one, other.numpy(), atol=1e-12)


def test_a_view_is_the_arms_own_block_whoever_moved_last(paper, draw):
    start, goal, turn, _ = decisions(draw, paper, 300, 4)
    env = make(300)
    pose, aim, arm = torch.tensor(start).float(), torch.tensor(goal).float(), torch.tensor(turn)
    epsilon = torch.full((300,), env.rules.epsilon_rad)
    seen = env.view(pose, aim, arm, epsilon, torch.zeros(300))
    blocks = observe(env.rules, "relative", pose, aim, torch.full_like(arm, -1), epsilon).reshape(300, 2, FIELDS)
    for row in range(300):
        assert torch.equal(seen[row, :FIELDS], blocks[row, turn[row]])
    assert torch.equal(seen[:, FIELDS], 2.0 * arm - 1.0)


def test_a_rollout_is_its_decisions_one_by_one_with_the_turn_changing_hands():
    env = make(8, settings=DecentralisedConfig(pass_reward=-0.25, decisions_per_transfer=2), epsilon_deg=60.0, max_steps=3)
    history = rollout(env, 60)
    outcomes, spent = set(), set()
    for row in history.reshape(-1):
        after, turn = row["next"], 1 - row["previous_arm"][0]
        result = env.rules.take_turn(row["achieved_goal"], row["desired_goal"], turn, row["action"], row["epsilon"][0])
        torch.testing.assert_close(after["placed"], result.placed, atol=1e-4, rtol=0)
        assert torch.equal(after["achieved_goal"], after["placed"])
        assert after["reward"] == result.reward
        assert after["terminated"] == result.terminated
        assert after["previous_arm"] == turn
        passed = bool(row["action"][0] < -1 / 3)
        assert bool(after["executed"]) is not passed
        assert after["transfers"] == row["transfers"] + (not passed)
        assert after["decisions"] == row["decisions"] + 1
        assert bool(after["truncated"]) is bool(not result.terminated and (after["transfers"] >= 3 or after["decisions"] >= 6))
        assert after["observation"][FIELDS] == (-1.0 if turn == 1 else 1.0)
        assert after["observation"][FIELDS + 1] == float(passed)
        outcomes.add(int(after["outcome"]))
        if after["truncated"]:
            assert after["outcome"] == Outcome.TIMEOUT
            spent.add("transfers" if after["transfers"] >= 3 else "decisions")
    assert outcomes == set(Outcome)
    assert spent == {"transfers", "decisions"}


@pytest.mark.parametrize("rows", [[0], [1, 4, 7], list(range(8))])
def test_partial_reset_touches_only_the_reset_cells(rows):
    env = make(8, seed=3)
    state = step_mdp(rollout(env, 5)[:, -1])
    mask = torch.zeros(8, 1, dtype=torch.bool)
    mask[rows] = True
    state["_reset"] = mask
    before = state.clone()
    after = env.reset(state)
    kept = ~mask[:, 0]
    for key in ("observation", "achieved_goal", "desired_goal", "previous_arm", "epsilon", "transfers", "decisions", "executed"):
        assert torch.equal(after[key][kept], before[key][kept]), key
    assert not after["decisions"][rows].any()
    assert (after["achieved_goal"][rows] != before["achieved_goal"][rows]).any(-1).all()
    turn, epsilon = 1 - after["previous_arm"][:, 0], after["epsilon"][:, 0]
    expected = env.view(after["achieved_goal"], after["desired_goal"], turn, epsilon, torch.zeros(8))
    assert torch.equal(after["observation"][rows], expected[rows])
