"""Supervisor policies by name, as plain callables on numpy. Nothing here needs torch unless a run directory's checkpoint is read.

A policy answers two calls: ``policy(observation)`` takes one observation of the AEC supervisor (``state``, ``goal``,
``previous_arm`` 0 none, 1 L, 2 R) and returns its action (``final``, ``arm``, ``place``); ``policy.act(pose, goal,
previous_arm)`` takes batches (n, 3), (n, 3), (n,) (-1 none, 0 L, 1 R), or single problems (3,), (3,), (), and returns
actions (n, 4) or (4,).
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import select
from marl_handover.cell import Cell, load_cell
from marl_handover.config import CellConfig, MotionConfig, NoiseConfig, RewardConfig, TaskConfig
from marl_handover.errors import CheckpointMismatch, CorruptFile, MissingFile, UnknownChoice
from marl_handover.motion.cost import motion_cost
from marl_handover.resources import package_path
from marl_handover.task.observations import ARM_FIELDS, ODD_FIELDS, observation_size, observe
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Rules

Floats = NDArray[np.float64]
KINDS = ("hybrid", "box")
NAMES = ("exact", "random", "greedy", "pretrained_a", "pretrained_b")


class SupervisorPolicy(ABC):
    """A supervisor of one cell.

    Attributes:
        rules: the rule book it acts under; ``rules.epsilon_rad`` is the accuracy it aims at.
        name: what it was loaded as.
    """

    variant = "hierarchical"

    def __init__(self, rules: Rules, name: str) -> None:
        self.rules, self.name = rules, name

    @abstractmethod
    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """Actions: final, arm, alpha, beta."""

    def under(self, rules: Rules) -> SupervisorPolicy:
        """The same policy acting under another rule book, with another epsilon for instance."""
        other = copy(self)
        other.rules = rules
        return other

    def __call__(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The AEC supervisor's action for its observation."""
        pose, goal = np.asarray(observation["state"], float), np.asarray(observation["goal"], float)
        action = self.act(pose, goal, np.asarray(observation["previous_arm"]) - 1)
        return {"final": int(action[0] > 0), "arm": int(action[1] > 0), "place": np.asarray(action[2:], np.float32)}


