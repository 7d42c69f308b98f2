"""What to believe of a stream of sightings: no unconfirmed jumps, nothing from a frozen camera, the last place of what is hidden."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import wrap
from marl_handover.perception.calibration import Floats, Pixels
from marl_handover.perception.camera import Frame
from marl_handover.perception.detector import Detector, PoseEstimate
from marl_handover.perception.settings import TrackerConfig

_EVERY_PX = 5
"""A frozen picture shows on every fifth pixel too: noise is on all of them."""


class Believed(NamedTuple):
    """What is known of the block or the goal.

    Attributes:
        pose: (3,) x_mm, y_mm, theta_rad where it was last believed to be; None: never seen.
        seen: whether this picture shows it there.
        age_s: since when it has not been seen there; infinite if never.
        confidence: of that sighting.
        hidden: not seen for longer than ``tracker.hidden_s``.
        doubted: a sighting in this picture that would be a jump, and is not confirmed yet.
    """

    pose: Floats | None
    seen: bool
    age_s: float
    confidence: float
    hidden: bool
    doubted: PoseEstimate | None


class Seen(NamedTuple):
    """Block and goal after a picture; ``frozen``: the camera gives the same picture again and again, which tells nothing."""

    block: Believed
    goal: Believed
    frozen: bool
    t_s: float
    number: int


class Tracker:
    """Turns frames into beliefs; one a camera. Goals that a block covers, and blocks that a hand covers, keep their last place."""

    def __init__(self, detector: Detector, config: TrackerConfig | None = None) -> None:
        self.detector, self.config = detector, config or TrackerConfig()
        self.config.validate()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._block, self._goal = _Belief(self.config), _Belief(self.config)
        self._last: tuple[float, int, Pixels] | None = None
        self._alike = self._since_search = 0

    def update(self, frame: Frame) -> Seen:
        """Take in a frame.

        Raises:
            CalibrationMismatch: it has another size than the camera's calibration.
        """
        frozen = self._is_frozen(frame)
        if frozen:
            return self._seen(frame, None, None, True)
        self._since_search += 1
        doubtful = self._block.doubtful or self._goal.doubtful
        everywhere = doubtful or self._since_search >= self.config.search_every
        sighting = self.detector.detect(frame.image, self._block.pose, self._goal.pose, everywhere)
        if sighting.block is None and not everywhere:
            everywhere = True
            sighting = self.detector.detect(frame.image, self._block.pose, self._goal.pose)
        if everywhere:
            self._since_search = 0
        return self._seen(frame, self._block.take(sighting.block, frame.t_s), self._goal.take(sighting.goal, frame.t_s), False)

    def _seen(self, frame: Frame, block: PoseEstimate | None, goal: PoseEstimate | None, frozen: bool) -> Seen:
        t_s = frame.t_s
        return Seen(self._block.report(t_s, block, frozen), self._goal.report(t_s, goal, frozen), frozen, t_s, frame.number)

    def _is_frozen(self, frame: Frame) -> bool:
        """Whether this frame repeats the last one, as so many before it did; or is the last one, or older."""
        sample = frame.image[::_EVERY_PX, ::_EVERY_PX].copy()
        last, self._last = self._last, (frame.t_s, frame.number, sample)
        if last is None:
            return False
        if frame.number <= last[1] or frame.t_s < last[0]:
            self._last = last
            return True
        self._alike = self._alike + 1 if np.array_equal(sample, last[2]) else 0
        return 0 < self.config.frozen_frames <= self._alike + 1


class _Belief:
    """Where one thing is."""

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self.pose: Floats | None = None
        self._t_s, self._confidence = -math.inf, 0.0
        self._candidates: list[Floats] = []

    @property
    def doubtful(self) -> bool:
        """Whether a jump waits for its confirmation."""
        return bool(self._candidates)

    def age_s(self, t_s: float) -> float:
        return t_s - self._t_s

    def take(self, estimate: PoseEstimate | None, t_s: float) -> PoseEstimate | None:
        """Take in a sighting, or that there is none; gives back one that is doubted."""
        if estimate is None:
            self._candidates = []
            return None
        if self.pose is not None and not self._near(estimate.pose, self.pose, *self._leap(self.age_s(t_s))):
            steady = all(self._near(estimate.pose, it, self._config.agreement_mm, self._config.agreement_deg) for it in self._candidates)
            self._candidates = [*self._candidates, estimate.pose] if steady else [estimate.pose]
            if len(self._candidates) < self._config.confirmations:
                return estimate
        self.pose, self._t_s, self._confidence, self._candidates = estimate.pose, t_s, estimate.confidence, []
        return None

    def report(self, t_s: float, doubted: PoseEstimate | None, frozen: bool) -> Believed:
        age = self.age_s(t_s)
        return Believed(self.pose, age == 0 and not frozen, age, self._confidence, age > self._config.hidden_s, doubted)

    def _leap(self, age_s: float) -> tuple[float, float]:
        """How far, in mm and degrees, it may be from where it was ``age_s`` ago."""
        return self._config.jump_mm + self._config.speed_mm_s * age_s, self._config.jump_deg + self._config.turn_deg_s * age_s

    @staticmethod
    def _near(pose: Floats, other: Floats, far_mm: float, far_deg: float) -> bool:
        turned = abs(float(wrap(pose[2] - other[2])))
        return math.hypot(*(pose[:2] - other[:2])) <= far_mm and math.degrees(turned) <= far_deg
