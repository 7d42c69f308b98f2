"""First guesses for a path: a few ways a person would try, then random bends of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Array, namespace
from marl_handover.geometry.closed_form import into_plane
from marl_handover.geometry.kernels import elbow_up
from marl_handover.motion.collision_model import CollisionModel
from marl_handover.motion.proportions import LENGTH_MM, LEVERS_MM, proportions
from marl_handover.motion.trajectory import basis, sample_places, sampled_basis

Floats = NDArray[np.float64]

SAMPLES = 33
RUN_UP_MM = 35.0
"""A guess is at full height this far from an end: where the string over the lift-over profile leaves the slope."""

_BEND_RAD = np.array([0.5, 0.35, 0.35, 0.5])


@lru_cache(maxsize=16)
def _fitting(control_points: int, degree: int) -> tuple[Floats, Floats]:
    """The basis at even samples (S, N), and the least-squares map (N - 2, S) from samples to inner control points."""
    B = np.array(sampled_basis(SAMPLES, control_points, degree))
    return B, np.asarray(np.linalg.pinv(B[:, 1:-1]), float)


def fit_control_points(samples: Floats, limits: Floats, control_points: int, degree: int) -> Floats:
    """Control points (N, 4) within ``limits`` (4, 2) near ``samples`` (SAMPLES, 4), ends exact."""
    B, inverse = _fitting(control_points, degree)
    ends = B[:, :1] * samples[0] + B[:, -1:] * samples[-1]
    inner = np.clip(inverse @ (samples - ends), limits[:, 0], limits[:, 1])
    return np.concatenate([samples[:1], inner, samples[-1:]])


def carrying_guesses(body: CollisionModel, ends_q: Floats, ends_mm: Floats, pick_height_mm: float, lift_mm: float) -> Iterator[Floats]:
    """Joint samples (SAMPLES, 4) of structured guesses to carry the block between ``ends_mm`` (2, 2), joints ``ends_q`` (2, 4)."""
    size = proportions(body.planar)
    yield _straight(body, ends_q, ends_mm, pick_height_mm, lift_mm, size.grip_least_mm)
    yield _around(body, ends_q, ends_mm, pick_height_mm, lift_mm, None)
    yield _around(body, ends_q, ends_mm, pick_height_mm, lift_mm, size.middle_mm)
    yield _posture(ends_q, size.postures_rad[0])
    yield _straight(body, ends_q, ends_mm, pick_height_mm, lift_mm, size.near_mm)
    yield _posture(ends_q, size.postures_rad[1])
    yield _posture(ends_q, size.postures_rad[2])


def reaching_guesses(body: CollisionModel, ends_q: Floats, pin_mm: Floats, above_mm: float, pin_last: bool) -> Iterator[Floats]:
    """Joint samples of guesses for an empty hand between a posture and the pin at ``pin_mm`` (3,), by way of a point above it."""
    t = _even()[:, None]
    away = ends_q[0] if pin_last else ends_q[1]
    pin = ends_q[1] if pin_last else ends_q[0]
    radius, _ = into_plane(body.planar, np.array([math.hypot(pin_mm[0], pin_mm[1])]), pin[:1])
    above = _lifted(body.planar, radius, pin[:1], np.array([pin_mm[2] + above_mm]))[0]
    if np.isnan(above).any():
        above = pin
    for order in ("together", "turn first", "turn last"):
        mid = 0.5 * (away + above)
        if order != "together":
            mid[0] = above[0] if order == "turn first" else away[0]
            mid[1:] = away[1:] if order == "turn first" else above[1:]
        knots = np.stack([away, mid, above, pin])
        at = np.array([0.0, 0.4, 0.85, 1.0])
        path = np.stack([np.interp(t[:, 0], at, knots[:, joint]) for joint in range(4)], axis=-1)
        yield path if pin_last else path[::-1]
    yield ends_q[0] + (ends_q[1] - ends_q[0]) * t


def random_bend(points: Floats, limits: Floats, degree: int, seed: int) -> Floats:
    """Control points (N, 4) bent by a smooth random curve that leaves the ends alone."""
    generator = np.random.default_rng(seed)
    count = len(points)
    tau = np.linspace(0.0, 1.0, count)[:, None]
    coefficients = generator.normal(size=(3, 4)) * _BEND_RAD / np.array([[1.0], [2.0], [3.0]])
    bend = sum(coefficients[k] * np.sin((k + 1) * math.pi * tau) for k in range(3))
    return np.concatenate([points[:1], np.clip((points + bend)[1:-1], limits[:, 0], limits[:, 1]), points[-1:]])


@lru_cache(maxsize=16)
def smoothing_metric(control_points: int, degree: int, length_mm: float) -> Floats:
    """The inverse (4 (N - 2), 4 (N - 2)) of how the length of a path of 1 mm grows when its inner control points bend it.

    ``length_mm`` is the arm's. A path of length L has this divided by L for its curvature; it is the optimiser's first guess of the inverse
    Hessian.
    """
    B = basis(np.linspace(0.0, 1.0, 49), control_points, degree)
    D = np.diff(B[:, 1:-1], axis=0)
    inner = np.linalg.inv(48 * D.T @ D + 1e-3 * np.eye(control_points - 2))
    return np.kron(inner, np.diag(1.0 / (length_mm / LENGTH_MM * LEVERS_MM) ** 2))


def _even() -> Floats:
    return np.linspace(0.0, 1.0, SAMPLES)


def _inside(samples: Floats, ends_q: Floats, limits: Floats) -> Floats:
    """Joint samples within the limits; where a point is out of reach, a straight line between the ends takes its place."""
    t = _even()[:, None]
    line = ends_q[0] + (ends_q[1] - ends_q[0]) * t
    samples = np.where(np.isnan(samples), line, np.clip(samples, limits[:, 0], limits[:, 1]))
    samples[0], samples[-1] = ends_q
    return samples


def _lifted(planar: Floats, r: Floats, yaw: Floats, z: Floats) -> Floats:
    joints = np.empty((len(r), 4))
    joints[:, 0] = yaw
    pitches = np.empty((len(r), 3))
    elbow_up(planar, r, z, hand_pitch(planar, r), pitches)
    joints[:, 1:] = pitches
    return joints


def hand_pitch(planar: Floats, r: Array) -> Array:
    """Pitch (...) of the hand with the grip at ``r`` (...) mm: level, but near the base as far down as keeps the wrist off the shoulder."""
    size, tool, xp = proportions(planar), math.hypot(planar[6], planar[7]), namespace(r)
    down = -xp.arccos(xp.clip((r - size.wrist_least_mm) / tool, 0.0, 1.0)) - size.hand_rad
    return xp.clip(down, None, 0.0)


def _straight(body: CollisionModel, ends_q: Floats, ends_mm: Floats, pick_height_mm: float, lift_mm: float, r_least_mm: float) -> Floats:
    """Up, along the straight line, and down; not nearer to the base than ``r_least_mm``."""
    t = sample_places(SAMPLES, 0.5)
    distance = math.dist(*ends_mm)
    p = ends_mm[0] + (ends_mm[1] - ends_mm[0]) * t[:, None]
    r, yaw = into_plane(body.planar, np.hypot(p[:, 0], p[:, 1]), np.arctan2(p[:, 1], p[:, 0]))
    height = pick_height_mm + lift_mm * np.minimum(1.0, np.minimum(t, 1.0 - t) * distance / RUN_UP_MM)
    return _inside(_lifted(body.planar, np.maximum(r, r_least_mm), yaw, height), ends_q, body.limits)


def _around(
    body: CollisionModel, ends_q: Floats, ends_mm: Floats, pick_height_mm: float, lift_mm: float, radius_mm: float | None
) -> Floats:
    """Up, around the base at an even or at a given radius, and down."""
    t = _even()
    near = np.minimum(1.0, np.minimum(t, 1.0 - t) * 6.0)
    radii, _ = into_plane(body.planar, np.hypot(ends_mm[:, 0], ends_mm[:, 1]), ends_q[:, 0])
    r = radii[0] + (radii[1] - radii[0]) * t
    if radius_mm is not None:
        r = r + (radius_mm - r) * near
    yaw = ends_q[0, 0] + (ends_q[1, 0] - ends_q[0, 0]) * t
    return _inside(_lifted(body.planar, r, yaw, pick_height_mm + lift_mm * near), ends_q, body.limits)


def _posture(ends_q: Floats, posture_rad: Floats) -> Floats:
    """Through a posture half-way, the yaw turning evenly."""
    t = _even()[:, None]
    path = ends_q[0] + (ends_q[1] - ends_q[0]) * t
    path[:, 1:] += (posture_rad - path[:, 1:]) * np.sin(math.pi * t) ** 0.7
    path[0], path[-1] = ends_q
    return path
