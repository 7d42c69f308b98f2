"""The commands as functions, with the same words: ``marl-handover train steps=8000`` is ``mh.train(steps=8000)``.

Keys are keyword arguments, and sections are mappings: ``algorithm={"name": "flat_sac", "hidden": [64, 64]}``. What a keyword cannot
spell is written as on the command line: ``mh.train("preset=epsilon_5deg", "task.epsilon_deg=3")``. But for :func:`simulate`,
nothing is printed but progress, which ``progress=False`` leaves out; errors are those of :mod:`marl_handover.errors`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from marl_handover.cell import Cell, load_cell
from marl_handover.compose import compose
from marl_handover.config import CellConfig, TaskConfig, require_choice
from marl_handover.errors import InvalidSetting
from marl_handover.policies import SupervisorPolicy, load
from marl_handover.progress import showing
from marl_handover.schema import with_settings

ENVIRONMENTS = ("SupervisorA", "SupervisorB")
LIBRARIES = ("gymnasium", "torchrl", "pettingzoo")


def make(name: str = "SupervisorB", library: str = "gymnasium", num_envs: int | None = None, **settings: Any) -> Any:
    """An environment of one of three libraries.

    Args:
        name: ``SupervisorA`` or ``SupervisorB``, the paper's two architectures.
        library: ``gymnasium``, a goal environment; ``torchrl``, a batch of cells; ``pettingzoo``, supervisor and arms by turns (AEC).
        num_envs: cells; of Gymnasium None gives one environment, a number a vector environment. PettingZoo has one.
        settings: settings of the task, such as ``epsilon_deg=1`` or ``reward={"step": -0.1}``; others of the environment: ``cell``,
            ``render_mode`` (Gymnasium, PettingZoo), ``scale_goals`` (Gymnasium), ``seed``, ``device`` (TorchRL), ``backend`` (PettingZoo).

    Returns:
        The Gymnasium environment or vector environment, :class:`~marl_handover.envs.supervisor_env.SupervisorEnv`, or an ``AECEnv``.

    Raises:
        UnknownChoice, UnknownKey, InvalidSetting: for what there is not.
    """
    require_choice("name", name, ENVIRONMENTS)
    require_choice("library", library, LIBRARIES)
    if library == "gymnasium":
        import gymnasium

        key = f"marl_handover/{name}-v0"
        return gymnasium.make(key, **settings) if num_envs is None else gymnasium.make_vec(key, num_envs, **settings)
    own = ("cell", "seed", "device") if library == "torchrl" else ("cell", "backend", "backend_options", "render_mode", "enabled")
    given = {key: settings.pop(key) for key in own if key in settings}
    task = with_settings(TaskConfig(), {"architecture": name[-1], **settings})
    if library == "torchrl":
        from marl_handover.envs.supervisor_env import SupervisorEnv

        cell = given.pop("cell", None)
        return SupervisorEnv(num_envs or 1, cell if isinstance(cell, Cell) else load_cell(cell or CellConfig()), task, **given)
    if num_envs not in (None, 1):
        raise InvalidSetting("num_envs", num_envs, "1 or left out with library='pettingzoo'")
    from marl_handover.envs import handover_aec

    return handover_aec.env(task=task, **given)


def load_policy(name: str, cell: Cell | CellConfig | str | None = None, **settings: Any) -> SupervisorPolicy:
    """A policy by name, run directory or file, as the key ``policy=`` takes them.

    Args:
        name: ``exact``, ``greedy``, ``random``, ``pretrained_b``, a run directory, a policy file, or ``shielded:`` before any of these.
        cell: to act in; its own if None.
        settings: ``seed`` of ``random``; settings of the task, put over its own.

    Raises:
        UnknownChoice, MissingFile, CorruptFile, UnknownKey, InvalidSetting: for what there is not.
    """
    seed = settings.pop("seed", 0)
    built = cell if isinstance(cell, Cell) or cell is None else load_cell(cell)
    policy = load(name, built, seed=seed)
    return load(name, built or policy.rules.cell, with_settings(policy.rules.config, settings), seed) if settings else policy


def train(*overrides: str, **keys: Any) -> Path:
    """Train a supervisor, as ``marl-handover train``; returns the run directory, which :func:`load_policy` takes."""
    from marl_handover.commands import train as command

    return Path(_called(command, "trained", overrides, keys))


def evaluate(*overrides: str, **keys: Any) -> dict[str, Any]:
    """Play episodes of a policy, as ``marl-handover evaluate``; returns what ``json=FILE`` gets: success rate, steps, outcomes."""
    from marl_handover.commands import evaluate as command

    return dict(_called(command, "evaluated", overrides, keys))


def plan(*overrides: str, **keys: Any) -> dict[str, Any]:
    """Solve one problem, as ``marl-handover plan``: ``start`` and ``goal`` are [x_mm, y_mm, theta_deg]; returns what ``json=FILE`` gets.

    Raises:
        WorkFailed: the policy does not reach the goal.
    """
    from marl_handover.commands import plan as command

    return dict(_called(command, "planned", overrides, keys))


def simulate(*overrides: str, **keys: Any) -> None:
    """Play episodes in simulated physics, as ``marl-handover simulate``, and print how they went; ``video=FILE`` makes a film.

    Raises:
        WorkFailed: an episode misses its goal.
    """
    from marl_handover.commands import simulate as command

    _called(command, "run", overrides, keys)


def plot(*overrides: str, **keys: Any) -> Path:
    """Draw a figure, as ``marl-handover plot``; returns the file, or the folder of a suite's figures."""
    from marl_handover.commands import plot as command

    return Path(_called(command, "drawn", overrides, keys))


def _called(command: ModuleType, function: str, overrides: tuple[str, ...], keys: Mapping[str, Any]) -> Any:
    """What a command's function returns for settings in the command line's words."""
    config = compose(command.SCHEMA, [*overrides, *_words(keys)], groups=command.GROUPS, aliases=command.ALIASES)
    with showing(getattr(config, "progress", True)):
        return getattr(command, function)(config) if function == "run" else getattr(command, function)(config, lambda text: None)


def _words(keys: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """``key=value`` of keywords, as the command line has them; a section's option, its ``name``, goes first."""
    for key, value in keys.items():
        if isinstance(value, Mapping):
            if "name" in value:
                yield f"{prefix}{key}={value['name']}"
            yield from _words({name: each for name, each in value.items() if name != "name"}, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}={_word(value)}"


def _word(value: Any) -> str:
    if isinstance(value, (str, Path)):
        return str(value)
    return json.dumps(value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value)
