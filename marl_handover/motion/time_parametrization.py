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

from marl_handover.compiled import compiled
from marl_handover.config import require_at_least, require_between, require_positive
from marl_handover.errors import InvalidSetting, NotFinite
from marl_handover.motion.trajectory import JointTrajectory, knots

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

STILL = 1e-9
"""A dq/dtau smaller than this part of the greatest is none; a path shorter than this, in rad, stands still."""

_NO_TURN = math.cos(math.radians(3.0))
_WIDENING = 2.0  # grid intervals over which a tight turn is spread in s
_LEAST = 0.01  # an x is not asked to fall to less than this part of the greatest in one interval; at 0 twice in a row nothing moves
_FASTEST = 1e10  # (ds/dt)^2 where no limit binds, as on a piece that stands still: all of it in 10 us
_SLOW = 1e-6  # a ds/dtau, 1 on the average, below which the path all but stands still and its acceleration is rounding
_NEVER = 1e300  # half the width of a strip that does not bind
_SETTLED = 1.003  # an excess over the limits that is not worth another pass


@compiled
def spline(points: Floats, knots: Floats, degree: int, tau: Floats) -> Floats:
    """The spline (n, joints) at ``tau`` (n,), ascending, by the recursion of Cox and de Boor."""
    joints = points.shape[1]
    values = np.zeros((tau.shape[0], joints))
    basis = np.empty(degree + 1)
    span = degree
    for j in range(tau.shape[0]):
        at = tau[j]
        while span < points.shape[0] - 1 and at >= knots[span + 1]:
            span += 1
        basis[0] = 1.0
        for order in range(1, degree + 1):
            carried = 0.0
            for r in range(order):
                right, left = knots[span + 1 + r], knots[span + 1 + r - order]
                part = basis[r] / (right - left)
                basis[r] = carried + (right - at) * part
                carried = (at - left) * part
            basis[order] = carried
        for r in range(degree + 1):
            for k in range(joints):
                values[j, k] += basis[r] * points[span - degree + r, k]
    return values


@compiled
def dot(a: Floats, i: int, b: Floats, j: int) -> float:
    """The product of row i of ``a`` and row j of ``b``."""
    total = 0.0
    for k in range(a.shape[1]):
        total += a[i, k] * b[j, k]
    return total


@compiled
def turns(tau: Floats, first: Floats) -> Floats:
    """About where the path turns by more than a right angle from one ``tau`` (n,) to the next; ``first`` (n, joints) is dq/dtau.

    Where dq/dtau vanishes at a ``tau``, its neighbours are compared, and any turn counts.
    """
    most = 0.0
    for j in range(tau.shape[0]):
        most = max(most, dot(first, j, first, j))
    found = np.empty(tau.shape[0])
    count, last = 0, -1
    for j in range(tau.shape[0]):
        square = dot(first, j, first, j)
        if square <= STILL**2 * most:
            continue
        if last >= 0:
            along = dot(first, last, first, j)
            before = dot(first, last, first, last)
            if along < (0.0 if j == last + 1 else _NO_TURN * math.sqrt(before * square)):
                found[count] = tau[last] + (before - along) / (before - 2.0 * along + square) * (tau[j] - tau[last])  # secant
                count += 1
        last = j
    return found[:count]


@compiled
def still_spans(first_points: Floats, knots: Floats, degree: int) -> Floats:
    """The inner ends of those spans between knots on which the path stands still."""
    most = 0.0
    for j in range(first_points.shape[0]):
        most = max(most, dot(first_points, j, first_points, j))
    found = np.empty(2 * first_points.shape[0])
    count, run = 0, 0
    for j in range(first_points.shape[0]):
        run = run + 1 if dot(first_points, j, first_points, j) <= STILL**2 * most else 0
        if run >= degree:
            for end in range(2):
                if 0.0 < knots[j + 1 + end] < 1.0:
                    found[count] = knots[j + 1 + end]
                    count += 1
    return found[:count]


