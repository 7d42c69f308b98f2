"""Pulse width to joint angle and back: what was measured, the line through it, and the file it is kept in.

Scales differ by up to a quarter between servo types, and horns sit on splines 15 degrees apart, so every joint of every arm needs at least
two measured points. A servo rests anywhere in its dead band, hence each pulse is best approached from both sides.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.config import require_choice
from marl_handover.errors import CorruptFile, HandoverError, MissingFile
from marl_handover.files import keep, make_folder, write_whole
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.settings import ARMS, HardwareConfig
from marl_handover.parsing import read_json

Floats = NDArray[np.float64]

VERSION = 1
FITS = ("line", "pieces")
SCALE_LIMITS = (4.0, 16.0)
"""us per degree; servos have 9 to 11, so beyond these a joint was mistaken for another, or an angle misread."""

RESIDUAL_LIMIT_DEG = 4.0
"""How far a measured point may be off the fitted map: four dead bands."""


class CalibrationProblem(HandoverError):
    """Measured points that cannot be one servo's, or a file that belongs to another arm."""

    def __init__(self, what: str, reason: str) -> None:
        super().__init__(f"calibration of {what}: {reason}")
        self.what, self.reason = what, reason


class ServoMap:
    """The monotone map of one servo, through points (pulse [us], angle [rad]).

    Args:
        name: of the joint, for messages.
        points: at least two, at different pulses.
        fit: ``line`` (least squares) or ``pieces`` (straight between the points, each pulse's mean; end pieces go on outwards).

    Raises:
        CalibrationProblem: too few points, not monotone, a scale no servo has, or a point far off the line.
    """

    def __init__(self, name: str, points: Sequence[tuple[float, float]], fit: str = "line") -> None:
        require_choice("fit", fit, FITS)
        self.name, self.fit = name, fit
        self.points = tuple((float(pulse), float(angle)) for pulse, angle in points)
        array = np.array(self.points, float).reshape(-1, 2)
        if not np.isfinite(array).all():
            raise CalibrationProblem(name, "a point is not finite")
        pulses = np.unique(array[:, 0])
        if len(pulses) < 2:
            raise CalibrationProblem(name, "two points at different pulses are needed at least")
        line = np.polyfit(array[:, 0], array[:, 1], 1)
        if fit == "line":
            self._pulses = np.array([pulses[0], pulses[-1]])
            self._angles = np.polyval(line, self._pulses)
        else:
            self._pulses = pulses
            self._angles = np.array([array[array[:, 0] == pulse, 1].mean() for pulse in pulses])
        steps = np.diff(self._angles)
        if not ((steps > 0).all() or (steps < 0).all()):
            raise CalibrationProblem(name, "angles do not go one way with the pulse; measure again")
        scales = np.abs(np.diff(self._pulses) / np.degrees(steps))
        if not (SCALE_LIMITS[0] <= scales.min() and scales.max() <= SCALE_LIMITS[1]):
            raise CalibrationProblem(
                name,
                f"{scales.max():.1f} us a degree; servos have {SCALE_LIMITS[0]:g} to {SCALE_LIMITS[1]:g}: was another joint measured?",
            )
        self.residual_rad = float(np.abs(self.to_rad(array[:, 0]) - array[:, 1]).max())
        if math.degrees(self.residual_rad) > RESIDUAL_LIMIT_DEG:
            raise CalibrationProblem(name, f"a point is {math.degrees(self.residual_rad):.1f} degrees off; measure it again")

    def to_rad(self, pulse_us: ArrayLike) -> Floats:
        """Angles of pulses; any shape."""
        return _interpolate(np.asarray(pulse_us, float), self._pulses, self._angles)

    def to_us(self, angle_rad: ArrayLike) -> Floats:
        """Pulses of angles, not rounded; any shape."""
        order = slice(None) if self._angles[-1] > self._angles[0] else slice(None, None, -1)
        return _interpolate(np.asarray(angle_rad, float), self._angles[order], self._pulses[order])

    def us_per_rad(self) -> float:
        """The steepest piece, absolute: what a speed limit has to reckon with is its flattest, :meth:`least_us_per_rad`."""
        return float(np.abs(np.diff(self._pulses) / np.diff(self._angles)).max())

    def least_us_per_rad(self) -> float:
        """The flattest piece, absolute."""
        return float(np.abs(np.diff(self._pulses) / np.diff(self._angles)).min())


