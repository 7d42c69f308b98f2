"""``calibrate what=servos``: every arm goes through some forty postures with a marker on its hand, and the camera says where that was.

A camera above the table sees no single joint. But the same fifteen numbers, zero, scale and dead band of five servos, have to explain
every observation at once; together with what is known beforehand (a protractor's reading, or the nominal servo) they follow from least
squares. Each joint comes to each posture from one side or the other, by lot, and rests short of it on that side, which gives the widths of
the dead bands; where the side is not known, dead bands are noise that a few dozen postures average out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from marl_handover.arrays import Floats, wrap
from marl_handover.cell.build import CellModel
from marl_handover.control.settings import CardConfig
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import ArmCalibration, CalibrationProblem, ServoMap
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand
from marl_handover.hardware.settings import ARMS
from marl_handover.perception.calibration import CameraCalibration, Pixels
from marl_handover.perception.camera import Camera
from marl_handover.perception.detector import MarkerFinder
from marl_handover.perception.settings import TargetConfig

LEAST_SIGHTINGS = 8
WORST_MM = 5.0
"""Half of the sightings may be off by this much: beyond it no servo explains them, whatever the numbers that came out."""

_USUAL_US, _ARM_SD_US, _JOINT_SD_US = 4.0, 3.0, 1.5
"""Half the dead band of a hobby servo; how far an arm's servos may be from that together, and each from the arm's others."""


class Unexplained(CalibrationProblem):
    """No servos explain what was seen: a camera that was knocked, a marker elsewhere or on the other hand, a loose horn."""

    def __init__(self, arm: str, off_mm: float, reason: str) -> None:
        super().__init__(arm, f"{reason}; did the camera or a marker move, is each marker on its own hand, is a horn loose?")
        self.off_mm = off_mm


class MarkerObservation(NamedTuple):
    """What a camera saw while an arm was sent to ``pulses_us`` (5,).

    ``seen_mm`` (2,) is a world position. With a camera's place it is where the ray through the point meets the plane z = ``plane_mm``, and
    the point is ``point_mm`` (3,) of the grip's frame. Without one (NaN) it is where a block stood that the hand had put down: the grip's
    own x and y. ``yaw_rad`` is the grip's world yaw, NaN if it was not seen. ``came`` says for each joint whether its pulse was rising (+1)
    or falling (-1) when it got there, 0 if that is not known.
    """

    pulses_us: Floats
    seen_mm: Floats
    yaw_rad: float = math.nan
    camera_mm: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    plane_mm: float = 0.0
    point_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    came: tuple[float, ...] = (0.0,) * len(ARM_JOINTS)


class SolvedCalibration(NamedTuple):
    """A calibration, and how sure it is.

    ``residual_mm`` is the sightings' root mean square residual, ``joint_sd_deg`` (5,) each joint's standard deviation in the middle of the
    postures; ``half_band_us`` (5,) is half the dead band of each servo, ``half_band_sd_us`` (5,) its standard deviation.
    """

    calibration: ArmCalibration
    residual_mm: float
    joint_sd_deg: Floats
    half_band_us: Floats
    half_band_sd_us: Floats


def solve_calibration(
    model: CellModel,
    before: ArmCalibration,
    sightings: Sequence[MarkerObservation],
    *,
    position_sd_mm: float = 1.5,
    yaw_sd_deg: float = 1.0,
    zero_sd_deg: float = 5.0,
    scale_sd: float = 0.05,
    arm: int | None = None,
) -> SolvedCalibration:
    """The calibration that explains the sightings best.

    The dead band of a joint that the sightings say little about comes out near the arm's other joints'.

    Args:
        model: the cell; its geometry is taken to be right.
        before: what was known, as lines; joints about which the sightings say nothing stay there.
        sightings: eight at least, in postures as different as there is room for.
        position_sd_mm: standard deviation of a sighting, dead bands included.
        yaw_sd_deg: the same of its yaw.
        zero_sd_deg: how well zeros were known, in degrees of the joint.
        scale_sd: how well scales were known, relative.
        arm: its index in the cell; None: that of the arm of a pair whose name ``before`` has.

    Raises:
        Unexplained: half of the sightings are off by more than :data:`WORST_MM`, or no best explanation was found.
        CalibrationProblem: too few sightings, or none of them finite; or what comes out is no servo.
    """
    arm = ARMS.index(before.arm) if arm is None else arm
    usable = [sighting for sighting in sightings if np.isfinite(sighting.pulses_us).all() and np.isfinite(sighting.seen_mm).all()]
    if len(usable) < LEAST_SIGHTINGS:
        raise CalibrationProblem(before.arm, f"{len(usable)} usable sightings; {LEAST_SIGHTINGS} are needed at least")
    pulses = np.array([sighting.pulses_us for sighting in usable], float)
    zeros, slopes = _lines(before)
    middle = (pulses.mean(axis=0) - zeros) / slopes
    came = np.array([sighting.came for sighting in usable], float)
    weights = np.concatenate([np.full(5, math.radians(zero_sd_deg)), np.full(5, scale_sd), [_ARM_SD_US], np.full(5, _JOINT_SD_US)])
    halves = np.hstack([np.zeros((5, 10)), np.ones((5, 1)), np.eye(5)])  # the arm's, and how far each joint's is from it

    def joints(parameters: Floats) -> Floats:
        # Turned about the middle of the postures, so that zero and scale are told apart.
        shift, stretch = parameters[:5], parameters[5:10]
        angles = (pulses - came * (_USUAL_US + halves @ parameters) - zeros) / slopes
        return middle + shift + (angles - middle) * (1.0 + stretch)

    def residuals(parameters: Floats) -> Floats:
        off_mm, off_rad = _misses(model, arm, joints(parameters), usable)
        return np.concatenate([(off_mm / position_sd_mm).ravel(), off_rad / math.radians(yaw_sd_deg), parameters / weights])

    found = least_squares(residuals, np.zeros(len(weights)), x_scale=weights, loss="soft_l1")
    off_mm, _ = _misses(model, arm, joints(found.x), usable)
    _require_explained(before.arm, off_mm, found.success, found.message)
    ends = np.stack([model.arm.lower_rad, model.arm.upper_rad])
    at_us = zeros + slopes * (middle + (ends - middle - found.x[:5]) / (1.0 + found.x[5:10]))
    maps = [ServoMap(f"{before.arm} {joint}", list(zip(at_us[:, n], ends[:, n], strict=True))) for n, joint in enumerate(ARM_JOINTS)]
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    calibration = replace(before, maps=tuple(maps), measured_unix_s=time.time())
    residual_mm = float(np.sqrt((off_mm**2).sum(axis=1).mean()))
    half_us, sd_us = np.maximum(_USUAL_US + halves @ found.x, 0.0), np.sqrt(np.diag(halves @ covariance @ halves.T))
    return SolvedCalibration(calibration, residual_mm, np.degrees(np.sqrt(np.diag(covariance)[:5])), half_us, sd_us)


def _require_explained(arm: str, off_mm: Floats, success: bool, message: str) -> None:
    """Raise :class:`Unexplained` if what was found is no explanation."""
    half_mm = float(np.median(np.hypot(*off_mm.T)))
    if not success:
        raise Unexplained(arm, half_mm, f"no best explanation of what was seen was found ({message})")
    if not half_mm <= WORST_MM:
        raise Unexplained(arm, half_mm, f"half of the sightings are off by more than {half_mm:.1f} mm; {WORST_MM:g} mm is the limit")


def _lines(calibration: ArmCalibration) -> tuple[Floats, Floats]:
    """Pulses at zero (5,) and slopes (5,) in us/rad of a calibration's maps."""
    zeros = np.array([float(servo.to_us(0.0)) for servo in calibration.maps])
    return zeros, np.array([float(servo.to_us(1.0)) for servo in calibration.maps]) - zeros


