"""Servos and grippers as they were calibrated: the maps from pulse to joint angle, and the files of it all.

Scales differ by up to a quarter between servo types, and horns sit on splines 15 degrees apart, so every joint of every arm needs at least
two measured points. A servo rests anywhere in its dead band, hence each pulse is best approached from both sides.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.config import require_between, require_choice
from marl_handover.errors import CorruptFile, HandoverError, MissingFile, UnsupportedKinematics
from marl_handover.files import keep, make_folder, read_bounded, write_together, write_whole
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.lerobot_file import Motor, read_motors
from marl_handover.hardware.settings import ARMS, COUNTS, COUNTS_PER_RAD, HardwareConfig
from marl_handover.parsing import JSON_BYTES, read_json

VERSION = 1
FITS = ("line", "pieces")
SCALE_LIMITS = (4.0, 16.0)
"""us per degree; servos have 9 to 11, so beyond these a joint was mistaken for another, or an angle misread."""

RESIDUAL_LIMIT_DEG = 4.0
"""How far a measured point may be off the fitted map: four dead bands."""

BACKLASH_VERSION = 2
BACKLASH_FILE = "play.json"
_HANDS = {"ssc32": ("fingers", 2, "two fingers that slide"), "feetech": ("jaw", 1, "a jaw that turns")}
"""Of what speaks each protocol: kind, joints and words of the hand that it has servos for."""

_SERVOS_AGAIN = "run: marl-handover calibrate what=servos hardware=NAME, with the name you run"
MOST_US = 20.0

SET_FILE = "servos.json"
"""Names the others' content, so that files of two calibrations are told from those of one."""

_SET_VERSION = 1


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
    """The five servo maps of one arm. ``measured_unix_s`` is 0 for nominal ones, that nobody has measured.

    ``homing_offsets`` are those that the arm's bus servos keep, the hand's last: they tell it from other arms. Boards' servos have none.
    """

    arm: str
    robot: str
    maps: tuple[ServoMap, ...]
    limits_rad: tuple[tuple[float, float], ...]
    measured_unix_s: float = 0.0
    homing_offsets: tuple[int, ...] = ()

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
        kept = {"homing_offsets": list(self.homing_offsets)} if self.homing_offsets else {}
        return {**head, **kept, "limits_rad": limits, "joints": joints}


def make_calibration(arm: str, model: ArmModel, points: Mapping[str, Sequence[tuple[float, float]]], fit: str = "line") -> ArmCalibration:
    """The calibration of an arm, by its name in the settings, from measured points (pulse [us], angle [rad]) of each joint, dated now."""
    _require_joints(arm, points)
    maps = tuple(ServoMap(f"{arm} {joint}", points[joint], fit) for joint in ARM_JOINTS)
    return ArmCalibration(arm, model.description.name, maps, _limits(model), time.time())


def nominal_calibration(config: HardwareConfig, arm: str, model: ArmModel) -> ArmCalibration:
    """What an arm is taken for before anything was measured: as the settings say; bus servos have the URDF's zeros in the middle."""
    maps = []
    if config.protocol == "feetech":
        path = config.arms[arm].lerobot
        motors = read_motors(Path(path)) if path else None
        zeros = [COUNTS / 2] * len(ARM_JOINTS) if motors is None else [motor.middle for motor in motors]
        homing = () if motors is None else tuple(motor.homing_offset for motor in motors)
        for joint, source, zero in zip(ARM_JOINTS, model.description.sources, zeros, strict=False):
            middle = -source.sign * source.offset_rad  # the joint's angle where the URDF's is 0
            quarter = COUNTS / 4 * source.sign
            points = [(zero - quarter, middle - math.pi / 2), (zero + quarter, middle + math.pi / 2)]
            maps.append(ServoMap(f"{arm} {joint}", points))
        return ArmCalibration(arm, model.description.name, tuple(maps), _limits(model), homing_offsets=homing)
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
    with stored("servo calibration", path, VERSION) as content:
        owner = (content["arm"], content["robot"])
        limits = {name: tuple(float(value) for value in pair) for name, pair in content["limits_rad"].items()}
        points = {
            name: (entry["fit"], [(float(p["pulse_us"]), float(p["angle_rad"])) for p in entry["points"]])
            for name, entry in content["joints"].items()
        }
        measured = float(content["measured_unix_s"])
        homing = tuple(int(offset) for offset in content.get("homing_offsets", ()))
    if owner != (arm, model.description.name):
        raise CalibrationProblem(str(path), f"it is of arm {owner[0]!r}, robot {owner[1]!r}; wanted {arm!r}, {model.description.name!r}")
    _require_joints(arm, points)
    _require_joints(arm, limits)
    for joint, pair in zip(ARM_JOINTS, _limits(model), strict=True):
        if not np.allclose(limits[joint], pair, atol=1e-6):
            now, then = np.degrees(pair).round(1).tolist(), np.degrees(limits[joint]).round(1).tolist()
            raise CalibrationProblem(str(path), f"{joint} was calibrated with limits {then} degrees, the URDF has {now}: calibrate again")
    maps = tuple(ServoMap(f"{arm} {joint}", points[joint][1], points[joint][0]) for joint in ARM_JOINTS)
    return ArmCalibration(arm, model.description.name, maps, _limits(model), measured, homing)


