"""Policies by name: those that learned nothing, those that were trained, and those that a plugin registers."""

from __future__ import annotations

import hashlib
import importlib
import json
import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from marl_handover.cell import Cell, load_cell
from marl_handover.config import CellConfig, CentralisedConfig, MotionConfig, TaskConfig
from marl_handover.errors import CheckpointMismatch, CorruptFile, HandoverError, InvalidSetting, MissingFile, UnknownChoice, first_line
from marl_handover.files import expanded, package_path
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.parsing import parse_object
from marl_handover.plugins import Registry
from marl_handover.policies.files import KINDS, read_policy, require_policy, stored_settings
from marl_handover.policies.policy import SHIELDED, Floats, ResigningPolicy, ShieldedPolicy, SupervisorPolicy
from marl_handover.task.actions import action_of
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Rules

Arrays = Mapping[str, NDArray[Any]]

POLICIES: Registry[Callable[[Rules, int], SupervisorPolicy]] = Registry("policy")
"""Policies that need no file: called with a rule book and a seed. ``POLICIES.register("NAME")`` adds one."""

_FAR_MM2 = 1e12
"""Squared distance that counts for more than any between an arm and an object."""

PRETRAINED = ("pretrained_a", "pretrained_b", "pretrained_twin", "pretrained_any")


def names() -> tuple[str, ...]:
    """All names of policies."""
    return (*POLICIES, *PRETRAINED)


@lru_cache(maxsize=64)
def _hops(num_arms: int, edges: tuple[tuple[int, int], ...]) -> NDArray[np.int64]:
    """The fewest hand-overs from each arm to each other one: (num_arms, num_arms); ``num_arms`` where there is no way."""
    adjacency = np.zeros((num_arms, num_arms))
    for edge in edges:
        adjacency[edge] = 1.0
    return np.minimum(shortest_path(adjacency, directed=False, unweighted=True), num_arms).astype(np.int64)