class ExactPolicy(SupervisorPolicy):
    """The exact planner in closed loop: the yardstick."""

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules, "exact")
        self.planner = ExactPlanner(rules)

    def under(self, rules: Rules) -> SupervisorPolicy:
        """A planner for that rule book."""
        return ExactPolicy(rules)

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The first action of an optimal plan."""
        return self.planner.act(pose, goal)


class RandomPolicy(SupervisorPolicy):
    """Uniform actions."""

    def __init__(self, rules: Rules, seed: int = 0) -> None:
        super().__init__(rules, "random")
        self.generator = np.random.default_rng(seed)

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """Anything."""
        return self.generator.uniform(-1.0, 1.0, (*pose.shape[:-1], 4))


class GreedyPolicy(SupervisorPolicy):
    """Nearest arm: finishes when an arm can; else the nearer arm hands over, at the place of a few that leaves the other the
    least error.
    """

    PLACES = 33

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules, "greedy")

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """One greedy step ahead."""
        cell = self.rules.cell
        able = self.rules.can_finish(pose, goal)
        finish = able.any(-1)
        square, yaw = cell.polar(pose)
        near = np.where(cell.within(square, yaw), square, math.inf).argmin(-1)
        alpha = np.linspace(-1.0, 1.0, self.PLACES)
        table = cell.chart.to_table(alpha, 0 * alpha)
        turn = cell.polar(table)[1] - yaw[..., None, :]
        placed_theta = pose[..., 2, None] + select(turn, np.broadcast_to(near[..., None], turn.shape[:-1]))
        placed = np.concatenate([np.broadcast_to(table, (*placed_theta.shape, 2)), placed_theta[..., None]], -1)
        error = abs(self.rules.finishing_error(placed, np.broadcast_to(goal[..., None, :], placed.shape)))
        other = np.broadcast_to((1 - near)[..., None], placed_theta.shape)
        best = select(error, other).argmin(-1)
        arm = np.where(finish, able.argmax(-1), near)
        return np.stack([np.where(finish, 1.0, -1.0), np.where(arm > 0, 1.0, -1.0), alpha[best], 0.0 * alpha[best]], -1)


class NetworkPolicy(SupervisorPolicy):
    """A trained actor, evaluated in numpy.

    Args:
        rules: the rule book to act under.
        name: what it was loaded as.
        arrays: weights, from a policy file.
        about: what the file says of them.
    """

    def __init__(self, rules: Rules, name: str, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        super().__init__(rules, name)
        self.about = dict(about)
        self.layers = [(arrays[f"weight_{index}"], arrays[f"bias_{index}"]) for index in range(about["layers"])]
        self.hybrid = about["kind"] == "hybrid"
        self.odd = np.array([-1.0 if field in ODD_FIELDS else 1.0 for field in ARM_FIELDS], np.float32)
        self.beta_sign = np.array([base.mirror for base in rules.cell.bases], np.float32)
        self.sines = [ARM_FIELDS.index(field) for field in ("sin_hand_over", "sin_finish_error")]
        self.angles = [ARM_FIELDS.index(field) for field in ("cos_finish_error", "cos_hand_over")]

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The likeliest branch and its mean place."""
        observation = observe(self.rules, self.about["layout"], pose, goal, previous_arm).astype(np.float32)
        return self._hybrid(observation) if self.hybrid else np.tanh(self._forward(observation)[..., :4])

    def _forward(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        for weight, bias in self.layers[:-1]:
            x = np.maximum(x @ weight + bias, 0)
        weight, bias = self.layers[-1]
        return x @ weight + bias

    def _hybrid(self, observation: NDArray[np.float32]) -> Floats:
        modes = self.about["modes"]
        blocks = observation.reshape(*observation.shape[:-1], -1, len(ARM_FIELDS))
        sign = self._sign(blocks)
        turned = np.where(sign[..., None] < 0, blocks * self.odd, blocks)
        out = self._forward(self._harmonics(turned))
        logits = out[..., : 1 + modes]
        if self.rules.external_finish:
            logits[..., 0] = -math.inf
        flat = logits.reshape(*logits.shape[:-2], -1)
        branch = flat.argmax(-1)
        arm, choice = np.divmod(branch, 1 + modes)
        mean = np.tanh(out[..., 1 + modes : 1 + 3 * modes]).reshape(*out.shape[:-2], -1, 2)
        index = arm * modes + np.maximum(choice - 1, 0)
        place = np.take_along_axis(mean, np.asarray(index)[..., None, None], -2)[..., 0, :]
        final, right = np.where(choice == 0, 1.0, -1.0), 2.0 * arm - 1.0
        return np.stack([final, right, place[..., 0] * select(sign, arm), place[..., 1] * self.beta_sign[arm]], -1)

    def _sign(self, blocks: NDArray[np.float32]) -> NDArray[np.float32]:
        if not self.about["canonical"]:
            return np.ones_like(blocks[..., 0])
        hand_over, finish = (blocks[..., index] for index in self.sines)
        return np.where(np.where(hand_over == 0, finish, hand_over) < 0, np.float32(-1), np.float32(1))

    def _harmonics(self, blocks: NDArray[np.float32]) -> NDArray[np.float32]:
        parts = [blocks]
        for index in self.angles:
            cosine, sine = blocks[..., index], blocks[..., index + 1]
            for _ in range(self.about["harmonics"]):
                cosine, sine = cosine * cosine - sine * sine, 2 * sine * cosine
                parts.append(np.stack([cosine, sine], -1))
        return np.concatenate(parts, -1)


def load(
    name: str, cell: Cell | None = None, task: TaskConfig | None = None, seed: int = 0, *, motion: MotionConfig | None = None
) -> SupervisorPolicy:
    """A policy by name: ``exact``, ``random``, ``greedy``, ``pretrained_a``, ``pretrained_b``, a run directory or a policy file (``.npz``).

    Args:
        name: see above.
        cell: the cell; the trained policy's own, or the shipped ``paper`` cell, if None.
        task: the task; the trained policy's own, or the defaults, if None.
        seed: of ``random``.
        motion: how the arms move whose ways are priced; the defaults if None.

    Raises:
        UnknownChoice, MissingFile, CorruptFile, CheckpointMismatch: if there is no such policy or its file is not whole.
    """
    if name in ("exact", "random", "greedy"):
        rules = _rules(cell or load_cell(), task or TaskConfig(), motion)
        made = {"exact": ExactPolicy, "greedy": GreedyPolicy}
        return RandomPolicy(rules, seed) if name == "random" else made[name](rules)
    arrays = _arrays(name)
    about = json.loads(str(arrays["about"]))
    own_cell, own_task = stored_settings(about)
    return NetworkPolicy(_rules(cell or load_cell(own_cell), task or own_task, motion), name, arrays, about)


def adapted(
    name: str, cell: CellConfig | None = None, seed: int = 0, *, motion: MotionConfig | None = None, **changes: Any
) -> SupervisorPolicy:
    """A policy by name under its own cell and task, except where the caller says otherwise.

    Args:
        name: as in :func:`load`.
        cell: settings of another cell.
        seed: of ``random``.
        motion: as in :func:`load`.
        changes: task settings put over the policy's own; None leaves one as it is.

    Raises:
        CheckpointMismatch: ``architecture`` is asked for and the policy was trained for the other one.
    """
    own = load(name, seed=seed, motion=motion)
    settings = replace(own.rules.config, **{key: value for key, value in changes.items() if value is not None})
    settings.validate()
    trained = own.rules.config.architecture
    if isinstance(own, NetworkPolicy) and settings.architecture != trained:
        raise CheckpointMismatch(name, "architecture", trained, settings.architecture)
    return own.under(_rules(own.rules.cell if cell is None else load_cell(cell), settings, motion))


def _rules(cell: Cell, task: TaskConfig, motion: MotionConfig | None) -> Rules:
    """The rule book that training used too."""
    return Rules(cell, task, motion_cost(cell, task, motion))


def stored_settings(about: Mapping[str, Any]) -> tuple[CellConfig, TaskConfig]:
    """The cell and the task a policy file was trained with."""
    cell = dict(about["cell"])
    cell["block"] = type(CellConfig().block)(**cell["block"])
    task = dict(about["task"])
    task["reward"], task["noise"] = RewardConfig(**task["reward"]), NoiseConfig(**task["noise"])
    return CellConfig(**cell), TaskConfig(**task)


def _arrays(name: str) -> Mapping[str, NDArray[Any]]:
    if name in NAMES:
        return read_policy(package_path(f"pretrained/{name.removeprefix('pretrained_')}.npz"))
    path = Path(name)
    if path.is_dir():
        from marl_handover.learning.export import run_arrays

        return run_arrays(path)
    if path.suffix == ".npz":
        return read_policy(path)
    if path.exists() or path.parent != Path():
        raise MissingFile("run directory or policy file", path, f"or choose one of: {', '.join(NAMES)}")
    raise UnknownChoice("policy", name, (*NAMES, "a run directory", "a policy file (.npz)"))


def read_policy(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a policy file; no pickled objects are read.

    Raises:
        MissingFile, CorruptFile: if it is not there, or not whole.
    """
    if not path.exists():
        raise MissingFile("policy file", path)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
        about = json.loads(str(arrays["about"]))
        width = arrays["weight_0"].shape[0]
        for index in range(about["layers"]):
            weight, bias = arrays[f"weight_{index}"], arrays[f"bias_{index}"]
            if weight.shape != (width, len(bias)):
                raise ValueError(f"layer {index} has shape {weight.shape}")
            width = len(bias)
        if about["kind"] not in KINDS:
            raise ValueError(f"its kind is {about['kind']!r}, not one of {', '.join(KINDS)}")
        observation_size(about["layout"])
        stored_settings(about)
    except Exception as error:  # numpy, zip and json raise many kinds
        reason = str(error).splitlines()[0] if isinstance(error, (KeyError, TypeError)) or "layer" in str(error) else "damaged or no policy"
        raise CorruptFile("policy file", path, f"{reason}; export it again") from error
    return arrays
