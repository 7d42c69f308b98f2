"""The examples run, in small size, with the libraries' own learners."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
STEPS = 2400  # learning starts after 2,000


def loaded(name):
    """An example as a module; nothing of it is run."""
    (path,) = (each for each in EXAMPLES if each.stem == name)
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_it_is_short_enough_to_be_copied(path):
    assert len(path.read_text().splitlines()) <= 80


def test_sb3_her(tmp_path):
    pytest.importorskip("stable_baselines3")
    model = loaded("sb3_her").train(STEPS, str(tmp_path), hidden=16, every=STEPS)
    assert model._n_updates > 0
    curve = np.load(tmp_path / "evaluations.npz")
    assert curve["timesteps"].tolist() == [STEPS]
    assert curve["successes"].shape == (1, 500)
    assert (tmp_path / "best_model.zip").is_file()


def test_torchrl_sac():
    ((step, success),) = loaded("torchrl_sac").train(STEPS, cells=60, hidden=16, every=STEPS)
    assert step == STEPS
    assert 0 <= success <= 1


def test_hindsight_of_torchrl_sac_says_what_the_environment_says():
    """Each relabelled command, played with the goal it was given, brings the reward and the end that hindsight tells."""
    example = loaded("torchrl_sac")
    settings = {"epsilon_deg": example.EPSILON_DEG, "reward": example.REWARD}
    env, one = (
        example.mh.make("SupervisorB", library="torchrl", num_envs=64, seed=1, **settings),
        example.mh.make("SupervisorB", **settings),
    )
    goals = []
    shown = env.observe
    env.observe = lambda pose, goal, *rest: goals.append(goal) or shown(pose, goal, *rest)
    taken, _ = env.step_and_maybe_reset(env.rand_action(env.reset()))
    goals.clear()
    rows = example.hindsight(env, taken)
    assert 0 < len(rows) < len(taken)
    for row, goal in zip(rows, goals[0], strict=True):
        one.reset(options={"state": row["achieved_goal"].tolist(), "goal": goal.tolist()})
        _, reward, terminated, _, _ = one.step(row["action"].numpy())
        assert reward == pytest.approx(row["next", "reward"].item())
        assert terminated == row["next", "terminated"].item()
