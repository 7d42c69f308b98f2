"""Overlapping transfers: the next arm sets out while the one before still moves, as early as their clearance allows.

The paths stay as they are; only the start of each cycle is moved. On a common clock the two motions keep the demanded clearance at every
time: at a sample more is asked by what both arms can move until half-way to the next. (The delay search of coordination diagrams:
O'Donnell and Lozano-Perez, "Deadlock-free and collision-free coordination of two robot manipulators", ICRA 1989.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled
from marl_handover.geometry.kernels import FAR_MM, broad_phase, closest_points, world_shapes
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import LOADED_PHASES, Phase, TransferMotion

Floats = NDArray[np.float64]

WITH_BLOCK = (*LOADED_PHASES, "release")
"""Phases in which the block is counted as part of the arm."""


class Schedule(NamedTuple):
    """When each cycle of a sequence starts, and how long the whole takes, one after another and overlapped, in s."""

    starts_s: tuple[float, ...]
    sequential_s: float
    overlapped_s: float

    @property
    def saved(self) -> float:
        """Share of the time that is saved."""
        return 1.0 - self.overlapped_s / self.sequential_s if self.sequential_s else 0.0


def coordinate(planner: MotionPlanner, motions: Sequence[TransferMotion]) -> Schedule:
    """The earliest starts of cycles that follow each other.

    A cycle of the same arm starts when the one before has ended. A cycle of the other arm may start earlier, as long as the arms keep
    ``arm_clearance_mm``, and grasps only after the block was released. It never starts before the cycle two before it has ended, so that
    at most two arms move.
    """
    starts: list[float] = []
    ends: list[float] = []
    for index, motion in enumerate(motions):
        start = ends[-1] if ends else 0.0
        if index and motion.arm != motions[index - 1].arm:
            before = motions[index - 1]
            floor = ends[index - 2] if index > 1 else 0.0
            start = max(floor, starts[-1] + earliest_start_s(planner, before, motion))
        starts.append(start)
        ends.append(start + motion.duration_s)
    return Schedule(tuple(starts), sum(motion.duration_s for motion in motions), max(ends, default=0.0))


def earliest_start_s(planner: MotionPlanner, before: TransferMotion, motion: TransferMotion) -> float:
    """How long after the start of ``before`` the other arm's ``motion`` may start, in s; not after the end of ``before``.

    Until it starts, its arm holds still where its approach begins; after its end, the arm before is parked.
    """
    step = planner.motion.sample_s
    first, counts, moved = _placed(planner, before, step)
    second, others, moving = _placed(planner, motion, step)
    gaps = pairwise_clearance(first, counts, second, others)
    clear = gaps >= planner.motion.arm_clearance_mm + (moved[:, None] + moving[None, :]) / 2
    least = math.ceil((_end_of(before.phases, "release") - _end_of(motion.phases, "approach")) / step)
    for delay in range(len(clear) - 1, max(least, 0) - 1, -1):
        if not _free(clear, delay):
            return min((delay + 1) * step, before.duration_s)
    return max(least, 0) * step


def pairwise_clearance(first: Floats, counts: NDArray[np.int64], second: Floats, others: NDArray[np.int64]) -> Floats:
    """Smallest distance in mm (n, m) between two arms' shapes at each pair of samples.

    Args:
        first: (n, K, 11) placed segments in the world, radius last.
        counts: (n,) how many of them count at each sample.
        second: (m, K, 11), the other arm's.
        others: (m,).
    """
    return np.asarray(_clearances(first, counts, second, others))


def _free(clear: NDArray[np.bool_], delay: int) -> bool:
    """Whether a start ``delay`` samples later is clear at all times until the arm before is parked."""
    times = np.arange(len(clear))
    return bool(clear[times, np.clip(times - delay, 0, len(clear[0]) - 1)].all())


def _placed(planner: MotionPlanner, motion: TransferMotion, step: float) -> tuple[Floats, NDArray[np.int64], Floats]:
    """World shapes of an arm along its cycle at even times; how many of them count, the block's only while it is held; and a bound in mm
    on how far any of them moves from each sample to the next or from the one before.
    """
    phases = motion.phases
    t = np.concatenate([phase.t_s for phase in phases])
    q = np.concatenate([phase.joints_rad for phase in phases])
    times = np.minimum(np.arange(math.ceil((t[-1] - t[0]) / step) + 1) * step + t[0], t[-1])
    joints = np.stack([np.interp(times, t, q[:, joint]) for joint in range(4)], axis=-1)
    names = np.array([phase.name for phase in phases])
    at = np.searchsorted([phase.t_s[-1] for phase in phases], times - 1e-9).clip(max=len(phases) - 1)
    body = planner.collision_models[motion.arm]
    bare, held = len(body.capsules), len(body.held)
    counts = np.where(np.isin(names[at], WITH_BLOCK), held, bare)
    base = planner.model.cell.bases[motion.arm]
    shapes = world_shapes(joints, body.planar, body.held, base.x_mm, base.y_mm, base.facing_rad)
    moves = np.abs(np.diff(joints, axis=0)) @ body.levers_mm
    return shapes, counts, np.maximum(np.append(moves, 0.0), np.append(0.0, moves))


def _end_of(phases: Sequence[Phase], name: str) -> float:
    """When a phase of a cycle ends, from the cycle's start on."""
    return float(next(phase for phase in phases if phase.name == name).t_s[-1] - phases[0].t_s[0])


@compiled(error_model="python")
def _clearances(first: Floats, counts: NDArray[np.int64], second: Floats, others: NDArray[np.int64]) -> Floats:
    out, point = np.empty((first.shape[0], second.shape[0])), np.empty(6)
    for i in range(first.shape[0]):
        for j in range(second.shape[0]):
            least, A, B = FAR_MM, first[i], second[j]
            for a in range(counts[i]):
                for b in range(others[j]):
                    need = A[a, 10] + B[b, 10]
                    if not broad_phase(A, a, B, b, need + least):
                        least = min(least, closest_points(A, a, B, b, point) - need)
            out[i, j] = least
    return out