@compiled
def _parameter_rates(nodes: Floats, first: Floats, second: Floats) -> Floats:
    """ds/dtau (n, 3) at the beginning, middle and end of each interval, from dq/dtau and d2q/dtau2 (2n + 1, joints) there.

    It is |dq/dtau|, but for tight turns: there it is made greater by the part of d2q/dtau2 across the path, so that they take longer in s.
    """
    n = nodes.shape[0] - 1
    speed = np.empty(2 * n + 1)
    greatest = 0.0
    for j in range(2 * n + 1):
        speed[j] = math.sqrt(dot(first, j, first, j))
        greatest = max(greatest, speed[j])
    for j in range(2 * n + 1):
        if speed[j] > STILL * greatest:
            across = dot(second, j, second, j) - (dot(first, j, second, j) / speed[j]) ** 2
            speed[j] = math.sqrt(speed[j] ** 2 + max(across, 0.0) * (_WIDENING / n) ** 2)
        else:
            speed[j] = 0.0
    rates = np.empty((n, 3))
    total = 0.0
    for i in range(n):
        start, middle, end = speed[2 * i], max(speed[2 * i + 1], STILL * greatest), speed[2 * i + 2]
        if 4.0 * middle < start + end - 2.0 * math.sqrt(start * end):  # the polynomial through the three would be negative somewhere
            middle = 0.5 * (start + end)
        rates[i, 0], rates[i, 1], rates[i, 2] = start, middle, end
        total += (nodes[i + 1] - nodes[i]) * (start + 4.0 * middle + end) / 6.0
    for i in range(n):
        for place in range(3):
            rates[i, place] /= total
    return rates


@compiled
def _within(rates: Floats, i: int, z: float) -> tuple[float, float, float]:
    """At the part ``z`` of interval i, as if its width were 1: s from its beginning, ds/dz and d2s/dz2."""
    start = rates[i, 0]
    bend = 4.0 * rates[i, 1] - 3.0 * start - rates[i, 2]
    curve = 2.0 * (start - 2.0 * rates[i, 1] + rates[i, 2])
    return ((curve / 3.0 * z + 0.5 * bend) * z + start) * z, (curve * z + bend) * z + start, 2.0 * curve * z + bend


@compiled
def _bounds(
    nodes: Floats, rates: Floats, first: Floats, second: Floats, velocity: Floats, most: Floats, slope: Floats, half: Floats
) -> None:
    """Every interval's bounds: of acceleration as strips |y + slope x| <= half (n, 3 joints), of speed as x <= most (n, 3).

    ``first`` and ``second`` (2n + 1, joints) are derivatives by tau. The three places are an interval's beginning, middle and end.
    """
    joints = first.shape[1]
    for i in range(rates.shape[0]):
        width = nodes[i + 1] - nodes[i]
        unit = _within(rates, i, 1.0)[0]
        for place in range(3):
            j = 2 * i + place
            s, _, bend = _within(rates, i, 0.5 * place)
            rate, passed = rates[i, place], s / unit
            most[i, place] = _FASTEST
            for k in range(joints):
                if rate > 0.0:
                    along = first[j, k] / rate
                    across = (second[j, k] - along * bend / width) / rate**2
                else:  # at rest in tau: the limit of the quotient, or nearly that, the next point's; x is 0, so that across does not matter
                    simple = abs(bend) > _SLOW * rates[i, 1]
                    along, across = second[j, k] * width / bend if simple else first[2 * i + 1, k] / rates[i, 1], 0.0
                if along * along * most[i, place] > velocity[k] * velocity[k]:
                    most[i, place] = (velocity[k] / along) ** 2
                along /= 2.0 * unit * width
                of_x, of_y = across * (1.0 - passed) - along, across * passed + along
                if of_y < 0.0:
                    of_x, of_y = -of_x, -of_y
                row = place * joints + k
                if max(abs(of_x), of_y) * _FASTEST < 1.0:
                    slope[i, row], half[i, row] = 0.0, _NEVER
                else:
                    of_y = max(of_y, 1e-12 * abs(of_x))  # a bound of x alone is nearly one
                    slope[i, row], half[i, row] = of_x / of_y, 1.0 / of_y


