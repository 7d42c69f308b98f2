"""How near arms come to the table, to each other and to themselves on a way, proved between samples too.

The planner's kernels take wrist roll to be 0, as planned motions have it. What goes to the wire is checked with the roll it has.

A *way* (3, 5 or more) is all joint vectors that an arm may have while it goes it: those between its end ``way[2]`` and the straight line
from ``way[0]`` to ``way[1]``, its beginning if it is on time and if it is late. It is cut into boxes. In a box no point of a capsule comes
farther from where it is in the middle than the joints' greatest changes times their levers, added up, of both arms. What stays clear by
more than that is settled; a box in which something does not is halved, until all is settled or a posture is found that is too near.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.compiled import compiled
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.capsules import block_capsules, capsule_pairs, joints_before
from marl_handover.geometry.kernels import FAR_MM, broad_phase, closest_points
from marl_handover.geometry.urdf import ARM_JOINTS

Ints = NDArray[np.int64]

SETTLED_MM = 0.05
"""What is proved may be nearer than the limit by this much; it ends the halving where something moves along the limit."""

MOST_LOOKS = 10_000
"""A way that so many postures do not settle is taken for one that is too near: some 50 ms of work."""

ANYWHERE, STANDING, DISC = 0.0, 1.0, 2.0
"""What a shape is held against: everything; arms, not the table; the table alone, as a disc, its ends those of its axis."""

_DEEP = 128


class Shapes(NamedTuple):
    """An arm's capsules, packed.

    ``pivots`` (6, 3): origins in mm of the base and the five joints' frames at zero. ``capsules`` (K, 9): number of joints before it, two
    end points in the frame of the last of them, radius, what it is held against. ``pairs`` (P, 2): those that belong to bodies which are
    not neighbours, the one with fewer joints before it first. ``levers`` (K, 5): bounds in mm on how far from each joint's axis any point
    of the segment is, 0 where the joint does not move it. ``reach`` (5,): the greatest of these. ``roll`` (3, 3): its first column is the
    axis of the last joint with all joints at zero, which is along x only of a hand that is level where it picks.
    """

    pivots: Floats
    capsules: Floats
    pairs: Ints
    levers: Floats
    reach: Floats
    roll: Floats


def arm_shapes(model: CellModel, holding: bool = False) -> Shapes:
    """The shapes of a cell's arm, fingers open; ``holding``: and those of the block and its pin in its hand.

    The block is turned about the pin in any way: against arms it is the planner's capsules, against the table the disc around it.
    """
    description = model.arm.description
    capsules, first, second = capsule_pairs(description)
    frames, level = model.arm.link_transforms(np.zeros(5)), joints_before(description)
    pivots = np.stack([np.zeros(3), *(frames[description.joint(name).child][:3, 3] for name in ARM_JOINTS)])
    rows = []
    for capsule in capsules:
        T, number = frames[capsule.link], level[capsule.link]
        ends = [T[:3, :3] @ np.array(end) + T[:3, 3] - pivots[number] for end in (capsule.start_mm, capsule.end_mm)]
        rows.append([number, *ends[0], *ends[1], capsule.radius_mm, ANYWHERE if number >= 2 else STANDING])
    pairs = list(zip(first, second, strict=True))
    if holding:
        block = _block_rows(model, model.arm.fk(np.zeros(5))[:3, 3] - pivots[5])
        # Nothing moves between the block and wrist and hand, but for the roll.
        pairs += [(k, len(rows) + n) for n, row in enumerate(block) if row[8] != DISC for k in range(len(rows)) if rows[k][0] <= 3]
        rows += block
    packed = np.array(rows, float)
    pairs = [(a, b) if packed[a, 0] <= packed[b, 0] else (b, a) for a, b in pairs]
    roll = _roll_frame(model.arm)
    levers = _levers(pivots, packed, roll)
    return Shapes(pivots, packed, np.array(pairs, np.int64).reshape(-1, 2), levers, levers.max(axis=0), roll)


def _roll_frame(arm: ArmModel) -> Floats:
    """See :attr:`Shapes.roll`."""
    turned = arm.fk(np.array([0.0, 0.0, 0.0, 0.0, 0.5]))[:3, :3] @ arm.fk(np.zeros(5))[:3, :3].T
    axis = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    if not axis.any():
        return np.eye(3)  # an arm whose last joint is fixed
    axis /= np.linalg.norm(axis)
    left = np.array([0.0, 1.0, 0.0]) - axis[1] * axis
    left /= np.linalg.norm(left)
    return np.column_stack([axis, left, np.cross(axis, left)])


def still(joints_rad: ArrayLike) -> Floats:
    """The way of an arm that stands at ``joints_rad`` (5,)."""
    return np.tile(np.asarray(joints_rad, float), (3, 1))


def _block_rows(model: CellModel, grip_mm: Floats) -> list[list[float]]:
    """The held block and its pin, in the frame of the last joint, in which the grip is at ``grip_mm`` (3,)."""
    block, drop = model.cell.config.block, model.cell.pick_height_mm
    rows = []
    for shape in block_capsules(block, drop):
        kind = ANYWHERE if shape.link == "pin" else STANDING
        rows.append([5.0, *(grip_mm + shape.start_mm), *(grip_mm + shape.end_mm), shape.radius_mm, kind])
    bottom, top = (grip_mm + [0.0, 0.0, height - drop] for height in (0.0, block.height_mm))
    return [*rows, [5.0, *bottom, *top, block.side_mm / 2 * math.sqrt(2), DISC]]


def _levers(pivots: Floats, capsules: Floats, roll: Floats) -> Floats:
    """See :class:`Shapes`; a disc's are of its rim."""
    levers = np.zeros((len(capsules), 5))
    arms = np.linalg.norm(np.diff(pivots, axis=0), axis=1)
    for row, shape in zip(levers, capsules, strict=True):
        level, ends = int(shape[0]), shape[1:7].reshape(2, 3)
        rim = shape[7] if shape[8] == DISC else 0.0
        for joint in range(1, level + 1):
            row[joint - 1] = arms[joint:level].sum() + np.linalg.norm(ends, axis=1).max() + rim
        if level == 5:  # about the roll axis
            _, left, up = (ends @ roll).T
            row[4] = np.hypot(left, up).max() + rim
        if level == 1:  # about z, as below
            row[0] = np.hypot(ends[:, 0], ends[:, 1]).max() + rim
        if level >= 2:
            row[0] = math.hypot(*pivots[2, :2]) + row[1]
    return levers


