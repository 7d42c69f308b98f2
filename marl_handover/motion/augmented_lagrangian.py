"""The compiled optimiser: augmented Lagrangian outside, BFGS inside, over the inner control points of yaw and three pitch joints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled
from marl_handover.motion.collision_model import Scene
from marl_handover.motion.objective import LEVER_MM, Penalty, columns, lagrangian

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
