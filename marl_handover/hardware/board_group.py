"""The boards of a cell, one or more, as one thing: joints and fingers to channels and pulses, and what is read back from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.geometry.arm_model import LIMIT_TOLERANCE_RAD, ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS, Gripper
from marl_handover.hardware.calibration import ArmCalibration
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.errors import BadCommand, BoardReset, ConnectionLost, TooSlow, TorqueLost, WrongState
from marl_handover.hardware.feetech_driver import FeetechDriver
from marl_handover.hardware.gripper import GripperMap
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason
from marl_handover.hardware.settings import SPEED_US_S, HardwareConfig, ServoUnit
from marl_handover.hardware.ssc32 import Ssc32
from marl_handover.hardware.transport import DeviceOptions, LineRecord, Wire


class Wiring:
    """Translates for all arms of a cell.

    Args:
        config: electronics, wired for the cell's arms alone.
        calibrations: of the arms, in order.
        hand: of every arm.
        pin_diameter_mm: of what the fingers close on.
        speed_rad_s: (5,) no joint may be faster, whatever a group move's time says: boards hold each servo to it.
    """

    def __init__(
        self,
        config: HardwareConfig,
        calibrations: Sequence[ArmCalibration],
        hand: Gripper,
        pin_diameter_mm: float,
        speed_rad_s: NDArray[np.float64],
    ) -> None:
        self._config, self._calibrations, self._pin_mm, self._names = config, tuple(calibrations), pin_diameter_mm, tuple(config.arms)
        self._hand = hand
        self._speeds: dict[tuple[str, int], int] = {}
        for name, calibration in zip(self._names, self._calibrations, strict=True):
            board, per_rad = config.arms[name].board, [servo.least_us_per_rad() for servo in calibration.maps]
            speeds = [*(speed_rad_s * per_rad), config.gate.finger_mm_s * abs(self.gripper(name).closing_per_mm)]
            for channel, speed in zip(config.channels(name), speeds, strict=True):
                self._speeds[board, channel] = min(max(math.floor(speed), SPEED_US_S[0]), SPEED_US_S[1])

    def gripper(self, name: str) -> GripperMap:
        """Fingers to pulses and back, of the arm ``name``, as its settings say now."""
        return GripperMap(self._config, name, self._hand)

    def boards(self, arms: Iterable[int]) -> tuple[str, ...]:
        """Names of the boards that arms are wired to, each once."""
        names = self._names
        return tuple(dict.fromkeys(self._config.arms[names[arm]].board for arm in arms if arm in range(len(names))))

    def pulses(self, commands: Sequence[JointCommand]) -> dict[str, dict[int, int]]:
        """Board -> channel -> pulse in us. Raises :class:`BadCommand` for what is no number."""
        found: dict[str, dict[int, int]] = {}
        for command in commands:
            name = self._names[command.arm]
            pulses = self._calibrations[command.arm].to_us(command.joints_rad)
            if not (np.isfinite(pulses).all() and math.isfinite(command.gripper_mm)):
                raise BadCommand("joints_rad", np.asarray(command.joints_rad).tolist(), "finite numbers")
            gripper = self.gripper(name).closing_pulse(command.gripper_mm, self._pin_mm)
            whole = [*(int(pulse) for pulse in np.rint(pulses)), gripper]
            found.setdefault(self._config.arms[name].board, {}).update(zip(self._config.channels(name), whole, strict=True))
        return found

    def speeds(self, board: str, channels: Iterable[int]) -> dict[int, int]:
        """Greatest speeds in us/s."""
        return {channel: self._speeds[board, channel] for channel in channels}

    def state(self, pulses_us: Mapping[str, Mapping[int, float]], arm: int) -> tuple[Floats, float]:
        """Joints (5,) and fingers that the pulses of an arm's channels stand for."""
        name = self._names[arm]
        found = pulses_us[self._config.arms[name].board]
        *joints, gripper = (found[channel] for channel in self._config.channels(name))
        return self._calibrations[arm].to_rad(np.array(joints, float)), self.gripper(name).mm(gripper)


def board_channels(config: HardwareConfig, board: str) -> list[int]:
    """Every channel of a board that an arm is wired to."""
    return [channel for arm, wiring in config.arms.items() if wiring.board == board for channel in config.channels(arm)]


Pulses = Mapping[str, Mapping[int, int | None]]
"""Board -> channel -> pulse in us, to 10 us; None where there is none."""


def all_held(pulses: Pulses) -> bool:
    """Whether every channel has a pulse."""
    return all(pulse is not None for found in pulses.values() for pulse in found.values())


def none_held(pulses: Pulses) -> bool:
    """Whether no channel has one."""
    return all(pulse is None for found in pulses.values() for pulse in found.values())


def require_held(pulses: Pulses) -> None:
    """Raise :class:`BoardReset` for a board that has a channel without a pulse."""
    for name, found in pulses.items():
        silent = [channel for channel, pulse in found.items() if pulse is None]
        if silent:
            raise BoardReset(name, silent)