@compiled
def place(q: Floats, shapes: Shapes, x: float, y: float, facing: float, out: Floats) -> None:
    """Fill ``out`` (K, 10) with the placed segments, rows as in the planner's kernels, of an arm at joints ``q`` (5,), base at (x, y)."""
    pivots, capsules, B = shapes.pivots, shapes.capsules, shapes.roll
    level_hand = B[0, 0] == 1.0
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
            elif level_hand:  # about x
                R[level, row, 0], R[level, row, 1], R[level, row, 2] = a, c * b + s * d, c * d - s * b
            else:  # about the first column of B
                u = a * B[0, 0] + b * B[1, 0] + d * B[2, 0]
                v = a * B[0, 1] + b * B[1, 1] + d * B[2, 1]
                w = a * B[0, 2] + b * B[1, 2] + d * B[2, 2]
                v, w = c * v + s * w, c * w - s * v
                for axis in range(3):
                    R[level, row, axis] = u * B[axis, 0] + v * B[axis, 1] + w * B[axis, 2]
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
def _middle(way: Floats, box: Floats, first: int, reach: Floats, q: Floats, change: Floats) -> tuple[float, float]:
    """The middle ``q`` (5,) of a box, and the greatest ``change`` (5,) of each joint from there; what each side of it adds to that, in mm.

    ``box[first:]``: how far on the way and how late the middle is, as shares, each followed by half the width of the box.
    """
    on, half_on, late, half_late = box[first], box[first + 1], box[first + 2], box[first + 3]
    along, across = 0.0, 0.0
    for joint in range(5):
        lag = way[1, joint] - way[0, joint]
        start = way[0, joint] + late * lag
        q[joint] = start + on * (way[2, joint] - start)
        by_on = half_on * abs(way[2, joint] - start)
        by_late = half_late * (1.0 - on + half_on) * abs(lag)
        change[joint] = by_on + by_late
        along += by_on * reach[joint]
        across += by_late * reach[joint]
    return along, across


@compiled
def _moved(levers: Floats, k: int, change: Floats, first: int) -> float:
    """How far a point of capsule ``k`` is moved at most, in mm, by the joints from number ``first`` on."""
    mm = 0.0
    for joint in range(first, 5):
        mm += levers[k, joint] * change[joint]
    return mm


@compiled
def _halve(stack: Floats, waiting: int, side: int) -> None:
    """Put both halves of the box in row ``waiting`` there and into the next row, cut across ``side``."""
    stack[waiting + 1] = stack[waiting]
    half = 0.5 * stack[waiting, side + 1]
    for child in range(2):
        stack[waiting + child, side] += half if child else -half
        stack[waiting + child, side + 1] = half


@compiled
def _height(placed: Floats, shapes: Shapes, k: int) -> float:
    """How high the lowest point of shape ``k`` is."""
    low = min(placed[k, 2], placed[k, 5])
    if shapes.capsules[k, 8] != DISC:
        return low - shapes.capsules[k, 7]
    upright = (placed[k, 5] - placed[k, 2]) / max(2.0 * placed[k, 9], 1e-9)
    return low - shapes.capsules[k, 7] * math.sqrt(max(1.0 - upright * upright, 0.0))


