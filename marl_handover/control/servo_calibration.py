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
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.capsules import joints_before
from marl_handover.geometry.se3 import apply, transform
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import ArmCalibration, CalibrationProblem, ServoMap
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand
from marl_handover.hardware.settings import ARMS
from marl_handover.perception.calibration import CameraCalibration, Pixels
from marl_handover.perception.camera import Camera
from marl_handover.perception.detector import MarkerFinder
from marl_handover.perception.scene import outline
from marl_handover.perception.settings import TargetConfig

LEAST_SIGHTINGS = 8
WORST_MM = 5.0
"""Half of the sightings may be off by this much: beyond it no servo explains them, whatever the numbers that came out."""

_USUAL_US, _ARM_SD_US, _JOINT_SD_US = 4.0, 3.0, 1.5
"""Half the dead band of a hobby servo; how far an arm's servos may be from that together, and each from the arm's others."""


_CARD_MM = 0.2
"""Thickness of a card."""


def T_grip_hand(arm: ArmModel) -> Floats:
    """The hand's frame (4, 4) in the grip's: x along the roll axis, as the fingers are. A grip is level where it picks; a hand may tilt."""
    turned = np.array([0.0, 0.0, 0.0, 0.0, 0.5])
    R = arm.fk(np.zeros(5))[:3, :3].T @ arm.fk(turned)[:3, :3]
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    axis *= np.sign(axis[0]) or 1.0
    return transform((0.0, 0.0, 0.0), (0.0, math.atan2(-float(axis[2]), float(axis[0])), 0.0))


def card_place(arm: ArmModel, cards: CardConfig) -> Floats:
    """Where the middle of a hand's marker card is (3,), in mm in the hand's frame: as the settings say, else flat on the palm.

    The palm is the largest of the hand's shapes, fingers apart.
    """
    if cards.place_mm is not None:
        return np.asarray(cards.place_mm, float)
    frames, levels = arm.link_transforms(np.zeros(5)), joints_before(arm.description)
    T_hand_root = np.linalg.inv(arm.fk(np.zeros(5)) @ T_grip_hand(arm))
    fingers = {arm.description.joint(name).child for name in arm.description.gripper.joints}
    boxes = []
    for link in arm.description.links:
        if levels[link.name] == len(ARM_JOINTS) and link.name not in fingers:
            for shape in link.collisions:
                corners = apply(T_hand_root @ frames[link.name] @ transform(shape.xyz_mm, shape.rpy_rad), outline(shape))
                boxes.append((corners.min(axis=0), corners.max(axis=0)))
    low, high = max(boxes, key=lambda box: float(np.prod(box[1] - box[0])))
    return np.array([(low[0] + high[0]) / 2, 0.0, high[2] + _CARD_MM])


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
    usable = _usable(before.arm, sightings)
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


def _usable(arm: str, sightings: Sequence[MarkerObservation]) -> list[MarkerObservation]:
    """Those that are finite. Raises :class:`CalibrationProblem` if they are too few."""
    usable = [sighting for sighting in sightings if np.isfinite(sighting.pulses_us).all() and np.isfinite(sighting.seen_mm).all()]
    if len(usable) < LEAST_SIGHTINGS:
        raise CalibrationProblem(arm, f"{len(usable)} usable sightings; {LEAST_SIGHTINGS} are needed at least")
    return usable


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
VISITS = 12
"""How often a posture is gone to, to see how far it is from itself."""
_DRAWN = 200_000
_SIDE_RAD = math.radians(4.0)
_SPEED_DEG_S = 40.0
_SETTLE_S = 0.4
_OUTER_RAD = np.radians([60.0, math.inf, math.inf, math.inf, 35.0])
"""How far joints are turned at most, either way: so that the camera sees the card."""
_ABOVE_MM, _WITHIN = (20.0, 145.0), (0.87, 0.89)
"""How high over where it picks a grip is, and how far out: shares of the ring's inner and outer radius."""
_FACING_UP = math.cos(math.radians(40.0))
_MARGIN_PX = 60.0
_SIGHT_SD_MM, _YAW_SD_DEG = 0.6, 1.0
_TYPICAL_HEIGHT_MM = 110.0
_OPENING_PX = 3
_ENCODER_SD = 1e-4
"""Scales of encoders are known, but for rounding."""


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


