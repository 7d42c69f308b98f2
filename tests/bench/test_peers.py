from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3", reason="the peers extra is not installed")

import common
import peers

from marl_handover.envs.goal_env import SupervisorGoalEnv
from marl_handover.task.observations import observe
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems


@pytest.fixture(scope="module")
def env() -> SupervisorGoalEnv:
    return SupervisorGoalEnv("B")


def problems(env: SupervisorGoalEnv, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    return sample_problems(env.rules.cell, count, torch.Generator().manual_seed(3))


@pytest.mark.parametrize("layout", ["raw", "relative"])
def test_extractor_computes_the_layout_from_the_dict(env: SupervisorGoalEnv, layout: str) -> None:
    pose, goal = problems(env, 300)
    previous = torch.arange(300) % 3 - 1
    inputs = {
        "observation": observe(env.rules, "object", pose, goal, previous).float(),
        "achieved_goal": pose.float(),
        "desired_goal": goal.float(),
    }
    extractor = peers.Layout(env.observation_space, env.rules, layout)
    expected = observe(env.rules, layout, pose.float(), goal.float(), previous)
    got = extractor(inputs)
    assert got.shape == (300, extractor.features_dim)
    torch.testing.assert_close(got, expected)


def filled(variant: str, steps: int = 400) -> Any:
    """A variant's buffer after random transitions, half of them aimed at being solved."""
    model, env = peers.make_model(variant, seed=0)
    buffer, planner, rng = model.replay_buffer, ExactPlanner(env.rules), np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    for _ in range(steps):
        action = planner.act(env._pose, env._goal) if rng.random() < 0.7 else rng.uniform(-1, 1, 4)
        action = np.asarray(action, np.float32)
        after, reward, terminated, truncated, info = env.step(action)
        info["TimeLimit.truncated"] = truncated
        as_batch = [{key: value[None] for key, value in row.items()} for row in (observation, after)]
        buffer.add(*as_batch, action[None], np.array([reward]), np.array([terminated or truncated]), [info])
        observation = env.reset()[0] if terminated or truncated else after
    buffer.truncate_last_trajectory()
    return buffer


@pytest.mark.filterwarnings("ignore:The last trajectory")
@pytest.mark.parametrize(("variant", "corrected"), [("paper_done_g1", True), ("paper_g1", False)])
def test_only_the_correcting_buffer_ends_relabelled_transitions(variant: str, corrected: bool) -> None:
    buffer = filled(variant)
    rows = np.arange(400)
    np.random.seed(0)  # noqa: NPY002 - the peer draws goals from the global generator
    data = buffer._get_virtual_samples(rows, np.zeros_like(rows))
    rewards, dones = data.rewards[:, 0].numpy(), data.dones[:, 0].numpy()
    terminal = (rewards == 20) | (rewards == -30)
    assert set(np.unique(rewards)) == {-30.0, -1.0, 20.0}
    assert ((dones == 1) == terminal).all() == corrected
    if not corrected:
        assert ((rewards == 20) & (dones == 0)).any()


@pytest.mark.filterwarnings("ignore:The last trajectory")
def test_buffer_keeps_only_what_rewards_need() -> None:
    assert set(filled("paper_g1", 30).infos[0, 0]) == {"feasible", "final", "TimeLimit.truncated"}


def test_evaluation_of_the_exact_planner_solves_everything(env: SupervisorGoalEnv) -> None:
    planner = ExactPlanner(env.rules)
    policy = SimpleNamespace(
        set_training_mode=lambda _: None,
        _predict=lambda inputs, deterministic: planner.act(inputs["achieved_goal"].double(), inputs["desired_goal"].double()),
    )
    score = peers.evaluate(SimpleNamespace(policy=policy), env.rules, *problems(env, 500))
    assert score.success_rate >= 0.998
    assert score.mean_steps == pytest.approx(2.94, abs=0.15)


def test_training_leaves_a_curve_and_a_result(tmp_path: Path) -> None:
    peers.main(["variant=paper_g1", "steps=1040", "evaluate_every=512", f"out={tmp_path}"])
    rows = common.read_metrics(tmp_path / "metrics.csv")
    assert [row["steps"] for row in rows] == [512, 1024, 1040]
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["ended"], result["to"]["90"], result["final"]["gradient_steps"]) == ("steps", None, rows[-1]["gradient_steps"])


def test_milestones_are_the_first_rows_at_or_above() -> None:
    rates = (0.2, 0.9, 0.8, 0.96)
    rows = [{"steps": i, "gradient_steps": i, "wall_s": i, "success_rate": rate} for i, rate in enumerate(rates)]
    found = common.milestones(rows)
    assert [hit and hit["steps"] for hit in found.values()] == [1, 1, 3, None]


def test_curriculum_starts_loose_and_evaluation_is_at_the_final_epsilon(tmp_path: Path) -> None:
    model, env = peers.make_model("paper_g1", 0)
    assert math.degrees(env.rules.epsilon_rad) == pytest.approx(15)
    recorder = peers.Recorder(env.rules, tmp_path, 60, 10_000)
    recorder.model = model
    for step, degrees in ((149_999, 15), (150_001, 5)):
        recorder.num_timesteps = step
        recorder.started_wall_s = recorder.started_cpu_s = 1e18
        assert recorder._on_step()
        assert math.degrees(env.rules.epsilon_rad) == pytest.approx(degrees)