@compiled
def _look_alone(placed: Floats, shapes: Shapes, change: Floats, limits: Floats, gaps: Floats, point: Floats) -> float:
    """Lower ``gaps`` (3,) to what one posture has; by how much, negative, its box may be below a limit, 0 if it is proved not to be."""
    capsules, pairs, levers, worst = shapes.capsules, shapes.pairs, shapes.levers, 0.0
    for k in range(capsules.shape[0]):
        if capsules[k, 8] != STANDING:
            which = 2 if capsules[k, 8] == DISC else 0
            height = _height(placed, shapes, k)
            gaps[which] = min(gaps[which], height)
            worst = min(worst, height - _moved(levers, k, change, 1) - limits[which])
    for n in range(pairs.shape[0]):
        a, b = pairs[n, 0], pairs[n, 1]
        # Joints before both turn both.
        need, moved = capsules[a, 7] + capsules[b, 7], _moved(levers, b, change, int(capsules[a, 0]))
        if not broad_phase(placed, a, placed, b, need + limits[1] + moved):
            gap = closest_points(placed, a, placed, b, point) - need
            gaps[1] = min(gaps[1], gap)
            worst = min(worst, gap - moved - limits[1])
    return worst


@compiled
def alone_mm(way: Floats, shapes: Shapes, limits: Floats, gaps: Floats) -> None:
    """Fill ``gaps`` (3,): height over the table of the links after the turret, distance of the arm to itself, height of the held block.

    On a ``way`` (3, 5). One that is not below its limit in ``limits`` (3,) is proved to be nowhere below it by more than
    :data:`SETTLED_MM`; one that is, is of a posture on the way, or it is what could be proved. All are exact of an arm that stands and
    limits of :data:`FAR_MM`.
    """
    stack, q, change, point = np.empty((_DEEP, 4)), np.empty(5), np.empty(5), np.empty(6)
    placed = np.empty((shapes.capsules.shape[0], 10))
    gaps[:] = FAR_MM
    stack[0] = 0.5
    waiting, looks = 1, 0
    while waiting > 0:
        waiting -= 1
        looks += 1
        along, across = _middle(way, stack[waiting], 0, shapes.reach, q, change)
        place(q, shapes, 0.0, 0.0, 0.0, placed)
        worst = _look_alone(placed, shapes, change, limits, gaps, point)
        if (gaps < limits).any():
            return
        if worst >= -SETTLED_MM:
            continue
        if looks >= MOST_LOOKS:
            gaps[:] = limits + worst
            return
        _halve(stack, waiting, 0 if along >= across else 2)
        waiting += 2


@compiled
def _look_between(
    first: Floats, second: Floats, shapes: Shapes, others: Shapes, change: Floats, change_other: Floats, limit_mm: float, point: Floats
) -> tuple[float, float]:
    """What two placed arms are apart, as far as it matters; by how much, negative, their box may be below the limit, 0 if it is not."""
    a_capsules, b_capsules, gap, worst = shapes.capsules, others.capsules, FAR_MM, 0.0
    moved_other = np.empty(b_capsules.shape[0])
    for b in range(b_capsules.shape[0]):
        moved_other[b] = _moved(others.levers, b, change_other, 0)
    for a in range(a_capsules.shape[0]):
        if a_capsules[a, 8] == DISC:
            continue
        moved_own = _moved(shapes.levers, a, change, 0)
        for b in range(b_capsules.shape[0]):
            need, moved = a_capsules[a, 7] + b_capsules[b, 7], moved_own + moved_other[b]
            if b_capsules[b, 8] != DISC and not broad_phase(first, a, second, b, need + limit_mm + moved):
                apart = closest_points(first, a, second, b, point) - need
                gap = min(gap, apart)
                worst = min(worst, apart - moved - limit_mm)
    return gap, worst


@compiled
def between_mm(
    way: Floats, other: Floats, together: bool, shapes: Shapes, others: Shapes, base: Floats, other_base: Floats, limit_mm: float
) -> float:
    """Distance of two arms on their ways (3, 5); bases are (x, y, facing). To be read as those of :func:`alone_mm`.

    If they move ``together`` both are as far on their ways, and as late, at any moment; else each may be anywhere on its own.
    """
    stack, point = np.empty((_DEEP, 8)), np.empty(6)
    q, change, q_other, change_other = np.empty(5), np.empty(5), np.empty(5), np.empty(5)
    first, second = np.empty((shapes.capsules.shape[0], 10)), np.empty((others.capsules.shape[0], 10))
    stack[0] = 0.5
    sides, least, waiting, looks = np.empty(4), FAR_MM, 1, 0
    while waiting > 0:
        waiting -= 1
        looks += 1
        sides[0], sides[1] = _middle(way, stack[waiting], 0, shapes.reach, q, change)
        sides[2], sides[3] = _middle(other, stack[waiting], 0 if together else 4, others.reach, q_other, change_other)
        place(q, shapes, base[0], base[1], base[2], first)
        place(q_other, others, other_base[0], other_base[1], other_base[2], second)
        gap, worst = _look_between(first, second, shapes, others, change, change_other, limit_mm, point)
        least = min(least, gap)
        if least < limit_mm:
            return least
        if worst >= -SETTLED_MM:
            continue
        if looks >= MOST_LOOKS:
            return limit_mm + worst
        if together:
            sides[:2] += sides[2:]
            sides[2:] = 0.0
        _halve(stack, waiting, 2 * int(np.argmax(sides)))
        waiting += 2
    return least
