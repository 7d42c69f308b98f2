"""One path to be found: where it starts and ends, what it keeps away from, and the search: an augmented Lagrangian outside, BFGS inside."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled
from marl_handover.motion.collision_model import MARGIN_MM, CollisionModel, Scene, ball_around, out_of_reach
from marl_handover.motion.initial_guesses import fit_control_points, random_bend, smoothing_metric
from marl_handover.motion.objective import LEVER_MM, ROUNDING_MM, Margins, Penalty, columns, dense_margins, lagrangian
from marl_handover.motion.proportions import proportions
from marl_handover.motion.trajectory import NoPath, basis, sample_places, sampled_basis

Floats = NDArray[np.float64]

LONGEST_STEP_RAD = 0.5
TRIES, ENOUGH = 12, 1e-4
"""Of a line search: how often it shortens the step, and the share of the promised gain it takes."""


class Spline(NamedTuple):
    """What the descent knows of the path: ``B`` (S, N) sampled basis; ``step`` (S - 1,) distances of the samples in tau; ``metric``
    (4 n, 4 n), n = N - 2, the first inverse Hessian; ``limits`` (4, 2) of the joints, asked of the control points, which bounds the path.
    """

    B: Floats
    step: Floats
    metric: Floats
    limits: Floats


class SolverOptions(NamedTuple):
    """How long the descent tries: first penalty per mm, its growth a round, rounds, steps a round, relative gain that ends a round,
    violation in mm that is good enough.
    """

    penalty: float
    growth: float
    rounds: int
    steps: int
    gain: float
    slack_mm: float


class Multipliers(NamedTuple):
    """Multipliers: ``lam`` (S, C) of the samples' constraints, ``limit`` (n, 4, 2) of the joint limits."""

    lam: Floats
    limit: Floats


class Evaluation(NamedTuple):
    """What an evaluation fills: joint samples (S, 4), their gradient (S, 4), constraints (S, C)."""

    Q: Floats
    grad: Floats
    values: Floats


@compiled
def minimize(points: Floats, spline: Spline, scene: Scene, weights: Floats, options: SolverOptions) -> tuple[Floats, float, int]:
    """Improve control points (N, 4), ends fixed.

    Returns:
        the control points, the greatest violation in mm at the samples, the number of evaluations of cost and gradient.
    """
    S, n, C = spline.B.shape[0], points.shape[0] - 2, columns(scene)
    held = Multipliers(np.zeros((S, C)), np.zeros((n, 4, 2)))
    now = Evaluation(np.empty((S, 4)), np.empty((S, 4)), np.empty((S, C)))
    x, rho, evaluations, before, worst = points.copy(), options.penalty, 0, np.inf, np.inf
    H = spline.metric.copy()
    for _ in range(options.rounds):
        x, cost, used = _minimise(x, rho, held, now, spline, scene, weights, options, H)
        evaluations += used
        worst, paid = _update_multipliers(x, now.values, held, rho, spline.limits)
        cost -= paid
        if worst <= options.slack_mm and abs(before - cost) < 2e-3 * cost:
            break
        before = cost
        rho *= options.growth
    return x, worst, evaluations


@compiled
def _minimise(
    x: Floats,
    rho: float,
    held: Multipliers,
    now: Evaluation,
    spline: Spline,
    scene: Scene,
    weights: Floats,
    options: SolverOptions,
    H: Floats,
) -> tuple[Floats, float, int]:
    """One round of BFGS at fixed multipliers; ``now`` ends as the evaluation of what is returned, ``H`` goes on to the next round."""
    n = x.shape[0] - 2
    f, g = _evaluate(x, rho, held, now, spline, scene, weights)
    evaluations = 1
    for _ in range(options.steps):
        d = -_times(H, g)
        slope = np.dot(d, g)
        if slope > -1e-9:
            break
        scale, accepted = min(1.0, LONGEST_STEP_RAD / np.abs(d).max()), False
        fn, gn, xn = f, g, x
        for _try in range(TRIES):
            xn = x.copy()
            xn[1:-1] += scale * d.reshape(n, 4)
            fn, gn = _evaluate(xn, rho, held, now, spline, scene, weights)
            evaluations += 1
            accepted = fn <= f + ENOUGH * scale * slope
            if accepted:
                break
            # The minimum of the parabola through what is known, within bounds.
            scale *= max(0.1, min(0.5, -0.5 * scale * slope / max(fn - f - scale * slope, 1e-12)))
        if not accepted:
            fn, gn = _evaluate(x, rho, held, now, spline, scene, weights)
            break
        _update(H, scale * d, gn - g)
        gain = f - fn
        x, f, g = xn, fn, gn
        if gain < options.gain * abs(f):
            break
    return x, f, evaluations


