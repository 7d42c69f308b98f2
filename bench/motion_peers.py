"""What motion planning is compared with, each on some rows of the committed transfers: the paper's program, OMPL, toppra."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from ompl_planner import STEP_RAD, OmplMissing, rrt_connect
from scipy.interpolate import BSpline

from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.motion.path_optimizer import FoundPath, NoPath, Segment
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.slsqp_planner import plan_slsqp
from marl_handover.motion.time_parametrization import time_path
from marl_handover.motion.trajectory import knots

TOLERANCE_MM, OMPL_S, REPEATS = 1.0, 5.0, 3


def spread(values: Sequence[float], digits: int = 4) -> dict[str, float]:
    """Median, 95th percentile and largest."""
    p50, p95, most = np.percentile(values, [50, 95, 100]) if len(values) else [math.nan] * 3
    return {"median": round(float(p50), digits), "p95": round(float(p95), digits), "worst": round(float(most), digits)}


class Timed(NamedTuple):
    """What a call gave, and how long it took by the clock and of a processor."""

    found: Any
    ms: float
    cpu_ms: float


def timed(work: Callable[[], Any]) -> Timed:
    """Call ``work``; a refusal is an answer too."""
    began, began_cpu = time.perf_counter(), time.process_time()
    try:
        found = work()
    except NoPath as refused:
        found = refused
    return Timed(found, 1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - began_cpu))


def arguments(row: dict[str, Any]) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """A row as the planner takes it."""
    return row["arm"], np.array(row["pick_mm"]), np.array(row["place_mm"]), np.array(row["other_rad"])


def against_paper(planner: MotionPlanner, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The paper's program and our planner on the same rows, one after the other."""
    ours, theirs = [], []
    plan_slsqp(planner.carrying(*arguments(rows[0]))[0], maxiter=2, tolerance_mm=math.inf)
    for row in rows:
        ours.append(timed(lambda row=row: planner.transfer(*arguments(row))))
        segment = planner.carrying(*arguments(row))[0]
        theirs.append(timed(lambda segment=segment: plan_slsqp(segment, tolerance_mm=TOLERANCE_MM)))
    shortfalls = [max(0.0, -it.found.margins.worst) for it in theirs if isinstance(it.found, FoundPath)]
    both = [
        (a.found, b.found) for a, b in zip(theirs, ours, strict=True) if isinstance(a.found, FoundPath) and isinstance(b.found, FoundPath)
    ]
    paper_ms, ours_ms = spread([it.ms for it in theirs], 1), spread([it.ms for it in ours], 2)
    paper_cpu, ours_cpu = (float(np.median([it.cpu_ms for it in those])) for those in (theirs, ours))
    return {
        "rows": len(rows),
        "paper_ms": paper_ms,
        "ours_ms": ours_ms,
        "times_faster": round(paper_ms["median"] / ours_ms["median"], 1),
        "times_faster_cpu": round(paper_cpu / ours_cpu, 1),
        "paper_found_within_1_mm": len(shortfalls),
        "paper_found_without_tolerance": sum(shortfall == 0.0 for shortfall in shortfalls),
        "paper_shortfall_mm": spread(shortfalls, 3),
        "paper_length_over_ours": spread([paper.length_mm / mine.length_mm for paper, mine in both]),
    }


