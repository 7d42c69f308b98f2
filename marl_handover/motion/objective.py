"""Compiled cost of a path and what it violates: the augmented Lagrangian that the optimiser descends, with its gradient.

Each sample of a path has C constraints c <= 0, in mm, in this order (K capsules, P self pairs, E edges):

* K: clearance of each capsule to the nearest obstacle;
* P: clearance of each pair of the arm's own bodies;
* K: clearance of each capsule to the table (nothing is asked of base, turret and what is held);
* 1: height of the grip over the lift-over profile;
* E: height of each of the held block's edges over the table, demanded as the profile rises.

And the dense check of a path, without any tolerance: clearances, heights and length at many samples.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled
from marl_handover.geometry.kernels import (
    FAR_MM,
    at_wrist,
    broad_phase,
    closest_points,
    forward_kinematics,
    hand_ball,
    hand_is_away,
    into_arm_plane,
    jacobian_transpose,
    place_capsules,
)
from marl_handover.motion.collision_model import Scene

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEVER_MM = 100.0
"""What one radian counts in mm where joint angles enter a cost or a limit."""

ROUNDING_MM = 1e-6
"""Heights that are met exactly at an end, such as a block standing on the table, may fall short by this much."""

COARSE = 25
"""The coarse pass looks at every 25th sample."""


class Penalty(NamedTuple):
    """What violations cost: multipliers ``lam`` (S, C), penalty ``rho`` per mm; ``step`` (S - 1,), the samples' distances in tau.

    ``weights`` (2,): of even speed and of joint motion, beside the length.
    """

    lam: Floats
    rho: float
    step: Floats
    weights: Floats


@compiled
def columns(scene: Scene) -> int:
    """How many constraints a sample has."""
    return 2 * scene.capsules.shape[0] + scene.pairs.shape[0] + 1 + scene.edges.shape[0]


@compiled
def first_moving(capsules: Floats) -> int:
    """Index of the first capsule that is neither base nor turret."""
    first = 0
    while first < capsules.shape[0] and capsules[first, 0] < 2.0:
        first += 1
    return first


@compiled
def ramp(x: float, y: float, profile: Floats, out: Floats) -> None:
    """The lift-over ramp at (x, y): ``out`` (3,) its value 0..1 and its gradient.

    The value is the product of 1 - exp(-s^2 / scale^2) over the ends, s being the horizontal distance to it: a function of place, not of
    tau, so that an optimiser cannot meet it by dwelling somewhere.
    """
    value, gx, gy = 1.0, 0.0, 0.0
    for end in range(2):
        scale = profile[4 + end]
        if scale <= 0.0:
            continue
        dx, dy = x - profile[2 * end], y - profile[2 * end + 1]
        near = math.exp(-(dx * dx + dy * dy) / (scale * scale))
        slope = 2.0 * near / (scale * scale)
        gx, gy = gx * (1.0 - near) + value * slope * dx, gy * (1.0 - near) + value * slope * dy
        value *= 1.0 - near
    out[0], out[1], out[2] = value, gx, gy


@compiled
def lagrangian(Q: Floats, scene: Scene, penalties: Penalty, grad: Floats, values: Floats) -> float:
    """Cost + penalty of joint samples ``Q`` (S, 4); fills ``grad`` (S, 4) and the constraints ``values`` (S, C) (-FAR_MM: inactive)."""
    # Out of the tuples once: each look into one costs a reference count, here and in every function it is handed to.
    planar, capsules, pairs, obstacles, group = scene.planar, scene.capsules, scene.pairs, scene.obstacles, scene.group
    clearance, edges, profile, lam, rho = scene.clearance, scene.edges, scene.profile, penalties.lam, penalties.rho
    samples, K, P = Q.shape[0], capsules.shape[0], pairs.shape[0]
    frames, grip, ends, point, slope = np.empty((samples, 5, 4)), np.empty((samples, 3)), np.empty((K, 10)), np.empty(6), np.empty(3)
    worst, contact, placed, close = np.empty(K), np.empty((K, 6)), np.empty((1, 10)), np.empty(K, np.int64)
    first, grouped, aside = first_moving(capsules), 0, planar[8]
    while grouped < P and pairs[grouped, 0] < first and capsules[pairs[grouped, 1], 0] >= 4.0:
        grouped += 1
    grad[:, :] = 0.0
    values[:, :] = -FAR_MM
    penalty = 0.0
    for i in range(samples):
        forward_kinematics(planar, Q, i, frames, i)
        r, z = at_wrist(frames, i, planar[6], planar[7])
        cy, sy = math.cos(Q[i, 0]), math.sin(Q[i, 0])
        grip[i, 0], grip[i, 1], grip[i, 2] = r * cy - aside * sy, r * sy + aside * cy, z
        if i == 0 or i == samples - 1:
            continue  # the ends are given
        place_capsules(capsules, Q[i, 0], frames, i, ends)
        if obstacles.shape[0] > 0:
            penalty += _obstacles(
                i, cy, sy, first, capsules, obstacles, group, lam, rho, frames, ends, worst, contact, placed, point, close, grad, values
            )
        penalty += _itself(i, grouped, planar, capsules, pairs, clearance[0], lam, rho, frames, ends, point, grad, values)
        penalty += _table(i, first, scene.carried, P, capsules, clearance[1], lam, rho, frames, ends, grad, values)
        ramp(grip[i, 0], grip[i, 1], profile, slope)
        sr, st = slope[1] * cy + slope[2] * sy, slope[2] * cy - slope[1] * sy
        before = 2 * K + P
        penalty += _height(
            i, before, r, z, r, aside, z, scene.pick_height + profile[6] * slope[0], profile[6], sr, st, lam, rho, frames, grad, values
        )
        for e in range(edges.shape[0]):
            er, ez = at_wrist(frames, i, edges[e, 0], edges[e, 1])
            penalty += _height(
                i, before + 1 + e, er, ez, r, aside, z, profile[7] * slope[0], profile[7], sr, st, lam, rho, frames, grad, values
            )
    return penalty + _length(Q, planar, penalties.step, penalties.weights, frames, grip, grad)


@compiled
def _charge(held: float, rho: float, over: float) -> float:
    """The force h = max(0, lambda + rho c) of a constraint; its penalty is h^2 / (2 rho)."""
    return max(0.0, held + rho * over)


@compiled
def _obstacles(
    i: int, cy: float, sy: float, first: int, capsules: Floats, obstacles: Floats, group: Floats, lam: Floats, rho: float, frames: Floats,
    ends: Floats, worst: Floats, contact: Floats, placed: Floats, point: Floats, close: Ints, grad: Floats, values: Floats,
) -> float:  # fmt: skip
    """Each capsule against the obstacle it is nearest to; those that are surely away, multipliers included, are skipped."""
    count = 0
    gr, gt = cy * group[0] + sy * group[1], cy * group[1] - sy * group[0]
    for k in range(first, ends.shape[0]):
        worst[k] = -lam[i, k] / rho
        dx, dy, dz = ends[k, 6] - gr, ends[k, 7] - gt, ends[k, 8] - group[2]
        away = group[3] + ends[k, 9] + capsules[k, 7] + group[4] - worst[k]
        if dx * dx + dy * dy + dz * dz < away * away:
            close[count] = k
            count += 1
    if count == 0:
        return 0.0
    for j in range(obstacles.shape[0]):
        into_arm_plane(obstacles, j, cy, sy, placed, 0)
        for index in range(count):
            k = close[index]
            need = obstacles[j, 6] + obstacles[j, 7] + capsules[k, 7]
            if broad_phase(ends, k, placed, 0, need - worst[k]):
                continue
            over = need - closest_points(ends, k, placed, 0, point)
            if over > worst[k]:
                worst[k] = over
                values[i, k] = over
                for axis in range(6):
                    contact[k, axis] = point[axis]
    penalty = 0.0
    for index in range(count):
        k = close[index]
        if values[i, k] <= -FAR_MM:
            continue
        h = _charge(lam[i, k], rho, values[i, k])
        penalty += 0.5 * h * h / rho
        c = contact
        jacobian_transpose(frames, i, int(capsules[k, 0]), c[k, 0], c[k, 1], c[k, 2], c[k, 3], c[k, 4], c[k, 5], -h, grad)
    return penalty


@compiled
def _itself(
    i: int, grouped: int, planar: Floats, capsules: Floats, pairs: Ints, clearance: float, lam: Floats, rho: float, frames: Floats,
    ends: Floats, point: Floats, grad: Floats, values: Floats,
) -> float:  # fmt: skip
    """Each pair of the arm's own bodies. The first ``grouped`` pairs are skipped together where the whole hand is away from the base."""
    K, penalty, start = capsules.shape[0], 0.0, 0
    if grouped and hand_is_away(planar, frames, i, clearance):
        start = grouped
        for p in range(grouped):
            if lam[i, K + p] > 0.0:
                start = 0
                break
    for p in range(start, pairs.shape[0]):
        a, b, held = pairs[p, 0], pairs[p, 1], lam[i, K + p]
        need = clearance + capsules[a, 7] + capsules[b, 7]
        if broad_phase(ends, a, ends, b, need + held / rho):
            continue
        distance = closest_points(ends, a, ends, b, point)
        values[i, K + p] = need - distance
        h = _charge(held, rho, need - distance)
        if h > 0.0:
            penalty += 0.5 * h * h / rho
            jacobian_transpose(frames, i, int(capsules[a, 0]), point[0], point[1], point[2], point[3], point[4], point[5], -h, grad)
            r, t, z = point[0] - distance * point[3], point[1] - distance * point[4], point[2] - distance * point[5]
            jacobian_transpose(frames, i, int(capsules[b, 0]), r, t, z, point[3], point[4], point[5], h, grad)
    return penalty


