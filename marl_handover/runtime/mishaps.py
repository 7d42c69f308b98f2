"""What may happen to an episode on the twin, arranged beforehand: for drills, tests and measurements."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from marl_handover.arrays import wrap
from marl_handover.config import require_choice
from marl_handover.hardware.emulator.faults import make_fault
from marl_handover.hardware.settings import ARMS
from marl_handover.runtime.session import GivenGoal
from marl_handover.runtime.twin import Floats, Twin
from marl_handover.task.rules import Rules

NUDGE_MM, NUDGE_RAD = 20.0, math.radians(20.0)
_AGAIN_S = 0.2
_JAMMED_S, _FROZEN_S, _LOST_S, _OFF_S = 3.0, 1.0, 1.0, 0.3
_ON_TABLE_MM = 0.5
_OPEN_SLACK_MM = 0.5


class Mishaps:
    """Arranges mishaps for a twin.

    Args:
        twin: whose clock decides.
        rules: say where a block or a goal may be.
        seed: of all that is random about them.
    """

    def __init__(self, twin: Twin, rules: Rules, seed: int = 0) -> None:
        self.twin, self.rules = twin, rules
        self._random = np.random.default_rng(seed)
        self._kinds: dict[str, Callable[[GivenGoal], None]] = {
            "missed_grasp": self._jam,
            "nudge": self._nudge,
            "goal_change": self._new_goal,
            "camera_freeze": lambda goal: self.twin.freeze(_FROZEN_S),
            "serial_loss": lambda goal: self._fault("unplug", _LOST_S),
            "brown_out": lambda goal: self._fault("brownout", _OFF_S),
        }

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of all mishaps."""
        return tuple(self._kinds)

    def arrange(self, kind: str, after_s: float, goal: GivenGoal) -> None:
        """Let ``kind`` happen ``after_s`` from now. Raises :class:`UnknownChoice` for another name."""
        require_choice("mishap", kind, self.kinds)
        self.twin.clock.at(self.twin.clock.now_s() + after_s, lambda: self._kinds[kind](goal))

    def _fault(self, kind: str, duration_s: float, amount: float | None = None) -> None:
        self.twin.add_faults([make_fault(kind, self.twin.clock.now_s(), duration_s, amount)])

    def _jam(self, goal: GivenGoal) -> None:
        """No gripper moves, from when all are open."""
        twin = self.twin
        if (twin.electronics.gripper_mm(twin.clock.now_s()) < twin.motion.finger_travel_mm - _OPEN_SLACK_MM).any():
            twin.clock.at(twin.clock.now_s() + _AGAIN_S, lambda: self._jam(goal))
            return
        for arm in ARMS:
            self._fault("jam", _JAMMED_S, self.twin.hardware.arms[arm].gripper.channel)

    def _nudge(self, goal: GivenGoal) -> None:
        """Somebody pushes the block, once it stands on the table with no hand at it."""
        twin = self.twin
        pose = twin.true_pose()
        if twin.cell.block.height_mm() > _ON_TABLE_MM or any(twin.cell.held(arm) for arm in range(len(ARMS))):
            twin.clock.at(twin.clock.now_s() + _AGAIN_S, lambda: self._nudge(goal))
            return
        while True:
            angle, share = self._random.uniform(-math.pi, math.pi), math.sqrt(self._random.random())
            turned = float(wrap(pose[2] + self._random.uniform(-NUDGE_RAD, NUDGE_RAD)))
            new = np.array([pose[0] + NUDGE_MM * share * math.cos(angle), pose[1] + NUDGE_MM * share * math.sin(angle), turned])
            if self.rules.cell.reaches(new[:2]).any():
                twin.nudge(new)
                return

    def _new_goal(self, goal: GivenGoal) -> None:
        """Somebody wants the block elsewhere."""
        goal.set(self._anywhere())

    def _anywhere(self) -> Floats:
        cell = self.rules.cell
        reach = max(abs(base.y_mm) for base in cell.bases) + cell.r_max_mm
        while True:
            at = self._random.uniform(-reach, reach, 2)
            if cell.reaches(at).any():
                return np.array([*at, self._random.uniform(-math.pi, math.pi)])
