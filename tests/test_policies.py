"""Policies by name, from a file without torch, and the same in numpy as in torch."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from marl_handover import policies
from marl_handover.cell import cell_config, load_cell
from marl_handover.cli import main
from marl_handover.compose import compose
from marl_handover.config import TaskConfig
from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile, UnknownChoice
from marl_handover.files import package_path
from marl_handover.learning.checkpoint import policy_arrays, run_arrays, save_policy
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.learning.trainer import Trainer
from marl_handover.learning.variant import Variant
from marl_handover.task.episode import play
from marl_handover.task.observations import observe
from marl_handover.task.rules import Outcome, Rules

KINDS = {
    "sac": ("algorithm=sac", "algorithm.mixture_components=1"),
    "sac A": ("algorithm=sac", "algorithm.mixture_components=3", "task.architecture=A"),
    "sac unfolded": ("algorithm=sac", "algorithm.mixture_components=2", "algorithm.canonical=false", "algorithm.harmonics=0"),
    "flat_sac": ("algorithm=flat_sac",),
    "td3 raw": ("algorithm=td3", "algorithm.layout=raw"),
    "ppo A": ("algorithm=ppo", "task.architecture=A"),
}


def untrained(paper, *overrides):
    """An algorithm with random weights, and its settings."""
    config = compose(TrainConfig, ["compile=off", *overrides], groups={"algorithm": ALGORITHMS})
    config.validate()
    torch.manual_seed(4)
    return Variant().algorithm(Rules(paper, config.task), config, torch.Generator().manual_seed(0)), config


@pytest.fixture(scope="module")
def file(paper, tmp_path_factory):
    """A policy file with random weights."""
    algorithm, config = untrained(paper, *KINDS["sac"])
    path = tmp_path_factory.mktemp("policy") / "policy.npz"
    save_policy(path, policy_arrays(algorithm, config, "a test"))
    return path


def observation(start, goal, previous):
    return {"state": start.astype(np.float32), "goal": goal.astype(np.float32), "previous_arm": int(previous) + 1}


@pytest.mark.parametrize("kind", KINDS)
def test_numpy_policy_is_the_torch_actor(paper, draw, tmp_path, kind):
    algorithm, config = untrained(paper, *KINDS[kind])
    save_policy(tmp_path / "policy.npz", policy_arrays(algorithm, config, "a test"))
    policy = policies.load(str(tmp_path / "policy.npz"))
    start, goal, previous, _ = draw(paper, 500, 1)
    seen = observe(policy.rules, config.algorithm.layout, start, goal, previous).astype(np.float32)
    expected = algorithm.act(torch.tensor(seen)).numpy()
    found = policy.act(start, goal, previous)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    one_by_one = [policy.act(*problem) for problem in zip(start[:50], goal[:50], previous[:50], strict=True)]
    np.testing.assert_allclose(one_by_one, found[:50], atol=1e-5)
    assert policy.rules.config.architecture == config.task.architecture
    assert found[:, 2:].std() > 0
    if config.algorithm.name == "sac" and config.task.architecture == "A":
        assert (found[:, 0] < 0).all()


def test_policy_file_round_trip(paper, file):
    algorithm, config = untrained(paper, *KINDS["sac"])
    arrays, stored = policy_arrays(algorithm, config, "a test"), policies.read_policy(file)
    assert arrays.keys() == stored.keys()
    for key, value in arrays.items():
        np.testing.assert_array_equal(stored[key], value)
    about = json.loads(str(stored["about"]))
    cell, task = policies.stored_settings(about)
    assert (cell, task) == (config.cell, config.task)
    assert about["origin"] == "a test"


def test_run_directory_and_its_exported_file_are_one_policy(paper, draw, tmp_path):
    config = compose(TrainConfig, ["compile=off", "algorithm.actor_hidden=[16]"], groups={"algorithm": ALGORITHMS})
    trainer = Trainer(config, tmp_path)
    trainer.save()
    save_policy(tmp_path / "policy.npz", run_arrays(tmp_path))
    problem = draw(paper, 50, 2)[:3]
    actions = [policies.load(str(path)).act(*problem) for path in (tmp_path, tmp_path / "policy.npz")]
    np.testing.assert_array_equal(*actions)
    seen = observe(trainer.rules, "relative", *problem).astype(np.float32)
    np.testing.assert_allclose(actions[0], trainer.algorithm.act(torch.tensor(seen)).numpy(), atol=1e-5)


@pytest.mark.parametrize("name", ["exact", "random", "greedy", "FILE"])
def test_no_policy_needs_torch(file, name):
    code = f"""
