"""Gymnasium's vector environment of many cells: each behaves as a cell alone does."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from marl_handover.envs.goal_env import SupervisorGoalEnv
from marl_handover.envs.goal_vector_env import SupervisorVectorEnv
from marl_handover.errors import InvalidSetting, NotFinite, UnknownChoice

ID = "marl_handover/SupervisorB-v0"
architectures = pytest.mark.parametrize("architecture", ["A", "B"])


def made(count=8, architecture="B", **settings):
    return gymnasium.make_vec(f"marl_handover/Supervisor{architecture}-v0", count, vectorization_mode="vector_entry_point", **settings)


@architectures
def test_each_cell_behaves_as_one_alone(architecture):
    """The cell alone is put where each of the many began, and gets the same commands."""
    many, alone = made(5, architecture, epsilon_deg=30.0, max_steps=5), SupervisorGoalEnv(architecture, epsilon_deg=30.0, max_steps=5)
    random, ended = np.random.default_rng(0), set()
    for seed in range(30):
        row = seed % 5
        observation, _ = many.reset(seed=seed)
        start = {"state": many.unwrapped._pose[row].copy(), "goal": many.unwrapped._goal[row].copy()}
        seen, _ = alone.reset(options=start)
        over = False
        while not over:
            for key, value in seen.items():
                np.testing.assert_allclose(observation[key][row], value, atol=1e-6)
            actions = random.uniform(-1, 1, (5, 4)).astype(np.float32)
            observation, rewards, terminated, truncated, infos = many.step(actions)
            seen, reward, ends, cut, info = alone.step(actions[row])
            assert (rewards[row], terminated[row], truncated[row]) == (reward, ends, cut)
            for key, value in info.items():
                np.testing.assert_array_equal(infos[key][row], value)
            over = ends or cut
        ended.add(info["outcome"])
    assert len(ended) > 1


def test_the_step_after_an_end_begins_the_next_episode():
    env = made(4, max_steps=1)
    env.reset(seed=0)
    actions = np.tile(np.array([-1, -1, 0, 0], np.float32), (4, 1))
    *_, terminated, truncated, infos = env.step(actions)
    assert (terminated | truncated).all()
    assert infos["_outcome"].all()
    observation, rewards, terminated, truncated, infos = env.step(actions)
    assert not (terminated | truncated).any()
    assert (rewards == 0).all()
    assert not infos["_outcome"].any()
    assert (observation["observation"][:, 3] == 0).all()


def test_rewards_of_all_cells_can_be_recomputed():
    env = made(16, epsilon_deg=40.0)
    env.reset(seed=1)
    random, seen = np.random.default_rng(1), set()
    for _ in range(100):
        observation, rewards, _, _, infos = env.step(random.uniform(-1, 1, (16, 4)).astype(np.float32))
        acted = infos["_arm"]
        again = env.unwrapped.compute_reward(observation["achieved_goal"], observation["desired_goal"], infos)
        np.testing.assert_array_equal(again[acted], rewards[acted])
        seen |= set(rewards[acted])
    assert seen == {20, -1, -30}


def test_the_seed_decides():
    runs = []
    for seed in (3, 3, 4):
        env, random = made(6, noise={"position_mm": 1.0}), np.random.default_rng(0)
        env.reset(seed=seed)
        runs.append(np.stack([env.step(random.uniform(-1, 1, (6, 4)).astype(np.float32))[0]["achieved_goal"] for _ in range(20)]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any()


def test_it_is_what_make_vec_gives():
    assert isinstance(gymnasium.make_vec(ID, 2).unwrapped, SupervisorVectorEnv)
    env = made(3, render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert [picture.shape for picture in env.render()] == [(320, 320, 3)] * 3
    assert repr(env.unwrapped) == (
        "SupervisorVectorEnv(num_envs=3, architecture='B', cell='paper', epsilon_deg=5, max_steps=20, layout='object')"
    )


def test_what_cannot_be_is_named():
    with pytest.raises(InvalidSetting, match="num_envs = 0"):
        SupervisorVectorEnv(0)
    with pytest.raises(UnknownChoice, match="render_mode"):
        SupervisorVectorEnv(2, render_mode="human")
    env = made(2)
    env.reset(seed=0)
    with pytest.raises(NotFinite, match="actions"):
        env.step(np.array([[0, 0, 0, 0], [0, np.nan, 0, 0]], np.float32))
