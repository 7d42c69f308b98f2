"""How far the grip travels in an evaluation: by the policy's own motions where it has them, and by the executors'."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import one_where
from marl_handover.config import MotionConfig
from marl_handover.envs.centralised import CentralisedRules, MotionCommand
from marl_handover.motion.path_length_table import known_table
from marl_handover.task.episode import Decision
from marl_handover.task.rules import Rules

CHUNK = 2000


class PathLengths:
    """An observer of roll-outs that remembers every commanded transfer that was carried out.

    The executors' lengths come from :mod:`marl_handover.motion.path_length_table`, 0.1 mm off in the median, for cells that have a
    table; nothing is computed for others. Architecture A's external transfers are not counted.
    """

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self.table = known_table(rules.cell, MotionConfig())
        self._ways: list[tuple[NDArray[Any], ...]] = []

    def __call__(self, decision: Decision) -> None:
        """Take in one decision of the running episodes."""
        done, command = decision.result.feasible, decision.result.command
        to = one_where(command.final, decision.goal[..., :2], command.place_mm)
        motion = command.motion if isinstance(command, MotionCommand) else np.zeros((len(to), 0))
        self._ways.append(tuple(part[done] for part in (command.arm, decision.pose[..., :2], to, motion)))

    def report(self) -> dict[str, float]:
        """``path_mm``: mean length of a transfer; ``executor_path_mm``: what executors would travel on the same ways."""
        if self.table is None or not self._ways:
            return {}
        arm, start, end, motion = (np.concatenate(parts) for parts in zip(*self._ways, strict=True))
        if not len(arm):
            return {}
        executors = self.table(self.rules.cell, arm, start, end)
        if not isinstance(self.rules, CentralisedRules):
            return {"path_mm": float(executors.mean()), "executor_path_mm": float(executors.mean())}
        chunks = (slice(first, first + CHUNK) for first in range(0, len(arm), CHUNK))
        own = np.concatenate([self.rules.path_mm(arm[rows], start[rows], end[rows], motion[rows]) for rows in chunks])
        return {"path_mm": float(own.mean()), "executor_path_mm": float(executors.mean())}