@compiled
def _update(H: Floats, s: Floats, y: Floats) -> None:
    """The BFGS update of an inverse Hessian, in place; left out where the curvature is not positive."""
    sy = np.dot(s, y)
    if sy <= 1e-10 * np.sqrt(np.dot(s, s) * np.dot(y, y)):
        return
    Hy = _times(H, y)
    factor = (1.0 + np.dot(y, Hy) / sy) / sy
    for a in range(H.shape[0]):
        for b in range(H.shape[0]):
            H[a, b] += factor * s[a] * s[b] - (Hy[a] * s[b] + s[a] * Hy[b]) / sy


@compiled
def _evaluate(
    x: Floats, rho: float, held: Multipliers, now: Evaluation, spline: Spline, scene: Scene, weights: Floats
) -> tuple[float, Floats]:
    """The augmented Lagrangian at control points ``x`` (N, 4) and its gradient over the inner ones, flat."""
    B, limits, Q, grad, limit = spline.B, spline.limits, now.Q, now.grad, held.limit
    S, n = B.shape[0], x.shape[0] - 2
    # Plain loops: at this size they are several times faster than calls of a matrix library.
    for i in range(S):
        for j in range(4):
            total = 0.0
            for k in range(n + 2):
                total += B[i, k] * x[k, j]
            Q[i, j] = total
    f = lagrangian(Q, scene, Penalty(held.lam, rho, spline.step, weights), grad, now.values)
    g = np.zeros((n, 4))
    for i in range(S):
        for k in range(n):
            for j in range(4):
                g[k, j] += B[i, k + 1] * grad[i, j]
    for k in range(n):
        for j in range(4):
            for side in range(2):
                sign = LEVER_MM * (2.0 * side - 1.0)
                h = max(0.0, limit[k, j, side] + rho * sign * (x[k + 1, j] - limits[j, side]))
                f += 0.5 * h * h / rho
                g[k, j] += h * sign
    return f, g.reshape(4 * n)


@compiled
def _times(H: Floats, v: Floats) -> Floats:
    """The product of a symmetric matrix with a vector."""
    out = np.zeros(len(v))
    for a in range(len(v)):
        for b in range(len(v)):
            out[b] += H[a, b] * v[a]
    return out


@compiled
def _update_multipliers(x: Floats, values: Floats, held: Multipliers, rho: float, limits: Floats) -> tuple[float, float]:
    """Take over the multipliers; the greatest violation in mm, and what the penalty was."""
    worst, paid, lam, limit = 0.0, 0.0, held.lam, held.limit
    for i in range(values.shape[0]):
        for c in range(values.shape[1]):
            h = max(0.0, lam[i, c] + rho * values[i, c])
            paid += 0.5 * h * h / rho
            lam[i, c] = h
            worst = max(worst, values[i, c])
    for k in range(limit.shape[0]):
        for j in range(4):
            for side in range(2):
                over = LEVER_MM * (2.0 * side - 1.0) * (x[k + 1, j] - limits[j, side])
                h = max(0.0, limit[k, j, side] + rho * over)
                paid += 0.5 * h * h / rho
                limit[k, j, side] = h
                worst = max(worst, over)
    return worst, paid


DENSE_SAMPLES = 1001
DESCENT_SAMPLES, CROWDING = 41, 0.6
WEIGHTS = np.array([0.1, 0.005])
"""Of even speed and of joint motion, beside the length: enough to leave no direction without curvature."""

SOLVER_OPTIONS = SolverOptions(penalty=0.1, growth=10.0, rounds=5, steps=30, gain=1e-4, slack_mm=0.2)

ALIKE_RAD = 1e-3
SHORTEST_MM = 20.0
"""Paths between nearer ends are bent as if they were this long."""

FIRST_MARGINS_MM = np.array([0.5, 0.5, 0.5, 0.25, 0.1])
"""What the optimiser asks beyond the demand at its few samples: arm and block, itself, ground, lift, edge."""

PATIENCE = 1000
"""Once there is a feasible path, no further start begins after so many evaluations."""

REPAIRS, GIVEN_UP = 6, 2
HOPELESS_MM = -1.0
"""A path that the dense check finds short is repaired; after so many repairs only one that is short by less than this."""

GOOD_RATIO = 1.03
"""A path this near to its expected length is not searched on."""

