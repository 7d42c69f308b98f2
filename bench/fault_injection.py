"""What may happen to an episode on the twin, arranged beforehand: for drills, tests and measurements."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from marl_handover.arrays import wrap
from marl_handover.config import require_choice
from marl_handover.control.events import Event
from marl_handover.control.session import GivenGoal
from marl_handover.control.twin import Floats, Twin
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.emulator.servo_bus import SERVO_FAULTS, USUAL
from marl_handover.task.rules import Rules

NUDGE_MM, NUDGE_RAD = 20.0, math.radians(20.0)
_AGAIN_S = 0.05
_JAMMED_S, _FROZEN_S, _LOST_S, _OFF_S = 3.0, 1.0, 1.0, 0.3
_CORRUPT = 0.02
_ON_TABLE_MM = 0.5
_OPEN_SLACK_MM = 3.0
_TRIES = 100
_CLEAR_MM, _ABOVE_MM = 70.0, 150.0
"""A hand so far beside the block, or its grip so far above the table, is not at it."""
_LOOK_SHARE = 0.75
"""A camera that freezes in the rest of a motion is frozen when the block is looked for."""

SIGNS = {
    "missed_grasp": (Event.FAILED_GRASP, Event.DROPPED),
    "nudge": (),
    "goal_change": (Event.GOAL_CHANGED,),
    "camera_freeze": (Event.CAMERA_FROZEN,),
    "serial_loss": (Event.SERIAL_LOST,),
    "brown_out": (Event.CONTROLLER_RESET, Event.SERIAL_LOST),
}
"""What the loop notes of each mishap that it has to get over; of a nudge between two looks it need not notice anything."""

BUS_SIGNS = {
    "bus_silent": (Event.SERIAL_LOST,),
    "servo_missing": (Event.SERIAL_LOST,),
    "overload": (Event.CONTROLLER_RESET, Event.PULSE_MISMATCH),
    "corrupt_replies": (),
}
"""The same of those that only a bus of servos knows."""


@dataclass
class InjectedFault:
    """One that was arranged. ``at_s`` is when it happened, NaN as long as it did not; ``until_s`` when it is over."""

    kind: str
    goal: GivenGoal
    at_s: float = math.nan
    until_s: float = -math.inf
    called_off: bool = False
    noted: set[Event] = field(default_factory=set)

    @property
    def happened(self) -> bool:
        """Whether it did."""
        return math.isfinite(self.at_s)

    @property
    def felt(self) -> bool:
        """Whether it happened and left its sign in the log."""
        signs = (SIGNS | BUS_SIGNS)[self.kind]
        return self.happened and (not signs or bool(self.noted & set(signs)))


class FaultInjector:
    """Arranges mishaps for a twin, by the clock or by the transfer.

    Args:
        twin: whose clock decides.
        rules: say where a block or a goal may be.
        seed: of all that is random about them.
    """

    def __init__(self, twin: Twin, rules: Rules, seed: int = 0) -> None:
        self.twin, self.rules = twin, rules
        self._random = np.random.default_rng(seed)
        self._doers: dict[str, Callable[[InjectedFault], None]] = {
            "missed_grasp": self._jam,
            "nudge": self._nudge,
            "goal_change": self._new_goal,
            "camera_freeze": self._freeze,
            "serial_loss": lambda mishap: self._fault(mishap, "unplug", _LOST_S),
            "brown_out": lambda mishap: self._fault(mishap, "brownout", _OFF_S),
        }
        self._kinds: dict[str, Any] = {}
        if twin.hardware.protocol == "feetech":
            self._kinds = {"kinds": SERVO_FAULTS, "usual": USUAL}
            self._doers |= {
                "bus_silent": lambda mishap: self._fault(mishap, "silent", _LOST_S),
                "servo_missing": lambda mishap: self._fault(mishap, "missing", _LOST_S, self._servo()),
                "overload": lambda mishap: self._fault(mishap, "overload", _LOST_S, self._servo()),
                "corrupt_replies": lambda mishap: self._fault(mishap, "corrupt", _LOST_S, _CORRUPT),
            }
        self._all: list[InjectedFault] = []
        self._waiting: list[tuple[InjectedFault, int, float]] = []
        self._motions = 0

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of all mishaps."""
        return tuple(self._doers)

    def arrange(self, kind: str, after_s: float, goal: GivenGoal) -> InjectedFault:
        """Let ``kind`` happen ``after_s`` from now. Raises :class:`UnknownChoice` for another name."""
        require_choice("mishap", kind, self.kinds)
        mishap = InjectedFault(kind, goal)
        self._all.append(mishap)
        self._at(after_s, mishap)
        return mishap

    def arrange_in(self, kind: str, motion: int, share: float, goal: GivenGoal) -> InjectedFault:
        """Let ``kind`` happen in the ``motion``-th motion from now, 0 the next, after ``share`` of it, from 0 to 1.

        Of a missed grasp it is the share of the approach; a camera freezes late enough to be frozen at the look that follows. The session's
        log has to be shown to :meth:`note`. Raises :class:`UnknownChoice` for another name.
        """
        require_choice("mishap", kind, self.kinds)
        mishap = InjectedFault(kind, goal)
        self._all.append(mishap)
        self._waiting.append((mishap, self._motions + motion, share))
        return mishap

    def note(self, row: dict[str, Any]) -> None:
        """Take note of a line of the session's log."""
        event = Event(row["event"])
        for mishap in self._all:
            if mishap.happened:
                mishap.noted.add(event)
        if event is not Event.MOTION:
            return
        due = [(mishap, share) for mishap, motion, share in self._waiting if motion == self._motions]
        self._waiting = [entry for entry in self._waiting if entry[1] != self._motions]
        self._motions += 1
        for mishap, share in due:
            self._at(_moment_s(mishap.kind, share, row["phases"]), mishap)

    def finish(self) -> None:
        """Call off what has not happened, and let time pass until everything else is over."""
        for mishap in self._all:
            mishap.called_off = True
        now_s = self.twin.clock.now_s()
        self.twin.clock.sleep_s(max(0.0, *(mishap.until_s - now_s for mishap in self._all)) if self._all else 0.0)
        self._all, self._waiting = [], []

    def _at(self, after_s: float, mishap: InjectedFault) -> None:
        def happen() -> None:
            if not mishap.called_off:
                self._doers[mishap.kind](mishap)

        self.twin.clock.at(self.twin.clock.now_s() + after_s, happen)

    def _begins(self, mishap: InjectedFault, duration_s: float = 0.0) -> None:
        mishap.at_s = self.twin.clock.now_s()
        mishap.until_s = mishap.at_s + duration_s

    def _servo(self) -> float:
        """The id of a joint's servo."""
        return float(self._random.choice(next(iter(self.twin.hardware.arms.values())).channels))

    def _fault(self, mishap: InjectedFault, kind: str, duration_s: float, amount: float | None = None) -> None:
        self._begins(mishap, duration_s)
        boards = tuple(self.twin.electronics.devices)
        board = boards[0] if len(boards) == 1 else str(self._random.choice(boards))
        self.twin.add_faults([make_fault(kind, mishap.at_s, duration_s, amount, **self._kinds)], board)

    def _freeze(self, mishap: InjectedFault) -> None:
        self._begins(mishap, _FROZEN_S)
        self.twin.freeze(_FROZEN_S)

    def _jam(self, mishap: InjectedFault) -> None:
        """No gripper moves, from when all are open."""
        twin = self.twin
        if (twin.electronics.gripper_mm(twin.clock.now_s()) < twin.motion.finger_travel_mm - _OPEN_SLACK_MM).any():
            self._at(_AGAIN_S, mishap)
            return
        self._begins(mishap, _JAMMED_S)
        for wiring in twin.hardware.arms.values():
            twin.add_faults([make_fault("jam", mishap.at_s, _JAMMED_S, wiring.gripper.channel, **self._kinds)], wiring.board)

    def _nudge(self, mishap: InjectedFault) -> None:
        """Somebody pushes the block, once it stands on the table and no hand is at it, nor where it comes to stand."""
        twin = self.twin
        pose = twin.true_pose()
        still = twin.cell.block.height_mm() <= _ON_TABLE_MM and self._clear(pose)
        new = self._pushed(pose) if still else None
        if new is None or not self._clear(new):
            self._at(_AGAIN_S, mishap)
            return
        self._begins(mishap)
        twin.set_object_pose(new)

    def _pushed(self, pose: Floats) -> Floats | None:
        """A pose (3,) near ``pose``, within the arms' reach; None if there is hardly one."""
        for _ in range(_TRIES):
            angle, share = self._random.uniform(-math.pi, math.pi), math.sqrt(self._random.random())
            turned = float(wrap(pose[2] + self._random.uniform(-NUDGE_RAD, NUDGE_RAD)))
            new = np.array([pose[0] + NUDGE_MM * share * math.cos(angle), pose[1] + NUDGE_MM * share * math.sin(angle), turned])
            if self.rules.cell.reaches(new[:2]).any():
                return new
        return None

    def _clear(self, pose: Floats) -> bool:
        """Whether no arm is at a block at ``pose`` (3,), nor over it."""
        for base, reached in zip(self.rules.cell.bases, self.twin.model.arm.grip_mm(self.twin.true_joints_rad()), strict=True):
            grip = base.to_world(reached)
            if grip[2] < _ABOVE_MM and _apart_mm(pose[:2], base.position_mm, grip[:2]) < _CLEAR_MM:
                return False
        return True

    def _new_goal(self, mishap: InjectedFault) -> None:
        """Somebody wants the block elsewhere."""
        self._begins(mishap)
        mishap.goal.set(self._anywhere())

    def _anywhere(self) -> Floats:
        cell = self.rules.cell
        reach = max(cell.extent_mm)
        while True:
            at = self._random.uniform(-reach, reach, 2)
            if cell.reaches(at).any():
                return np.array([*at, self._random.uniform(-math.pi, math.pi)])


def _moment_s(kind: str, share: float, phases: list[tuple[str, float, float]]) -> float:
    """How long after a motion's beginning a mishap happens."""
    ends_s = {name: end_s for name, _, end_s in phases}
    last_s = max(ends_s.values())
    if kind == "missed_grasp":
        return share * ends_s["approach"]
    return last_s * (_LOOK_SHARE + (1 - _LOOK_SHARE) * share) if kind == "camera_freeze" else last_s * share


def _apart_mm(point: Floats, begin: Floats, end: Floats) -> float:
    """Of a point from a straight piece, all (2,)."""
    along = end - begin
    share = float(np.clip((point - begin) @ along / max(float(along @ along), 1e-9), 0.0, 1.0))
    return math.dist(point, begin + share * along)
