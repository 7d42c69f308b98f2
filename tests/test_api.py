"""``import marl_handover as mh``: the same words and results as the command line, and an import that costs nothing."""

from __future__ import annotations

import json
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch

import marl_handover as mh
from marl_handover.cli import main
from marl_handover.errors import InvalidSetting, UnknownChoice, UnknownKey

PROBLEM = {"start": [150, -100, 30], "goal": [-160, 120, 90]}


def test_every_name_is_there_and_nothing_is_imported_before():
    heavy = ("torch", "numpy", "gymnasium", "torchrl", "matplotlib")
    code = f"import sys, marl_handover as mh; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    assert all(getattr(mh, name) is not None for name in mh.__all__)
    assert set(mh.__all__) <= set(dir(mh))
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = mh.trian


def test_a_plan_is_what_the_command_writes(tmp_path, capsys):
    file = tmp_path / "plan.json"
    plan = mh.plan(**PROBLEM, policy="exact")
    assert capsys.readouterr().out == ""
    assert main(["plan", "start=[150,-100,30]", "goal=[-160,120,90]", "policy=exact", f"json={file}"]) == 0
    assert json.loads(file.read_text()) == json.loads(json.dumps(plan))


def test_an_evaluation_is_what_the_command_writes(tmp_path, capsys):
    file = tmp_path / "report.json"
    report = mh.evaluate("seed=3", policy="greedy", episodes=40, task={"epsilon_deg": 2.0}, progress=False)
    assert capsys.readouterr().out == ""
    assert main(["evaluate", "seed=3", "policy=greedy", "episodes=40", "task.epsilon_deg=2", "progress=false", f"json={file}"]) == 0
    written = json.loads(file.read_text())
    assert {"success_rate", "mean_steps"} & set(report)
    assert report.keys() == written.keys()
    assert all(report[key] == written[key] for key in report.keys() - {"decision_us", "wall_s"})  # these are a clock's


def test_wrong_words_are_told_as_on_the_command_line():
    with pytest.raises(UnknownKey, match="epsilon_dge"):
        mh.evaluate(task={"epsilon_dge": 1}, progress=False)
    with pytest.raises(UnknownChoice, match="SupervisorC"):
        mh.make("SupervisorC")
    with pytest.raises(InvalidSetting, match="num_envs"):
        mh.make(library="pettingzoo", num_envs=2)


def test_environments_of_three_libraries():
    assert isinstance(mh.make("SupervisorA").unwrapped, mh.SupervisorGoalEnv)
    assert mh.make("SupervisorA").unwrapped.rules.config.architecture == "A"
    assert isinstance(mh.make(num_envs=3, epsilon_deg=1), gymnasium.vector.VectorEnv)
    batch = mh.make(library="torchrl", num_envs=3, cell="triangle", layout="graph")
    assert isinstance(batch, mh.SupervisorEnv)
    assert batch.batch_size == torch.Size([3])
    assert "supervisor" in mh.make(library="pettingzoo").possible_agents


def test_a_policy_with_other_settings():
    policy = mh.load_policy("exact", "triangle", epsilon_deg=1.0)
    assert policy.rules.config.epsilon_deg == 1.0
    assert policy.rules.cell.num_arms == 3
    observation, _ = mh.make(cell="triangle", epsilon_deg=1.0).reset(seed=0)
    assert policy.predict(observation)[0].shape == (policy.rules.action_size,)


@pytest.fixture
def doubled(no_new_plugins):
    """The name of a reward that is twice the usual one."""
    mh.REWARDS.register("doubled")(lambda rules, verdict, placed, goal: 2 * verdict.reward)
    return "doubled"


def test_a_reward_of_ones_own_is_the_environments_and_hindsights(doubled):
    own, usual = mh.make(reward={"function": doubled}), mh.make()
    random = np.random.default_rng(0)
    for seed in range(20):
        observation, _ = own.reset(seed=seed)
        usual.reset(seed=seed)
        action = random.uniform(-1, 1, 4).astype(np.float32)
        shown, reward, *ends, info = own.step(action)
        same, expected, *expected_ends, _ = usual.step(action)
        assert reward == 2 * expected
        assert ends == expected_ends
        np.testing.assert_array_equal(shown["achieved_goal"], same["achieved_goal"])
        assert own.unwrapped.compute_reward(shown["achieved_goal"], observation["desired_goal"], info) == reward
        other = random.permutation([own.unwrapped.observation_space["desired_goal"].sample() for _ in range(3)])
        infos = [info] * 3
        placed = np.repeat(shown["achieved_goal"][None], 3, 0)
        np.testing.assert_allclose(
            own.unwrapped.compute_reward(placed, other, infos), 2 * usual.unwrapped.compute_reward(placed, other, infos)
        )


def test_a_reward_of_ones_own_is_refused_where_it_means_nothing(doubled):
    with pytest.raises(InvalidSetting, match="architecture A"):
        mh.make("SupervisorA", reward={"function": doubled})
    with pytest.raises(UnknownChoice, match="doubeld"):
        mh.make(reward={"function": "doubeld"})
