"""The paper's own planner, for reproduction and comparison: its nonlinear program as it stands, handed to SciPy's SLSQP.

All 7 x 5 coordinates of the control points are variables. Equality constraints hold both ends at the demanded poses; heights and clearances
are inequalities at each sample between them, 101 in all; the joint limits are bounds. The grip's path length is integrated by the
trapezoidal rule over 100 intervals. Gradients are SLSQP's own finite differences. One start: the line in joint space, lifted. The demands
are those of :class:`~marl_handover.motion.path_optimizer.Segment`, computed by the same compiled geometry: what is compared with this is
the formulation, not Python.

Heights at both ends are met exactly by the poses; demanded there once more, SLSQP finds its linear problems incompatible and gives up at
12 of 20 transfers. The program holds its demands at the samples only, so the dense check mostly finds a path short by a fraction of a
millimetre.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from marl_handover.compiled import compiled
from marl_handover.geometry.closed_form import grip_in_plane, grip_speed, out_of_plane
from marl_handover.geometry.kernels import elbow_up
from marl_handover.motion.collision_model import Scene
from marl_handover.motion.objective import dense_margins
from marl_handover.motion.path_optimizer import DENSE_SAMPLES, FoundPath, NoPath, Segment, require_free_ends
from marl_handover.motion.trajectory import sampled_basis

Floats = NDArray[np.float64]

CONTROL_POINTS, DEGREE, INTERVALS = 7, 5, 100
JOINTS = 5
ACCURACY_MM = 0.01
"""SLSQP's ``ftol``. In mm it finds shorter paths than in m with its own 1e-6, in half the time."""

END_TOLERANCE_MM, END_TOLERANCE_RAD = 0.01, 1e-4
"""How well an equality constraint has to hold."""


def plan_slsqp(segment: Segment, maxiter: int = 100, tolerance_mm: float = 0.0) -> FoundPath:
    """The path SLSQP finds, checked at :data:`~marl_handover.motion.path_optimizer.DENSE_SAMPLES` samples.

    Args:
        segment: what is asked.
        maxiter: iterations of SLSQP.
        tolerance_mm: by how much a demand may be missed at the dense samples.

    Returns:
        7 control points; ``evaluations`` are SLSQP's iterations.

    Raises:
        NoPath: an end itself is too near something, or the path misses a demand by more than the tolerance.
    """
    require_free_ends(segment)
    solution, iterations = solve(segment, maxiter)
    misses = np.abs(_pose_errors(segment, solution))
    if max(misses[:, :3].max() / END_TOLERANCE_MM, misses[:, 3:].max() / END_TOLERANCE_RAD) > 1.0:
        raise NoPath("path", "the demanded poses at its ends", float(misses[:, :3].max()), 1)
    solution[[0, -1], :4], solution[[0, -1], 4] = segment.ends, 0.0  # so near, they may as well be exact: other paths join there
    margins, length = segment.check(np.array(sampled_basis(DENSE_SAMPLES, CONTROL_POINTS, DEGREE)) @ solution[:, :4])
    if not margins.worst >= -tolerance_mm:
        raise NoPath("path", f"what is demanded at {DENSE_SAMPLES} samples", -margins.worst, 1)
    return FoundPath(solution, length, margins, 1, iterations)


def solve(segment: Segment, maxiter: int) -> tuple[Floats, int]:
    """Where SLSQP ends, feasible or not: control points (7, 5) in rad within the joint limits, and its iterations."""
    lower, upper = np.append(segment.collision_model.limits[:, 0], -np.pi / 2), np.append(segment.collision_model.limits[:, 1], np.pi / 2)
    basis, slope = (np.array(sampled_basis(INTERVALS + 1, CONTROL_POINTS, DEGREE, derivative)) for derivative in (0, 1))

    def length(x: Floats) -> float:
        points = x.reshape(CONTROL_POINTS, JOINTS)
        speed = grip_speed(segment.scene.planar, basis @ points, slope @ points)
        return float(np.trapezoid(speed, dx=1.0 / INTERVALS))

    def poses(x: Floats) -> Floats:
        return _pose_errors(segment, x.reshape(CONTROL_POINTS, JOINTS)).ravel()

    kinds = _kinds(segment.scene)

    def demands(x: Floats) -> Floats:
        out = np.empty((INTERVALS - 1, 6))
        sample_margins(basis[1:-1] @ x.reshape(CONTROL_POINTS, JOINTS)[:, :4], segment.scene, out)
        return out[:, kinds].ravel()

    found: Any = minimize(
        length,
        first_guess(segment).ravel(),
        method="SLSQP",
        bounds=list(zip(np.tile(lower, CONTROL_POINTS), np.tile(upper, CONTROL_POINTS), strict=True)),
        constraints=[{"type": "eq", "fun": poses}, {"type": "ineq", "fun": demands}],
        options={"maxiter": maxiter, "ftol": ACCURACY_MM},
    )
    return np.clip(found.x.reshape(CONTROL_POINTS, JOINTS), lower, upper), int(found.nit)


def first_guess(segment: Segment) -> Floats:
    """Control points (7, 5): the line in joint space, the inner ones raised by the lift where the arm reaches that far."""
    t = np.linspace(0.0, 1.0, CONTROL_POINTS)[:, None]
    line = segment.ends[0] + (segment.ends[1] - segment.ends[0]) * t
    r, z = grip_in_plane(segment.scene.planar, line)
    raised = np.empty((CONTROL_POINTS, 3))
    elbow_up(segment.scene.planar, r, z + segment.scene.profile[6] * (t[:, 0] > 0.0) * (t[:, 0] < 1.0), line[:, 1:].sum(axis=1), raised)
    pitches = np.where(np.isnan(raised), line[:, 1:], raised)
    inner = np.clip(pitches, segment.collision_model.limits[1:, 0], segment.collision_model.limits[1:, 1])
    return np.concatenate([line[:, :1], inner, np.zeros((CONTROL_POINTS, 1))], axis=1)


@compiled(error_model="python")
def sample_margins(Q: Floats, scene: Scene, out: Floats) -> None:
    """Fill ``out`` (S, 6) with the fields of :class:`~marl_handover.motion.objective.Margins` of each joint sample of ``Q`` (S, 4)."""
    for i in range(Q.shape[0]):
        dense_margins(Q[i : i + 1], scene, out[i])


def _pose_errors(segment: Segment, points: Floats) -> Floats:
    """How far both ends (2, 5) are from their poses: x, y, z in mm, pitch and roll in rad."""

    def poses(q: Floats) -> Floats:
        r, z = grip_in_plane(segment.scene.planar, q)
        return np.stack([*out_of_plane(segment.scene.planar, r, q[:, 0]), z, q[:, 1:4].sum(axis=1)], axis=1)

    ends = points[[0, -1]]
    return np.concatenate([poses(ends) - poses(segment.ends), ends[:, 4:]], axis=1)


def _kinds(scene: Scene) -> list[int]:
    """Which fields of the margins are about something that is there."""
    there = [scene.arm_rows > 0, scene.arm_rows < len(scene.obstacles), len(scene.pairs) > 0, True, True, len(scene.edges) > 0]
    return [field for field, is_there in enumerate(there) if is_there]