@compiled
def _table(
    i: int, first: int, carried: int, P: int, capsules: Floats, clearance: float, lam: Floats, rho: float, frames: Floats, ends: Floats,
    grad: Floats, values: Floats,
) -> float:  # fmt: skip
    """Each of the arm's capsules against the table."""
    penalty, before = 0.0, capsules.shape[0] + P
    for k in range(first, carried):
        e = 0 if ends[k, 2] < ends[k, 5] else 3
        over = clearance + capsules[k, 7] - ends[k, e + 2]
        h = _charge(lam[i, before + k], rho, over)
        if h > 0.0:
            values[i, before + k] = over
            penalty += 0.5 * h * h / rho
            jacobian_transpose(frames, i, int(capsules[k, 0]), ends[k, e], ends[k, e + 1], ends[k, e + 2], 0.0, 0.0, 1.0, -h, grad)
    return penalty


@compiled
def _height(
    i: int, column: int, pr: float, pz: float, r: float, t: float, z: float, demanded: float, rise: float, sr: float, st: float,
    lam: Floats, rho: float, frames: Floats, grad: Floats, values: Floats,
) -> float:  # fmt: skip
    """A point (pr, pz) of the hand over a height that depends on where the grip (r, t, z) is: ``rise`` x (sr, st) is its slope."""
    over = demanded - pz
    values[i, column] = over
    h = _charge(lam[i, column], rho, over)
    if h > 0.0:
        jacobian_transpose(frames, i, 4, pr, 0.0, pz, 0.0, 0.0, 1.0, -h, grad)
        jacobian_transpose(frames, i, 4, r, t, z, sr, st, 0.0, h * rise, grad)
    return 0.5 * h * h / rho


