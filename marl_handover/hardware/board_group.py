"""The boards of a cell, one or more, as one thing: joints and fingers to channels and pulses, and what is read back from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.geometry.arm_model import LIMIT_TOLERANCE_RAD, ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import ArmCalibration
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.errors import BadCommand, BoardReset, PortLost, TooSlow, WrongState
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason
from marl_handover.hardware.settings import PULSE_US, READING_US, SPEED_US_S, TIME_MS, GripperConfig, HardwareConfig
from marl_handover.hardware.ssc32 import LineRecord, Ssc32, group_move, stop
from marl_handover.hardware.transport import BITS_PER_BYTE


class Wiring:
    """Translates for all arms of a cell.

    Args:
        config: electronics, wired for the cell's arms alone.
        calibrations: of the arms, in order.
        pin_diameter_mm: of what the fingers close on.
        speed_rad_s: (5,) no joint may be faster, whatever a group move's time says: boards hold each servo to it.
    """

    def __init__(
        self, config: HardwareConfig, calibrations: Sequence[ArmCalibration], pin_diameter_mm: float, speed_rad_s: NDArray[np.float64]
    ) -> None:
        self._config, self._calibrations, self._pin_mm, self._names = config, tuple(calibrations), pin_diameter_mm, tuple(config.arms)
        self._speeds: dict[tuple[str, int], int] = {}
        for name, calibration in zip(self._names, self._calibrations, strict=True):
            board, gripper = config.arms[name].board, config.arms[name].gripper
            per_rad = [servo.least_us_per_rad() for servo in calibration.maps]
            speeds = [*(speed_rad_s * per_rad), config.gate.finger_mm_s * abs(gripper.open_us - gripper.closed_us) / gripper.open_mm]
            for channel, speed in zip(config.channels(name), speeds, strict=True):
                self._speeds[board, channel] = min(max(math.floor(speed), SPEED_US_S[0]), SPEED_US_S[1])

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
            gripper = gripper_pulse_us(self._config.arms[name].gripper, command.gripper_mm, self._pin_mm)
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
        return self._calibrations[arm].to_rad(np.array(joints, float)), finger_mm(self._config.arms[name].gripper, gripper)


def gripper_pulse_us(gripper: GripperConfig, opening_mm: float, pin_diameter_mm: float) -> int:
    """The pulse for fingers ``opening_mm`` from closed, each. Asked to close, they are sent into the pin by the preload and no further."""
    aim_mm = max(opening_mm, pin_diameter_mm / 2 - gripper.preload_mm, 0.0)
    pulse = round(gripper.closed_us + aim_mm / gripper.open_mm * (gripper.open_us - gripper.closed_us))
    low, high = sorted((gripper.open_us, gripper.closed_us))
    return min(max(pulse, low), high)


def finger_mm(gripper: GripperConfig, pulse_us: float) -> float:
    """How far from closed each finger is sent by a pulse."""
    return (pulse_us - gripper.closed_us) / (gripper.open_us - gripper.closed_us) * gripper.open_mm


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


def readback_middles(pulses: Pulses) -> dict[str, dict[int, int]]:
    """The middle of what each reading may stand for, whole and within what boards take. Channels without a pulse are left out."""
    return {
        name: {channel: min(pulse + READING_US // 2, PULSE_US[1]) for channel, pulse in found.items() if pulse is not None}
        for name, found in pulses.items()
    }


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
    lower, upper = arm_model.lower_rad, arm_model.upper_rad
    low = np.array(readings)
    ends = np.sort([calibrations[arm].to_rad(low), calibrations[arm].to_rad(low + READING_US)], axis=0)
    outside = (ends[1] < lower - LIMIT_TOLERANCE_RAD) | (ends[0] > upper + LIMIT_TOLERANCE_RAD)
    if outside.any():
        index = int(np.argmax(outside))
        limit = f"{math.degrees(lower[index]):.2f} to {math.degrees(upper[index]):.2f} degrees; let the arms go limp and put them there"
        what = f"{ARM_JOINTS[index]}, as the board holds it,"
        raise CommandRejected(Reason.JOINT_LIMIT, arm, what, math.degrees(float(ends[:, index].mean())), limit, names)
    shut, wide = sorted(finger_mm(config.arms[name].gripper, gripper + more) for more in (0, READING_US))
    if wide < 0.0 or shut > config.gate.finger_mm:
        limit = f"0 to {config.gate.finger_mm:g} mm"
        raise CommandRejected(Reason.GRIPPER, arm, "the opening of each finger, as the board holds it,", (shut + wide) / 2, limit, names)
    fingers = min(max((shut + wide) / 2, 0.0), config.gate.finger_mm)
    return np.clip(calibrations[arm].to_rad(low + READING_US / 2), lower, upper), fingers


STOP_WITHIN_S = 0.04
"""From the stop being latched to its last byte at a board, at worst."""

PulsesOfBoards = Mapping[str, Mapping[int, int]]
"""Board -> channel -> pulse in us."""


class BoardGroup:
    """Every board that an arm is wired to; ``by_name`` holds each. ``on_wait``: see :class:`Ssc32`."""

    def __init__(
        self, config: HardwareConfig, clock: Clock, *, dry_run: bool = False, on_wait: Callable[[], object] = lambda: None
    ) -> None:
        self.by_name = {
            name: Ssc32(name, config.boards[name], config.timeouts, clock, log_entries=config.log_entries, dry_run=dry_run, on_wait=on_wait)
            for name in config.used_boards()
        }
        self._channels = {name: board_channels(config, name) for name in self.by_name}
        self._tolerance_us = config.stream.pulse_tolerance_us
        self._look_s = config.stream.poll_s + config.stream.backlog_s

    def connect(self) -> None:
        """Connect all. Raises as :meth:`Ssc32.connect`, and :class:`TooSlow`; then none is left open."""
        try:
            for name, board in self.by_name.items():
                board.connect()
                takes_s = self.stop_s(name, board.wire.baud)
                if takes_s > STOP_WITHIN_S:
                    raise TooSlow(name, board.wire.baud, takes_s, STOP_WITHIN_S)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let all ports go."""
        for board in self.by_name.values():
            board.close()

    def stop_s(self, name: str, baud: int) -> float:
        """How long a stop takes at worst to reach the last channel of a board: it is noticed late, and waits for the longest line."""
        channels = self._channels[name]
        longest = group_move(dict.fromkeys(channels, PULSE_US[1]), TIME_MS[1], dict.fromkeys(channels, SPEED_US_S[1]))
        return self._look_s + (len(longest) + len(stop(channels))) * BITS_PER_BYTE / baud

    def pulses(self) -> dict[str, dict[int, int | None]]:
        """What all wired channels put out; None: no pulse, and so no known position."""
        return {name: board.pulses(self._channels[name]) for name, board in self.by_name.items()}

    def require_pulses(self) -> None:
        """Ask whether every wired channel puts out what it was sent by now. Raises as :meth:`Ssc32.require_pulses`."""
        for name, board in self.by_name.items():
            board.require_pulses(self._channels[name], self._tolerance_us)

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

    def stop(self) -> bool:
        """Stop every channel of every board that can be reached; whether all could."""
        reached = True
        for name, board in self.by_name.items():
            try:
                board.stop(self._channels[name])
            except (PortLost, WrongState):
                reached = False
        return reached

    def torque_off(self) -> None:
        """No more pulses on any channel, but for a dry run. Raises :class:`PortLost`, after all boards were tried."""
        lost: PortLost | None = None
        for name, board in self.by_name.items():
            try:
                board.torque_off(self._channels[name])
            except PortLost as error:
                lost = error
        if lost is not None:
            raise lost