def require_own_arms(calibrations: Sequence[ArmCalibration], marks: Sequence[tuple[int, ...]]) -> None:
    """See that every arm is the one that was calibrated, by the homing offsets that its servos keep, ``marks`` of the arms in order.

    Raises :class:`CalibrationProblem` for arms that are swapped, and for one that was calibrated with other servos or other offsets.
    """
    for calibration, kept in zip(calibrations, marks, strict=True):
        if not calibration.homing_offsets or calibration.homing_offsets == kept:
            continue
        other = next((other.arm for other in calibrations if other.homing_offsets == kept), None)
        if other is not None:
            raise CalibrationProblem(
                f"the {calibration.arm} arm", f"the arm at its port is the {other} one: swap the two USB cables, or ports"
            )
        reason = f"its servos keep homing offsets {list(kept)}, it was calibrated with {list(calibration.homing_offsets)}"
        raise CalibrationProblem(
            f"the {calibration.arm} arm", f"{reason}: another arm, or calibrated since by another program; {_SERVOS_AGAIN}"
        )


@contextmanager
def stored(what: str, path: Path, version: int, again: str = "") -> Iterator[dict[str, Any]]:
    """What a file of that version holds. Raises :class:`CorruptFile` for another one, and for whatever is missed in it within the block."""
    try:
        content = read_json(path, what)
        if content["version"] != version:
            raise CorruptFile(what, path, f"it has version {content['version']!r}, this program reads {version}{again}")
        yield content
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise CorruptFile(what, path, f"{type(error).__name__}: {error}") from error


def calibrations(config: HardwareConfig, model: ArmModel) -> tuple[ArmCalibration, ...]:
    """The calibration of every arm of ``config``, in order: its file's, or the nominal one where the settings name none.

    Raises:
        UnsupportedKinematics: the arm has other joints or another hand than the servos are wired for.
    """
    description = model.description
    servos, hand = [source.joint for source in description.sources], description.gripper
    kind, count, words = _HANDS[config.protocol]
    if None in servos or hand.kind != kind or len(hand.joints) != count:
        missing = "the joint wrist_roll" if None in servos else f"a hand with {words}"
        problem = f"hardware {config.name!r} has servos for five joints and a hand with {words}, but this robot lacks {missing}; "
        raise UnsupportedKinematics(description.path, f"{problem}choose hardware= and cell= that go together, or use backend=bullet")
    return tuple(
        load_calibration(wiring.calibration, arm, model) if wiring.calibration else nominal_calibration(config, arm, model)
        for arm, wiring in config.arms.items()
    )


def lerobot_motors(calibration: ArmCalibration, model: ArmModel, ids: Sequence[int], closed: int) -> tuple[Motor, ...]:
    """What LeRobot's file of an arm of bus servos says if the calibration is right: the middle of every joint's range is the URDF's zero.

    Args:
        calibration: of the arm, measured.
        model: its kinematics.
        ids: of its servos, the hand's last.
        closed: counts of the hand's servo where the hand is closed.
    """
    motors = []
    for index, (source, servo) in enumerate(zip(model.description.sources, calibration.maps, strict=True)):
        middle = round(float(servo.to_us(-source.sign * source.offset_rad)))
        half = min(middle, COUNTS - 1 - middle, *(abs(round(float(servo.to_us(end))) - middle) for end in calibration.limits_rad[index]))
        motors.append(Motor(ids[index], calibration.homing_offsets[index], middle - half, middle + half))
    hand = model.description.gripper
    widest = round(closed + COUNTS_PER_RAD * (hand.joint_values(None)[hand.joints[0]] - hand.closed[0]) / hand.opening[0])
    return (*motors, Motor(ids[-1], calibration.homing_offsets[-1], closed, min(widest, COUNTS - 1)))


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


