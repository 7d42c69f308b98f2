"""Actions of the hierarchy as agents send them, spaces of the AEC environment, and observations in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.cell import Cell, CellModel
from marl_handover.config import MotionConfig
from marl_handover.envs.cycle_check import Refusal
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.motion.executor import arm_agents
from marl_handover.motion.trajectory import PickPlacePaths
from marl_handover.task.actions import action_of
from marl_handover.task.rules import Rules

REASONS = (Refusal.DECLINED, Refusal.OUT_OF_REACH, Refusal.NO_PATH)
"""What an arm's ``reason`` stands for; numbers as in :mod:`marl_handover.motion.executor`."""

SNAP_RAD = 1e-6
"""A control point this far beyond a joint's limit is put on it: float32 rounding, not a command."""


def read_command(action: Any, num_arms: int) -> Floats | Refusal:
    """The supervisor's action as the rule book's (size,), or why it is none."""
    final, arm, place = _choice(action, "final", 2), _choice(action, "arm", num_arms), _numbers(action, "place", (2,))
    receiver = 0 if num_arms == 2 else _choice(action, "receiver", num_arms)
    if isinstance(final, Refusal):
        return final
    if isinstance(arm, Refusal):
        return arm
    if isinstance(receiver, Refusal):
        return receiver
    if isinstance(place, Refusal):
        return place
    return action_of(final, arm, receiver, place, num_arms)


def read_cycle(action: Any, control_points: int, arm: ArmModel) -> PickPlacePaths | Refusal:
    """An arm's action as paths, or why it is none."""
    grasp, release = _choice(action, "grasp", 2), _choice(action, "release", 2)
    for value in (grasp, release):
        if isinstance(value, Refusal):
            return value
    if not (grasp and release):
        reason = _choice(action, "reason", len(REASONS)) if "reason" in action else 0  # who declines need not say why
        return reason if isinstance(reason, Refusal) else REASONS[reason]
    paths = _numbers(action, "paths", (3, control_points, len(arm.lower_rad)))
    if isinstance(paths, Refusal):
        return paths
    inside = np.clip(paths, arm.lower_rad, arm.upper_rad)
    return PickPlacePaths(*np.where(abs(paths - inside) <= SNAP_RAD, inside, paths))


def _choice(action: Any, key: str, count: int) -> int | Refusal:
    number = _numbers(action, key, ())
    if isinstance(number, Refusal):
        return number
    return int(number) if number in range(count) else Refusal.WRONG_SHAPE


def _numbers(action: Any, key: str, shape: tuple[int, ...]) -> Floats | Refusal:
    """Finite numbers of that shape; a single one may come wrapped."""
    if not isinstance(action, Mapping) or key not in action:
        return Refusal.WRONG_SHAPE
    try:
        values = np.asarray(action[key], float)
    except (TypeError, ValueError, ArithmeticError, RuntimeError):  # what numpy and torch find wrong with it
        return Refusal.WRONG_SHAPE
    if shape == () and values.size == 1:
        values = values.reshape(())
    if values.shape != shape:
        return Refusal.WRONG_SHAPE
    return values if np.isfinite(values).all() else Refusal.NOT_FINITE


SUPERVISOR = "supervisor"
EDGE_MM = 1.0
"""Positions are shown up to this far outside all reach, where no arm can do anything about them; what lies farther is shown there."""