def readback_middles(pulses: Pulses, unit: ServoUnit) -> dict[str, dict[int, int]]:
    """The middle of what each reading may stand for, whole and within what servos take. Channels without a pulse are left out."""
    return {
        name: {channel: min(pulse + unit.reading // 2, unit.upper) for channel, pulse in found.items() if pulse is not None}
        for name, found in pulses.items()
    }


ENCODER_BEYOND_RAD, ENCODER_BEYOND_MM = math.radians(3.0), 2.0
"""A bus servo that was sent to its limit may truly stand so far beyond: pushed, or let go there. It is brought back from there."""


def readback_state(
    config: HardwareConfig, calibrations: Sequence[ArmCalibration], arm_model: ArmModel, pulses: Pulses, arm: int
) -> tuple[Floats, float]:
    """Joints (5,) and fingers of an arm that is held at ``pulses``, all of them there.

    Raises :class:`CommandRejected` if it is held outside its limits, whatever its readings stand for: another cell's settings, or a
    calibration that is not this arm's. From there nobody knows the way.
    """
    names = tuple(config.arms)
    name = names[arm]
    found = pulses[config.arms[name].board]
    *readings, gripper = (float(found[channel] or 0) for channel in config.channels(name))
    lower, upper, unit_step = arm_model.lower_rad, arm_model.upper_rad, config.unit.reading
    low, fingers_of = np.array(readings), GripperMap(config, name, arm_model.description.gripper)
    ends = np.sort([calibrations[arm].to_rad(low), calibrations[arm].to_rad(low + unit_step)], axis=0)
    beyond_rad, beyond_mm = (ENCODER_BEYOND_RAD, ENCODER_BEYOND_MM) if config.unit.encoders else (0.0, 0.0)
    slack_rad = LIMIT_TOLERANCE_RAD + beyond_rad
    outside = (ends[1] < lower - slack_rad) | (ends[0] > upper + slack_rad)
    if outside.any():
        index = int(np.argmax(outside))
        limit = f"{math.degrees(lower[index]):.2f} to {math.degrees(upper[index]):.2f} degrees; let the arms go limp and put them there"
        what = f"{ARM_JOINTS[index]}, as the board holds it,"
        raise CommandRejected(Reason.JOINT_LIMIT, arm, what, math.degrees(float(ends[:, index].mean())), limit, names)
    shut, wide = sorted(fingers_of.mm(gripper + more) for more in (0, unit_step))
    if wide < -beyond_mm or shut > config.gate.finger_mm + beyond_mm:
        limit = f"0 to {config.gate.finger_mm:g} mm"
        raise CommandRejected(Reason.GRIPPER, arm, "the opening of each finger, as the board holds it,", (shut + wide) / 2, limit, names)
    fingers = min(max((shut + wide) / 2, 0.0), config.gate.finger_mm)
    return np.clip(calibrations[arm].to_rad(low + unit_step / 2), lower, upper), fingers


STOP_WITHIN_S = 0.04
"""From the stop being latched to its last byte at a board, at worst."""

PulsesOfBoards = Mapping[str, Mapping[int, int]]
"""Board -> channel -> pulse in us."""


class Controller(Protocol):
    """What drives servos: a controller board, or a bus of servos with controllers of their own. Nothing above asks which.

    Channels are a board's outputs, or ids on a bus; a pulse is what a servo is told, in the unit of its kind, see
    :data:`~marl_handover.hardware.settings.PROTOCOLS`.
    """

    name: str
    has_encoders: bool
    """Whether it is known where a servo stands that does not hold: then its first move is no jump."""

    @property
    def wire(self) -> Wire:
        """The open port."""

    def connect(self) -> object:
        """Open the port, find what is on it, and set it up."""

    def close(self) -> None:
        """Let the port go; servos hold."""

    def pulses(self, channels: Iterable[int]) -> dict[int, int | None]:
        """Where servos are held, or stand; None where nobody knows."""

    def require_pulses(self, channels: Iterable[int], tolerance: float) -> None:
        """See that servos are where they were sent by now; raises what is wrong."""

    def marks(self, channels: Iterable[int]) -> tuple[int, ...]:
        """What servos keep that tells one arm from another; nothing where they keep nothing."""

    def limp(self, channels: Iterable[int]) -> list[int]:
        """Servos that do not hold, although it is known where they stand."""

    def note_readback(self, pulses: Mapping[int, int]) -> None:
        """Take readings of servos that stand still for where they were sent."""

    def first_move(self, pulses: Mapping[int, int], time_ms: int | None) -> LineRecord:
        """Hold servos where they are known to stand."""

    def move(
        self, pulses: Mapping[int, int], time_ms: int, speeds: Mapping[int, int] | None = None, aims: Mapping[int, int] | None = None
    ) -> LineRecord:
        """Move servos together, in a time, none faster than its speed; towards ``aims``, further on, those that brake for their goal."""

    def correct(self) -> None:
        """Bring servos that stand still nearer to where they were sent, where encoders tell what is missing."""

    def stop(self, channels: Iterable[int]) -> LineRecord:
        """Hold servos where they are on their way. From any thread, and without waiting for an answer."""

    def torque_off(self, channels: Iterable[int]) -> LineRecord:
        """Let servos go: arms sink."""

    def stop_s(self, channels: Sequence[int]) -> float:
        """How long a stop is on the wire at worst."""


class BoardGroup:
    """All that arms are wired to; ``by_name`` holds each :class:`Controller`. ``on_wait``: see :class:`WiredDevice`."""

    def __init__(
        self, config: HardwareConfig, clock: Clock, *, dry_run: bool = False, on_wait: Callable[[], object] = lambda: None
    ) -> None:
        self.by_name: dict[str, Controller] = {}
        for name in config.used_boards():
            board = config.boards[name]
            usual: DeviceOptions = {"log_entries": config.log_entries, "dry_run": dry_run, "on_wait": on_wait}
            if config.protocol == "ssc32":
                self.by_name[name] = Ssc32(name, board, config.timeouts, clock, **usual)
                continue
            grippers = [wiring.gripper.channel for wiring in config.arms.values() if wiring.board == name]
            bus: dict[str, Any] = {"servos": board_channels(config, name), "grippers": grippers, "settings": config.bus}
            self.by_name[name] = FeetechDriver(name, board, config.timeouts, clock, **bus, **usual)
        self._channels = {name: board_channels(config, name) for name in self.by_name}
        self._tolerance_us = config.stream.pulse_tolerance_us
        self._look_s = config.stream.poll_s + config.stream.backlog_s

    def connect(self) -> None:
        """Connect all. Raises as :meth:`Ssc32.connect`, and :class:`TooSlow`; then none is left open."""
        try:
            for name, board in self.by_name.items():
                board.connect()
                takes_s = self.stop_s(name)
                if takes_s > STOP_WITHIN_S:
                    raise TooSlow(name, board.wire.baud, takes_s, STOP_WITHIN_S)
        except BaseException:
            self.close()
            raise

    @property
    def have_encoders(self) -> bool:
        """Whether every servo tells where it stands, held or not."""
        return all(board.has_encoders for board in self.by_name.values())

    def close(self) -> None:
        """Let all ports go."""
        for board in self.by_name.values():
            board.close()

    def stop_s(self, name: str) -> float:
        """How long a stop takes at worst to reach the last channel of a board: it is noticed late, and waits for the longest line."""
        return self._look_s + self.by_name[name].stop_s(self._channels[name])

    def pulses(self) -> dict[str, dict[int, int | None]]:
        """What all wired channels put out; None: no pulse, and so no known position."""
        return {name: board.pulses(self._channels[name]) for name, board in self.by_name.items()}

    def require_pulses(self) -> None:
        """Ask whether every wired channel puts out what it was sent by now. Raises as :meth:`Ssc32.require_pulses`."""
        for name, board in self.by_name.items():
            board.require_pulses(self._channels[name], self._tolerance_us)

    def marks(self, config: HardwareConfig) -> list[tuple[int, ...]]:
        """What every arm's servos keep that tells it from others; see :class:`Controller`."""
        return [self.by_name[wiring.board].marks(config.channels(name)) for name, wiring in config.arms.items()]

    def require_holding(self) -> None:
        """Raise :class:`TorqueLost` if a servo does not hold, although it is known where it stands: that is not where it was sent."""
        for name, board in self.by_name.items():
            if limp := board.limp(self._channels[name]):
                raise TorqueLost(name, limp)

    def note_readback(self, pulses: Mapping[str, Mapping[int, int | None]]) -> None:
        """Take readings for where the channels stand. See :meth:`Ssc32.note_readback`."""
        for name, found in pulses.items():
            self.by_name[name].note_readback({channel: pulse for channel, pulse in found.items() if pulse is not None})

    def backlog_s(self, names: Iterable[str]) -> float:
        """How long the last byte written to any of these boards is still on its way."""
        return max((self.by_name[name].wire.backlog_s() for name in names), default=0.0)

    def first_move(self, pulses: PulsesOfBoards, time_ms: int | None) -> tuple[LineRecord, ...]:
        """As :meth:`Ssc32.first_move`, board by board."""
        return tuple(self.by_name[name].first_move(found, time_ms) for name, found in pulses.items())

    def correct(self) -> None:
        """As :meth:`Controller.correct`, of all."""
        for board in self.by_name.values():
            board.correct()

    def stop(self) -> bool:
        """Stop every channel of every board that can be reached; whether all could."""
        reached = True
        for name, board in self.by_name.items():
            try:
                board.stop(self._channels[name])
            except (ConnectionLost, WrongState):
                reached = False
        return reached

    def torque_off(self) -> None:
        """No more pulses on any channel, but for a dry run. Raises :class:`ConnectionLost`, after all boards were tried."""
        lost: ConnectionLost | None = None
        for name, board in self.by_name.items():
            try:
                board.torque_off(self._channels[name])
            except ConnectionLost as error:
                lost = error
        if lost is not None:
            raise lost
