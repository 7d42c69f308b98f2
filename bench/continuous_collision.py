"""A proof that a path keeps its clearances at every tau, not only at samples.

Between two values of tau no point of the arm moves farther than the joints' greatest speeds there times their levers. So a margin m at
the middle of an interval of half-width h is worth m - v h all over it; an interval that this does not settle is halved. Speeds are
bounded by the control points of the derivative, which is a spline too and stays in their hull.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled
from marl_handover.motion.collision_model import Scene
from marl_handover.motion.objective import dense_margins
from marl_handover.motion.path_optimizer import Segment
from marl_handover.motion.trajectory import knots

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

DEPTH = 14
FIRST = 8
"""Intervals a knot span is cut into at first; how often one may be halved."""


class Certificate(NamedTuple):
    """What is proved of a path: its margins to the other arm, the standing block, itself and the table are nowhere below ``margin_mm``.

    ``proved``: that is at least 0, so that these clearances hold everywhere. Not part of it are the heights of the grip over the
    lift-over profile and of the held block over the table: they are met exactly at both ends, where no bound can tell. ``looks``:
    postures looked at.
    """

    margin_mm: float
    proved: bool
    looks: int


def certify(segment: Segment, points: Floats, degree: int) -> Certificate:
    """Prove the clearances of a path's control points (N, 4) or (N, 5), as far as they can be."""
    points = np.ascontiguousarray(points[:, :4])
    vector = knots(len(points), degree)
    slopes = degree * np.diff(points, axis=0) / (vector[degree + 1 : -1] - vector[1 : -degree - 1])[:, None]
    inner = vector[degree : len(points) + 1]
    fastest = np.stack([np.abs(slopes[span : span + degree]).max(axis=0) for span in range(len(inner) - 1)])
    margin, looks = _prove(points, degree, vector, inner, fastest @ segment.collision_model.levers_mm, segment.scene)
    return Certificate(float(margin), bool(margin >= 0.0), int(looks))


@compiled(error_model="python")
def _prove(points: Floats, degree: int, vector: Floats, inner: Floats, speeds: Floats, scene: Scene) -> tuple[float, int]:
    """The least proved margin over all spans, and the postures looked at."""
    least, looks, out, q = np.inf, 0, np.empty(6), np.empty((1, 4))
    middles, halves = np.empty(FIRST + 2 * DEPTH + 2), np.empty(FIRST + 2 * DEPTH + 2)
    for span in range(len(inner) - 1):
        width = (inner[span + 1] - inner[span]) / FIRST
        waiting = FIRST
        for part in range(FIRST):
            middles[part], halves[part] = inner[span] + (part + 0.5) * width, 0.5 * width
        while waiting > 0:
            waiting -= 1
            middle, half = middles[waiting], halves[waiting]
            _at(points, degree, vector, span + degree, middle, q)
            dense_margins(q, scene, out)
            looks += 1
            margin = out[:4].min()
            worth = margin - speeds[span] * half
            # What no halving can settle, or need not.
            if worth >= 0.0 or margin <= 0.0 or half < width * 0.5**DEPTH:
                least = min(least, worth)
                continue
            for sign in (-0.5, 0.5):
                middles[waiting], halves[waiting] = middle + sign * half, 0.5 * half
                waiting += 1
    return least, looks


@compiled(error_model="python")
def _at(points: Floats, degree: int, vector: Floats, span: int, tau: float, out: Floats) -> None:
    """De Boor's algorithm: the path at ``tau`` of knot span ``span`` into ``out`` (1, 4)."""
    work = points[span - degree : span + 1].copy()
    for level in range(1, degree + 1):
        for i in range(degree, level - 1, -1):
            left = vector[span - degree + i]
            share = (tau - left) / (vector[i + 1 + span - level] - left)
            for j in range(4):
                work[i, j] = (1.0 - share) * work[i - 1, j] + share * work[i, j]
    for j in range(4):
        out[0, j] = work[degree, j]