class Spaces:
    """The spaces of one cell.

    The supervisor observes ``state`` and ``goal`` (3,): x_mm, y_mm, theta_rad, ``previous_arm`` (0 none, 1 L, 2 R) and ``legal`` (4,): at
    ``2 * arm + final`` whether that command can be carried out, which without ``final`` takes that the arm reaches the object, with it that
    it reaches the goal as well; architecture A has no final commands. It acts with ``final``, ``arm`` and ``place``: alpha, beta.

    Of N arms, N != 2, ``previous_arm`` is 0 or 1 + the arm's index, and ``legal`` is (N + N * N): the final commands of each arm, then at
    ``N + N * arm + receiver`` the others, which also take that the two share a place. The action has a ``receiver`` besides: the place
    lies in what the arm shares with it.

    An arm observes whether it is ``active``; the ``target`` (2,) it is to take the object to (the object's own place if it is not active),
    world, mm; the ``object`` (3,); its ``joints`` (5,) and those of the others, ``other_joints``; and whether the transfer is ``final``. It
    acts with ``paths`` (3, N, 5): control points in rad of approach, transfer and retreat; ``grasp`` and ``release``: 0 declines, and then
    ``reason`` says why.

    Args:
        model: all arms; their joints are seen.
        motion: how they move.
        in_order: the cell of those that are in order, who are N, and have agents; all if None.
    """

    def __init__(self, model: CellModel, motion: MotionConfig, in_order: Cell | None = None) -> None:
        cell = in_order or model.cell
        self.num_arms, self.control_points = cell.num_arms, motion.control_points
        self._shares = np.zeros((self.num_arms, self.num_arms), bool)
        for pair in cell.graph.edges:
            self._shares[pair] = self._shares[pair[::-1]] = True
        self._high = np.array([*(value + EDGE_MM for value in model.cell.extent_mm), math.pi], np.float32)
        self._lower = np.stack([arm.lower_rad for arm in model.arms]).astype(np.float32)
        self._upper = np.stack([arm.upper_rad for arm in model.arms]).astype(np.float32)
        self.observation, self.action = {SUPERVISOR: self._supervisor_sees()}, {SUPERVISOR: self._supervisor_acts()}
        for arm, agent in zip(model.cell.numbered(range(cell.num_arms), cell).tolist(), arm_agents(cell), strict=True):
            self.observation[agent], self.action[agent] = self._arm_sees(arm), self._arm_acts(arm)

    def supervisor_sees(self, rules: Rules, pose: Floats, goal: Floats, previous_arm: Any) -> dict[str, Any]:
        """The supervisor's observation; ``previous_arm`` is -1 for none."""
        picks = rules.cell.reaches(pose)
        places = picks & rules.cell.reaches(goal) & (not rules.external_finish)
        return {
            "state": self._shown(pose),
            "goal": self._shown(goal),
            "previous_arm": np.int64(previous_arm + 1),
            "legal": self._legal(picks, places).astype(np.int8),
        }

    def _legal(self, picks: NDArray[np.bool_], places: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which commands can be carried out by arms (N,) that pick up the object, and, of these, place it at the goal."""
        if self.num_arms == 2:
            return np.stack([picks, places], -1).reshape(-1)
        return np.concatenate([places, (picks[:, None] & self._shares).reshape(-1)])

    def arm_sees(self, arm: int, active: bool, target_mm: Floats, final: bool, pose: Floats, joints_rad: Floats) -> dict[str, Any]:
        """An arm's observation; ``joints_rad`` (num_arms, 5) are those of all arms."""
        joints = np.clip(joints_rad.astype(np.float32), self._lower, self._upper)
        return {
            "active": np.int64(active),
            "target": self._shown(target_mm),
            "object": self._shown(pose),
            "joints": joints[arm],
            "other_joints": np.delete(joints, arm, 0).reshape(-1),
            "final": np.int64(final),
        }

    def _shown(self, pose: Floats) -> NDArray[np.float32]:
        high = self._high[: len(pose)]
        return np.clip(pose.astype(np.float32), -high, high)

    def _supervisor_sees(self) -> Dict:
        return Dict(
            state=Box(-self._high, self._high),
            goal=Box(-self._high, self._high),
            previous_arm=Discrete(self.num_arms + 1),
            legal=MultiBinary(4 if self.num_arms == 2 else self.num_arms + self.num_arms**2),
        )

    def _supervisor_acts(self) -> Dict:
        place = Box(-1.0, 1.0, (2,))
        if self.num_arms == 2:
            return Dict(final=Discrete(2), arm=Discrete(2), place=place)
        return Dict(final=Discrete(2), arm=Discrete(self.num_arms), receiver=Discrete(self.num_arms), place=place)

    def _arm_sees(self, arm: int) -> Dict:
        return Dict(
            active=Discrete(2),
            target=Box(-self._high[:2], self._high[:2]),
            object=Box(-self._high, self._high),
            joints=Box(self._lower[arm], self._upper[arm]),
            other_joints=Box(np.delete(self._lower, arm, 0).reshape(-1), np.delete(self._upper, arm, 0).reshape(-1)),
            final=Discrete(2),
        )

    def _arm_acts(self, arm: int) -> Dict:
        lower, upper = self._lower[arm], self._upper[arm]
        shape = (3, self.control_points, len(lower))
        paths = Box(np.broadcast_to(lower, shape), np.broadcast_to(upper, shape))
        return Dict(paths=paths, grasp=Discrete(2), release=Discrete(2), reason=Discrete(len(REASONS)))