class Repeatability(NamedTuple):
    """How far a hand was from its mean place when it came to one posture again and again: root mean squares, as the camera saw them."""

    position_mm: float
    yaw_deg: float
    visits: int


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
        arm, half_mm = driver.model.arm, cards.marker_mm / 2
        self._T_grip_card = T_grip_hand(arm) @ transform(tuple(card_place(arm, cards)), (0.0, 0.0, 0.0))
        self._corners_mm = apply(self._T_grip_card, half_mm * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]))

    def arm(self, arm: int) -> Measured:
        """Calibrate one arm and park it again.

        Raises:
            CalibrationProblem: the marker was seen too seldom, or no servo explains what was seen.
            CommandRejected, Stopped, ArmingLost, ConnectionLost, BadReply: as :meth:`ArmDriver.move`.
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
        if self._encoders(arm):
            sure["scale_sd"] = _ENCODER_SD
        found = solve_calibration(self.driver.model, before, sightings, arm=arm, **sure)
        seen = len(sightings) // 4
        if self._encoders(arm):  # what a servo rests short of is read, and taken out as it is driven
            found = found._replace(half_band_us=np.zeros(5), half_band_sd_us=np.zeros(5))
        calibration = replace(found.calibration, homing_offsets=self.driver.boards.marks(self.driver.config)[arm])
        return Measured(calibration, found.half_band_us, found.half_band_sd_us, found.residual_mm, seen, found.joint_sd_deg)

    def repeatability(self, arm: int, visits: int = VISITS) -> Repeatability | None:
        """Go to one posture from others on all sides, and see where the marker is every time; None if it is not seen twice.

        Raises as :meth:`arm`.
        """
        postures, T_world_base, seen = self._postures(arm), self.driver.model.cell.bases[arm].matrix(), []
        if len(postures) < 2:
            return None
        target = postures[len(postures) // 2]
        height_mm = float((T_world_base @ self.driver.model.arm.fk(target.joints_rad) @ self._T_grip_card)[2, 3])
        for visit in range(visits):
            away = postures[visit % len(postures)]
            for posture in (away, Posture(target.joints_rad, away.side)):
                found = self._marker(arm, posture)
            if found is not None:
                seen.append(self.seen_by.on_plane(found, height_mm))
        self.driver.drive(arm, self.driver.parked_rad, self.driver.gripper_mm(arm), _SPEED_DEG_S)
        if len(seen) < 2:
            return None
        corners = np.array(seen)
        middles, edges = corners.mean(axis=1), corners[:, 1] - corners[:, 0]
        yaws = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
        spread_mm = float(np.sqrt(((middles - middles.mean(axis=0)) ** 2).sum(axis=1).mean()))
        return Repeatability(spread_mm, math.degrees(float(yaws.std())), len(seen))

    def _sight(self, arm: int, posture: Posture) -> list[MarkerObservation]:
        """The four corners of the marker at a posture; none if it is not seen."""
        found = self._marker(arm, posture)
        if found is None:
            return []
        pulses = self._pulses(arm, JointCommand(arm, posture.joints_rad, self.driver.gripper_mm(arm)))
        camera_mm = _triple(self.seen_by.eye_mm())
        way = np.sign([float(servo.to_us(1.0)) - float(servo.to_us(0.0)) for servo in self.driver.calibrations[arm].maps])
        came = tuple((0.0 * way if self._encoders(arm) else posture.side * way).tolist())
        return [
            MarkerObservation(pulses, at, camera_mm=camera_mm, plane_mm=0.0, point_mm=_triple(corner), came=came)
            for at, corner in zip(self.seen_by.on_plane(found, 0.0), self._corners_mm, strict=True)
        ]

    def _marker(self, arm: int, posture: Posture) -> Floats | None:
        """Pixels (4, 2) of the marker's corners once the hand is at a posture; None if it may not go there, or is not seen."""
        fingers, number = self.driver.gripper_mm(arm), self._markers[arm]
        try:
            for joints in (posture.joints_rad - posture.side * _SIDE_RAD, posture.joints_rad):
                self.driver.drive(arm, joints, fingers, _SPEED_DEG_S)
        except CommandRejected:
            return None
        self.driver.settle(_SETTLE_S)
        found = self._finder.find(_grey(self.camera.read().image), [number]).get(number)
        return None if found is None else found.pixels

    def _encoders(self, arm: int) -> bool:
        """Whether an arm's servos tell where they stand."""
        return self.driver.boards.by_name[self.driver.config.arms[self._names[arm]].board].has_encoders

    def _pulses(self, arm: int, command: JointCommand) -> Floats:
        """Pulses (5,) of the joints: where encoders say that they stand, else as they were sent."""
        wiring = self.driver.config.arms[self._names[arm]]
        if self._encoders(arm):
            told = self.driver.boards.by_name[wiring.board].pulses(wiring.channels)
            return np.array([math.nan if told[channel] is None else told[channel] for channel in wiring.channels], float)
        sent = self.driver.wiring.pulses([command])[wiring.board]
        return np.array([sent[channel] for channel in wiring.channels], float)

    def _postures(self, arm: int) -> list[Posture]:
        """Postures over the table in which the marker can be seen, in an order in which neighbours are near each other."""
        limits = self.driver.model.arm
        low, high = np.maximum(limits.lower_rad, -_OUTER_RAD), np.minimum(limits.upper_rad, _OUTER_RAD)
        q = self._random.uniform(low, high, (_DRAWN, 5))
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
        ring, above = model.cell.arms[arm], grip[:, 2, 3] - model.cell.pick_heights_mm[arm]
        room = (above > _ABOVE_MM[0]) & (above < _ABOVE_MM[1])
        room &= (radius > _WITHIN[0] * ring.r_min_mm) & (radius < _WITHIN[1] * ring.r_max_mm)
        card = base.matrix() @ grip @ self._T_grip_card
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
