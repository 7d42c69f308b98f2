"""How near arms come to the table, to each other and to themselves, in any posture: a few microseconds a posture.

The planner's kernels take wrist roll to be 0, as planned motions have it. What goes to the wire is checked with the roll it has.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.build import CellModel
from marl_handover.compiled import compiled
from marl_handover.geometry.capsules import capsule_pairs, joints_before
from marl_handover.geometry.kernels import FAR_MM, broad_phase, closest_points
from marl_handover.geometry.urdf import ARM_JOINTS

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Shapes(NamedTuple):
    """An arm's capsules, packed.

    ``pivots`` (6, 3): origins in mm of the base and the five joints' frames at zero. ``capsules`` (K, 8): number of joints before it, two
    end points in the frame of the last of them, radius. ``pairs`` (P, 2): those that belong to bodies which are not neighbours.
    """

    pivots: Floats
    capsules: Floats
    pairs: Ints


def arm_shapes(model: CellModel) -> Shapes:
    """The shapes of a cell's arm, fingers open."""
    description = model.arm.description
    capsules, first, second = capsule_pairs(description)
    frames, level = model.arm.link_transforms(np.zeros(5)), joints_before(description)
    pivots = np.stack([np.zeros(3), *(frames[description.joint(name).child][:3, 3] for name in ARM_JOINTS)])
    rows = []
    for capsule in capsules:
        T, number = frames[capsule.link], level[capsule.link]
        ends = [T[:3, :3] @ np.array(end) + T[:3, 3] - pivots[number] for end in (capsule.start_mm, capsule.end_mm)]
        rows.append([number, *ends[0], *ends[1], capsule.radius_mm])
    return Shapes(pivots, np.array(rows, float), np.stack([first, second], axis=1).astype(np.int64))


@compiled
def place(q: Floats, shapes: Shapes, x: float, y: float, facing: float, out: Floats) -> None:
    """Fill ``out`` (K, 10) with the placed segments, rows as in the planner's kernels, of an arm at joints ``q`` (5,), base at (x, y)."""
    pivots, capsules = shapes.pivots, shapes.capsules
    R, p = np.empty((6, 3, 3)), np.empty((6, 3))
    cf, sf = math.cos(facing), math.sin(facing)
    R[0] = np.eye(3)
    R[0, 0, 0], R[0, 0, 1], R[0, 1, 0], R[0, 1, 1] = cf, -sf, sf, cf
    p[0, 0], p[0, 1], p[0, 2] = x, y, 0.0
    for level in range(1, 6):
        c, s = math.cos(q[level - 1]), math.sin(q[level - 1])
        for row in range(3):
            a, b, d = R[level - 1, row, 0], R[level - 1, row, 1], R[level - 1, row, 2]
            p[level, row] = p[level - 1, row]
            for axis in range(3):
                p[level, row] += R[level - 1, row, axis] * (pivots[level, axis] - pivots[level - 1, axis])
            if level == 1:  # about z
                R[level, row, 0], R[level, row, 1], R[level, row, 2] = c * a + s * b, c * b - s * a, d
            elif level < 5:  # about -y: positive lifts
                R[level, row, 0], R[level, row, 1], R[level, row, 2] = c * a + s * d, b, c * d - s * a
            else:  # about x
                R[level, row, 0], R[level, row, 1], R[level, row, 2] = a, c * b + s * d, c * d - s * b
    for k in range(capsules.shape[0]):
        level, square = int(capsules[k, 0]), 0.0
        for row in range(3):
            for e in range(2):
                value = p[level, row]
                for axis in range(3):
                    value += R[level, row, axis] * capsules[k, 1 + 3 * e + axis]
                out[k, 3 * e + row] = value
            out[k, 6 + row] = 0.5 * (out[k, row] + out[k, 3 + row])
            square += (out[k, 3 + row] - out[k, row]) ** 2
        out[k, 9] = 0.5 * math.sqrt(square)


@compiled
def alone_mm(Q: Floats, shapes: Shapes, out: Floats) -> None:
    """Fill ``out`` (2,): smallest height over the table of the links after the turret, and smallest distance of the arm to itself.

    Over the joint samples ``Q`` (S, 5).
    """
    capsules, pairs = shapes.capsules, shapes.pairs
    placed, point = np.empty((capsules.shape[0], 10)), np.empty(6)
    out[0], out[1] = FAR_MM, FAR_MM
    for i in range(Q.shape[0]):
        place(Q[i], shapes, 0.0, 0.0, 0.0, placed)
        for k in range(capsules.shape[0]):
            if capsules[k, 0] >= 2.0:
                out[0] = min(out[0], min(placed[k, 2], placed[k, 5]) - capsules[k, 7])
        for n in range(pairs.shape[0]):
            a, b = pairs[n, 0], pairs[n, 1]
            need = capsules[a, 7] + capsules[b, 7]
            if not broad_phase(placed, a, placed, b, need + out[1]):
                out[1] = min(out[1], closest_points(placed, a, placed, b, point) - need)


@compiled
def between_mm(Q: Floats, others: Floats, together: bool, shapes: Shapes, base: Floats, other_base: Floats) -> float:
    """Smallest distance of two arms over their joint samples ``Q`` (S, 5) and ``others`` (N, 5); bases are (x, y, facing).

    Samples are taken in pairs if the arms move ``together`` (S = N), else each with each.
    """
    capsules = shapes.capsules
    K, N, best = capsules.shape[0], others.shape[0], FAR_MM
    first, second, point = np.empty((K, 10)), np.empty((N, K, 10)), np.empty(6)
    for j in range(N):
        place(others[j], shapes, other_base[0], other_base[1], other_base[2], second[j])
    for i in range(Q.shape[0]):
        place(Q[i], shapes, base[0], base[1], base[2], first)
        for j in range(i if together else 0, i + 1 if together else N):
            for a in range(K):
                for b in range(K):
                    need = capsules[a, 7] + capsules[b, 7]
                    if not broad_phase(first, a, second[j], b, need + best):
                        best = min(best, closest_points(first, a, second[j], b, point) - need)
    return best
