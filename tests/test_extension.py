"""What can be added is one file in any folder, found by its name: arm, backend, policy, layout, algorithm, physics engine."""

from __future__ import annotations

import json
import pickle
import re
import subprocess
import sys

import pytest

from marl_handover import plugins
from marl_handover.cli import main
from marl_handover.experiments.executor import fan_out
from marl_handover.learning.settings import ALGORITHMS

ARM = """
arms:
  - {name: near, x_mm: -175, facing_deg: 0}
  - {name: far, x_mm: 175, facing_deg: 180}
"""

BACKEND = """
from marl_handover.config import BACKENDS
from marl_handover.envs.backends import NoisyBackend


@BACKENDS.register("coarse")
class Coarse(NoisyBackend):
    def _moved(self, arm, transfer):
        done = super()._moved(arm, transfer)
        self.put(done.pose.round(0))
        return done._replace(pose=self._pose.copy())
"""

ENGINE = """
from marl_handover.config import ENGINES
from marl_handover.simulation.engine import default_engine


@ENGINES.register("told")
class Told(ENGINES[default_engine()]):
    def close(self):
        print(f"{self.time_s:.1f} s have passed")
        super().close()
"""

POLICY = """
import numpy as np

from marl_handover.policies import POLICIES
from marl_handover.policies.registry import ExactPolicy


@POLICIES.register("hesitant")
class Hesitant(ExactPolicy):
    def __init__(self, rules, seed=0):
        super().__init__(rules)
        self.name, self.random = "hesitant", np.random.default_rng(seed)

    def act(self, pose, goal, previous_arm):
        action = super().act(pose, goal, previous_arm)
        waits = self.random.random(pose.shape[:-1]) < 0.3
        action[..., 0] = np.where(waits, -1.0, action[..., 0])
        return action
"""

LAYOUT = """
from marl_handover.arrays import namespace
from marl_handover.config import LAYOUTS
from marl_handover.task.observations import Layout


def with_difference(rules, pose, goal, previous_arm, epsilon_rad):
    scale = rules.cell.r_max_mm
    parts = [pose[..., :2] / scale, goal[..., :2] / scale, pose[..., 2:] - goal[..., 2:]]
    return namespace(pose).concat(parts, -1)


LAYOUTS.register("difference")(Layout(with_difference, lambda num_arms: 5))
"""

ALGORITHM = """
from dataclasses import dataclass

from marl_handover.baselines.flat_sac import FlatSac, FlatSacConfig
from marl_handover.config import bounded
from marl_handover.learning.algorithm import register_algorithm


@dataclass
class BolderConfig(FlatSacConfig):
    name: str = "bolder"
    boldness: float = bounded(2.0, 1.0, 10.0)  # how much wider than its policy it explores


@register_algorithm(BolderConfig)
class Bolder(FlatSac):
    config: BolderConfig

    def explore(self, observation):
        return self.loss.drawn(observation, self.config.boldness * self._noise(len(observation)))[0].detach()
"""

SHORT = [
    *("compile=off", "progress=false", "num_envs=16", "steps=512", "evaluation_interval=512", "evaluation_episodes=20"),
    *("algorithm.hidden=[16]", "algorithm.learning_starts=256", "algorithm.batch_size=32", "algorithm.env_steps_per_gradient_step=32"),
]


@pytest.fixture
def write(tmp_path, no_new_plugins):
    """``write("name.py", text)``: the path of a file in a folder of its own; afterwards nobody knows what it registered."""

    def make(name, text):
        path = tmp_path / name
        path.write_text(text)
        return str(path)

    return make


def evaluated(tmp_path, *arguments):
    """What ``evaluate`` reports."""
    path = tmp_path / "result.json"
    assert main(["evaluate", "progress=false", "episodes=40", f"json={path}", *arguments]) == 0
    return json.loads(path.read_text())


def test_an_arm(write, tmp_path):
    cell = write("near.yaml", ARM)
    assert evaluated(tmp_path, f"cell={cell}")["success_rate"] == 1.0
    trace = tmp_path / "trace.jsonl"
    assert main(["evaluate", "progress=false", "episodes=3", f"cell={cell}", f"trace={trace}"]) == 0
    assert trace.read_text()


def test_a_backend(write, tmp_path):
    file = write("coarse.py", BACKEND)
    report = evaluated(tmp_path, f"plugins={file}", "backend=coarse", "episodes=3")
    assert (report["backend"], report["episodes"]) == ("coarse", 3)