@compiled
def _greatest_start(slope: Floats, half: Floats, i: int, x: float, y_most: float, sum_most: float) -> float:
    """The greatest start value of interval i, at most ``x``, with a y in all strips, at most ``y_most`` and ``sum_most`` less the start.

    The least and the greatest such y are a convex and a concave function of the start, in order at 0: where they cross is found by
    Newton's method from the right, which ends after finitely many steps.
    """
    x = min(x, sum_most)
    rows = slope.shape[1]
    y_least = _LEAST * y_most
    for row in range(rows):
        y_least = min(y_least, 0.5 * half[i, row])
    for _ in range(2 * rows):
        low, low_slope = y_least, 0.0
        high, high_slope = y_most, 0.0
        if sum_most - x < high:
            high, high_slope = sum_most - x, -1.0
        for row in range(rows):
            middle = -slope[i, row] * x
            if middle - half[i, row] > low:
                low, low_slope = middle - half[i, row], -slope[i, row]
            if middle + half[i, row] < high:
                high, high_slope = middle + half[i, row], -slope[i, row]
        if low <= high or low_slope <= high_slope:
            break
        x = max(x - (low - high) / (low_slope - high_slope), 0.0)
    return x


@compiled
def _squared_speeds(stops: Bools, most: Floats, slope: Floats, half: Floats) -> Floats:
    """The greatest x at each grid point (n + 1,), 0 at ``stops`` (n + 1,) and at both ends."""
    n = slope.shape[0]
    x = np.zeros(n + 1)
    for i in range(n - 1, 0, -1):
        if not stops[i]:
            x[i] = _greatest_start(slope, half, i, min(most[i - 1, 2], most[i, 0]), x[i + 1], 2.0 * most[i, 1])
    for i in range(n - 1):
        y = min(x[i + 1], 2.0 * most[i, 1] - x[i])
        for row in range(slope.shape[1]):
            y = min(y, half[i, row] - slope[i, row] * x[i])
        x[i + 1] = max(y, 0.0)
    return x


@compiled
def _excess(nodes: Floats, rates: Floats, squares: Floats, first: Floats, second: Floats, velocity: Floats, excess: Floats) -> float:
    """The greatest acceleration, or square of a speed, relative to its limit, at the quarters of the intervals; at least 1.

    That of each interval is written to ``excess`` (n,). ``first`` and ``second`` (2n, joints) are derivatives by tau at the quarters.
    """
    worst = 1.0
    for i in range(rates.shape[0]):
        excess[i] = 1.0
        width = nodes[i + 1] - nodes[i]
        rise = (squares[i + 1] - squares[i]) / _within(rates, i, 1.0)[0]
        for side in range(2):
            s, rate, bend = _within(rates, i, 0.25 + 0.5 * side)
            if rate < _SLOW:
                continue
            x, u = squares[i] + s * rise, 0.5 * rise / width
            for k in range(first.shape[1]):
                along = first[2 * i + side, k] / rate
                across = (second[2 * i + side, k] - along * bend / width) / rate**2
                excess[i] = max(excess[i], abs(across * x + along * u), x * (along / velocity[k]) ** 2)
        worst = max(worst, excess[i])
    return worst


