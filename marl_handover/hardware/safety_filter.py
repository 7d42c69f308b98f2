"""The safety filter: every command passes it on its way to the wire, and every refusal says what it found and what is allowed.

It stands below planning and trusts none of it. It models where the arms have been sent, by time, and judges each command from there:
numbers, joint limits, pulses, age, step, speed, and the room swept on the way: table, the arm itself, the other arms.

What is promised of that room: nowhere on the way of a command that passed, between samples too, is an arm nearer to the table, to itself
or to another arm than ``table_clearance_mm``, ``self_clearance_mm`` and ``arm_clearance_mm``, less 0.1 mm. A hand that is closed is
taken to hold the block, since nothing says that it is empty. The block and its pin keep the same distances, but for the table, on which
the block stands when it is taken and set down: its lowest point, in whatever way it is turned about the pin, is nowhere lower than
``block_dip_mm`` under the table, less 0.1 mm. Aims that take out the backlash of servos are that much below what is meant.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Collection, Sequence
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.errors import WorkFailed
from marl_handover.geometry.arm_model import LIMIT_TOLERANCE_RAD
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import ArmCalibration
from marl_handover.hardware.clearance import FAR_MM, alone_mm, arm_shapes, between_mm, still
from marl_handover.hardware.settings import ARMS, HardwareConfig

LAG_S = 0.05
"""Boards may be behind what they were sent by this much: two frames, and the line's own time."""

GRASP_MM = 1.0
"""Each finger this far from the pin may hold it yet: zeros of grippers are no better known."""

_ROUNDING = 1e-6
_ANGLES = (*ARM_JOINTS, "fingers")


class Reason(enum.StrEnum):
    """Why a command is refused."""

    SHAPE = "shape"
    NOT_FINITE = "not finite"
    STALE = "stale"
    NO_REFERENCE = "no reference"
    DURATION = "duration"
    JOINT_LIMIT = "joint limit"
    PULSE_LIMIT = "pulse limit"
    GRIPPER = "gripper"
    STEP = "step"
    SPEED = "speed"
    SPEED_CHANGE = "speed change"
    TABLE = "table"
    ITSELF = "itself"
    OTHER_ARM = "other arm"


class CommandRejected(WorkFailed):
    """A command that is not sent. ``value`` and ``limit`` are in the units of the message; ``names`` are those of the cell's arms."""

    def __init__(self, reason: Reason, arm: int | None, what: str, value: Any, limit: str, names: Sequence[str] = ARMS) -> None:
        self.reason, self.arm, self.what, self.value, self.limit = reason, arm, what, value, limit
        shown = f"{value:.2f}" if isinstance(value, float) else value
        whose = "" if arm is None else f"arm {names[arm] if arm in range(len(names)) else arm}, "
        super().__init__(f"safety filter ({reason}): {whose}{what} is {shown}; allowed: {limit}")


class JointCommand(NamedTuple):
    """Where an arm is to be: ``joints_rad`` (5,), and how far each finger is to be from closed, in mm."""

    arm: int
    joints_rad: Floats
    gripper_mm: float


class _Held(NamedTuple):
    """A move that was sent: from where to where (joints and fingers, 6), and when; and where the arm was :data:`LAG_S` before it."""

    before: Floats
    start: Floats
    target: Floats
    begin_s: float
    end_s: float

    def at(self, t_s: float) -> Floats:
        if t_s < self.begin_s:
            return self.start + min((self.begin_s - t_s) / LAG_S, 1.0) * (self.before - self.start)
        if t_s >= self.end_s:
            return self.target
        return self.start + (t_s - self.begin_s) / (self.end_s - self.begin_s) * (self.target - self.start)

    def speed_rad_s(self, t_s: float) -> Floats:
        """Of the joints (5,), as sent; a servo is not at rest as soon as its move is over, nor is the next one sent at that very moment."""
        if not self.begin_s <= t_s < self.end_s + LAG_S or self.end_s <= self.begin_s:
            return np.zeros(5)
        return (self.target - self.start)[:5] / (self.end_s - self.begin_s)

    def way(self, now_s: float, aim: Floats | None) -> Floats:
        """All that the arm may still do, as a way (3, 6) of :mod:`~marl_handover.hardware.clearance`, if it is sent to ``aim`` (6,) now."""
        late = self.at(now_s - LAG_S)
        if aim is None and now_s - LAG_S >= self.begin_s:
            return np.array([late, late, self.target])
        return np.array([self.at(now_s), late, self.target if aim is None else aim])