@POLICIES.register("exact")
class ExactPolicy(SupervisorPolicy):
    """The exact planner in closed loop: the yardstick."""

    any_cell = True

    def __init__(self, rules: Rules, seed: int = 0) -> None:
        super().__init__(rules, "exact")
        self.planner = ExactPlanner(rules)

    def under(self, rules: Rules) -> SupervisorPolicy:
        """The same with a planner for that rule book."""
        other = copy(self)
        other.rules, other.planner = rules, ExactPlanner(rules)
        return other

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The first action of an optimal plan."""
        return self.planner.act(pose, goal)


@POLICIES.register("random")
class RandomPolicy(SupervisorPolicy):
    """Uniform actions."""

    any_cell = True

    def __init__(self, rules: Rules, seed: int = 0) -> None:
        super().__init__(rules, "random")
        self.generator = np.random.default_rng(seed)

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """Anything; in a cell of more than two arms, towards a receiver that shares a place with the arm."""
        cell, count = self.rules.cell, self.rules.cell.num_arms
        action = self.generator.uniform(-1.0, 1.0, (*pose.shape[:-1], self.rules.action_size))
        if count != 2:
            shares = _hops(count, tuple(cell.graph.edges))[action[..., 1 : 1 + count].argmax(-1)] == 1
            receivers = action[..., 1 + count : 1 + 2 * count]
            receivers[~shares] = -1.0
        return action


@POLICIES.register("greedy")
class GreedyPolicy(SupervisorPolicy):
    """Nearest arm: finishes when an arm can; else the nearest arm hands over, at the place of a few that leaves the next one the
    least error. Among many arms, the object goes to those that are fewer hand-overs away from one that reaches the goal.
    """

    any_cell = True
    PLACES = 33

    def __init__(self, rules: Rules, seed: int = 0) -> None:
        super().__init__(rules, "greedy")

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """One greedy step ahead."""
        cell = self.rules.cell
        able = self.rules.can_finish(pose, goal)
        finish = able.any(-1)
        square, yaw = cell.polar(pose)
        away = self._away(goal)
        # Distances decide between arms that can pass the object to one that reaches the goal, or do themselves.
        far = np.where(cell.within(square, yaw), square + _FAR_MM2 * np.maximum(away - 1, 0), math.inf)
        near = far.argmin(-1)
        receiver, place = self._hand_over(near, pose, yaw, goal, away)
        return action_of(finish, np.where(finish, able.argmax(-1), near), receiver, place, cell.num_arms)

    def _away(self, goal: Floats) -> NDArray[np.int64]:
        """How many hand-overs each arm (..., num_arms) is away from one that reaches the goal (..., 3)."""
        cell = self.rules.cell
        hops = _hops(cell.num_arms, tuple(cell.graph.edges))
        away: NDArray[np.int64] = np.where(cell.reaches(goal)[..., None, :], hops, cell.num_arms).min(-1)
        return away

    def _hand_over(
        self, near: NDArray[np.int64], pose: Floats, yaw: Floats, goal: Floats, away: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], Floats]:
        """Receiver (...) and place (..., 2) of hand-overs by the arms ``near`` (...), which see the object at base yaws (..., num_arms)."""
        cell, rules = self.rules.cell, self.rules
        alpha = np.linspace(-1.0, 1.0, self.PLACES)
        goal_yaw = cell.polar(goal)[1]
        least, receiver, at = np.full(np.shape(near), math.inf), np.zeros_like(near), np.zeros(np.shape(near))
        for (i, j), space in cell.graph.edges.items():
            seen = cell.polar(space.to_table(alpha, 0 * alpha))[1]
            for giver, other in ((i, j), (j, i)):
                theta = pose[..., 2, None] + (seen[:, giver] - yaw[..., giver, None])
                error = abs(rules.orientation_error(theta + (goal_yaw[..., other, None] - seen[:, other]), goal[..., 2, None]))
                best = error.argmin(-1)
                left = error.min(-1) + 2 * math.pi * away[..., other]
                better = (near == giver) & (left < least)
                least, receiver, at = np.where(better, left, least), np.where(better, other, receiver), np.where(better, alpha[best], at)
        return receiver, np.stack([at, 0.0 * at], -1)


def load(
    name: str, cell: Cell | None = None, task: TaskConfig | None = None, seed: int = 0, *, motion: MotionConfig | None = None
) -> SupervisorPolicy:
    """A policy by name: ``exact``, ``random``, ``greedy``, ``pretrained_a``, ``pretrained_b``, ``pretrained_twin``, ``pretrained_any``,
    a run directory or a policy file (``.npz``), or any of these shielded, as ``shielded:NAME``.

    Args:
        name: see above.
        cell: the cell; the trained policy's own, or the shipped ``paper`` cell, if None.
        task: the task; the trained policy's own, or the defaults, if None.
        seed: of ``random``.
        motion: how the arms move whose ways are priced; the defaults if None.

    Raises:
        UnknownChoice, MissingFile, CorruptFile, CheckpointMismatch: if there is no such policy or its file is not whole.
    """
    if name.startswith(SHIELDED):
        inner = name.removeprefix(SHIELDED)
        if inner.startswith(SHIELDED):
            raise InvalidSetting("policy", name, f"shielded once, {SHIELDED}NAME")
        return ShieldedPolicy(load(inner, cell, task, seed, motion=motion))
    if name in POLICIES:
        return POLICIES[name](_rules(cell or load_cell(), task or TaskConfig(), motion), seed)
    arrays = _arrays(name)
    try:
        policy = _made(name, arrays, cell, task, motion)
        _try_out(policy)
    except HandoverError:
        raise
    except Exception as error:  # of numbers that are none, of layers that are too narrow, and whatever else such a file can hold
        raise CorruptFile("policy", name, f"what it holds does not fit together ({first_line(error)[:100]})") from error
    return policy


def _made(name: str, arrays: Arrays, cell: Cell | None, task: TaskConfig | None, motion: MotionConfig | None) -> SupervisorPolicy:
    about = parse_object(str(arrays["about"]))
    own_cell, own_task = stored_settings(about)
    rules = _rules(cell or load_cell(own_cell), task or own_task, motion, about)
    module, _, kind = KINDS[about["kind"]].partition(":")
    policy: SupervisorPolicy = getattr(importlib.import_module(module), kind)(rules, name, arrays, about)
    return policy


def _try_out(policy: SupervisorPolicy) -> None:
    """Ask a policy for two decisions, so that what cannot act is refused when it is loaded. Raises whatever that raises."""
    cell = policy.rules.cell
    pose = np.array([[*arm.at((arm.r_min_mm + arm.r_max_mm) / 2, sum(arm.yaw_rad) / 2), 0.0] for arm in cell.arms])
    with np.errstate(all="ignore"):
        action = policy.act(pose, pose[::-1], np.arange(len(pose)) - 1)
    size = policy.rules.action_size
    if action.shape != (len(pose), size):
        raise ValueError(f"its answers have the shape {action.shape[1:]}, not ({size},)")
    may_wait = policy.variant == "decentralised" or cell.config.enabled is not None  # there it means that nobody wants to move
    able = cell.reaches(pose[:, :2]).any(-1)  # the middle of a ring may be a place where nothing can be put
    if not (np.isfinite(action[able & able[::-1]]).all() or may_wait):
        raise ValueError("its answers are no numbers")


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
    if own.about and not own.any_cell and settings.architecture != trained:
        raise CheckpointMismatch(name, "architecture", trained, settings.architecture)
    adapted_to = own.under(_rules(own.rules.cell if cell is None else load_cell(cell), settings, motion, own.about))
    return ResigningPolicy(adapted_to) if adapted_to.rules.cell.config.enabled else adapted_to


def content_hash(name: str) -> str:
    """Short hash of what a trained policy is, wherever its file is, which tells it from another of the same name; empty for a baseline.

    Raises:
        UnknownChoice, MissingFile, CorruptFile, CheckpointMismatch: as :func:`load`.
    """
    name = name.removeprefix(SHIELDED)
    if name in POLICIES:
        return ""
    digest = hashlib.sha256()
    arrays = dict(_arrays(name))
    about = parse_object(str(arrays.pop("about")))
    digest.update(json.dumps({**about, "origin": ""}, sort_keys=True).encode())
    for key, array in sorted(arrays.items()):
        digest.update(f"{key} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:12]


def _rules(cell: Cell, task: TaskConfig, motion: MotionConfig | None, about: Mapping[str, Any] | None = None) -> Rules:
    """The rule book that training used too; ``about`` is what a policy file says of itself.

    Raises:
        TwoArmsOnly: the policy of a file is to act in a cell of other than two arms.
        InvalidSetting: it tells places in another chart than the cell's.
    """
    if about and about["kind"] != "graph":
        cell.require_pair("a trained policy", "policy=pretrained_any, exact and greedy take any cell")
        trained = _trained_chart(about)
        if trained not in ("", cell.chart_name):
            raise InvalidSetting("cell.chart", cell.chart_name, f"{trained!r} for this policy, which tells places in that chart")
    if about and about["variant"] == "centralised":
        from marl_handover.envs.centralised import CentralisedRules

        return CentralisedRules(cell, task, CentralisedConfig(**about["centralised"]), motion)
    return Rules(cell, task, motion_cost(cell, task, motion))


def _trained_chart(about: Mapping[str, Any]) -> str:
    """The chart that a policy file was trained with; empty where an old one does not say, and a grid of places suits any."""
    if about["kind"] == "discrete":
        return ""
    cell = about["cell"]
    mirrored = not cell.get("arms") and not cell.get("obstacles")  # the pair as older files know it has the paper's
    return str(about.get("chart") or cell.get("chart") or ("paper" if mirrored else ""))


def _arrays(name: str) -> Arrays:
    if name in PRETRAINED:
        return read_policy(package_path(f"pretrained/{name.removeprefix('pretrained_')}.npz"))
    path = expanded(name)
    if path.is_dir():
        from marl_handover.learning.checkpoint import run_arrays

        arrays = run_arrays(path)
        require_policy(arrays, path, "policy of the run")
        return arrays
    if path.suffix == ".npz":
        return read_policy(path)
    if path.exists() or path.parent != Path():
        raise MissingFile("run directory or policy file", path, f"or choose one of: {', '.join(names())}")
    raise UnknownChoice("policy", name, (*names(), f"{SHIELDED}NAME", "a run directory", "a policy file (.npz)"))
