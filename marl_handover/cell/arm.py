"""One arm of a cell: where it stands and what it reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import wrap
from marl_handover.config import RobotConfig
from marl_handover.geometry.se2 import SE2

REACH_TOLERANCE_MM = 1e-3
"""Membership has this tolerance everywhere: at beta = +-1 float32 rounding would put one chart point in ten outside."""


PAIR_NAMES = ("left", "right")
"""Names of the arms of a mirrored pair."""


@dataclass(frozen=True)
class Arm:
    """An arm that stands on the table.

    Attributes:
        name: unique in its cell.
        base: its base frame; +x is the direction of zero yaw.
        r_min_mm, r_max_mm: radii of the annulus around its base in which it can pick and place.
        yaw_rad: (lower, upper) base yaw about its facing.
        robot: which robot it is: arms of the same robot move alike.
        lateral_mm: how far the grip is left of the arm's vertical plane through the yaw axis. At a distance rho from the base the joint's
            yaw is smaller than the direction of the grip by asin(lateral_mm / rho).
        pick_height_mm: how high over the table its grip is where it picks and places.
    """

    name: str
    base: SE2
    r_min_mm: float
    r_max_mm: float
    yaw_rad: tuple[float, float]
    robot: str = ""
    lateral_mm: float = 0.0
    pick_height_mm: float = RobotConfig.pick_height_mm

    def reaches(self, position_mm: ArrayLike) -> NDArray[np.bool_]:
        """Whether it can place at world positions (..., 2), to :data:`REACH_TOLERANCE_MM`: (...)."""
        local = self.base.to_local(position_mm)
        radius, yaw = np.hypot(local[..., 0], local[..., 1]), np.arctan2(local[..., 1], local[..., 0])
        if self.lateral_mm:
            yaw = wrap(yaw - lateral_rad(self.lateral_mm, radius))
        slack = REACH_TOLERANCE_MM / self.r_min_mm
        good = (radius >= self.r_min_mm - REACH_TOLERANCE_MM) & (radius <= self.r_max_mm + REACH_TOLERANCE_MM)
        return np.asarray(good & (yaw >= self.yaw_rad[0] - slack) & (yaw <= self.yaw_rad[1] + slack))

    def at(self, radius_mm: ArrayLike, yaw_rad: ArrayLike) -> NDArray[np.float64]:
        """World points (..., 2) of the grip at distances (...) from the base and base yaws (...)."""
        if self.lateral_mm:
            yaw_rad = np.asarray(yaw_rad, float) + lateral_rad(self.lateral_mm, radius_mm)
        return self.base.around(radius_mm, yaw_rad)


class Disc(NamedTuple):
    """A round place on the table, of which the centre of an object keeps clear."""

    x_mm: float
    y_mm: float
    radius_mm: float


def lateral_rad(lateral_mm: ArrayLike, radius_mm: ArrayLike) -> NDArray[np.float64]:
    """How far to the left of an arm's vertical plane its grip is seen from the yaw axis, ``radius_mm`` away: elementwise, broadcast.

    Where a grip that is ``lateral_mm`` beside the plane cannot be so near to the axis, it is a quarter turn.
    """
    lateral, radius = np.asarray(lateral_mm, float), np.asarray(radius_mm, float)
    return np.asarray(np.arctan2(lateral, np.sqrt(np.maximum(radius**2 - lateral**2, 0.0))))


def mirrored_pair(base_distance_mm: float) -> tuple[SE2, SE2]:
    """Left base at (0, +d/2) facing -y, right base at (0, -d/2) facing +y: each faces the other."""
    half = base_distance_mm / 2
    return SE2(0.0, half, (0.0, -1.0)), SE2(0.0, -half, (0.0, 1.0))