@compiled
def fastest(
    nodes: Floats, stops: Bools, rounds: int, first_points: Floats, second_points: Floats, knots: Floats, degree: int, velocity: Floats
) -> tuple[Floats, Floats, Floats]:
    """ds/dtau (n, 3), x (n + 1,) and the time (n + 1,) of the fastest motion on grid points ``nodes`` (n + 1,) that halts at ``stops``.

    ``first_points`` and ``second_points`` are control points of the derivatives; they and ``velocity`` are in units of the acceleration
    limits. The result is checked at the quarters of the intervals as well: up to ``rounds`` times the limits of the intervals where
    it exceeds them are made stricter, and what is left is taken out of the whole motion. With 0 rounds there is no check.
    """
    n = nodes.shape[0] - 1
    places, quarters = np.empty(2 * n + 1), np.empty(2 * n)
    places[2 * n] = nodes[n]
    for i in range(n):
        places[2 * i], places[2 * i + 1] = nodes[i], 0.5 * (nodes[i] + nodes[i + 1])
        quarters[2 * i], quarters[2 * i + 1] = 0.75 * nodes[i] + 0.25 * nodes[i + 1], 0.25 * nodes[i] + 0.75 * nodes[i + 1]
    first, second = spline(first_points, knots[1:-1], degree - 1, places), spline(second_points, knots[2:-2], degree - 2, places)
    rates = _parameter_rates(nodes, first, second)
    most, slope, half = np.empty((n, 3)), np.empty((n, 3 * first.shape[1])), np.empty((n, 3 * first.shape[1]))
    _bounds(nodes, rates, first, second, velocity, most, slope, half)
    squares = _squared_speeds(stops, most, slope, half)
    worst = 1.0
    if rounds > 0:
        first, second = spline(first_points, knots[1:-1], degree - 1, quarters), spline(second_points, knots[2:-2], degree - 2, quarters)
        excess = np.empty(n)
        for turn in range(rounds + 1):
            worst = _excess(nodes, rates, squares, first, second, velocity, excess)
            if worst <= _SETTLED or turn == rounds:
                break
            for i in range(n):
                for place in range(3):
                    most[i, place] /= excess[i]
                for row in range(slope.shape[1]):
                    half[i, row] /= excess[i]
            squares = _squared_speeds(stops, most, slope, half)
    times = np.zeros(n + 1)
    for i in range(n + 1):
        squares[i] /= worst
        if i > 0:
            length = (nodes[i] - nodes[i - 1]) * _within(rates, i - 1, 1.0)[0]
            times[i] = times[i - 1] + 2.0 * length / (math.sqrt(squares[i - 1]) + math.sqrt(squares[i]))
    return rates, squares, times


@compiled
def time_law(nodes: Floats, rates: Floats, squares: Floats, times: Floats, t: Floats) -> tuple[Floats, Floats]:
    """The tau and dtau/dt (m,) at times ``t`` (m,), ascending."""
    tau = np.empty(t.shape[0])
    tau_rate = np.empty(t.shape[0])
    i = 0
    for j in range(t.shape[0]):
        while i < times.shape[0] - 2 and t[j] > times[i + 1]:
            i += 1
        width = nodes[i + 1] - nodes[i]
        length = _within(rates, i, 1.0)[0]
        passed = t[j] - times[i]
        speed = math.sqrt(squares[i])
        u = (squares[i + 1] - squares[i]) / (2.0 * length * width)
        target = (speed + 0.5 * u * passed) * passed / width
        # Solve s(z) = target: Newton's method, or halving where that leaves the bracket.
        low, high = 0.0, 1.0
        z = min(max(target / length, 0.0), 1.0)
        for _ in range(60):
            s, rate, _ = _within(rates, i, z)
            if s > target:
                high = z
            else:
                low = z
            last = z
            z = z - (s - target) / rate
            if not low <= z <= high:
                z = 0.5 * (low + high)
            if abs(z - last) < 1e-13:
                break
        rate = _within(rates, i, z)[1]
        tau[j] = nodes[i] + width * z
        tau_rate[j] = max(speed + u * passed, 0.0) / rate if rate > 0.0 else 0.0
    return tau, tau_rate


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
        control_points: (N, joints) in rad, of a clamped uniform B-spline (:mod:`marl_handover.motion.trajectory`).
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