def _misses(model: CellModel, arm: int, joints_rad: Floats, sightings: Sequence[MarkerObservation]) -> tuple[Floats, Floats]:
    """Predicted less seen: positions (n, 2) in mm, yaws (n,) in rad, 0 where none was seen."""
    base, T = model.cell.bases[arm], model.arm.fk(joints_rad)
    points = np.array([sighting.point_mm for sighting in sightings])
    at = base.to_world(np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3])
    cameras = np.array([sighting.camera_mm for sighting in sightings])
    planes = np.array([sighting.plane_mm for sighting in sightings])
    share = (planes - cameras[:, 2]) / (at[:, 2] - cameras[:, 2])
    projected = cameras[:, :2] + share[:, None] * (at[:, :2] - cameras[:, :2])
    predicted = np.where(np.isfinite(projected), projected, at[:, :2])
    forward = base.matrix()[:2, :2] @ T[:, :2, 0].T
    yaws = np.array([sighting.yaw_rad for sighting in sightings])
    off = wrap(np.arctan2(forward[1], forward[0]) - yaws)
    return predicted - np.array([sighting.seen_mm for sighting in sightings]), np.where(np.isfinite(off), off, 0.0)


POSTURES = 40
_DRAWN = 60_000
_SIDE_RAD = math.radians(4.0)
_SPEED_DEG_S = 40.0
_SETTLE_S = 0.4
_LOW = np.radians([-60.0, 30.0, -160.0, -70.0, -35.0])
_HIGH = np.radians([60.0, 125.0, -114.0, 90.0, 35.0])
_HEIGHT_MM, _RADIUS_MM = (65.0, 190.0), (130.0, 205.0)
_FACING_UP = math.cos(math.radians(40.0))
_MARGIN_PX = 60.0
_SIGHT_SD_MM, _YAW_SD_DEG = 0.6, 1.0
_TYPICAL_HEIGHT_MM = 110.0
_OPENING_PX = 3


