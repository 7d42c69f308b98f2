"""The cell: where the arms stand, what each can reach, and the chart of what they share.

World frame: origin midway between the bases, +z up, the base line is the y axis; lengths in mm, angles in rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from marl_handover.arrays import Array, namespace
from marl_handover.cell.chart import Chart
from marl_handover.config import CellConfig
from marl_handover.errors import NoSharedSpace
from marl_handover.geometry.se2 import SE2

REACH_TOLERANCE_MM = 1e-3
"""Membership has this tolerance everywhere: at beta = +-1 float32 rounding would put one chart point in ten outside."""


@dataclass(frozen=True)
class Base(SE2):
    """Where an arm stands; its frame's +x axis is the direction of zero yaw. ``mirror`` is -1 for the arm that is the mirror image."""

    mirror: int


def mirrored_pair(base_distance_mm: float) -> tuple[Base, Base]:
    """Left base at (0, +d/2) facing -y, right base at (0, -d/2) facing +y."""
    half = base_distance_mm / 2
    return Base(0.0, half, (0.0, -1.0), -1), Base(0.0, -half, (0.0, 1.0), 1)


@dataclass(frozen=True)
class Cell:
    """Continuous model of the cell: one annulus sector a arm, and the shared chart.

    Attributes:
        bases: one :class:`Base` an arm, in the order of the arm indices (0 = L, 1 = R).
        r_min_mm, r_max_mm: radii of the annulus around each base.
        yaw_rad: (lower, upper) base yaw about each arm's facing.
        config: the settings the cell was built from.
    """

    bases: tuple[Base, ...]
    r_min_mm: float
    r_max_mm: float
    yaw_rad: tuple[float, float]
    config: CellConfig

    def __post_init__(self) -> None:
        tip = math.atan2(self.chart.x_max_mm, self.chart.base_distance_mm / 2)
        if self.yaw_rad[0] > -tip or self.yaw_rad[1] < tip:
            raise NoSharedSpace(
                self.chart.base_distance_mm,
                self.r_min_mm,
                self.r_max_mm,
                f"its tips need a base yaw of +-{math.degrees(tip):.1f} deg, the arm has "
                f"{math.degrees(self.yaw_rad[0]):.1f} to {math.degrees(self.yaw_rad[1]):.1f} deg",
            )

    @property
    def num_arms(self) -> int:
        """Number of arms."""
        return len(self.bases)

    @cached_property
    def chart(self) -> Chart:
        """The chart of the shared space."""
        return Chart(self.r_min_mm, self.r_max_mm, self.config.base_distance_mm, self.config.chart_inset)

    def with_inset(self, chart_inset: float) -> Cell:
        """The same cell with another part of the chart in use."""
        return replace(self, config=replace(self.config, chart_inset=chart_inset))

    def polar(self, position_mm: Array) -> tuple[Array, Array]:
        """Squared radius [mm^2] and base yaw [rad] of positions (..., >= 2) seen from each arm, both (..., num_arms)."""
        xp = namespace(position_mm)
        base_x, base_y, facing_x, facing_y, _ = self._constants(position_mm)
        dx, dy = position_mm[..., 0:1] - base_x, position_mm[..., 1:2] - base_y
        forward = facing_x * dx + facing_y * dy
        left = facing_x * dy - facing_y * dx
        return forward * forward + left * left, xp.atan2(left, forward)

    def _constants(self, like: Array) -> Array:
        """The bases' x, y, facing vector and facing angle as arrays (5, num_arms) of the kind of ``like``; made once for each kind."""
        key = (like.dtype, getattr(like, "device", None))
        if key not in self._kinds:
            rows = [[base.x_mm, base.y_mm, *base.facing, base.facing_rad] for base in self.bases]
            table = np.array(rows, np.float64).T
            if isinstance(like, (np.ndarray, np.generic)):
                self._kinds[key] = table.astype(like.dtype)
            else:
                self._kinds[key] = like.new_tensor(table.tolist())
        return self._kinds[key]

    @cached_property
    def _kinds(self) -> dict[Any, Array]:
        return {}

    def gripper_yaw(self, yaw_rad: Array) -> Array:
        """World yaw psi of each gripper, (..., num_arms), from base yaws; not wrapped."""
        return yaw_rad + self._constants(yaw_rad)[4]

    def within(self, square_mm2: Array, yaw_rad: Array) -> Array:
        """Whether squared radius and base yaw lie in the annulus sector, to 1 um; elementwise."""
        low, high = self.r_min_mm - REACH_TOLERANCE_MM, self.r_max_mm + REACH_TOLERANCE_MM
        slack = REACH_TOLERANCE_MM / self.r_min_mm
        in_annulus = (square_mm2 >= low * low) & (square_mm2 <= high * high)
        return in_annulus & (yaw_rad >= self.yaw_rad[0] - slack) & (yaw_rad <= self.yaw_rad[1] + slack)

    def reaches(self, position_mm: Array) -> Array:
        """Which arms can place at positions (..., >= 2): bool (..., num_arms)."""
        return self.within(*self.polar(position_mm))