import sys
sys.modules["torch"] = None
from marl_handover.policies import load
policy = load({str(file) if name == "FILE" else name!r})
action = policy({{"state": [0.0, 100.0, 1.0], "goal": [10.0, -120.0, -2.0], "previous_arm": 0}})
print(action["final"], action["arm"], *action["place"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.split()) == 4


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize("name", ["exact", "random", "greedy", "FILE"])
def test_called_with_an_observation_it_answers_an_action(paper, draw, file, name, architecture):
    policy = policies.load(str(file) if name == "FILE" else name, paper, TaskConfig(architecture=architecture))
    for start, goal, previous in zip(*draw(paper, 30, 3)[:3], strict=True):
        action = policy(observation(start, goal, previous))
        assert set(action) == {"final", "arm", "place"}
        assert action["final"] in (0, 1)
        assert action["arm"] in (0, 1)
        assert action["place"].shape == (2,)
        assert action["place"].dtype == np.float32
        assert (abs(action["place"]) <= 1).all()


def success_rate(policy, problems):
    episodes = play(policy.rules, policy.act, *problems)
    return (episodes.outcome == int(Outcome.SUCCESS)).mean(), episodes.transfers.mean()


def test_exact_beats_greedy_beats_random(paper, draw):
    problems = draw(paper, 400, 4)[:2]
    rates = {name: success_rate(policies.load(name, paper), problems) for name in ("exact", "greedy", "random")}
    assert rates["exact"][0] == 1.0
    assert rates["exact"][1] < rates["greedy"][1]
    assert rates["exact"][0] > rates["greedy"][0] > rates["random"][0] + 0.1


def test_random_policy_follows_its_seed(paper, draw):
    problem = draw(paper, 20, 5)[:3]
    one, again, other = (policies.load("random", paper, seed=seed).act(*problem) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    assert (abs(one) <= 1).all()


def test_a_policy_under_another_epsilon(paper, draw, file):
    start, goal, previous, _ = draw(paper, 300, 6)
    wide = Rules(paper, TaskConfig(epsilon_deg=60.0))
    for name in ("exact", "greedy", str(file)):
        policy = policies.load(name, paper)
        before = policy.act(start, goal, previous)
        other = policy.under(wide)
        assert other.rules is wide
        assert (other.act(start, goal, previous) != before).any(), "the accuracy is part of what is seen"
        np.testing.assert_array_equal(policy.act(start, goal, previous), before)
    exact = policies.load("exact", paper)
    assert success_rate(exact.under(wide), (start, goal))[1] < success_rate(exact, (start, goal))[1]
    assert exact.rules.epsilon_rad == pytest.approx(math.radians(5))


@pytest.mark.parametrize("name", ["exakt", "best", "pretrained"])
def test_unknown_names(name):
    with pytest.raises((UnknownChoice, MissingFile)) as error:
        policies.load(name)
    assert "exact, random, greedy" in str(error.value)


def test_missing_files(tmp_path):
    for path in (tmp_path / "run", tmp_path / "policy.npz", tmp_path):
        with pytest.raises(MissingFile, match=str(tmp_path)):
            policies.load(str(path))


def assert_corrupt(path):
    with pytest.raises(CorruptFile, match="policy file"):
        policies.load(str(path))


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_a_truncated_file_is_corrupt(tmp_path, file, kept):
    content = file.read_bytes()
    (tmp_path / "policy.npz").write_bytes(content[: int(kept * len(content))])
    assert_corrupt(tmp_path / "policy.npz")


def test_a_file_with_objects_is_corrupt(tmp_path, file):
    path = tmp_path / "policy.npz"
    np.savez(path, **{**policies.read_policy(file), "about": np.array([object()])}, allow_pickle=True)
    assert_corrupt(path)


@pytest.mark.parametrize("key", ["about", "weight_1", "bias_0"])
def test_a_file_without_an_array_is_corrupt(tmp_path, file, key):
    path = tmp_path / "policy.npz"
    np.savez(path, **{name: value for name, value in policies.read_policy(file).items() if name != key})
    assert_corrupt(path)


@pytest.mark.parametrize("key", ["layers", "kind", "layout", "cell", "task"])
def test_a_file_that_does_not_say_what_it_is_is_corrupt(tmp_path, file, key):
    path, arrays = tmp_path / "policy.npz", policies.read_policy(file)
    about = {name: value for name, value in json.loads(str(arrays["about"])).items() if name != key}
    np.savez(path, **{**arrays, "about": np.array(json.dumps(about))})
    assert_corrupt(path)


@pytest.mark.parametrize("kept", [("chart", "cell"), ("cell",), ("chart",), ()])
@pytest.mark.parametrize(("trained", "other"), [("paper", "angle"), ("angle", "paper")])
def test_places_told_in_another_chart_are_refused(tmp_path, file, trained, other, kept):
    """Whether the file says it by itself, by its cell, or, as older ones, not at all: then it is the paper's."""
    path, arrays = tmp_path / "policy.npz", policies.read_policy(file)
    about = json.loads(str(arrays["about"]))
    assert about.pop("chart") == "paper"
    about["cell"]["chart"] = trained if "cell" in kept else None
    about |= {"chart": trained} if "chart" in kept else {}
    np.savez(path, **{**arrays, "about": np.array(json.dumps(about))})
    trained, other = (trained, other) if kept else ("paper", "angle")
    cells = {chart: load_cell(replace(cell_config("paper"), chart=chart)) for chart in ("paper", "angle")}
    assert policies.load(str(path), cell=cells[trained]).rules.cell.chart_name == trained
    with pytest.raises(InvalidSetting, match=f"cell.chart = '{other}': must be '{trained}'"):
        policies.load(str(path), cell=cells[other])


def test_the_pairs_own_policy_does_not_act_on_the_angle_chart(capsys):
    assert main(["evaluate", "policy=pretrained_b", "cell.chart=angle", "episodes=2"]) == 2
    assert "cell.chart = 'angle': must be 'paper'" in capsys.readouterr().err


def test_a_run_is_loaded_in_a_cell_with_a_disc_on_the_middle_of_a_ring():
    """Where no arm can have the object a policy has no answer; that is no fault of its file."""
    cell = load_cell(cell_config("scattered8"))
    middles = np.array([arm.at((arm.r_min_mm + arm.r_max_mm) / 2, sum(arm.yaw_rad) / 2) for arm in cell.arms])
    assert not cell.reaches(middles).any(-1).all()
    path = str(package_path("pretrained/any.npz"))
    assert policies.load(path, cell=cell).rules.cell is cell
