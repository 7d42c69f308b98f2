"""One path to be found: where it starts and ends, what it must keep away from, and the search for it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.motion.body import MARGIN_MM, ArmBody, ball_around, out_of_reach
from marl_handover.motion.descent import Effort, Spline, descend
from marl_handover.motion.scene import Scene
from marl_handover.motion.splines import basis, sampled_basis
from marl_handover.motion.starts import bent, fitted, sample_places, smoothing_metric
from marl_handover.motion.trajectory import NoPath
from marl_handover.motion.verify import ROUNDING_MM, Margins, dense_margins

Floats = NDArray[np.float64]

DENSE_SAMPLES = 1001
SAMPLES, CROWDING = 41, 0.6
WEIGHTS = np.array([0.1, 0.005])
"""Of even speed and of joint motion, beside the length: enough to leave no direction without curvature."""

EFFORT = Effort(penalty=0.3, growth=6.0, rounds=5, steps=30, gain=1e-4, slack_mm=0.2)

SHORTEST_MM = 20.0
"""Paths between nearer ends are bent as if they were this long."""

FIRST_MARGINS_MM = np.array([0.5, 0.5, 0.5, 0.2, 0.05])
"""What the optimiser asks beyond the demand at its few samples: arm and block, itself, ground, lift, edge."""

REPAIRS = 3
HOPELESS_MM = -6.0
GOOD_RATIO = 1.02
"""A path this near to the lower bound of its length is not searched on."""

WANTED, FAIR_RATIO = 2, 1.08
"""Feasible paths to choose from where none is that good; one more where none is even fair."""


class FoundPath(NamedTuple):
    """A path that passed the dense check.

    ``points`` (N, 5) control points in rad; ``length_mm`` of the grip's path; ``margins`` at the tightest of the dense samples;
    ``starts`` tried; ``evaluations`` of cost and gradient.
    """

    points: Floats
    length_mm: float
    margins: Margins
    starts: int
    evaluations: int


@dataclass(frozen=True, eq=False)
class Segment:
    """A path of one arm in its base frame.

    Attributes:
        body: the arm.
        scene: what the path is judged against.
        ends: (2, 4) joints at start and end, roll left out, in rad.
        lower_bound_mm: no path is shorter.
    """

    body: ArmBody
    scene: Scene
    ends: Floats
    lower_bound_mm: float

    def check(self, joints: Floats) -> tuple[Margins, float]:
        """Margins and length in mm of joint samples (S, 4)."""
        out = np.empty(6)
        length = dense_margins(np.ascontiguousarray(joints), self.scene, out)
        return Margins(*(float(value) for value in out)), float(length)

    def improve(self, points: Floats, degree: int, margins_mm: Floats, effort: Effort) -> tuple[Floats, int]:
        """Control points (N, 4) after the descent that asks for ``margins_mm`` (5,) more than is demanded, and its evaluations."""
        near = self.scene.obstacles[~out_of_reach(self.body, self.scene.obstacles)]
        asked = self.scene._replace(
            obstacles=(obstacles := near + margins_mm[0] * (np.arange(9) == 7)),
            group=ball_around(obstacles),
            clearance=self.scene.clearance + margins_mm[1:3],
            profile=self.scene.profile + np.array([0, 0, 0, 0, 0, 0, margins_mm[3], margins_mm[4]]),
        )
        spline = _spline(len(points), degree)
        metric = spline.metric * max(self.lower_bound_mm, SHORTEST_MM)
        spline = spline._replace(metric=metric, limits=self.body.limits)
        x, _, evaluations = descend(np.ascontiguousarray(points), spline, asked, WEIGHTS, effort)
        return x, evaluations


def find_path(
    segment: Segment, guesses: Iterable[Floats], control_points: int, degree: int, starts: int, wanted: int = WANTED
) -> FoundPath:
    """The shortest of a few feasible paths; of the first one that is near its lower bound.

    Args:
        segment: what is asked.
        guesses: joint samples of first guesses, each (SAMPLES, 4).
        control_points: N.
        degree: of the spline.
        starts: guesses and random bends of them, at most.
        wanted: feasible paths to choose from.

    Raises:
        NoPath: with the reason.
    """
    refuse_bad_ends(segment)
    best: FoundPath | None = None
    feasible, evaluations, miss = 0, 0, Margins(*[-np.inf] * 6)
    fitted_guesses: list[Floats] = []
    supply = iter(guesses)
    for start in range(starts):
        samples = next(supply, None)
        if samples is not None:
            fitted_guesses.append(fitted(samples, segment.body.limits, control_points, degree))
            points = fitted_guesses[-1]
        else:
            points = bent(fitted_guesses[start % len(fitted_guesses)], segment.body.limits, degree, start)
        found, margins, used = attempt(segment, points, degree)
        evaluations += used
        if found is None:
            miss = max(miss, margins, key=lambda m: m.worst)
            continue
        feasible += 1
        if best is None or found.length_mm < best.length_mm:
            best = found
        ratio = best.length_mm / max(segment.lower_bound_mm, 1e-9)
        if ratio <= GOOD_RATIO or feasible >= wanted + (wanted > 1 and ratio > FAIR_RATIO):
            break
    if best is None:
        raise NoPath("path", _named(miss), -miss.worst, starts)
    return best._replace(starts=start + 1, evaluations=evaluations)


def attempt(segment: Segment, points: Floats, degree: int, effort: Effort = EFFORT) -> tuple[FoundPath | None, Margins, int]:
    """One start: descend, check densely, ask for more where it fell short, descend again."""
    asked, evaluations = FIRST_MARGINS_MM.copy(), 0
    dense = np.array(sampled_basis(DENSE_SAMPLES, len(points), degree))
    for _ in range(REPAIRS):
        points, used = segment.improve(points, degree, asked, effort)
        evaluations += used
        margins, length = segment.check(dense @ points)
        if margins.worst >= 0.0 and within(points, segment.body.limits):
            full = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
            return FoundPath(full, length, margins, 1, evaluations), margins, evaluations
        if margins.worst < HOPELESS_MM:
            break
        short = np.array([min(margins.arm, margins.block), margins.itself, margins.ground, margins.lift, margins.edge])
        asked = np.minimum(asked + np.where(short < -ROUNDING_MM, 0.05 - 1.3 * short, 0.0), MARGIN_MM)
        points = np.concatenate([points[:1], np.clip(points[1:-1], segment.body.limits[:, 0], segment.body.limits[:, 1]), points[-1:]])
    return None, margins, evaluations


def within(points: Floats, limits: Floats) -> bool:
    """Whether the inner control points (N, 4) are within the joint limits; then the path is."""
    return bool(((points[1:-1] >= limits[:, 0]) & (points[1:-1] <= limits[:, 1])).all())


def refuse_bad_ends(segment: Segment) -> None:
    """Raise :class:`NoPath` if an end itself is too near something; no path could help."""
    for reason, q in (("start", segment.ends[:1]), ("end", segment.ends[1:])):
        margins, _ = segment.check(q)
        if margins.worst < 0.0:
            raise NoPath(reason, _named(margins), -margins.worst, 0)


def _named(margins: Margins) -> str:
    """What the tightest margin is about."""
    names = {
        "arm": "the clearance to the other arm", "block": "the clearance to the standing block", "itself": "the arm's clearance to itself",
        "ground": "the clearance to the table", "lift": "the lift-over height", "edge": "the held block's height over the table",
    }  # fmt: skip
    return names[min(margins._fields, key=lambda field: getattr(margins, field))]


@lru_cache(maxsize=16)
def _spline(control_points: int, degree: int) -> Spline:
    """The spline of a path of 1 mm, joint limits left open."""
    tau = sample_places(SAMPLES, CROWDING)
    B = np.ascontiguousarray(basis(tau, control_points, degree))
    return Spline(B, np.diff(tau), smoothing_metric(control_points, degree), np.empty((4, 2)))
