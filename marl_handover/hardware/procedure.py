"""Calibrating an arm's servos: which pulses to go to, how to get there, and what becomes of the angles that were measured.

    procedure = CalibrationProcedure(driver, arm=0)
    for stop in procedure.stops:
        procedure.go(stop)
        procedure.record(stop, measure(stop.joint))
    procedure.result().save(path)

All joints but one stay parked, so that a protractor on one joint's two links, or a marker on the hand, shows one angle at a time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.urdf import ARM_JOINTS
from marl_handover.config import require_between
from marl_handover.errors import NotFinite
from marl_handover.hardware.calibration import ArmCalibration, CalibrationProblem, make_calibration
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.gate import GateRejection, JointCommand
from marl_handover.hardware.settings import ARMS

Floats = NDArray[np.float64]

_SEARCH_RAD = math.radians(2.5)
_SPEED_DEG_S = 25.0


class Stop(NamedTuple):
    """A place to measure at: joint ``joint`` (index) sent to about ``angle_rad``, coming from below (+1) or above (-1)."""

    joint: int
    angle_rad: float
    side: int

    @property
    def name(self) -> str:
        """The joint's name."""
        return ARM_JOINTS[self.joint]


class CalibrationProcedure:
    """The stops of one arm, and what was measured at them.

    Args:
        driver: armed, both arms parked; its calibration may be the nominal one.
        arm: index.
        points: for each joint, each approached from both sides: a servo rests on the near side of its dead band.
        margin_deg: kept from joint limits and from whatever the gate sees in the way, since angles are not yet known well.

    Raises:
        CalibrationProblem: a joint has too little room around the parked pose.
    """

    def __init__(self, driver: ArmDriver, arm: int, points: int = 3, margin_deg: float = 8.0) -> None:
        require_between("points", points, 2, 20)
        require_between("margin_deg", margin_deg, 0, 45)
        self.driver, self.arm = driver, arm
        self._measured: dict[str, list[tuple[float, float]]] = {name: [] for name in ARM_JOINTS}
        self._pulse_us: dict[Stop, int] = {}
        self.ranges_rad = [self._range(joint, math.radians(margin_deg)) for joint in range(len(ARM_JOINTS))]
        self.stops = [
            Stop(joint, float(angle), side)
            for joint, (low, high) in enumerate(self.ranges_rad)
            for side in (1, -1)
            for angle in np.linspace(low, high, points)[::side]
        ]
        """In an order in which neighbours are near each other."""

    def go(self, stop: Stop) -> int:
        """Drive there, the last few degrees from the stop's side; the pulse sent. Raises as :meth:`ArmDriver.move`."""
        low, high = self.ranges_rad[stop.joint]
        before = stop.angle_rad - stop.side * min(math.radians(5.0), (high - low) / 4)
        now = self.driver.joints_rad()[self.arm]
        others = np.array([joint for joint in range(len(ARM_JOINTS)) if joint != stop.joint])
        if np.abs(now[others] - self.driver.parked_rad[others]).max() > 1e-3:
            self._drive(self.driver.parked_rad)
        for angle in (before, stop.angle_rad):
            target = self.driver.parked_rad.copy()
            target[stop.joint] = angle
            self._drive(target)
        self.driver.wait(self.driver.config.stream.settle_s)
        wiring = self.driver.config.arms[ARMS[self.arm]]
        channel = wiring.channels[stop.joint]
        sent = self.driver.wiring.pulses([JointCommand(self.arm, target, self.driver.gripper_mm(self.arm))])
        self._pulse_us[stop] = sent[wiring.board][channel]
        return self._pulse_us[stop]

    def record(self, stop: Stop, angle_rad: float) -> None:
        """Note what was measured at a stop. Raises :class:`NotFinite`, or :class:`CalibrationProblem` if the arm never went there."""
        if not math.isfinite(angle_rad):
            raise NotFinite(f"the angle of {stop.name}", angle_rad)
        if stop not in self._pulse_us:
            raise CalibrationProblem(stop.name, "measured before the arm went there")
        self._measured[stop.name].append((float(self._pulse_us[stop]), angle_rad))

    def result(self, fit: str = "line") -> ArmCalibration:
        """The calibration from what was recorded. Raises :class:`CalibrationProblem` if that cannot be."""
        return make_calibration(ARMS[self.arm], self.driver.model.arm, self._measured, fit)

    def _drive(self, target_rad: Floats) -> None:
        self.driver.drive(self.arm, target_rad, self.driver.gripper_mm(self.arm), _SPEED_DEG_S)

    def _range(self, joint: int, margin_rad: float) -> tuple[float, float]:
        """How far the joint may turn to either side of the parked pose with nothing in the way."""
        arm = self.driver.model.arm
        bounds = (float(arm.lower_rad[joint]) + margin_rad, float(arm.upper_rad[joint]) - margin_rad)
        parked = float(self.driver.parked_rad[joint])
        ends = []
        for bound in bounds:
            free = parked
            steps = math.ceil(abs(bound - parked) / _SEARCH_RAD)
            for angle in np.linspace(parked, bound, steps + 1)[1:]:
                if not self._clear(joint, float(angle) + math.copysign(margin_rad, bound - parked)):
                    break
                free = float(angle)
            ends.append(free)
        low, high = min(ends), max(ends)
        if high - low < math.radians(20.0):
            raise CalibrationProblem(
                ARM_JOINTS[joint], f"only {math.degrees(high - low):.0f} degrees are free around the parked pose; need 20"
            )
        return low, high

    def _clear(self, joint: int, angle_rad: float) -> bool:
        target = self.driver.parked_rad.copy()
        target[joint] = angle_rad
        try:
            self.driver.gate.check_room({self.arm: target}, self.driver.clock.now_s())
        except GateRejection:
            return False
        return True
