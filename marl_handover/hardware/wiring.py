"""From joints and fingers to channels and pulses, and back, as the arms are wired and calibrated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from marl_handover.hardware.calibration import ArmCalibration
from marl_handover.hardware.errors import BadCommand
from marl_handover.hardware.gate import JointCommand
from marl_handover.hardware.protocol import SPEED_US_S
from marl_handover.hardware.settings import ARMS, GripperConfig, HardwareConfig

Floats = NDArray[np.float64]


class Wiring:
    """Translates for all arms of a cell.

    Args:
        config: electronics.
        calibrations: of the arms, in order.
        pin_diameter_mm: of what the fingers close on.
        speed_rad_s: (5,) no joint may be faster, whatever a group move's time says: boards hold each servo to it.
    """

    def __init__(
        self, config: HardwareConfig, calibrations: Sequence[ArmCalibration], pin_diameter_mm: float, speed_rad_s: NDArray[np.float64]
    ) -> None:
        self._config, self._calibrations, self._pin_mm = config, tuple(calibrations), pin_diameter_mm
        self._speeds: dict[tuple[str, int], int] = {}
        for name, calibration in zip(ARMS, self._calibrations, strict=True):
            board, gripper = config.arms[name].board, config.arms[name].gripper
            per_rad = [servo.least_us_per_rad() for servo in calibration.maps]
            speeds = [*(speed_rad_s * per_rad), config.gate.finger_mm_s * abs(gripper.open_us - gripper.closed_us) / gripper.open_mm]
            for channel, speed in zip(config.channels(name), speeds, strict=True):
                self._speeds[board, channel] = min(max(math.floor(speed), SPEED_US_S[0]), SPEED_US_S[1])

    def boards(self, arms: Iterable[int]) -> tuple[str, ...]:
        """Names of the boards that arms are wired to, each once."""
        return tuple(dict.fromkeys(self._config.arms[ARMS[arm]].board for arm in arms if arm in range(len(ARMS))))

    def pulses(self, commands: Sequence[JointCommand]) -> dict[str, dict[int, int]]:
        """Board -> channel -> pulse in us. Raises :class:`BadCommand` for what is no number."""
        found: dict[str, dict[int, int]] = {}
        for command in commands:
            name = ARMS[command.arm]
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
        name = ARMS[arm]
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
    return [channel for arm in ARMS if config.arms[arm].board == board for channel in config.channels(arm)]