@dataclass(frozen=True)
class ArmCalibration:
    """The five servo maps of one arm. ``measured_unix_s`` is 0 for nominal ones, that nobody has measured."""

    arm: str
    robot: str
    maps: tuple[ServoMap, ...]
    limits_rad: tuple[tuple[float, float], ...]
    measured_unix_s: float = 0.0

    def to_us(self, joints_rad: ArrayLike) -> Floats:
        """Pulses (..., 5) of joint vectors (..., 5)."""
        q = np.asarray(joints_rad, float)
        return np.stack([servo.to_us(q[..., index]) for index, servo in enumerate(self.maps)], axis=-1)

    def to_rad(self, pulses_us: ArrayLike) -> Floats:
        """Joint vectors (..., 5) of pulses (..., 5)."""
        pulses = np.asarray(pulses_us, float)
        return np.stack([servo.to_rad(pulses[..., index]) for index, servo in enumerate(self.maps)], axis=-1)

    def save(self, path: Path | str) -> Path | None:
        """Write the file as a whole. What was there is kept beside it; its path, or None.

        Raises :class:`~marl_handover.errors.CannotWrite`.
        """
        path = Path(path)
        make_folder(path.parent)
        backup = keep(path)
        write_whole(path, self.text())
        return backup

    def text(self) -> str:
        """What the file holds."""
        return json.dumps(self._content(), indent=2, allow_nan=False) + "\n"

    def _content(self) -> dict[str, Any]:
        joints = {
            name: {"fit": servo.fit, "points": [{"pulse_us": pulse, "angle_rad": angle} for pulse, angle in servo.points]}
            for name, servo in zip(ARM_JOINTS, self.maps, strict=True)
        }
        limits = {name: list(pair) for name, pair in zip(ARM_JOINTS, self.limits_rad, strict=True)}
        head = {"version": VERSION, "arm": self.arm, "robot": self.robot, "measured_unix_s": self.measured_unix_s}
        return {**head, "limits_rad": limits, "joints": joints}


def make_calibration(arm: str, model: ArmModel, points: Mapping[str, Sequence[tuple[float, float]]], fit: str = "line") -> ArmCalibration:
    """The calibration of an arm (``left`` or ``right``) from measured points (pulse [us], angle [rad]) of each joint, dated now."""
    _require_joints(arm, points)
    maps = tuple(ServoMap(f"{arm} {joint}", points[joint], fit) for joint in ARM_JOINTS)
    return ArmCalibration(arm, model.description.name, maps, _limits(model), time.time())


def nominal_calibration(config: HardwareConfig, arm: str, model: ArmModel) -> ArmCalibration:
    """What an arm is taken for before anything was measured."""
    maps = []
    for joint in ARM_JOINTS:
        servo = config.nominal[joint]
        points = [(servo.zero_us + servo.us_per_deg * degrees, math.radians(degrees)) for degrees in (-90.0, 90.0)]
        maps.append(ServoMap(f"{arm} {joint}", points))
    return ArmCalibration(arm, model.description.name, tuple(maps), _limits(model))


def load_calibration(path: Path | str, arm: str, model: ArmModel) -> ArmCalibration:
    """Read a file and see that it fits the arm.

    Raises:
        MissingFile, CorruptFile: there is none, or it is no calibration.
        CalibrationProblem: it belongs to another arm or URDF, or its points cannot be right.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFile("servo calibration", path, "run: marl-handover calibrate")
    try:
        content = read_json(path, "servo calibration")
        version = content["version"]
        if version != VERSION:
            raise CorruptFile("servo calibration", path, f"it has version {version!r}, this program reads {VERSION}")
        owner = (content["arm"], content["robot"])
        limits = {name: tuple(float(value) for value in pair) for name, pair in content["limits_rad"].items()}
        points = {
            name: (entry["fit"], [(float(p["pulse_us"]), float(p["angle_rad"])) for p in entry["points"]])
            for name, entry in content["joints"].items()
        }
        measured = float(content["measured_unix_s"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise CorruptFile("servo calibration", path, f"{type(error).__name__}: {error}") from error
    if owner != (arm, model.description.name):
        raise CalibrationProblem(str(path), f"it is of arm {owner[0]!r}, robot {owner[1]!r}; wanted {arm!r}, {model.description.name!r}")
    _require_joints(arm, points)
    _require_joints(arm, limits)
    for joint, pair in zip(ARM_JOINTS, _limits(model), strict=True):
        if not np.allclose(limits[joint], pair, atol=1e-6):
            now, then = np.degrees(pair).round(1).tolist(), np.degrees(limits[joint]).round(1).tolist()
            raise CalibrationProblem(str(path), f"{joint} was calibrated with limits {then} degrees, the URDF has {now}: calibrate again")
    maps = tuple(ServoMap(f"{arm} {joint}", points[joint][1], points[joint][0]) for joint in ARM_JOINTS)
    return ArmCalibration(arm, model.description.name, maps, _limits(model), measured)


def calibrations(config: HardwareConfig, model: ArmModel) -> tuple[ArmCalibration, ...]:
    """The calibration of every arm: its file's, or the nominal one where the settings name none."""
    return tuple(
        load_calibration(config.arms[arm].calibration, arm, model)
        if config.arms[arm].calibration
        else nominal_calibration(config, arm, model)
        for arm in ARMS
    )


def _limits(model: ArmModel) -> tuple[tuple[float, float], ...]:
    """The URDF's own limits: cells that narrow them share one calibration."""
    joints = [model.description.joint(name) for name in ARM_JOINTS]
    return tuple((joint.lower, joint.upper) for joint in joints)


def _require_joints(arm: str, entries: Mapping[str, Any]) -> None:
    if set(entries) != set(ARM_JOINTS):
        raise CalibrationProblem(arm, f"joints are {sorted(entries)}, wanted {sorted(ARM_JOINTS)}")


def _interpolate(x: Floats, xs: Floats, ys: Floats) -> Floats:
    """Straight between the points, the outer pieces going on outwards; ``xs`` rise."""
    index = np.clip(np.searchsorted(xs, x) - 1, 0, len(xs) - 2)
    slope = (ys[index + 1] - ys[index]) / (xs[index + 1] - xs[index])
    return np.asarray(ys[index] + slope * (x - xs[index]))