def against_ompl(planner: MotionPlanner, rows: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """RRT-Connect, then OMPL's simplification, under the same demands at every configuration."""
    ways, ours, ratios = [], [], []
    for number, row in enumerate(rows):
        segment = planner.carrying(*arguments(row))[0]
        try:
            ways.append(timed(lambda segment=segment, number=number: ompl_way(segment, number)))
        except OmplMissing as missing:
            print(f"OMPL left out: {missing}")
            return None
        ours.append(timed(lambda row=row: planner.transfer(*arguments(row))))
        if ways[-1].found is not None and isinstance(ours[-1].found, FoundPath):
            ratios.append(segment.check(dense(ways[-1].found))[1] / ours[-1].found.length_mm)
    return {
        "rows": len(rows),
        "found": sum(way.found is not None for way in ways),
        "ompl_ms": spread([way.ms for way in ways], 1),
        "ours_ms": spread([it.ms for it in ours], 2),
        "ompl_length_over_ours": spread(ratios),
    }


def ompl_way(segment: Segment, seed: int) -> np.ndarray | None:
    """Corners (k, 4) of a way that keeps all demands."""
    low, high = segment.collision_model.limits.T
    return rrt_connect(*segment.ends, lambda q: segment.check(q[None])[0].worst >= 0.0, low, high, seconds=OMPL_S, seed=seed)


def dense(corners: np.ndarray) -> np.ndarray:
    """Samples (n, 4) of the polyline through ``corners``, at most ``STEP_RAD`` apart."""
    pieces = [corners[:1]]
    for a, b in pairwise(corners):
        count = max(1, math.ceil(float(np.linalg.norm(b - a)) / STEP_RAD))
        pieces.append(a + (b - a) * np.linspace(0.0, 1.0, count + 1)[1:, None])
    return np.concatenate(pieces)


def against_toppra(planner: MotionPlanner, paths: Sequence[np.ndarray]) -> dict[str, Any]:
    """Timing of found paths, control points (N, 5), beside toppra's with 100 and 500 grid intervals."""
    motion, arm = planner.motion, planner.model.arm
    velocity = motion.velocity_scale * np.array([arm.description.joint(name).velocity for name in ARM_JOINTS])
    acceleration = np.full(len(ARM_JOINTS), math.radians(motion.acceleration_deg_s2))
    limits = (velocity, acceleration)
    time_path(paths[0], motion.degree, *limits, motion.sample_s)
    runs = [
        [timed(lambda points=points: time_path(points, motion.degree, *limits, motion.sample_s)) for _ in range(REPEATS)]
        for points in paths
    ]
    durations = [float(those[0].found.t_s[-1]) for those in runs]
    found: dict[str, Any] = {"paths": len(paths), "ours_ms": spread([float(np.median([it.ms for it in those])) for those in runs])}
    try:
        toppra_s(paths[0], motion.degree, *limits, 10)
    except ImportError as missing:
        print(f"toppra left out: {missing}")
        return found
    for grid in (100, 500):
        theirs = [timed(lambda points=points, grid=grid: toppra_s(points, motion.degree, *limits, grid)) for points in paths]
        found[f"toppra_{grid}_ms"] = spread([it.ms for it in theirs])
        found[f"duration_over_toppra_{grid}"] = spread([mine / it.found for mine, it in zip(durations, theirs, strict=True)])
    return found


def toppra_s(points: np.ndarray, degree: int, velocity: np.ndarray, acceleration: np.ndarray, grid: int) -> float:
    """Duration of toppra's motion along the spline, from rest to rest, its own problem set up included."""
    import toppra

    limits = [
        toppra.constraint.JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        toppra.constraint.JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
    ]
    spline = BSpline(knots(len(points), degree), points, degree)

    class Path(toppra.interpolator.AbstractGeometricPath):
        path_interval, waypoints, dof = np.array([0.0, 1.0]), None, points.shape[1]
        derivatives = (spline, spline.derivative(1), spline.derivative(2))

        def __call__(self, tau: np.ndarray, order: int = 0) -> np.ndarray:
            return self.derivatives[order](tau)

    tau = np.linspace(0.0, 1.0, grid + 1)
    problem = toppra.algorithm.TOPPRA(limits, Path(), gridpoints=tau, solver_wrapper="seidel")
    speeds = problem.compute_parameterization(0.0, 0.0, return_data=True)[1]
    return float(np.sum(2.0 / grid / (speeds[1:] + speeds[:-1])))
