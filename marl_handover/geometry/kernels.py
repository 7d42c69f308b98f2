"""Compiled geometry of one arm in its own vertical plane: forward kinematics, capsule distances, and what they push on the joints.

Planar frame: r forward along the arm, t to its left, z up from the table; it turns with the base yaw. Wrist roll is 0 throughout.
Arrays are packed for speed; :mod:`marl_handover.motion.collision_model` makes them:

* ``planar`` (15,): shoulder (r, z), then the vectors shoulder-elbow, elbow-wrist, wrist-grip at zero, and the grip's t, in mm; then two
  balls (r, z, radius), one around base and turret, one in the wrist's frame around wrist, hand and what they hold.
* ``capsules`` (K, 9): level, two end points in the frame of that level's pivot, radius, half the length. Levels: 0 base, 1 turret,
  2 upper arm, 3 forearm, 4 wrist and hand (with what it holds).
* ``obstacles`` (M, 9): two end points in the arm's base frame, radius, demanded clearance, half the length.

A placed segment is a row of 10: its end points (r, t, z), its midpoint, half its length. Functions take arrays with row numbers, not
rows: a view costs more than the arithmetic here.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FAR_MM = 1e9


@compiled
def forward_kinematics(planar: Floats, Q: Floats, i: int, frames: Floats, slot: int) -> None:
    """Fill ``frames[slot]`` (5, 4): each level's pivot (r, z) and (cos, sin) of its pitch; Q[i] = (yaw, shoulder, elbow, wrist pitch)."""
    for level in range(2):
        frames[slot, level, 0], frames[slot, level, 1], frames[slot, level, 2], frames[slot, level, 3] = 0.0, 0.0, 1.0, 0.0
    angle = 0.0
    r, z = planar[0], planar[1]
    for level in range(2, 5):
        angle += Q[i, level - 1]
        c, s = math.cos(angle), math.sin(angle)
        frames[slot, level, 0], frames[slot, level, 1], frames[slot, level, 2], frames[slot, level, 3] = r, z, c, s
        x, y = planar[2 * level - 2], planar[2 * level - 1]
        r, z = r + c * x - s * y, z + s * x + c * y


@compiled
def at_wrist(frames: Floats, i: int, x: float, z: float) -> tuple[float, float]:
    """A point (x, z) of the wrist's frame as (r, z) in mm, at sample ``i``."""
    c, s = frames[i, 4, 2], frames[i, 4, 3]
    return frames[i, 4, 0] + c * x - s * z, frames[i, 4, 1] + s * x + c * z


@compiled
def elbow_up(planar: Floats, r: Floats, z: Floats, pitch: Floats, out: Floats) -> None:
    """Fill ``out`` (n, 3) with shoulder, elbow and wrist pitch of the elbow-up arm whose grip is at (r, z) mm; NaN out of reach.

    The compiled twin of :meth:`marl_handover.geometry.closed_form.ArmModel.ik` for first guesses; joint values are not wrapped.
    """
    upper, forearm = math.hypot(planar[2], planar[3]), math.hypot(planar[4], planar[5])
    slope_1, slope_2 = math.atan2(planar[3], planar[2]), math.atan2(planar[5], planar[4])
    for i in range(len(r)):
        c, s = math.cos(pitch[i]), math.sin(pitch[i])
        x = r[i] - (c * planar[6] - s * planar[7]) - planar[0]
        y = z[i] - (s * planar[6] + c * planar[7]) - planar[1]
        cosine = (x * x + y * y - upper * upper - forearm * forearm) / (2.0 * upper * forearm)
        if abs(cosine) > 1.0:
            out[i, :] = math.nan
            continue
        bend = -math.acos(cosine)
        out[i, 0] = math.atan2(y, x) - math.atan2(forearm * math.sin(bend), upper + forearm * math.cos(bend)) - slope_1
        out[i, 1] = bend + slope_1 - slope_2
        out[i, 2] = pitch[i] - out[i, 0] - out[i, 1]