def test_a_physics_engine(write, capsys):
    file = write("told.py", ENGINE)
    problem = ["start=[60,-10,0]", "goal=[-60,-10,-35.1]", "grasp=constraint"]
    assert main(["simulate", f"plugins={file}", "engine=told", *problem, "progress=false"]) == 0
    assert re.search(r"^[\d.]+ s have passed$", capsys.readouterr().out, re.MULTILINE)


def test_a_policy(write, tmp_path, capsys):
    file = write("hesitant.py", POLICY)
    report = evaluated(tmp_path, f"plugins={file}", "policy=hesitant")
    assert report["success_rate"] > 0.5
    assert report["mean_steps"] > report["optimal_mean_steps"]
    assert evaluated(tmp_path, f"plugins={file}", "policy=shielded:hesitant")["success_rate"] >= report["success_rate"]


def test_a_layout(write, tmp_path):
    file, run = write("difference.py", LAYOUT), tmp_path / "run"
    assert main(["train", f"plugins={file}", "algorithm=flat_sac", "algorithm.layout=difference", f"out={run}", *SHORT]) == 0
    assert evaluated(tmp_path, f"plugins={file}", f"policy={run}")["episodes"] == 40


def test_an_algorithm(write, tmp_path, capsys):
    file, run = write("bolder.py", ALGORITHM), tmp_path / "run"
    assert main(["train", f"plugins={file}", "algorithm=bolder", "algorithm.boldness=3", f"out={run}", *SHORT]) == 0
    assert evaluated(tmp_path, f"policy={run}")["episodes"] == 40
    assert main(["train", f"plugins={file}", f"resume={run}", "steps=512", "progress=false"]) == 0
    capsys.readouterr()
    assert main(["train", f"plugins={file}", "--help"]) == 0
    assert "how much wider than its policy it explores" in capsys.readouterr().out
    assert main(["train", "algorithm=bolder", "algorithm.boldness=0"]) == 2
    assert "algorithm.boldness = 0.0: must be between 1 and 10" in capsys.readouterr().err


@pytest.mark.slow
def test_worker_processes_know_them_too(write):
    with plugins.added([write("bolder.py", ALGORITHM)]):
        config = ALGORITHMS["bolder"](boldness=4.0)
        found = list(fan_out(lambda settings: settings.boldness, [config, config], jobs=2, progress=False))
    assert [boldness for _, boldness in found] == [4.0, 4.0]


def test_a_name_without_its_plugin_is_unknown(write, capsys):
    assert main(["train", "algorithm=bolder"]) == 2
    assert "choose one of: sac, graph_sac, flat_sac, td3, ppo, dqn" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "said"), [(None, "plugin not found"), ("import nowhere", "No module named 'nowhere'"), ("x = (", "SyntaxError")]
)
def test_a_plugin_that_cannot_be_loaded_is_told_in_one_line(write, tmp_path, capsys, text, said):
    path = str(tmp_path / "none.py") if text is None else write("bad.py", text)
    assert main(["evaluate", f"plugins={path}", "episodes=2"]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert len(err.splitlines()) == 1


IN_WORKERS = (
    *("source=aec", "workers=2", "compile=off", "progress=false", "num_envs=4", "steps=64", "evaluation_interval=64"),
    *("evaluation_episodes=10", "algorithm.hidden=[16]", "algorithm.learning_starts=32", "algorithm.batch_size=16"),
)


@pytest.mark.slow
@pytest.mark.parametrize("collector", ["multiprocess", "ray"])
def test_collecting_workers_know_an_algorithm_too(write, tmp_path, collector):
    if collector == "ray":
        pytest.importorskip("ray")
    file, run = write("bolder.py", ALGORITHM), tmp_path / "run"
    assert main(["train", f"plugins={file}", "algorithm=bolder", f"collector={collector}", f"out={run}", *IN_WORKERS]) == 0
    assert evaluated(tmp_path, f"plugins={file}", f"policy={run}")["episodes"] == 40


def test_what_a_parcel_holds_is_unpacked_where_its_plugins_are_known(write):
    def boldness():
        from marl_handover.learning.settings import ALGORITHMS  # the worker's own

        return ALGORITHMS["bolder"](boldness=4.0).boldness

    with plugins.added([write("bolder.py", ALGORITHM)]):
        parcel = plugins.Parcel(boldness)
    code = "import pickle, sys; print(pickle.load(sys.stdin.buffer)())"
    found = subprocess.run([sys.executable, "-c", code], input=pickle.dumps(parcel), capture_output=True)
    assert found.stdout.split() == [b"4.0"], found.stderr
