"""Timed joint motions as the interactive cell follows them: evaluated at any time, stopped at any time, joined without a stop.

A track keeps joints and their rates at samples so dense that cubics between them are the motion itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from marl_handover.motion.trajectory import JointTrajectory, still

Floats = NDArray[np.float64]

STEP_S = 0.002
"""Between samples: accelerations jump in time-optimal motions, and a cubic across such a jump is off for no longer than this."""

BRAKE_SHARE = 0.97
"""Of the acceleration limits that a stop makes use of; the rest is for what happens between samples."""

EXCESS = 1.005
"""Sums of two motions that are within limits may pass them by this factor: each of them is checked as closely as that."""

DELAYS = (0.0, 0.25, 0.5, 0.75)
"""Parts of a stop after which the next motion may set out."""


def stopped(track: JointTrajectory, t_s: float, acceleration_rad_s2: Floats) -> JointTrajectory:
    """The quickest stop along the way of ``track`` from time ``t_s`` on.

    It is the same way with another clock s(t): a joint's acceleration is q'' s'^2 + q' s''. As s' is at most 1, to let it be is always
    allowed, so no braking can get trapped; with x = s'^2, each joint lets x fall at 2 (limit / |q'| + x q'' / q') a unit of s.
    """
    if track.duration_s - t_s < 1e-9:
        return still(track.end_rad, STEP_S)
    clock = t_s + _even(track.duration_s - t_s)
    _, rates = track.at(clock)
    steps = np.diff(clock)
    way, bend = np.sign(rates[1:] + rates[:-1]), np.diff(rates, axis=0) / steps[:, None]
    fastest = np.maximum(np.maximum(abs(rates[1:]), abs(rates[:-1])), 1e-9)
    room, slope = BRAKE_SHARE * acceleration_rad_s2 / fastest, way * bend / fastest
    places, speeds, times = [float(clock[0])], [1.0], [0.0]
    x = 1.0
    for step, limit, change in zip(steps.tolist(), room.tolist(), slope.tolist(), strict=True):
        # What falls with x is taken at the end of the step, what rises at its beginning: neither is overrated.
        pairs = list(zip(limit, change, strict=True))
        fall = 2 * max(0.0, min((c + d * x) / (1 + 2 * step * max(d, 0.0)) for c, d in pairs))
        if fall * step >= x:
            fall = 2 * min(c + min(d, 0.0) * x for c, d in pairs)
            part = x / fall
            places.append(places[-1] + part)
            times.append(times[-1] + max(2 * part / speeds[-1], 1e-6))
            speeds.append(0.0)
            break
        x -= fall * step
        places.append(places[-1] + step)
        speeds.append(math.sqrt(x))
        times.append(times[-1] + 2 * step / (speeds[-1] + speeds[-2]))
    knots, place, speed = np.array(times), np.array(places), np.array(speeds)
    t = _even(knots[-1])
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    since, change = t - knots[i], (np.diff(speed) / np.diff(knots))[i]
    joints, rates = track.at(np.minimum(place[i] + since * (speed[i] + since * change / 2), place[-1]))
    rates = rates * (speed[i] + since * change)[:, None]
    rates[-1] = 0.0
    return JointTrajectory(t, joints, rates)


def _even(duration_s: float) -> Floats:
    """Times (n,) from 0 to ``duration_s``, :data:`STEP_S` apart at most."""
    return np.linspace(0.0, duration_s, 1 + max(1, math.ceil(duration_s / STEP_S - 1e-9)))


def joined(
    first: JointTrajectory, second: JointTrajectory, velocity_rad_s: Floats, acceleration_rad_s2: Floats, allowed: Callable[[Floats], bool]
) -> JointTrajectory:
    """A stop and the motion from there as one, the second setting out before the first has ended if it can.

    While both are under way they are added up: where one slows down and the other speeds up alike, the arm goes on without slowing down.

    Args:
        first: ends where ``second`` begins, both at rest there.
        second: see above.
        velocity_rad_s: limits (5,).
        acceleration_rad_s2: limits (5,).
        allowed: whether joint samples (n, 5) touch nothing and are within the joint limits.
    """
    for share in DELAYS:
        delay = share * first.duration_s
        if first.duration_s > delay + second.duration_s:
            continue
        t = _even(delay + second.duration_s)
        (joints, rates), (more, added) = first.at(t), second.at(t - delay)
        joints, rates = joints + more - second.joints_rad[0], rates + added
        both = t <= first.duration_s + STEP_S
        bends = np.diff(rates, axis=0)[both[1:]] / np.diff(t)[both[1:], None]
        if (abs(rates[both]) > EXCESS * velocity_rad_s).any() or (abs(bends) > EXCESS * acceleration_rad_s2).any():
            continue
        if allowed(joints[both]):
            return JointTrajectory(t, joints, rates)
    t = np.concatenate([first.t_s, first.duration_s + second.t_s[1:]])
    joints = np.concatenate([first.joints_rad, second.joints_rad[1:]])
    return JointTrajectory(t, joints, np.concatenate([first.velocities_rad_s, second.velocities_rad_s[1:]]))
