"""``policy.predict`` as Stable-Baselines3 has it, for whatever the package's environments show."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

from marl_handover.cell import load_cell
from marl_handover.config import TaskConfig
from marl_handover.envs import SupervisorEnv, SupervisorGoalEnv, handover_aec
from marl_handover.errors import InvalidSetting
from marl_handover.policies import SupervisorPolicy, load
from marl_handover.policies.policy import NobodyMoves

POLICIES = ["exact", "greedy", "pretrained_b"]
ID = "marl_handover/SupervisorB-v0"


@pytest.mark.parametrize("name", POLICIES)
def test_it_plays_the_environment_of_one_cell(name):
    """The action is that of the batched call on the problem as the environment has it."""
    policy, env = load(name), SupervisorGoalEnv("B")
    won = 0
    for seed in range(10):
        observation, info = env.reset(seed=seed)
        over, state = False, None
        while not over:
            action, state = policy.predict(observation, state, episode_start=np.array([False]), deterministic=True)
            assert env.action_space.contains(action)
            expected = policy.act(
                observation["achieved_goal"].astype(float), observation["desired_goal"].astype(float), np.int64(env._previous)
            )
            np.testing.assert_array_equal(action, expected.astype(np.float32))
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        assert state is None
        won += info["is_success"]
    assert won >= 9 if name != "greedy" else won >= 1


def test_it_plays_many_cells_at_once():
    policy, env = load("exact"), gymnasium.make_vec(ID, 16)
    observation, _ = env.reset(seed=0)
    won = 0
    for _ in range(30):
        action, _ = policy.predict(observation)
        assert env.action_space.contains(action)
        observation, *_, infos = env.step(action)
        won += int((infos["is_success"] & infos["_is_success"]).sum())
        assert not ((infos["outcome"] == "wrong_position") & infos["_outcome"]).any()
    assert won >= 50


@pytest.mark.parametrize("cell", ["paper", "triangle"])
def test_it_plays_tensors(cell):
    built = load_cell(cell)
    task = TaskConfig(layout="raw")
    policy, env = load("exact", built, task), SupervisorEnv(8, built, task, seed=0)
    seen, won = env.reset(), 0
    for _ in range(20):
        action, state = policy.predict(seen, "kept")
        assert isinstance(action, torch.Tensor)
        assert state == "kept"
        seen["action"] = action
        after, seen = env.step_and_maybe_reset(seen)
        won += int((after["next", "outcome"] == 1).sum())
    assert won >= 20


def test_it_tells_which_arm_moved_last_in_cells_of_many_arms():
    """A policy that repeats the arm that it is told moved last."""

    class Told(SupervisorPolicy):
        def act(self, pose, goal, previous_arm):
            assert previous_arm == env._previous
            return random.act(pose, goal, previous_arm)

    env = SupervisorGoalEnv(cell="triangle")
    random, told = load("random", env.rules.cell), Told(env.rules, "told")
    observation, _ = env.reset(seed=0)
    arms = set()
    for _ in range(60):
        action, _ = told.predict(observation)
        observation, _, terminated, truncated, _ = env.step(action)
        arms.add(int(env._previous))
        if terminated or truncated:
            observation, _ = env.reset()
    assert arms == {-1, 0, 1, 2}


def test_it_plays_the_supervisor_of_the_aec_environment():
    env, policy = handover_aec.env(), load("pretrained_b")
    env.reset(seed=0)
    seen = env.observe("supervisor")
    action, state = policy.predict(seen)
    assert env.action_space("supervisor").contains({**action, "final": np.int64(action["final"]), "arm": np.int64(action["arm"])})
    called = policy(seen)
    assert (action["final"], action["arm"], state) == (called["final"], called["arm"], None)


@pytest.mark.parametrize("bad", [np.zeros(38, np.float32), {"observation": np.zeros(4)}, None])
def test_another_observation_is_refused(bad):
    with pytest.raises(InvalidSetting, match="achieved_goal"):
        load("exact").predict(bad)


def test_draws_are_refused_and_so_is_a_command_to_nobody():
    class Idle(SupervisorPolicy):
        def act(self, pose, goal, previous_arm):
            return np.full((*pose.shape[:-1], 4), np.nan)

    policy, env = load("exact"), SupervisorGoalEnv("B")
    observation, _ = env.reset(seed=0)
    with pytest.raises(InvalidSetting, match="deterministic"):
        policy.predict(observation, deterministic=False)
    with pytest.raises(NobodyMoves, match="idle"):
        Idle(env.rules, "idle").predict(observation)


def test_stable_baselines_judges_it():
    """Its own ``evaluate_policy`` takes our policy for a model."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    rewards, lengths = evaluate_policy(
        load("exact"), make_vec_env(ID, 4, seed=0), n_eval_episodes=20, return_episode_rewards=True, warn=False
    )
    assert [reward == 20 - (length - 1) for reward, length in zip(rewards, lengths, strict=True)].count(True) >= 19


def test_a_policy_says_what_it_is():
    assert repr(load("pretrained_b")) == "NetworkPolicy('pretrained_b', architecture='B', cell='paper', epsilon_deg=5)"