WANTED, FAIR_RATIO = 2, 1.15
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
        collision_model: the arm.
        scene: what the path is judged against.
        ends: (2, 4) joints at start and end, roll left out, in rad.
        lower_bound_mm: no path is shorter.
        expected_mm: what the length is likely to be at best; paths near it are not searched on.
    """

    collision_model: CollisionModel
    scene: Scene
    ends: Floats
    lower_bound_mm: float
    expected_mm: float

    def check(self, joints: Floats) -> tuple[Margins, float]:
        """Margins and length in mm of joint samples (S, 4)."""
        out = np.empty(6)
        length = dense_margins(np.ascontiguousarray(joints), self.scene, out)
        return Margins(*(float(value) for value in out)), float(length)

    def improve(self, points: Floats, degree: int, margins_mm: Floats, options: SolverOptions) -> tuple[Floats, int]:
        """Control points (N, 4) after the descent that asks for ``margins_mm`` (5,) more than is demanded, and its evaluations."""
        near = self.scene.obstacles[~out_of_reach(self.collision_model, self.scene.obstacles)]
        asked = self.scene._replace(
            obstacles=(obstacles := near + margins_mm[0] * (np.arange(9) == 7)),
            group=ball_around(obstacles),
            clearance=self.scene.clearance + margins_mm[1:3],
            profile=self.scene.profile + np.array([0, 0, 0, 0, 0, 0, margins_mm[3], margins_mm[4]]),
        )
        spline = _spline(len(points), degree, proportions(self.scene.planar).length_mm)
        metric = spline.metric * max(self.lower_bound_mm, SHORTEST_MM)
        spline = spline._replace(metric=metric, limits=self.collision_model.limits)
        x, _, evaluations = minimize(np.ascontiguousarray(points), spline, asked, WEIGHTS, options)
        return x, evaluations


def find_path(
    segment: Segment,
    guesses: Iterable[Floats],
    control_points: int,
    degree: int,
    starts: int,
    wanted: int = WANTED,
    thorough: bool = False,
) -> FoundPath:
    """The shortest of a few feasible paths; of the first one that is near its expected length.

    Args:
        segment: what is asked.
        guesses: joint samples of first guesses, each (S, 4), S as :mod:`marl_handover.motion.initial_guesses` has it.
        control_points: N.
        degree: of the spline.
        starts: guesses and random bends of them, at most.
        wanted: feasible paths to choose from.
        thorough: choose from all starts.

    Raises:
        NoPath: with the reason.
    """
    require_free_ends(segment)
    best: FoundPath | None = None
    feasible, evaluations, miss = 0, 0, Margins(*[-np.inf] * 6)
    fitted_guesses: list[Floats] = []
    supply = iter(guesses)
    for start in range(starts):
        points = _next_start(supply, fitted_guesses, segment.collision_model.limits, control_points, degree, start)
        found, margins, used = solve_from(segment, points, degree, beat_mm=np.inf if best is None else best.length_mm)
        evaluations += used
        if found is None:
            miss = max(miss, margins, key=lambda m: m.worst)
        else:
            feasible += 1
            best = found if best is None or found.length_mm < best.length_mm else best
        if best is None or thorough:
            continue
        ratio = best.length_mm / max(segment.expected_mm, 1e-9)
        if ratio <= GOOD_RATIO or feasible >= wanted + (wanted > 1 and ratio > FAIR_RATIO) or evaluations > PATIENCE:
            break
    if best is None:
        raise NoPath("path", _named(miss), -miss.worst, starts)
    return best._replace(starts=start + 1, evaluations=evaluations)


def _next_start(supply: Iterator[Floats], before: list[Floats], limits: Floats, control_points: int, degree: int, seed: int) -> Floats:
    """Control points of the next guess that is unlike the ones ``before``, to which it is added; when there is none, of a bend of one."""
    for samples in supply:
        points = fit_control_points(samples, limits, control_points, degree)
        if not any(np.abs(points - other).max() < ALIKE_RAD for other in before):
            before.append(points)
            return points
    return random_bend(before[seed % len(before)], limits, degree, seed)


def solve_from(
    segment: Segment, points: Floats, degree: int, options: SolverOptions = SOLVER_OPTIONS, beat_mm: float = np.inf
) -> tuple[FoundPath | None, Margins, int]:
    """One start: descend, check densely, ask for more where it fell short, descend again.

    Gives up on a path that gets longer than ``beat_mm``, and on one that repairs do not help.
    """
    asked, evaluations = FIRST_MARGINS_MM.copy(), 0
    dense = np.array(sampled_basis(DENSE_SAMPLES, len(points), degree))
    low, high = segment.collision_model.limits.T
    for repair in range(REPAIRS):
        points, used = segment.improve(points, degree, asked, options)
        points[1:-1] = np.clip(points[1:-1], low, high)  # what the descent leaves over is small; inside them, the whole path is
        evaluations += used
        margins, length = segment.check(dense @ points)
        if margins.worst >= 0.0:
            full = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
            return FoundPath(full, length, margins, 1, evaluations), margins, evaluations
        if length >= beat_mm or (repair + 1 >= GIVEN_UP and margins.worst < HOPELESS_MM):
            break
        short = np.array([min(margins.arm, margins.block), margins.itself, margins.ground, margins.lift, margins.edge])
        asked = np.minimum(asked + np.where(short < -ROUNDING_MM, 0.1 - 1.3 * short, 0.0), MARGIN_MM)
    return None, margins, evaluations


def require_free_ends(segment: Segment) -> None:
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
def _spline(control_points: int, degree: int, length_mm: float) -> Spline:
    """The spline of a path of 1 mm of an arm of ``length_mm``, joint limits left open."""
    tau = sample_places(DESCENT_SAMPLES, CROWDING)
    B = np.ascontiguousarray(basis(tau, control_points, degree))
    return Spline(B, np.diff(tau), smoothing_metric(control_points, degree, length_mm), np.empty((4, 2)))
