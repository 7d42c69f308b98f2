"""What the arms of a twin do, against their limits: looked at every 20 ms, from outside the host's own gate."""

from __future__ import annotations

import math
from collections import Counter
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.control.twin import Twin
from marl_handover.hardware.clearance import FAR_MM, alone_mm, arm_shapes, between_mm, still
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.emulator.board import FRAME_S
from marl_handover.hardware.settings import COUNTS_PER_RAD

Floats = NDArray[np.float64]

PULSE_US = 1.0
"""Pulses are whole numbers."""
TRUE_RAD = math.radians(1.5)
"""How far beyond a limit a joint may truly stand that was sent to it: half a dead band, and what a calibration is off."""
SPEED_SHARE = 1.1
"""Above the gate's own by what rounding to whole pulses and whole frames adds."""
SENT_SLACK_MM = 0.3
_OFF_US = 1.0


class LimitWatch:
    """Counts every 20 ms in which something is outside its limits, and remembers the worst of each.

    *Sent* is what boards put out, or bus servos tell, read through the host's calibration; *true* is where the arms are. All is
    judged while the servos are on: switched off, people turn them by hand.
    """

    def __init__(self, twin: Twin, driver: ArmDriver) -> None:
        self._twin, self._driver, self._config = twin, driver, twin.hardware
        self._gate, model = self._config.gate, twin.model
        self._lower, self._upper = model.arm.lower_rad, model.arm.upper_rad
        self._shapes = arm_shapes(model)
        self._bases = [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]
        self._pulses = [np.array(self._config.pulse_limits(name), float) for name in self._config.arms]
        self._slack = 1.0 if self._config.protocol == "ssc32" else TRUE_RAD * COUNTS_PER_RAD
        self._before: Floats | None = None
        self.violations: Counter[str] = Counter()
        self.worst: dict[str, float] = {}
        twin.clock.at(twin.clock.now_s() + FRAME_S, self._tick)

    def taken(self) -> dict[str, Any]:
        """Violations and worst values since this was asked last, collisions of the bodies among them."""
        collisions = self._twin.follower.collisions
        for name in collisions:
            self.violations[f"touch: {name}"] += 1
        found = {"violations": dict(self.violations), "worst": {name: round(value, 4) for name, value in self.worst.items()}}
        collisions.clear()
        self.violations.clear()
        self.worst.clear()
        return found

    def _tick(self) -> None:
        now_s = self._twin.clock.now_s()
        self._twin.clock.at(now_s + FRAME_S, self._tick)
        sent_us = self._twin.electronics.told(now_s)
        on = (sent_us > _OFF_US).all(axis=1)
        if on.all():
            sent = np.array([it.to_rad(row) for it, row in zip(self._driver.calibrations, sent_us, strict=True)])
            true = self._twin.true_joints_rad()
            self._joints(sent_us, sent, true)
            self._room("sent", sent, self._gate.table_clearance_mm - SENT_SLACK_MM, self._gate.arm_clearance_mm - SENT_SLACK_MM)
            self._room("true", true, 0.0, 0.0)
            if self._before is not None:
                self._speed(np.abs(sent - self._before) / FRAME_S)
            self._before = sent
        else:
            self._before = None
            self._twin.follower.collisions.clear()  # what falls or is turned by hand touches what it may

    def _joints(self, sent_us: Floats, sent: Floats, true: Floats) -> None:
        for row, limits in zip(sent_us, self._pulses, strict=True):
            self._over("sent pulse, us", float(np.maximum(limits[:, 0] - row, row - limits[:, 1]).max()), PULSE_US)
        rounding = np.array([[PULSE_US / servo.us_per_rad() for servo in it.maps] for it in self._driver.calibrations])
        beyond = np.maximum(self._lower - sent, sent - self._upper)
        self._over("sent joint, rounded pulses", float((beyond / rounding).max()), self._slack)
        self._over("true joint, rad", float(np.maximum(self._lower - true, true - self._upper).max()), TRUE_RAD)

    def _room(self, what: str, joints: Floats, table_mm: float, apart_mm: float) -> None:
        gaps = np.empty(3)
        for row in joints:
            alone_mm(still(row), self._shapes, np.full(3, FAR_MM), gaps)
            self._over(f"{what} plane, mm below", -float(gaps[0]), -table_mm)
        for one, other in combinations(range(len(joints)), 2):
            ways, bases = (still(joints[one]), still(joints[other])), (self._bases[one], self._bases[other])
            gap = between_mm(*ways, True, self._shapes, self._shapes, *bases, FAR_MM)
            self._over(f"{what} arm to arm, mm nearer", -gap, -apart_mm)

    def _speed(self, speed_rad_s: Floats) -> None:
        self._over("sent speed, share", float((speed_rad_s / self._driver.safety_filter.speed_rad_s).max()), SPEED_SHARE)

    def _over(self, name: str, value: float, limit: float) -> None:
        self.worst[name] = max(value, self.worst.get(name, -math.inf))
        if value > limit:
            self.violations[name] += 1
