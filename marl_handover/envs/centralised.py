"""The rule book of the centralised formulation: one action decides *and* moves; the motion is judged like the executors' own."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from marl_handover.arrays import Array, namespace, one_where
from marl_handover.cell import Cell, build_cell
from marl_handover.compose import to_yaml
from marl_handover.config import CentralisedConfig, MotionConfig, TaskConfig
from marl_handover.envs.cycle_check import LENGTH_SAMPLES, CycleCheck
from marl_handover.errors import InvalidSetting
from marl_handover.motion.batched_paths import MotionCheck, MotionNumbers, ends_of
from marl_handover.motion.trajectory import sampled_basis
from marl_handover.task.rules import Command, Rules


class MotionCommand(Command):
    """A command with the ``motion`` (..., M) that carries it out, numbers in [-1, 1]."""

    motion: Array

    def __new__(cls, final: Array, arm: Array, place_mm: Array, receiver: Array, motion: Array) -> MotionCommand:
        """As :class:`Command`, and the motion's numbers."""
        command = super().__new__(cls, final, arm, place_mm, receiver)
        command.motion = motion
        return command


class CentralisedRules(Rules):
    """Actions are (final, arm, alpha, beta) and the M numbers of the acting arm's spline. A motion that may not be made is refused.

    Args:
        cell: the cell.
        task: its settings; architecture B, without a weight on the path cost.
        settings: what the numbers mean.
        motion: clearances and the parked pose of the other arm; the defaults if None.

    Raises:
        InvalidSetting: architecture A, or a path cost: both are the executors' matter.
    """

    def __init__(self, cell: Cell, task: TaskConfig, settings: CentralisedConfig, motion: MotionConfig | None = None) -> None:
        super().__init__(cell, task)
        if task.architecture != "B":
            raise InvalidSetting("task.architecture", task.architecture, "B with variant=centralised, whose policy moves the last time too")
        if task.reward.motion_weight:
            weight = task.reward.motion_weight
            raise InvalidSetting("task.reward.motion_weight", weight, "0 with variant=centralised, whose paths have no price")
        settings.validate()
        self.settings = settings
        self.check, self.numbers, self.grip = _checked(cell, settings, motion or MotionConfig())
        self.action_size = Rules.action_size + self.numbers.count

    def decode(self, action: Array) -> MotionCommand:
        """Command of an action (..., 4 + M)."""
        command = super().decode(action[..., : Rules.action_size])
        return MotionCommand(*command, namespace(action).clip(action[..., Rules.action_size :], -1.0, 1.0))

    def transfer(self, pose: Array, goal: Array, command: Command) -> tuple[Array, Array]:
        """As the base class; where the motion may not be made, the arm refuses and the object stays.

        Raises:
            InvalidSetting: for a command without a motion.
        """
        if not isinstance(command, MotionCommand):
            raise InvalidSetting("command", type(command).__name__, "one with a motion, as decode gives it")
        moved, feasible = super().transfer(pose, goal, command)
        target = one_where(command.final, goal[..., :2], command.place_mm)
        allowed = feasible & self._allowed(command.arm, pose[..., :2], target, command.motion, feasible)
        return one_where(allowed, moved, pose), allowed

    def path_mm(self, arm: Array, from_mm: Array, to_mm: Array, motion: Array) -> Array:
        """Length (n,) of the grip's paths: arms (n,), places (n, 2) in mm, motions (n, M); numpy."""
        ends = ends_of(self.cell, *(torch.tensor(np.asarray(part)) for part in (arm, from_mm, to_mm)))
        points = self.numbers.points(ends, torch.tensor(np.asarray(motion))).double().numpy()
        joints = sampled_basis(LENGTH_SAMPLES, points.shape[1], self.settings.degree) @ points
        level = np.concatenate([joints, np.zeros_like(joints[..., :1])], -1)
        steps = np.diff(self.grip.grip_mm(0, level), axis=1)  # all arms are alike
        return np.sqrt((steps**2).sum(-1)).sum(-1)

    def _allowed(self, arm: Array, from_mm: Array, to_mm: Array, motion: Array, asked: Array) -> Array:
        """Whether motions are allowed, bool (...), numpy or torch; only those are looked at that are ``asked`` for."""
        shape = asked.shape
        arms, starts, places, numbers, wanted = (
            (torch.tensor(np.asarray(part)) if namespace(part) is np else part).reshape(-1, *part.shape[len(shape) :])
            for part in (arm, from_mm, to_mm, motion, asked)
        )
        rows = wanted.nonzero()[:, 0]
        ends = ends_of(self.cell, arms[rows], starts[rows], places[rows])
        allowed = torch.zeros_like(wanted)
        allowed[rows] = self.check.passes(arms[rows], self.numbers.points(ends, numbers[rows]), ends)
        allowed = allowed.reshape(shape)
        return allowed.numpy() if namespace(asked) is np else allowed


_CHECKS: dict[str, tuple[MotionCheck, MotionNumbers, CycleCheck]] = {}


def _checked(cell: Cell, settings: CentralisedConfig, motion: MotionConfig) -> tuple[MotionCheck, MotionNumbers, CycleCheck]:
    """The check, the meaning of the numbers and the grip of a cell, once for each: packing the bodies takes half a second."""
    parts: tuple[Any, ...] = (cell.config, settings, motion)
    key = "".join(to_yaml(part) for part in parts)
    if key not in _CHECKS:
        model = build_cell(cell.config)
        _CHECKS[key] = MotionCheck(model, motion, settings), MotionNumbers(model, motion, settings), CycleCheck(model, motion)
    return _CHECKS[key]
