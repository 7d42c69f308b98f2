"""``calibrate what=servos``: every arm goes through some forty postures with a marker on its hand, and the camera says where that was.

Zero and scale of all five servos follow from all sightings at once (:mod:`~marl_handover.hardware.identify`), and so do the widths of their
dead bands: each joint comes to each posture from one side or the other, by lot, and rests short of it on that side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.geometry.se3 import transform
from marl_handover.hardware.calibration import ArmCalibration, CalibrationProblem
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.identify import LEAST_SIGHTINGS, MarkerObservation, solve_calibration
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand
from marl_handover.hardware.settings import ARMS
from marl_handover.perception.calibration import CameraCalibration, Pixels
from marl_handover.perception.camera import Camera
from marl_handover.perception.markers import MarkerFinder
from marl_handover.perception.settings import TargetConfig
from marl_handover.runtime.settings import CardConfig

Floats = NDArray[np.float64]

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
                ARMS[arm], f"the marker on its hand was seen in {len(sightings) // 4} of {self.count} postures; is it glued on, is it lit?"
            )
        before = self.driver.calibrations[arm]
        found = solve_calibration(self.driver.model, before, sightings, position_sd_mm=_SIGHT_SD_MM, yaw_sd_deg=_YAW_SD_DEG)
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
        wiring = self.driver.config.arms[ARMS[arm]]
        sent = self.driver.wiring.pulses([JointCommand(arm, posture.joints_rad, fingers)])[wiring.board]
        pulses = np.array([sent[channel] for channel in wiring.channels], float)
        number = self.cards.ids[arm]
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
