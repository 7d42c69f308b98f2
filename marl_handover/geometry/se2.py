"""Poses on the table."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.geometry.se3 import flat_pose

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SE2:
    """A frame that stands on the table: its origin, and the unit vector (cos, sin) along its +x axis, in the world."""

    x_mm: float
    y_mm: float
    facing: tuple[float, float]

    @classmethod
    def facing_deg(cls, x_mm: float, y_mm: float, angle_deg: float) -> SE2:
        """The frame that faces a direction in degrees; quarter turns are exact."""
        quarters = angle_deg / 90.0
        if quarters == round(quarters):
            return cls(x_mm, y_mm, ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4])
        angle = math.radians(angle_deg)
        return cls(x_mm, y_mm, (math.cos(angle), math.sin(angle)))

    @property
    def facing_rad(self) -> float:
        """World direction of the frame's +x axis."""
        return math.atan2(self.facing[1], self.facing[0])

    @property
    def position_mm(self) -> Floats:
        """The origin (2,) in the world."""
        return np.array([self.x_mm, self.y_mm])

    def rotation(self) -> Floats:
        """The frame's axes in the world as columns (2, 2); exact where the direction is."""
        cos, sin = self.facing
        return np.array([[cos, -sin], [sin, cos]])

    def to_world(self, points_mm: ArrayLike) -> Floats:
        """Points (..., 2) or (..., 3) of this frame in the world; heights stay."""
        points = np.array(points_mm, dtype=float)
        x, y, cos, sin = points[..., 0].copy(), points[..., 1].copy(), math.cos(self.facing_rad), math.sin(self.facing_rad)
        points[..., 0], points[..., 1] = self.x_mm + cos * x - sin * y, self.y_mm + sin * x + cos * y
        return points

    def to_local(self, points_mm: ArrayLike) -> Floats:
        """World points (..., 2) or (..., 3) in this frame; heights stay."""
        points = np.array(points_mm, dtype=float)
        dx, dy, cos, sin = points[..., 0] - self.x_mm, points[..., 1] - self.y_mm, math.cos(self.facing_rad), math.sin(self.facing_rad)
        points[..., 0], points[..., 1] = cos * dx + sin * dy, cos * dy - sin * dx
        return points

    def around(self, radius_mm: ArrayLike, yaw_rad: ArrayLike) -> Floats:
        """World points (..., 2) at distances (...) from the origin, in directions (...) counted from the frame's +x axis."""
        angle, radius = self.facing_rad + np.asarray(yaw_rad, float), np.asarray(radius_mm, float)
        return np.stack([self.x_mm + radius * np.cos(angle), self.y_mm + radius * np.sin(angle)], axis=-1)

    def matrix(self) -> Floats:
        """T_world_frame (4, 4), in mm."""
        return flat_pose(self.x_mm, self.y_mm, self.facing_rad)