class SafetyFilter:
    """Judges commands for all arms of a cell.

    Args:
        model: geometry and joint limits.
        config: limits, and the pulse limits of the wiring, that of the cell's arms alone.
        calibrations: of the arms, in order.
    """

    def __init__(self, model: CellModel, config: HardwareConfig, calibrations: Sequence[ArmCalibration]) -> None:
        self.limits, self.calibrations, self.names = config.gate, tuple(calibrations), tuple(config.arms)
        self._arm, self._shapes = model.arm, (arm_shapes(model), arm_shapes(model, holding=True))
        self._closed_mm = model.cell.config.block.pin_diameter_mm / 2 + GRASP_MM
        self._least_mm = np.array([self.limits.table_clearance_mm, self.limits.self_clearance_mm, -self.limits.block_dip_mm])
        self._bases = [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]
        self._pulses, self._unit = [np.array(config.pulse_limits(name), float) for name in config.arms], config.unit.name
        speeds = [model.arm.description.joint(name).velocity for name in ARM_JOINTS]
        self.speed_rad_s = config.gate.speed_share * np.array(speeds)
        self._speed = np.append(self.speed_rad_s, config.gate.finger_mm_s)
        self._most_change_deg_s = config.bus.speed_change_deg_s if config.unit.encoders else math.inf
        self._held: list[_Held | None] = [None] * len(self._bases)
        # Compiled, or loaded, here: not between a plan and its first command.
        alone_mm(still(np.zeros(5)), self._shapes[0], np.full(3, -FAR_MM), np.empty(3))
        between_mm(still(np.zeros(5)), still(np.zeros(5)), True, *self._shapes, self._bases[0], self._bases[0], -FAR_MM)

    def refer(self, arm: int, joints_rad: ArrayLike, gripper_mm: float) -> None:
        """Take it that an arm stands still there."""
        where = np.append(np.asarray(joints_rad, float), gripper_mm)
        self._held[arm] = _Held(where, where, where, 0.0, 0.0)

    def forget(self) -> None:
        """No arm's position is known any more."""
        self._held = [None] * len(self._held)

    def freeze(self, t_s: float) -> None:
        """Take it that all arms stopped where they were at ``t_s``."""
        for arm in range(len(self._held)):
            if (held := self._held[arm]) is not None:
                now = held.at(t_s)
                self.refer(arm, now[:5], float(now[5]))

    def held(self, arm: int, t_s: float) -> tuple[Floats, float] | None:
        """Joints (5,) and fingers that an arm has been sent to by ``t_s``; None if nothing is known."""
        held = self._held[arm]
        if held is None:
            return None
        now = held.at(t_s)
        return now[:5].copy(), float(now[5])

    def check(self, commands: Sequence[JointCommand], duration_s: float, now_s: float, made_s: float) -> None:
        """Judge commands that are to be carried out together in ``duration_s`` from ``now_s``, thought of at ``made_s``.

        Raises :class:`CommandRejected` with the first thing that is wrong. A filter that is not enabled looks at form and numbers only.
        """
        self._check_times(duration_s, now_s, made_s)
        targets = self._targets(commands)
        if not self.limits.enabled:
            return
        for arm, target in targets.items():
            held = self._held[arm]
            if held is None:
                raise self._rejected(Reason.NO_REFERENCE, arm, "its position", "unknown", "an arm that was armed in its parked pose")
            self._check_ends(arm, target)
            change = target - held.at(now_s)
            self._check_way(arm, np.abs(change), duration_s)
            self._check_speed_change(arm, change[:5] / duration_s - held.speed_rad_s(now_s))
        self.check_room(targets, now_s)

    def check_stand(self, commands: Sequence[JointCommand]) -> None:
        """Judge poses of all arms as places to stand in, whatever the way there; as before a first move, whose way nobody knows.

        Raises :class:`CommandRejected`.
        """
        targets = self._targets(commands)
        if not self.limits.enabled:
            return
        for arm, target in targets.items():
            self._check_ends(arm, target)
        ways = [still(targets[arm]) if arm in targets else None for arm in range(len(self._held))]
        self._check_ways(ways, targets, together=True)

    def accept(self, commands: Sequence[JointCommand], duration_s: float, now_s: float) -> None:
        """Commands were sent: take them for what the arms now do."""
        for command in commands:
            target = np.append(np.asarray(command.joints_rad, float), command.gripper_mm)
            held = self._held[command.arm]
            start, before = (target, target) if held is None else (held.at(now_s), held.at(now_s - LAG_S))
            self._held[command.arm] = _Held(before, start, target, now_s, now_s + duration_s)

    def check_room(self, targets: dict[int, Floats], now_s: float, *, together: bool = True) -> None:
        """Judge the room swept when arms go straight, in joint angles, from where they are to ``targets`` (each (5,) or longer).

        Arms of one command move ``together``; else each may be anywhere on its way while another is anywhere on its own, as arms of
        which one is stuck. One that is still in an earlier move may be anywhere on the rest of it at any moment. All may be behind by any
        part of :data:`LAG_S`, those that move together by the same. Fingers that are not named stay as they are.
        """
        ways: list[Floats | None] = []
        for arm, held in enumerate(self._held):
            aim = None
            if held is not None and arm in targets:
                aim = held.target.copy()
                aim[: len(targets[arm])] = targets[arm]
            ways.append(None if held is None else held.way(now_s, aim))
        self._check_ways(ways, targets, together)

    def _check_times(self, duration_s: float, now_s: float, made_s: float) -> None:
        for name, value in (("the duration", duration_s), ("when it was made", made_s)):
            if not _is(value, Real):
                raise self._rejected(Reason.SHAPE, None, name, repr(value), "a number of seconds")
        if not (math.isfinite(duration_s) and 0.0 < duration_s <= 60.0):
            raise self._rejected(Reason.DURATION, None, "the duration", duration_s, "above 0 and up to 60 s")
        age_s = now_s - made_s
        if self.limits.enabled and not -_ROUNDING <= age_s <= self.limits.stale_s:
            raise self._rejected(Reason.STALE, None, "its age", age_s, f"0 to {self.limits.stale_s:g} s")

    def _targets(self, commands: Sequence[JointCommand]) -> dict[int, Floats]:
        """Joints and fingers (6,) by arm."""
        found = [self.target(command) for command in commands]
        targets = {int(command.arm): target for command, target in zip(commands, found, strict=True)}
        if not commands or len(targets) != len(commands):
            raise self._rejected(
                Reason.SHAPE, None, "arms of the command", [command.arm for command in commands], "each at most once, at least one"
            )
        return targets

    def target(self, command: JointCommand) -> Floats:
        """Joints and fingers (6,) of a command. Raises :class:`CommandRejected` if it has not the form of one, or is not finite."""
        if not _is(command.arm, Integral) or command.arm not in range(len(self._held)):
            raise self._rejected(Reason.SHAPE, None, "the arm", repr(command.arm), f"0 to {len(self._held) - 1}")
        try:
            target = np.append(np.asarray(command.joints_rad, float), float(command.gripper_mm))
        except (TypeError, ValueError):
            target = np.zeros(0)
        if target.shape != (6,) or np.ndim(command.joints_rad) != 1:
            raise self._rejected(
                Reason.SHAPE, command.arm, "the command", np.shape(command.joints_rad), "five angles, and a number for the fingers"
            )
        if not np.isfinite(target).all():
            raise self._rejected(Reason.NOT_FINITE, command.arm, "the command", target.tolist(), "finite numbers")
        return target

    def _check_ends(self, arm: int, target: Floats) -> None:
        """Whether an arm may be at ``target`` (6,)."""
        lower, upper = self._arm.lower_rad, self._arm.upper_rad
        for index, joint in enumerate(ARM_JOINTS):
            angle = float(target[index])
            if not lower[index] - LIMIT_TOLERANCE_RAD <= angle <= upper[index] + LIMIT_TOLERANCE_RAD:
                limit = f"{math.degrees(lower[index]):.2f} to {math.degrees(upper[index]):.2f} degrees"
                raise self._rejected(Reason.JOINT_LIMIT, arm, joint, math.degrees(angle), limit)
        if not 0.0 <= target[5] <= self.limits.finger_mm:
            raise self._rejected(Reason.GRIPPER, arm, "the opening of each finger", float(target[5]), f"0 to {self.limits.finger_mm:g} mm")
        for joint, pulse, (low, high) in zip(ARM_JOINTS, np.rint(self.calibrations[arm].to_us(target[:5])), self._pulses[arm], strict=True):
            if not low <= pulse <= high:
                raise self._rejected(Reason.PULSE_LIMIT, arm, f"the pulse of {joint}", float(pulse), f"{low:g} to {high:g} {self._unit}")

    def _check_way(self, arm: int, change: Floats, duration_s: float) -> None:
        """Whether an arm may change so much, joints and fingers (6,), in one command."""
        step_rad = math.radians(self.limits.step_deg)
        widest = int(np.argmax(change[:5]))
        if change[widest] > step_rad + _ROUNDING:
            what = f"the step of {ARM_JOINTS[widest]}"
            raise self._rejected(Reason.STEP, arm, what, math.degrees(change[widest]), f"up to {self.limits.step_deg:g} degrees")
        over = change / duration_s - self._speed * (1 + _ROUNDING)
        worst = int(np.argmax(over / self._speed))
        if over[worst] > 0.0:
            speed, limit, unit = change[worst] / duration_s, self._speed[worst], "mm/s"
            if worst < 5:
                speed, limit, unit = math.degrees(speed), math.degrees(limit), "degrees/s"
            raise self._rejected(Reason.SPEED, arm, f"the speed of {_ANGLES[worst]}", float(speed), f"up to {limit:.1f} {unit}")

    def _check_speed_change(self, arm: int, change_rad_s: Floats) -> None:
        """Whether an arm's servos can change their speeds by so much (5,) at once without leaving their way."""
        worst = int(np.argmax(np.abs(change_rad_s)))
        changed = math.degrees(abs(change_rad_s[worst]))
        if changed > self._most_change_deg_s + _ROUNDING:
            what = f"the change of the speed of {ARM_JOINTS[worst]}"
            raise self._rejected(Reason.SPEED_CHANGE, arm, what, changed, f"up to {self._most_change_deg_s:g} degrees/s at once")

    def _check_ways(self, ways: Sequence[Floats | None], commanded: Collection[int], together: bool) -> None:
        """Whether arms may go their ``ways`` (3, 6), None of one that is unknown; those that are ``commanded`` are judged."""
        for arm in commanded:
            own = ways[arm]
            if own is None:
                raise self._rejected(Reason.NO_REFERENCE, arm, "its position", "unknown", "an arm that was armed in its parked pose")
            self._check_alone(arm, own)
            for other, way in enumerate(ways):
                if other == arm or (other in commanded and other < arm):
                    continue
                if way is None:
                    limit = "arms that were all armed in their parked pose"
                    raise self._rejected(Reason.NO_REFERENCE, other, "its position", "unknown", limit)
                self._check_pair(arm, own, other, way, together and other in commanded)

    def _rejected(self, reason: Reason, arm: int | None, what: str, value: Any, limit: str) -> CommandRejected:
        return CommandRejected(reason, arm, what, value, limit, self.names)

    def _holds(self, way: Floats) -> bool:
        """Whether a hand may hold the block anywhere on a way (3, 6)."""
        return bool(way[:, 5].min() <= self._closed_mm)

    def _check_alone(self, arm: int, way: Floats) -> None:
        gaps, holding = np.empty(3), self._holds(way)
        alone_mm(way, self._shapes[holding], self._least_mm, gaps)
        found = (
            (Reason.TABLE, "the height over the table on the way"),
            (Reason.ITSELF, f"the distance{_with_block(holding)} to itself on the way"),
            (Reason.TABLE, "the height over the table of the block in its closed hand, on the way,"),
        )
        for gap, least, (reason, what) in zip(gaps.tolist(), self._least_mm.tolist(), found, strict=True):
            if gap < least:
                raise self._rejected(reason, arm, what, gap, f"at least {least:g} mm")

    def _check_pair(self, arm: int, way: Floats, other: int, other_way: Floats, together: bool) -> None:
        holding, also, least = self._holds(way), self._holds(other_way), self.limits.arm_clearance_mm
        shapes, others = self._shapes[holding], self._shapes[also]
        gap = between_mm(way, other_way, together, shapes, others, self._bases[arm], self._bases[other], least)
        if gap < least:
            whom = "the other arm" if len(self.names) == 2 else f"arm {self.names[other]}"
            what = f"the distance{_with_block(holding)} to {whom}{_with_block(also)} on the way"
            raise self._rejected(Reason.OTHER_ARM, arm, what, gap, f"at least {least:g} mm")


def _with_block(holding: bool) -> str:
    return ", with the block in its closed hand," if holding else ""


def _is(value: Any, kind: type) -> bool:
    """Whether ``value`` is a number of that kind; truth values are none."""
    return isinstance(value, kind) and not isinstance(value, bool)
