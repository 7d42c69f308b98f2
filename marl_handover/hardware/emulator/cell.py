"""The emulated electronics of a cell: a board for each that the settings name, a servo behind each channel that an arm is wired to."""

from __future__ import annotations

import math
import random

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.emulator.board import Board
from marl_handover.hardware.emulator.device import Device
from marl_handover.hardware.emulator.servo import Servo, ServoTruth
from marl_handover.hardware.settings import ARMS, HardwareConfig

Floats = NDArray[np.float64]


class EmulatedCell:
    """Boards and servos as the settings wire them, each servo with a scale, an offset and a dead band of its own, drawn from the seed.

    Args:
        config: the electronics; ``config.emulator`` says what the servos are like.
        arm: kinematics; their limits say where the end stops are.
        standing_rad: (5,) where the joints stand when nothing was ever switched on: whoever sets up a cell puts the arms there.
        gripper_mm: the same of the fingers.
    """

    def __init__(self, config: HardwareConfig, arm: ArmModel, standing_rad: ArrayLike, gripper_mm: float = 12.0) -> None:
        config.validate()
        self.config, self._arm = config, arm
        self._random = random.Random(config.emulator.seed)
        self.truths = {name: self._drawn(name) for name in ARMS}
        """Arm -> the five joints' servos as they truly are, then the gripper's."""
        servos: dict[str, dict[int, Servo]] = {name: {} for name in config.used_boards()}
        stand = [*(float(angle) for angle in np.asarray(standing_rad, float)), gripper_mm]
        for arm_name, truths in self.truths.items():
            for channel, truth, position in zip(config.channels(arm_name), truths, stand, strict=True):
                servos[config.arms[arm_name].board][channel] = Servo(truth, position, self._random.randrange(2**31))
        emulator = config.emulator
        self.devices = {
            name: Device(
                Board(emulator.firmware, emulator.seed), found, baud=config.boards[name].baud, boot_s=emulator.boot_s, seed=emulator.seed
            )
            for name, found in servos.items()
        }

    def mount(self, clock: Clock) -> dict[str, str]:
        """Put every board behind the URL ``ssc32emu://<its name>``; the URLs by board."""
        from marl_handover.hardware.emulator.protocol_ssc32emu import mount

        return {name: mount(name, device, clock) for name, device in self.devices.items()}

    def joints_rad(self, t_s: float) -> Floats:
        """Where the joints truly are: (num_arms, 5)."""
        return self._positions(t_s)[:, :-1]

    def gripper_mm(self, t_s: float) -> Floats:
        """How far each hand's fingers would be from closed if nothing were between them: (num_arms,)."""
        return self._positions(t_s)[:, -1]

    def put(self, arm: int, joints_rad: ArrayLike, t_s: float) -> None:
        """Turn an arm's joints (5,) by hand; servos that get a pulse turn back."""
        self._positions(t_s)
        for servo, angle in zip(self.servos(arm), np.asarray(joints_rad, float), strict=False):
            servo.put(float(angle))

    def servos(self, arm: int) -> list[Servo]:
        """An arm's servos, the gripper's last."""
        name = ARMS[arm]
        device = self.devices[self.config.arms[name].board]
        return [device.servos[channel] for channel in self.config.channels(name)]

    def _positions(self, t_s: float) -> Floats:
        for device in self.devices.values():
            device.advance(t_s)
        return np.array([[servo.position for servo in self.servos(arm)] for arm in range(len(ARMS))])

    def _drawn(self, arm: str) -> list[ServoTruth]:
        """The servos of an arm."""
        config, emulator = self.config, self.config.emulator
        beyond = math.radians(emulator.end_stop_deg)
        speeds = [math.radians(speed) for speed in emulator.speed_deg_s]
        truths = []
        for index, joint in enumerate(ARM_JOINTS):
            nominal = config.nominal[joint]
            zero_us = nominal.zero_us + self._error(emulator.offset_sd_us)
            slope = math.degrees(nominal.us_per_deg) * (1 + self._error(emulator.scale_sd))
            low, high = self._arm.lower_rad[index] - beyond, self._arm.upper_rad[index] + beyond
            truths.append(self._truth(zero_us, slope, float(low), float(high), speeds[index]))
        gripper = config.arms[arm].gripper
        zero_us = gripper.closed_us + self._error(emulator.offset_sd_us)
        slope = (gripper.open_us - gripper.closed_us) / gripper.open_mm * (1 + self._error(emulator.scale_sd))
        radius_mm = 10.0  # of the gripper servo's crank
        truths.append(self._truth(zero_us, slope, 0.0, config.gate.finger_mm + 1.0, speeds[-1] * radius_mm))
        return truths

    def _truth(self, zero_us: float, slope_us: float, low: float, high: float, speed: float) -> ServoTruth:
        emulator = self.config.emulator
        band_us = max(0.0, emulator.dead_band_us + self._error(emulator.dead_band_sd_us))
        return ServoTruth(zero_us, slope_us, low, high, speed, band_us, emulator.lag_s, emulator.settle_sd_us)

    def _error(self, sd: float) -> float:
        return max(-2.0, min(2.0, self._random.gauss(0.0, 1.0))) * sd