@compiled
def place_capsules(capsules: Floats, yaw: float, frames: Floats, i: int, ends: Floats) -> None:
    """Fill ``ends`` (K, 10): both end points (r, t, z), then the midpoint and half the length.

    Seen from the arm's plane, the base turns against the yaw; most of it is around the yaw axis and looks the same.
    """
    for k in range(capsules.shape[0]):
        level = int(capsules[k, 0])
        r0, z0, c, s = frames[i, level, 0], frames[i, level, 1], frames[i, level, 2], frames[i, level, 3]
        for e in range(2):
            x, y, z = capsules[k, 1 + 3 * e], capsules[k, 2 + 3 * e], capsules[k, 3 + 3 * e]
            ends[k, 3 * e] = r0 + c * x - s * z
            ends[k, 3 * e + 1] = y
            ends[k, 3 * e + 2] = z0 + s * x + c * z
        for axis in range(3):
            ends[k, 6 + axis] = 0.5 * (ends[k, axis] + ends[k, 3 + axis])
        ends[k, 9] = capsules[k, 8]
    base = 0
    while base < capsules.shape[0] and capsules[base, 0] == 0.0:
        if ends[base, 0] != 0.0 or ends[base, 1] != 0.0 or ends[base, 3] != 0.0 or ends[base, 4] != 0.0:
            cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
            for column in (0, 3, 6):
                x, y = ends[base, column], ends[base, column + 1]
                ends[base, column], ends[base, column + 1] = cos_yaw * x + sin_yaw * y, cos_yaw * y - sin_yaw * x
        base += 1


@compiled
def into_arm_plane(obstacles: Floats, row: int, cos_yaw: float, sin_yaw: float, out: Floats, slot: int) -> None:
    """Put an obstacle into the planar frame: row ``slot`` of ``out`` (., 10), as :func:`place_capsules` does."""
    for e in range(2):
        x, y = obstacles[row, 3 * e], obstacles[row, 3 * e + 1]
        out[slot, 3 * e] = cos_yaw * x + sin_yaw * y
        out[slot, 3 * e + 1] = cos_yaw * y - sin_yaw * x
        out[slot, 3 * e + 2] = obstacles[row, 3 * e + 2]
    for axis in range(3):
        out[slot, 6 + axis] = 0.5 * (out[slot, axis] + out[slot, 3 + axis])
    out[slot, 9] = obstacles[row, 8]


@compiled
def hand_ball(planar: Floats, frames: Floats, i: int, out: Floats, slot: int) -> None:
    """Put the ball around wrist, hand and what they hold into row ``slot`` of ``out``, as a segment without length, its radius left out."""
    r, z = at_wrist(frames, i, planar[12], planar[13])
    for e in range(3):
        out[slot, 3 * e], out[slot, 3 * e + 1], out[slot, 3 * e + 2] = r, 0.0, z
    out[slot, 9] = 0.0


@compiled
def hand_is_away(planar: Floats, frames: Floats, i: int, need: float) -> bool:
    """Whether wrist, hand and what they hold are surely farther than ``need`` from base and turret."""
    r, z = at_wrist(frames, i, planar[12], planar[13])
    dr, dz = r - planar[9], z - planar[10]
    away = planar[11] + planar[14] + need
    return dr * dr + dz * dz > away * away


@compiled
def broad_phase(A: Floats, a: int, B: Floats, b: int, limit: float) -> bool:
    """Whether two placed segments, rows of ``A`` and ``B``, are surely farther apart than ``limit``: it spares most distances."""
    dx, dy, dz = A[a, 6] - B[b, 6], A[a, 7] - B[b, 7], A[a, 8] - B[b, 8]
    away = limit + A[a, 9] + B[b, 9]
    return away < 0.0 or dx * dx + dy * dy + dz * dz > away * away


@compiled
def closest_points(A: Floats, a: int, B: Floats, b: int, out: Floats) -> float:
    """Distance of two placed segments; ``out`` (6,): the nearest point of the first, then the unit vector from the second's to it.

    Exact for parallel segments and points. Where the segments meet, the vector is up: some way out is better than none.
    """
    d1x, d1y, d1z = A[a, 3] - A[a, 0], A[a, 4] - A[a, 1], A[a, 5] - A[a, 2]
    d2x, d2y, d2z = B[b, 3] - B[b, 0], B[b, 4] - B[b, 1], B[b, 5] - B[b, 2]
    gx, gy, gz = A[a, 0] - B[b, 0], A[a, 1] - B[b, 1], A[a, 2] - B[b, 2]
    aa, ee = d1x * d1x + d1y * d1y + d1z * d1z, d2x * d2x + d2y * d2y + d2z * d2z
    bb = d1x * d2x + d1y * d2y + d1z * d2z
    cc, ff = d1x * gx + d1y * gy + d1z * gz, d2x * gx + d2y * gy + d2z * gz
    determinant = aa * ee - bb * bb
    s = 0.0
    if determinant > 1e-12 * aa * ee:
        s = min(max((bb * ff - cc * ee) / determinant, 0.0), 1.0)
    t = min(max((bb * s + ff) / ee, 0.0), 1.0) if ee > 0.0 else 0.0
    if aa > 0.0:
        s = min(max((bb * t - cc) / aa, 0.0), 1.0)
    out[0], out[1], out[2] = A[a, 0] + s * d1x, A[a, 1] + s * d1y, A[a, 2] + s * d1z
    nx, ny, nz = out[0] - B[b, 0] - t * d2x, out[1] - B[b, 1] - t * d2y, out[2] - B[b, 2] - t * d2z
    distance = math.sqrt(nx * nx + ny * ny + nz * nz)
    if distance > 1e-9:
        out[3], out[4], out[5] = nx / distance, ny / distance, nz / distance
    else:
        out[3], out[4], out[5] = 0.0, 0.0, 1.0
    return distance


