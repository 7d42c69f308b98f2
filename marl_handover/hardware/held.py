"""What boards say that they put out: whether it is all, nothing or some of it, and where arms stand that are held so."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from marl_handover.geometry.arm_model import LIMIT_TOLERANCE_RAD, ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import ArmCalibration
from marl_handover.hardware.errors import BoardReset
from marl_handover.hardware.gate import GateRejection, Reason
from marl_handover.hardware.protocol import PULSE_US, READING_US
from marl_handover.hardware.settings import ARMS, HardwareConfig
from marl_handover.hardware.wiring import finger_mm

Floats = NDArray[np.float64]

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


def middles(pulses: Pulses) -> dict[str, dict[int, int]]:
    """The middle of what each reading may stand for, whole and within what boards take. Channels without a pulse are left out."""
    return {
        name: {channel: min(pulse + READING_US // 2, PULSE_US[1]) for channel, pulse in found.items() if pulse is not None}
        for name, found in pulses.items()
    }


def stands(
    config: HardwareConfig, calibrations: Sequence[ArmCalibration], arm_model: ArmModel, pulses: Pulses, arm: int
) -> tuple[Floats, float]:
    """Joints (5,) and fingers of an arm that is held at ``pulses``, all of them there.

    Raises :class:`GateRejection` if it is held outside its limits, whatever its readings stand for: another cell's settings, or a
    calibration that is not this arm's. From there nobody knows the way.
    """
    name = ARMS[arm]
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
        raise GateRejection(Reason.JOINT_LIMIT, arm, what, math.degrees(float(ends[:, index].mean())), limit)
    shut, wide = sorted(finger_mm(config.arms[name].gripper, gripper + more) for more in (0, READING_US))
    if wide < 0.0 or shut > config.gate.finger_mm:
        limit = f"0 to {config.gate.finger_mm:g} mm"
        raise GateRejection(Reason.GRIPPER, arm, "the opening of each finger, as the board holds it,", (shut + wide) / 2, limit)
    fingers = min(max((shut + wide) / 2, 0.0), config.gate.finger_mm)
    return np.clip(calibrations[arm].to_rad(low + READING_US / 2), lower, upper), fingers