@compiled
def _length(Q: Floats, planar: Floats, step: Floats, weights: Floats, frames: Floats, grip: Floats, grad: Floats) -> float:
    """Length of the grip's path, with a little for uneven speed and for joint motion; adds its gradient to ``grad``."""
    samples = Q.shape[0]
    length, square, joints = 0.0, 0.0, 0.0
    for i in range(samples - 1):
        dx, dy, dz = grip[i + 1, 0] - grip[i, 0], grip[i + 1, 1] - grip[i, 1], grip[i + 1, 2] - grip[i, 2]
        d = math.sqrt(dx * dx + dy * dy + dz * dz + 1e-12)
        length += d
        square += d * d / step[i]
        for j in range(4):
            joints += (Q[i + 1, j] - Q[i, j]) ** 2 / step[i]
    # Both are at least the length, and equal to it at even speed.
    even, turning = math.sqrt(square), LEVER_MM * math.sqrt(joints + 1e-12)
    px, py, pz = 0.0, 0.0, 0.0  # what the step before pulls at this sample with
    for i in range(samples - 1):
        dx, dy, dz = grip[i + 1, 0] - grip[i, 0], grip[i + 1, 1] - grip[i, 1], grip[i + 1, 2] - grip[i, 2]
        d = math.sqrt(dx * dx + dy * dy + dz * dz + 1e-12)
        factor = (1.0 - weights[0]) / d + weights[0] / (even * step[i])
        fx, fy, fz = factor * dx, factor * dy, factor * dz
        if i > 0:
            cy, sy = math.cos(Q[i, 0]), math.sin(Q[i, 0])
            r, z = at_wrist(frames, i, planar[6], planar[7])
            gx, gy = px - fx, py - fy
            jacobian_transpose(frames, i, 4, r, planar[8], z, cy * gx + sy * gy, cy * gy - sy * gx, pz - fz, 1.0, grad)
        px, py, pz = fx, fy, fz
        for j in range(4):
            pull = weights[1] * LEVER_MM * LEVER_MM / (turning * step[i]) * (Q[i + 1, j] - Q[i, j])
            grad[i + 1, j] += pull
            grad[i, j] -= pull
    return (1.0 - weights[0]) * length + weights[0] * even + weights[1] * turning


