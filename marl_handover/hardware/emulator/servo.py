"""A hobby servo: it follows the pulse with a lag and a limited speed, rests anywhere within its dead band, and tells nobody where it is."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass


@dataclass(frozen=True)
class ServoTruth:
    """What a servo is really like. Positions ``p`` are rad for a joint, mm for a gripper.

    ``pulse = zero_us + slope_us * p``; ``low`` and ``high`` are the end stops, ``speed`` per second.
    """

    zero_us: float
    slope_us: float
    low: float
    high: float
    speed: float
    dead_band_us: float = 8.0
    lag_s: float = 0.03
    settle_sd_us: float = 0.0


class Servo:
    """A servo that stands at ``position`` (rad or mm) when it is first powered."""

    def __init__(self, truth: ServoTruth, position: float, seed: int = 0) -> None:
        self.truth = truth
        self._random = random.Random(seed)
        self._pulse_us, self._moved, self._error_us = 0.0, False, 0.0
        self.jammed = False
        """Something holds it: it pushes and does not move."""
        self.put(position)

    @property
    def position(self) -> float:
        """Where it truly is."""
        return (self._at_us - self.truth.zero_us) / self.truth.slope_us

    @property
    def pushing(self) -> bool:
        """Whether it strains against an end stop or an obstacle; hobby servos burn out like that."""
        stuck = self.jammed or not self._low_us < self._at_us < self._high_us
        return stuck and self._pulse_us > 0 and abs(self._pulse_us - self._at_us) > 2 * self.truth.dead_band_us

    def put(self, position: float) -> None:
        """Turn it by hand."""
        truth = self.truth
        self._low_us, self._high_us = sorted((truth.zero_us + truth.slope_us * truth.low, truth.zero_us + truth.slope_us * truth.high))
        self._at_us = min(max(truth.zero_us + truth.slope_us * position, self._low_us), self._high_us)

    def step(self, pulse_us: float, duration_s: float) -> None:
        """Follow a pulse for a while; 0 is none, and it stays where it is."""
        truth = self.truth
        if pulse_us != self._pulse_us:
            self._pulse_us, self._moved = pulse_us, True
        elif self._moved:
            self._moved, self._error_us = False, self._random.gauss(0.0, truth.settle_sd_us)
        if pulse_us <= 0.0 or self.jammed:
            return
        gap = pulse_us + self._error_us - self._at_us
        beyond = abs(gap) - truth.dead_band_us / 2
        if beyond > 0.0:
            fastest = truth.speed * abs(truth.slope_us) * duration_s
            self._at_us += math.copysign(min(fastest, beyond * -math.expm1(-duration_s / truth.lag_s)), gap)
            self._at_us = min(max(self._at_us, self._low_us), self._high_us)