@compiled
def jacobian_transpose(
    frames: Floats, i: int, level: int, r: float, t: float, z: float, nr: float, nt: float, nz: float, weight: float, grad: Floats
) -> None:
    """Add ``weight`` x d(n . point)/dq to ``grad[i]`` (4,), for a point (r, t, z) fixed to ``level`` and a constant vector n."""
    if level >= 1:
        grad[i, 0] += weight * (nt * r - nr * t)
    for joint in range(2, level + 1):
        grad[i, joint - 1] += weight * (nz * (r - frames[i, joint, 0]) - nr * (z - frames[i, joint, 1]))


@compiled
def world_shapes(joints: Floats, planar: Floats, capsules: Floats, x: float, y: float, facing: float) -> Floats:
    """Placed segments (S, K, 11) of joint samples (S, 4), in the frame the arm's base stands in at (x, y) and faces; radius last."""
    S, K = joints.shape[0], capsules.shape[0]
    out, frames, ends = np.empty((S, K, 11)), np.empty((1, 5, 4)), np.empty((K, 10))
    for i in range(S):
        forward_kinematics(planar, joints, i, frames, 0)
        place_capsules(capsules, joints[i, 0], frames, 0, ends)
        c, s = math.cos(joints[i, 0] + facing), math.sin(joints[i, 0] + facing)
        for k in range(K):
            for e in range(0, 9, 3):
                r, t = ends[k, e], ends[k, e + 1]
                out[i, k, e], out[i, k, e + 1], out[i, k, e + 2] = x + c * r - s * t, y + s * r + c * t, ends[k, e + 2]
            out[i, k, 9], out[i, k, 10] = ends[k, 9], capsules[k, 7]
    return out


@compiled
def can_meet(planar: Floats, capsules: Floats, a: int, b: int, need: float, limits: Floats, steps: Ints) -> bool:
    """Whether capsules ``a`` and ``b`` of one arm might come nearer than ``need`` within the joint ``limits`` (4, 2).

    Their distance is looked at on a grid of ``steps`` (3,) values of the pitch joints between them; between grid points it changes by no
    more than the joints' steps times the farther body's distance from each joint, so a False is a proof.
    """
    low, high = int(min(capsules[a, 0], capsules[b, 0])), int(max(capsules[a, 0], capsules[b, 0]))
    farther = b if capsules[b, 0] >= capsules[a, 0] else a
    frames, ends, q, out = np.empty((1, 5, 4)), np.empty((capsules.shape[0], 10)), np.zeros((1, 4)), np.empty(6)
    count, half = np.ones(3, np.int64), np.zeros(3)
    for joint in range(3):
        # Only joints that lie between the two bodies count; the others turn both.
        if low < joint + 2 <= high:
            count[joint] = steps[joint]
            half[joint] = 0.5 * (limits[joint + 1, 1] - limits[joint + 1, 0]) / (steps[joint] - 1)
    for i in range(count[0]):
        for j in range(count[1]):
            for k in range(count[2]):
                for joint, index in enumerate((i, j, k)):
                    q[0, joint + 1] = limits[joint + 1, 0] + 2.0 * half[joint] * index
                forward_kinematics(planar, q, 0, frames, 0)
                place_capsules(capsules, 0.0, frames, 0, ends)
                slack = 0.0
                for joint in range(3):
                    if half[joint] > 0.0:
                        lever = 0.0
                        for e in range(2):
                            dr, dz = ends[farther, 3 * e] - frames[0, joint + 2, 0], ends[farther, 3 * e + 2] - frames[0, joint + 2, 1]
                            lever = max(lever, math.sqrt(dr * dr + dz * dz))
                        slack += half[joint] * lever
                # Levers change on the way too; the bodies are rigid, so by no more than the slack itself.
                if closest_points(ends, a, ends, b, out) < need + 1.12 * slack:
                    return True
    return False
