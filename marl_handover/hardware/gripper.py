"""Hands: fingers to pulses and back, and the file of what ``calibrate what=grippers`` found."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from marl_handover.config import require_between
from marl_handover.errors import CorruptFile
from marl_handover.files import keep, write_whole
from marl_handover.geometry.urdf import Gripper
from marl_handover.hardware.calibration import CalibrationProblem, stored
from marl_handover.hardware.settings import COUNTS_PER_RAD, GripperConfig, HardwareConfig

GRIPPERS_FILE = "grippers.json"
_GRIPPERS_VERSION = 1
_GRIPPERS_FOUND = ("open_us", "closed_us")
_GRIPPERS_ASKED = (*_GRIPPERS_FOUND, "open_mm")
_GRIPPERS_AGAIN = "run: marl-handover calibrate what=grippers hardware=NAME, with the name you run"


class GripperMap:
    """Fingers to pulses and back. A board's servo opens a hand in proportion to its pulse; a bus servo is the hinge of a jaw itself.

    Args:
        config: electronics.
        arm: its name.
        hand: as the URDF has it.
    """

    def __init__(self, config: HardwareConfig, arm: str, hand: Gripper) -> None:
        self._gripper, self._hand, self._hinged, self._unit = config.arms[arm].gripper, hand, hand.kind == "jaw", config.unit
        self._widest_mm = min(config.gate.finger_mm, hand.travel_mm) if self._hinged else self._gripper.open_mm

    @property
    def closing_per_mm(self) -> float:
        """Change of the pulse as each finger closes by 1 mm, near closed."""
        return self._pulse(0.0) - self._pulse(1.0)

    def shifted(self, further_mm: float) -> GripperConfig:
        """The gripper with pulses at which each finger is ``further_mm`` nearer to closed.

        Raises:
            InvalidSetting: a servo has no such pulses.
        """
        shift = round(further_mm * self.closing_per_mm)
        found = ("closed_us",) if self._hinged else _GRIPPERS_FOUND
        moved = {name: getattr(self._gripper, name) + shift for name in found}
        for name, pulse in moved.items():
            require_between(f"gripper.{name}", pulse, self._unit.lower, self._unit.upper)
        return replace(self._gripper, **moved)

    def closing_pulse(self, opening_mm: float, pin_diameter_mm: float) -> int:
        """The pulse for fingers ``opening_mm`` from closed, each. Asked to close, they go into the pin by the preload and no further."""
        aim_mm = max(opening_mm, pin_diameter_mm / 2 - self._gripper.preload_mm, 0.0)
        low, high = sorted((self._pulse(0.0), self._pulse(self._widest_mm)))
        return min(max(round(self._pulse(aim_mm)), math.ceil(low)), math.floor(high))

    def mm(self, pulse: float) -> float:
        """How far from closed each finger is sent by a pulse."""
        if self._hinged:
            return self._hand.gripper_mm(
                [self._hand.closed[0] + self._hand.opening[0] * (pulse - self._gripper.closed_us) / COUNTS_PER_RAD]
            )
        return (pulse - self._gripper.closed_us) / (self._gripper.open_us - self._gripper.closed_us) * self._gripper.open_mm

    def _pulse(self, opening_mm: float) -> float:
        gripper = self._gripper
        if self._hinged:
            turned = (self._hand.joint_values(opening_mm)[self._hand.joints[0]] - self._hand.closed[0]) / self._hand.opening[0]
            return gripper.closed_us + COUNTS_PER_RAD * turned
        return gripper.closed_us + opening_mm / gripper.open_mm * (gripper.open_us - gripper.closed_us)


def save_grippers(folder: Path, asked: Mapping[str, GripperConfig], found: Mapping[str, GripperConfig]) -> Path:
    """Write what was found for all hands, whose settings were ``asked``, into ``folder``; what was there is kept beside it. Its path.

    Raises:
        CannotWrite: there is no room, or no folder.
    """
    path = folder / GRIPPERS_FILE
    arms = {arm: {"settings": _picked(asked[arm], _GRIPPERS_ASKED), "found": _picked(found[arm], _GRIPPERS_FOUND)} for arm in found}
    content = {"version": _GRIPPERS_VERSION, "measured_unix_s": time.time(), "arms": arms}
    keep(path)
    write_whole(path, json.dumps(content, indent=1) + "\n")
    return path


def with_grippers(hardware: HardwareConfig, folder: Path) -> HardwareConfig:
    """``hardware`` with the pulses that were found for its hands; as it is if nobody has calibrated them.

    Raises:
        CorruptFile: the file cannot be read.
        CalibrationProblem: its hands were set otherwise.
    """
    path = folder / GRIPPERS_FILE
    if not path.is_file():
        return hardware
    with stored("gripper calibration", path, _GRIPPERS_VERSION, f"; {_GRIPPERS_AGAIN}") as content:
        asked = {arm: {name: float(content["arms"][arm]["settings"][name]) for name in _GRIPPERS_ASKED} for arm in hardware.arms}
        found = {arm: {name: int(content["arms"][arm]["found"][name]) for name in _GRIPPERS_FOUND} for arm in hardware.arms}
    for arm, wiring in hardware.arms.items():
        now = _picked(wiring.gripper, _GRIPPERS_ASKED)
        if now != asked[arm]:
            raise CalibrationProblem(f"the {arm} gripper", f"{path} was found for {asked[arm]}, the settings say {now}; {_GRIPPERS_AGAIN}")
        unit = hardware.unit
        if not all(unit.lower <= pulse <= unit.upper for pulse in found[arm].values()):
            raise CorruptFile(
                "gripper calibration", path, f"pulses of {found[arm]}, a servo takes {unit.lower} to {unit.upper} {unit.name}"
            )
    arms = {arm: replace(wiring, gripper=replace(wiring.gripper, **found[arm])) for arm, wiring in hardware.arms.items()}
    return replace(hardware, arms=arms)


def _picked(gripper: GripperConfig, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(gripper, name) for name in names}
