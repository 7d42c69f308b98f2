"""Cells and random problems that many tests share; hypothesis draws the same examples at every run."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock
from hypothesis import settings

from marl_handover.cell import Cell, build_cell, cell_config, load_cell
from marl_handover.config import RewardConfig, TaskConfig
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules

pytest_plugins = ["learning_fixtures"]
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))  # scripts, no package
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")
torch.set_num_threads(1)


def pytest_configure():
    """What starts the tests may ignore signals, as a shell does for what it runs in the background; they and their children must not."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


ENGINES = {"bullet": "pybullet", "mujoco": "mujoco"}
"""Physics engines, and the packages that they need."""


@pytest.fixture(scope="session", params=ENGINES)
def engine(request):
    """The name of each physics engine that is installed."""
    pytest.importorskip(ENGINES[request.param])
    return request.param


@pytest.fixture(scope="session", autouse=True)
def _registry_of_tests(tmp_path_factory):
    """Sessions of tests stay off the user's session registry: they do not answer when somebody stops real arms meanwhile."""
    from marl_handover.hardware import session_registry

    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("user")
        patch.setattr(session_registry, "user_path", lambda suffix: folder / suffix)
        yield


def _of_this_package(made):
    """Whether an entry of a registry is one of the package's modules, which register once, when they are imported first."""
    return str(getattr(made, "__module__", "marl_handover.")).startswith("marl_handover.")


@pytest.fixture
def no_new_plugins(monkeypatch):
    """What a plug-in registers meanwhile is forgotten afterwards."""
    from marl_handover import plugins
    from marl_handover.config import BACKENDS, ENGINES, LAYOUTS, REWARDS
    from marl_handover.learning.algorithm import LEARNERS
    from marl_handover.learning.settings import ALGORITHMS
    from marl_handover.policies import POLICIES

    monkeypatch.delenv(plugins.VARIABLE, raising=False)
    monkeypatch.setattr(plugins, "_loaded", set())
    tables = [LEARNERS, *(registry._entries for registry in (ALGORITHMS, BACKENDS, ENGINES, LAYOUTS, POLICIES, REWARDS))]
    before = [dict(table) for table in tables]
    yield
    for table, entries in zip(tables, before, strict=True):
        ours = {name: made for name, made in table.items() if name in entries or _of_this_package(made)}
        table.clear()
        table.update(ours)


@pytest.fixture
def empty_session_registry(tmp_path, monkeypatch):
    """No session of another test in this process is registered: what a page stops is then the session that the test made up."""
    from marl_handover.hardware import session_registry

    monkeypatch.setattr(session_registry, "user_path", lambda suffix: tmp_path / f"user{suffix}")


@pytest.fixture(scope="session")
def paper() -> Cell:
    return load_cell("paper")


@pytest.fixture(scope="session", params=["paper", "al5a"])
def cell(request) -> Cell:
    return load_cell(request.param)


@pytest.fixture(scope="session")
def model():
    """The paper's cell with its arms and their shapes."""
    return build_cell(cell_config("paper"))


@pytest.fixture(scope="session")
def planner(model):
    """Its motion planner, whose kernels are compiled once."""
    from marl_handover.motion.planner import MotionPlanner

    return MotionPlanner(model)


@pytest.fixture(scope="session")
def rules_of():
    """Rules of a cell and an architecture; keywords go to the task, ``motion_cost`` to the rules."""

    def make(cell, architecture="B", motion_weight=0.0, motion_cost=None, **task):
        config = TaskConfig(architecture=architecture, reward=RewardConfig(motion_weight=motion_weight), **task)
        return Rules(cell, config, motion_cost) if motion_cost else Rules(cell, config)

    return make


@pytest.fixture(scope="session")
def draw():
    """``draw(cell, count, seed)``: float64 numpy starts, goals, previous arms and actions.

    Half of the starts and half of the goals are moved into the shared space, where most decisions are taken.
    """

    def make(cell, count, seed):
        random = np.random.default_rng(seed)
        start, goal = (array.numpy() for array in sample_problems(cell, count, torch.Generator().manual_seed(seed)))
        for poses in (start, goal):
            shared = random.random(count) < 0.5
            inside = cell.chart.to_table(*random.uniform(-1, 1, (2, count)))
            poses[shared, :2] = inside[shared]
        action = random.uniform(-1, 1, (count, 4))
        return start, goal, random.integers(-1, 2, count), action

    return make


@pytest.fixture(scope="session")
def assert_same_angle():
    """Angles are equal modulo a full turn."""

    def check(actual, desired, atol=1e-9):
        difference = np.asarray(actual) - np.asarray(desired)
        np.testing.assert_allclose(np.remainder(difference + np.pi, 2 * np.pi) - np.pi, 0, atol=atol)

    return check


@pytest.fixture(scope="session")
def twin_calibration(tmp_path_factory):
    """A folder of what ``calibrate`` finds on the twin, with fewer postures than usual; made once for all workers, and only read."""
    from marl_handover.cli import main

    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "twin_calibration"
    with FileLock(f"{folder}.lock"):
        if not (made := Path(f"{folder}.made")).exists():
            arguments = [f"calibration={folder}", "postures=24", f"hardware.stop_file={folder / 'stop'}"]
            assert main(["calibrate", "hardware=twin", *arguments]) == 0
            made.touch()
    return folder
