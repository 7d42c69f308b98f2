"""Time-optimal timing of a joint path under limits of velocity and acceleration: a compiled reachability analysis.

The path is q(tau), tau in [0, 1]. It is written in a parameter s from 0 to 1 that is nearly its arc length, so that the law of speed below
has no singular ends: a path whose dq/dtau vanishes there, as a clamped spline's may, starts like any other. At cusps the path has to stop
and is treated as beginning anew. ds/dtau is a polynomial of degree 2 on each interval between grid points. Along the path x = (ds/dt)^2 is
piecewise linear in s, so that ds/dt is continuous and u = d2s/dt2 constant on each interval. A joint's acceleration is q'' x + q' u, its
speed q' sqrt(x), primes by s; both are bounded at the beginning, the middle and the end of each interval. In (x, y), the values of x at
the ends of an interval, a bound of acceleration is a strip around the origin. A backward pass finds the greatest x of each grid point from
which the end can be reached, a forward pass then takes the greatest y at each step. Rest is always possible, so neither can fail.

This is done on grid points even in tau, then on twice as many that are nearer to even in the time found first, which puts them where the
path is slow or turns. There the motion is checked between the grid points too, and made slower where it exceeds a limit.

Method: H. Pham, Q.-C. Pham, "A New Approach to Time-Optimal Path Parameterization Based on Reachability Analysis", IEEE Trans. Robotics
34(3), 2018. The parameter s, the bounds in the middle, the closed form of the two-variable problems, the second grid and the check are
additions.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.config import require_at_least, require_between, require_positive
from marl_handover.errors import InvalidSetting, NotFinite
from marl_handover.motion.splines import knots
from marl_handover.motion.time_parametrization_kernels import STILL, fastest, spline, still_spans, time_law, turns
from marl_handover.motion.trajectory import JointTrajectory

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

GRID = 100
"""Intervals of the grid."""

_WHOLE = np.array([0.0, 1.0])
_EVEN_IN_TAU = 0.4  # share of the second grid that stays even in tau, so that no piece of the path is left without grid points
_ROUNDS = 2  # of checking between the grid points
_LARGEST_RAD = 1e6  # beyond, squares of rounding errors would be felt


def time_path(
    control_points: ArrayLike,
    degree: int,
    velocity_rad_s: ArrayLike,
    acceleration_rad_s2: ArrayLike,
    sample_s: float,
    grid: int = GRID,
) -> JointTrajectory:
    """The fastest motion along a path, from rest to rest.

    Args:
        control_points: (N, joints) in rad, of a clamped uniform B-spline (:mod:`marl_handover.motion.splines`).
        degree: of the spline, at least 3: a spline of degree 2 has jumps of acceleration.
        velocity_rad_s: greatest speed (joints,) of each joint.
        acceleration_rad_s2: greatest acceleration (joints,) of each joint.
        sample_s: the samples are at most this far apart.
        grid: number of intervals on which the limits are imposed.

    Returns:
        Samples at even intervals, on the path; the first and last are exactly its ends. A path that stands still
        gives two, ``sample_s`` apart.

    Raises:
        NotFinite: a control point is not finite.
        InvalidSetting: a shape does not fit, or ``degree``, a limit, ``sample_s`` or ``grid`` is too small, or a control point above 1e6.
    """
    points = _checked_points(control_points, degree)
    velocity = _limits("velocity_rad_s", velocity_rad_s, points.shape[1])
    acceleration = _limits("acceleration_rad_s2", acceleration_rad_s2, points.shape[1])
    require_positive("sample_s", sample_s)
    require_at_least("grid", grid, 2)
    if np.ptp(points, axis=0).max() <= STILL:
        return JointTrajectory(np.array([0.0, sample_s]), points[[0, -1]], np.zeros((2, points.shape[1])))
    knot, widths_1, widths_2 = _knots_and_widths(len(points), degree)
    first = np.diff(points / acceleration, axis=0) / widths_1
    second = np.diff(first, axis=0) / widths_2
    path = (first, second, knot, degree, velocity / acceleration)
    nodes, stops = _spread(_breaks(first, second, knot, degree, 2 * grid), _WHOLE, _WHOLE, max(2, grid // 2))
    _, _, times = fastest(nodes, stops, 0, *path)
    share = (1.0 - _EVEN_IN_TAU) / times[-1] * times + _EVEN_IN_TAU * nodes
    nodes, stops = _spread(share[stops], share, nodes, grid)
    rates, squares, times = fastest(nodes, stops, _ROUNDS, *path)
    t = np.linspace(0.0, times[-1], 1 + max(1, math.ceil(times[-1] / sample_s - 1e-9)))
    tau, tau_rate = time_law(nodes, rates, squares, times, t)
    joints = spline(points, knot, degree, tau)
    velocities = spline(first, knot[1:-1], degree - 1, tau) * acceleration * tau_rate[:, None]
    joints[0], joints[-1] = points[0], points[-1]
    velocities[0] = velocities[-1] = 0.0
    return JointTrajectory(t, joints, velocities)


def _checked_points(control_points: ArrayLike, degree: int) -> Floats:
    points = np.array(control_points, dtype=float, order="C")
    if points.ndim != 2 or points.shape[1] < 1:
        raise InvalidSetting("control_points", points.shape, "an array (N, joints)")
    require_at_least("degree", degree, 3)
    if len(points) <= degree:
        raise InvalidSetting("control_points", len(points), f"more than the degree, {degree}")
    if not np.isfinite(points).all():
        raise NotFinite("control_points", points[~np.isfinite(points)][0])
    require_between("control_points", float(points.flat[np.abs(points).argmax()]), -_LARGEST_RAD, _LARGEST_RAD)
    return points


def _limits(name: str, values: ArrayLike, joints: int) -> Floats:
    limits = np.array(values, dtype=float, order="C")
    if limits.shape != (joints,):
        raise InvalidSetting(name, limits.shape, f"of shape ({joints},)")
    for value in limits:
        require_positive(name, float(value))
    return limits


@lru_cache(maxsize=64)
def _knots_and_widths(points: int, degree: int) -> tuple[Floats, Floats, Floats]:
    """The knots, and what differences of the control points are divided by to give those of the first and second derivative."""
    knot = knots(points, degree)
    widths = [(knot[degree + 1 : -order] - knot[order : -degree - 1])[:, None] / (degree + 1 - order) for order in (1, 2)]
    return knot, widths[0], widths[1]


def _breaks(first_points: Floats, second_points: Floats, knot: Floats, degree: int, steps: int) -> Floats:
    """Values of tau (k,), from 0 to 1, between which the path goes without a stop: cusps, and the ends of pieces that stand still."""
    tau = np.linspace(0.0, 1.0, steps + 1)
    corners = turns(tau, spline(first_points, knot[1:-1], degree - 1, tau))
    still = still_spans(first_points, knot, degree)
    if len(corners) + len(still) == 0:
        return _WHOLE
    for _ in range(4):  # Newton's method to where dq/dtau is 0, or least
        first, second = spline(first_points, knot[1:-1], degree - 1, corners), spline(second_points, knot[2:-2], degree - 2, corners)
        size = (second**2).sum(axis=1)
        step = (first * second).sum(axis=1) / np.where(size > 0.0, size, np.inf)
        corners = corners - np.clip(step, -0.4 / steps, 0.4 / steps)
    return np.unique(np.concatenate([_WHOLE, still, np.clip(corners, 0.1 / steps, 1.0 - 0.1 / steps)]))


def _spread(breaks: Floats, share: Floats, tau: Floats, grid: int) -> tuple[Floats, Bools]:
    """About ``grid`` intervals, even in ``share`` between ``breaks``: the grid points' tau (n + 1,), and which of them are breaks.

    ``share`` (m,), from 0 to 1, belongs to ``tau`` (m,); ``breaks`` (k,), from 0 to 1, are values of share.
    """
    if len(breaks) == 2:
        stops = np.zeros(grid + 1, dtype=bool)
        stops[0] = stops[-1] = True
        return np.interp(np.linspace(0.0, 1.0, grid + 1), share, tau), stops
    counts = np.maximum(2, np.rint(grid * np.diff(breaks)).astype(int))
    pieces = [np.linspace(low, high, count, endpoint=False) for low, high, count in zip(breaks[:-1], breaks[1:], counts, strict=True)]
    stops = np.zeros(counts.sum() + 1, dtype=bool)
    stops[np.cumsum(counts)] = stops[0] = True
    return np.interp(np.concatenate([*pieces, breaks[-1:]]), share, tau), stops
