"""LeRobot's calibration file of an SO-101: read as a start, and written so that LeRobot's own programs know the arm.

Its degrees count from the middle of a joint's range, which is where the URDF's joint is 0; so a range's middle is the zero.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.files import write_whole
from marl_handover.hardware.settings import COUNTS
from marl_handover.parsing import read_json

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
"""An arm's motors, in the order of its servos' ids."""

MOST_OFFSET = 2047
_WHAT = "LeRobot calibration"


class Motor(NamedTuple):
    """One entry of the file: the servo's id, what it subtracts from its encoder, and between which counts it moves."""

    id: int
    homing_offset: int
    range_min: int
    range_max: int
    drive_mode: int = 0

    @property
    def middle(self) -> float:
        """Counts of the middle of its range."""
        return (self.range_min + self.range_max) / 2


def read_motors(path: Path) -> tuple[Motor, ...]:
    """The motors of a file, in the order of :data:`MOTORS`.

    Raises:
        MissingFile: there is none.
        CorruptFile: it is no calibration of an SO-101, lacks a motor, or has a value that no servo keeps.
    """
    if not path.is_file():
        raise MissingFile(_WHAT, path, "run: lerobot-calibrate, or leave hardware.arms.NAME.lerobot empty")
    content = read_json(path, _WHAT)
    missing = [name for name in MOTORS if not isinstance(content.get(name), dict)]
    if missing:
        raise CorruptFile(_WHAT, path, f"no motor {', '.join(missing)}; an SO-101 has {', '.join(MOTORS)}")
    motors = []
    for name in MOTORS:
        entry = content[name]
        try:
            motor = Motor(**{key: _whole(entry[key]) for key in Motor._fields})
        except (KeyError, ValueError) as error:
            raise CorruptFile(_WHAT, path, f"motor {name}: {error}") from error
        if motor.drive_mode:
            raise CorruptFile(_WHAT, path, f"motor {name}: drive_mode {motor.drive_mode}; an SO-101 has 0")
        if not (0 <= motor.range_min < motor.range_max < COUNTS and abs(motor.homing_offset) <= MOST_OFFSET):
            limit = f"0 <= range_min < range_max < {COUNTS}, homing_offset within {MOST_OFFSET} either way"
            raise CorruptFile(_WHAT, path, f"motor {name}: {dict(motor._asdict())}; allowed: {limit}")
        motors.append(motor)
    return tuple(motors)


def write_motors(path: Path, motors: Sequence[Motor]) -> None:
    """Write a file of the motors, in the order of :data:`MOTORS`. Raises :class:`~marl_handover.errors.CannotWrite`."""
    keys = ("id", "drive_mode", "homing_offset", "range_min", "range_max")
    content = {name: {key: getattr(motor, key) for key in keys} for name, motor in zip(MOTORS, motors, strict=True)}
    write_whole(path, json.dumps(content, indent=4) + "\n")


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{value!r} is no whole number")
    return value