def half_bands_rad(half_us: Mapping[str, ArrayLike], calibrations: Sequence[ArmCalibration]) -> Floats:
    """(num_arms, 5) in rad of half dead bands (5,) given in us, by arm; ``calibrations`` are in the order of the arms."""
    scales = np.array([[servo.us_per_rad() for servo in calibration.maps] for calibration in calibrations])
    return np.array([half_us[calibration.arm] for calibration in calibrations], float) / scales


def backlash_text(half_us: Mapping[str, ArrayLike], sd_us: Mapping[str, ArrayLike]) -> str:
    """What the file holds: half the dead bands (5,) in us of each arm's servos, and their standard deviations (5,)."""

    def listed(values: Mapping[str, ArrayLike]) -> dict[str, dict[str, float]]:
        rows = {arm: np.round(np.asarray(each, float), 3).tolist() for arm, each in values.items()}
        return {arm: dict(zip(ARM_JOINTS, row, strict=True)) for arm, row in rows.items()}

    content = {"version": BACKLASH_VERSION, "half_band_us": listed(half_us), "half_band_sd_us": listed(sd_us)}
    return json.dumps(content, indent=1) + "\n"


def load_backlash(folder: Path, arms: Sequence[str] = ARMS) -> dict[str, Floats]:
    """Half the dead bands (5,) in us, by arm, of ``arms``. Raises :class:`MissingFile`, :class:`CorruptFile` or :class:`InvalidSetting`."""
    path = folder / BACKLASH_FILE
    if not path.is_file():
        raise MissingFile("backlash of the servos", path, _SERVOS_AGAIN)
    with stored("backlash of the servos", path, BACKLASH_VERSION, f", a band for each joint; {_SERVOS_AGAIN}") as content:
        found = {arm: np.array([float(content["half_band_us"][arm][joint]) for joint in ARM_JOINTS]) for arm in arms}
        for arm, values in found.items():
            for joint, value in zip(ARM_JOINTS, values, strict=True):
                require_between(f"half_band_us.{arm}.{joint}", float(value), 0.0, MOST_US)
    return found


def arm_file(arm: str) -> str:
    """The name of an arm's file."""
    return f"{arm}.json"


def servo_files(arms: Sequence[str] = ARMS) -> tuple[str, ...]:
    """The names of all that ``calibrate what=servos`` finds of ``arms``."""
    return (*(arm_file(arm) for arm in arms), BACKLASH_FILE)


SERVO_FILES = servo_files()


def save_servos(folder: Path, arms: Mapping[str, ArmCalibration], half_us: Mapping[str, ArrayLike], sd_us: Mapping[str, ArrayLike]) -> None:
    """Write what was found for all arms into ``folder``; what was there is kept beside it. The last file makes the others valid.

    Args:
        folder: where; made if it is missing.
        arms: calibration of each arm.
        half_us: half the dead bands (5,) in us of each arm's servos.
        sd_us: their standard deviations (5,).

    Raises:
        CannotWrite: there is no room for them, and then those that were there stay.
    """
    make_folder(folder)
    texts = {arm_file(arm): found.text() for arm, found in arms.items()} | {BACKLASH_FILE: backlash_text(half_us, sd_us)}
    digests = {name: hashlib.sha256(texts[name].encode()).hexdigest() for name in servo_files(tuple(arms))}
    texts[SET_FILE] = json.dumps({"version": _SET_VERSION, "sha256": digests}, indent=1) + "\n"
    for name in texts:
        keep(folder / name)
    write_together({folder / name: text for name, text in texts.items()})


def require_one_set(folder: Path, names: Collection[str] = SERVO_FILES) -> None:
    """See that the files ``names`` in ``folder`` come from one calibration.

    Raises:
        MissingFile: one is not there.
        CorruptFile: the one that names the others cannot be read.
        CalibrationProblem: they do not belong together, or were changed since.
    """
    for name in (*names, SET_FILE):
        if not (folder / name).is_file():
            raise MissingFile("servo calibration", folder / name, _SERVOS_AGAIN)
    path = folder / SET_FILE
    with stored("servo calibration", path, _SET_VERSION, f"; {_SERVOS_AGAIN}") as content:
        wanted = {name: str(content["sha256"][name]) for name in names}
        others = [name for name in names if _digest(folder / name) != wanted[name]]
    if others:
        raise CalibrationProblem(str(folder), f"{' and '.join(others)} changed since the others were written; {_SERVOS_AGAIN}")


def _digest(path: Path) -> str:
    return hashlib.sha256(read_bounded(path, JSON_BYTES, "servo calibration")).hexdigest()