class Margins(NamedTuple):
    """What a path leaves over, in mm, at the tightest sample; negative where it falls short.

    ``arm`` and ``block``: smallest distance less the clearance demanded, to the other arm and to the standing block; ``itself``, ``ground``
    likewise; ``lift``: height of the grip over the lift-over profile; ``edge``: height of the held block over what is demanded of it.
    """

    arm: float
    block: float
    itself: float
    ground: float
    lift: float
    edge: float

    @property
    def worst(self) -> float:
        """The smallest margin; lift and edge count from their rounding on."""
        return min(self.arm, self.block, self.itself, self.ground, self.lift + ROUNDING_MM, self.edge + ROUNDING_MM)


@compiled
def dense_margins(Q: Floats, scene: Scene, out: Floats) -> float:
    """Fill ``out`` (6,) with the fields of :class:`Margins` over the joint samples ``Q`` (S, 4); the grip's path length in mm.

    A coarse pass finds what is nearly the tightest, so that the full one can skip nearly every pair: those that are surely farther apart.
    """
    planar, capsules, pairs, obstacles = scene.planar, scene.capsules, scene.pairs, scene.obstacles
    edges, profile, K = scene.edges, scene.profile, scene.capsules.shape[0]
    frames, ends, placed, point, slope = np.empty((1, 5, 4)), np.empty((K, 10)), np.empty((2, 10)), np.empty(6), np.empty(3)
    first, hand = first_moving(capsules), 0
    while hand < K and capsules[hand, 0] < 4.0:
        hand += 1
    out[:] = FAR_MM
    length, px, py, pz = 0.0, 0.0, 0.0, 0.0
    for stride in (COARSE, 1):
        for i in range(0, Q.shape[0], stride):
            forward_kinematics(planar, Q, i, frames, 0)
            place_capsules(capsules, Q[i, 0], frames, 0, ends)
            cy, sy = math.cos(Q[i, 0]), math.sin(Q[i, 0])
            _around(cy, sy, first, hand, planar, capsules, obstacles, scene.arm_rows, frames, ends, placed, point, out)
            _self_margin(first, scene.carried, planar, capsules, pairs, scene.clearance, frames, ends, point, out)
            if stride > 1:
                continue
            r, z = at_wrist(frames, 0, planar[6], planar[7])
            x, y = r * cy - planar[8] * sy, r * sy + planar[8] * cy
            if i > 0:
                length += math.sqrt((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2)
            px, py, pz = x, y, z
            ramp(x, y, profile, slope)
            out[4] = min(out[4], z - scene.pick_height - profile[6] * slope[0])
            for e in range(edges.shape[0]):
                _, height = at_wrist(frames, 0, edges[e, 0], edges[e, 1])
                out[5] = min(out[5], height - profile[7] * slope[0])
    return length


@compiled
def _around(
    cy: float, sy: float, first: int, hand: int, planar: Floats, capsules: Floats, obstacles: Floats, arm_rows: int, frames: Floats,
    ends: Floats, placed: Floats, point: Floats, out: Floats,
) -> None:  # fmt: skip
    """Take one sample's distances to obstacles into ``out``; the hand's shapes are skipped together where a ball around them is away."""
    hand_ball(planar, frames, 0, placed, 1)
    for j in range(obstacles.shape[0]):
        into_arm_plane(obstacles, j, cy, sy, placed, 0)
        field = 0 if j < arm_rows else 1
        away = obstacles[j, 6] + obstacles[j, 7]
        for k in range(first, hand if broad_phase(placed, 1, placed, 0, away + planar[14] + out[field]) else capsules.shape[0]):
            need = away + capsules[k, 7]
            if not broad_phase(ends, k, placed, 0, need + out[field]):
                out[field] = min(out[field], closest_points(ends, k, placed, 0, point) - need)


@compiled
def _self_margin(
    first: int, carried: int, planar: Floats, capsules: Floats, pairs: Ints, clearance: Floats, frames: Floats, ends: Floats,
    point: Floats, out: Floats,
) -> None:  # fmt: skip
    """Take one sample's distances of the arm to itself and to the table into ``out``."""
    P, grouped = pairs.shape[0], 0
    if hand_is_away(planar, frames, 0, clearance[0] + max(out[2], 0.0)):
        while grouped < P and pairs[grouped, 0] < first and capsules[pairs[grouped, 1], 0] >= 4.0:
            grouped += 1
    for p in range(grouped, P):
        a, b = pairs[p, 0], pairs[p, 1]
        need = clearance[0] + capsules[a, 7] + capsules[b, 7]
        if not broad_phase(ends, a, ends, b, need + out[2]):
            out[2] = min(out[2], closest_points(ends, a, ends, b, point) - need)
    for k in range(first, carried):
        out[3] = min(out[3], min(ends[k, 2], ends[k, 5]) - capsules[k, 7] - clearance[1])