class Posture(NamedTuple):
    """Joints (5,) to be measured at, and the side (5,), +1 from below, -1 from above, each comes from."""

    joints_rad: Floats
    side: Floats


class Measured(NamedTuple):
    """What came of an arm: its calibration, its dead bands, the residual in mm, and how many sightings it rests on.

    ``half_band_us`` (5,) is half the dead band of each servo, ``half_band_sd_us`` (5,) how sure that is: a standard deviation.
    ``joint_sd_deg`` (5,) is the same of each joint's angle in the middle of the postures.
    """

    calibration: ArmCalibration
    half_band_us: Floats
    half_band_sd_us: Floats
    residual_mm: float
    sightings: int
    joint_sd_deg: Floats


class ServoCalibration:
    """Calibrates the arms of an armed driver, one after the other.

    Args:
        driver: armed, arms parked; nominal calibrations will do.
        camera: sees the shared part of the table.
        seen_by: its calibration.
        target: says from which dictionary the markers are.
        cards: the markers on the hands.
        seed: decides the postures.
        postures: how many for each arm.
    """

    def __init__(
        self,
        driver: ArmDriver,
        camera: Camera,
        seen_by: CameraCalibration,
        target: TargetConfig,
        cards: CardConfig,
        seed: int = 0,
        postures: int = POSTURES,
    ) -> None:
        self.driver, self.camera, self.seen_by, self.cards, self.count = driver, camera, seen_by, cards, postures
        self._names = tuple(driver.config.arms)
        self._markers = cards.numbers(len(self._names))
        self._random = np.random.default_rng(seed)
        edge_px = cards.marker_mm * seen_by.px_per_mm(_TYPICAL_HEIGHT_MM)
        self._finder = MarkerFinder(target.dictionary, edge_px, _OPENING_PX)
        self._corners_mm = np.asarray(cards.place_mm) + cards.marker_mm / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])

    def arm(self, arm: int) -> Measured:
        """Calibrate one arm and park it again.

        Raises:
            CalibrationProblem: the marker was seen too seldom, or no servo explains what was seen.
            CommandRejected, Stopped, BoardReset, PortLost, BadReply: as :meth:`ArmDriver.move`.
        """
        sightings: list[MarkerObservation] = []
        for posture in self._postures(arm):
            sightings += self._sight(arm, posture)
        self.driver.drive(arm, self.driver.parked_rad, self.driver.gripper_mm(arm), _SPEED_DEG_S)
        if len(sightings) < 4 * LEAST_SIGHTINGS:
            raise CalibrationProblem(
                self._names[arm],
                f"the marker on its hand was seen in {len(sightings) // 4} of {self.count} postures; is it glued on, is it lit?",
            )
        before = self.driver.calibrations[arm]
        sure = {"position_sd_mm": _SIGHT_SD_MM, "yaw_sd_deg": _YAW_SD_DEG}
        found = solve_calibration(self.driver.model, before, sightings, arm=arm, **sure)
        seen = len(sightings) // 4
        return Measured(found.calibration, found.half_band_us, found.half_band_sd_us, found.residual_mm, seen, found.joint_sd_deg)

    def _sight(self, arm: int, posture: Posture) -> list[MarkerObservation]:
        """The four corners of the marker at a posture; none if it is not seen."""
        fingers = self.driver.gripper_mm(arm)
        try:
            for joints in (posture.joints_rad - posture.side * _SIDE_RAD, posture.joints_rad):
                self.driver.drive(arm, joints, fingers, _SPEED_DEG_S)
        except CommandRejected:
            return []
        self.driver.wait(_SETTLE_S)
        wiring = self.driver.config.arms[self._names[arm]]
        sent = self.driver.wiring.pulses([JointCommand(arm, posture.joints_rad, fingers)])[wiring.board]
        pulses = np.array([sent[channel] for channel in wiring.channels], float)
        number = self._markers[arm]
        found = self._finder.find(_grey(self.camera.read().image), [number]).get(number)
        if found is None:
            return []
        camera_mm = _triple(self.seen_by.eye_mm())
        way = np.sign([float(servo.to_us(1.0)) - float(servo.to_us(0.0)) for servo in self.driver.calibrations[arm].maps])
        came = tuple((posture.side * way).tolist())
        return [
            MarkerObservation(pulses, at, camera_mm=camera_mm, plane_mm=0.0, point_mm=_triple(corner), came=came)
            for at, corner in zip(self.seen_by.on_plane(found.pixels, 0.0), self._corners_mm, strict=True)
        ]

    def _postures(self, arm: int) -> list[Posture]:
        """Postures over the table in which the marker can be seen, in an order in which neighbours are near each other."""
        q = self._random.uniform(_LOW, _HIGH, (_DRAWN, 5))
        q = q[self._suitable(arm, q)]
        side = self._random.choice([-1.0, 1.0], (len(q), 5))
        chosen: list[Posture] = []
        for joints, way in zip(q, side, strict=True):
            if len(chosen) == self.count:
                break
            if self._clear(arm, joints) and self._clear(arm, joints - way * _SIDE_RAD):
                chosen.append(Posture(joints, way))
        return _short_tour(chosen, self.driver.parked_rad)

    def _suitable(self, arm: int, q: Floats) -> NDArray[np.bool_]:
        """Which joints (n, 5) keep their limits and put the marker where it is seen, well above the table."""
        model, base = self.driver.model, self.driver.model.cell.bases[arm]
        limits = model.arm.within_limits(q - _SIDE_RAD) & model.arm.within_limits(q + _SIDE_RAD)
        grip = model.arm.fk(q)
        radius = np.hypot(grip[:, 0, 3], grip[:, 1, 3])
        room = (grip[:, 2, 3] > _HEIGHT_MM[0]) & (grip[:, 2, 3] < _HEIGHT_MM[1]) & (radius > _RADIUS_MM[0]) & (radius < _RADIUS_MM[1])
        card = base.matrix() @ grip @ transform(tuple(self.cards.place_mm), (0.0, 0.0, 0.0))
        away = self.seen_by.eye_mm() - card[:, :3, 3]
        facing = np.einsum("ni,ni->n", card[:, :3, 2], away) / np.linalg.norm(away, axis=1) > _FACING_UP
        pixels = self.seen_by.project(card[:, :3, 3])
        inside = ((pixels > _MARGIN_PX) & (pixels < np.array(self.seen_by.intrinsics.size_px) - _MARGIN_PX)).all(axis=1)
        return np.asarray(limits & room & facing & inside)

    def _clear(self, arm: int, joints_rad: Floats) -> bool:
        """Whether an arm may go there straight from the parked pose."""
        try:
            self.driver.safety_filter.check_room({arm: joints_rad}, self.driver.clock.now_s())
        except CommandRejected:
            return False
        return True


def _short_tour(postures: list[Posture], start_rad: Floats) -> list[Posture]:
    """Always the nearest one next."""
    left, tour, here = list(postures), [], start_rad
    while left:
        nearest = min(range(len(left)), key=lambda index: float(np.abs(left[index].joints_rad - here).max()))
        tour.append(left.pop(nearest))
        here = tour[-1].joints_rad
    return tour


def _triple(point: Floats) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in point)
    return x, y, z


def _grey(image: Pixels) -> Pixels:
    """BGR as grey."""
    return np.rint(image @ np.array([0.114, 0.587, 0.299])).astype(np.uint8)
