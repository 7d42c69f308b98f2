"""The file of a gripper calibration: the pulses of each hand, and the settings they were found for."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from marl_handover.config import require_between
from marl_handover.errors import CorruptFile
from marl_handover.files import keep, write_whole
from marl_handover.hardware.calibration import CalibrationProblem
from marl_handover.hardware.protocol import PULSE_US
from marl_handover.hardware.settings import ARMS, GripperConfig, HardwareConfig
from marl_handover.parsing import read_json

FILE = "grippers.json"
VERSION = 1
_FOUND = ("open_us", "closed_us")
_ASKED = (*_FOUND, "open_mm")
_AGAIN = "run: marl-handover calibrate what=grippers hardware=NAME, with the name you run"


def shifted(gripper: GripperConfig, further_mm: float) -> GripperConfig:
    """``gripper`` with pulses at which each finger is ``further_mm`` nearer to closed.

    Raises:
        InvalidSetting: a servo has no such pulses.
    """
    shift_us = round(further_mm / gripper.open_mm * (gripper.closed_us - gripper.open_us))
    moved = replace(gripper, open_us=gripper.open_us + shift_us, closed_us=gripper.closed_us + shift_us)
    for name in _FOUND:
        require_between(f"gripper.{name}", getattr(moved, name), *PULSE_US)
    return moved


def save_grippers(folder: Path, asked: Mapping[str, GripperConfig], found: Mapping[str, GripperConfig]) -> Path:
    """Write what was found for all hands, whose settings were ``asked``, into ``folder``; what was there is kept beside it. Its path.

    Raises:
        CannotWrite: there is no room, or no folder.
    """
    path = folder / FILE
    arms = {arm: {"settings": _picked(asked[arm], _ASKED), "found": _picked(found[arm], _FOUND)} for arm in ARMS}
    content = {"version": VERSION, "measured_unix_s": time.time(), "arms": arms}
    keep(path)
    write_whole(path, json.dumps(content, indent=1) + "\n")
    return path


def with_grippers(hardware: HardwareConfig, folder: Path) -> HardwareConfig:
    """``hardware`` with the pulses that were found for its hands; as it is if nobody has calibrated them.

    Raises:
        CorruptFile: the file cannot be read.
        CalibrationProblem: its hands were set otherwise.
    """
    path = folder / FILE
    if not path.is_file():
        return hardware
    try:
        content = read_json(path, "gripper calibration")
        if content["version"] != VERSION:
            raise CorruptFile("gripper calibration", path, f"it has version {content['version']!r}, this program reads {VERSION}; {_AGAIN}")
        asked = {arm: {name: float(content["arms"][arm]["settings"][name]) for name in _ASKED} for arm in ARMS}
        found = {arm: {name: int(content["arms"][arm]["found"][name]) for name in _FOUND} for arm in ARMS}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise CorruptFile("gripper calibration", path, f"{type(error).__name__}: {error}") from error
    for arm in ARMS:
        now = _picked(hardware.arms[arm].gripper, _ASKED)
        if now != asked[arm]:
            raise CalibrationProblem(f"the {arm} gripper", f"{path} was found for {asked[arm]}, the settings say {now}; {_AGAIN}")
        if not all(PULSE_US[0] <= pulse <= PULSE_US[1] for pulse in found[arm].values()):
            raise CorruptFile("gripper calibration", path, f"pulses of {found[arm]}, a servo takes {PULSE_US[0]} to {PULSE_US[1]} us")
    arms = {arm: replace(wiring, gripper=replace(wiring.gripper, **found[arm])) for arm, wiring in hardware.arms.items()}
    return replace(hardware, arms=arms)


def _picked(gripper: GripperConfig, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(gripper, name) for name in names}
