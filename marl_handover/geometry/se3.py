"""Poses in space as matrices (4, 4). ``T_a_b`` takes coordinates in b to coordinates in a; translations are in mm."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def transform(xyz_mm: Sequence[float], rpy_rad: Sequence[float]) -> Floats:
    """The (4, 4) transform of a URDF ``<origin>``: roll, pitch and yaw about the fixed x, y and z axes, then the shift."""
    T: Floats = np.eye(4)
    x, y, z = (rotation(np.asarray(angle), axis) for angle, axis in zip(rpy_rad, np.eye(3), strict=True))
    T[:3, :3] = z @ y @ x
    T[:3, 3] = xyz_mm
    return T


def rotation(angle_rad: Floats, axis: Sequence[float] | Floats) -> Floats:
    """Rotations (..., 3, 3) by ``angle_rad`` (...) about the unit vector ``axis`` (3,)."""
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.asarray(angle_rad, dtype=float)[..., None, None]
    return np.asarray(np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * (skew @ skew))


def flat_pose(x_mm: float, y_mm: float, yaw_rad: float, z_mm: float = 0.0) -> Floats:
    """The pose (4, 4) of something that lies flat: turned about the vertical, then shifted."""
    T = np.eye(4)
    T[:2, :2] = [[math.cos(yaw_rad), -math.sin(yaw_rad)], [math.sin(yaw_rad), math.cos(yaw_rad)]]
    T[:3, 3] = x_mm, y_mm, z_mm
    return T


def apply(T: Floats, points_mm: ArrayLike) -> Floats:
    """Points (3,), or points (n, 3) with one pose (4, 4), taken through poses ``T`` (..., 4, 4): (..., 3) or (n, 3)."""
    points = np.asarray(points_mm, dtype=float)
    if points.ndim == 1:
        return np.asarray(T[..., :3, :3] @ points + T[..., :3, 3])
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def rpy_of(R: Floats) -> tuple[float, float, float]:
    """The roll, pitch and yaw in rad of a rotation (3, 3), as :func:`transform` takes them."""
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    if math.hypot(R[0, 0], R[1, 0]) < 1e-9:  # roll and yaw turn about one axis: all of it is roll
        return math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])
