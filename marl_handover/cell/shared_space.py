"""What two arms share: where one can hand an object to the other, with its chart; and over all arms, who can pass to whom."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse.csgraph import connected_components

from marl_handover.arrays import Array, namespace
from marl_handover.cell.arm import Arm
from marl_handover.cell.chart import AngleChart, Chart, PaperChart
from marl_handover.errors import NoSharedSpace
from marl_handover.geometry.se2 import SE2


@dataclass(frozen=True)
class HandoverGraph:
    """The hand-over graph of a cell.

    Attributes:
        names: of the arms, in their order.
        edges: (i, j), i < j, -> what arms i and j share; only pairs that share something.
    """

    names: tuple[str, ...]
    edges: Mapping[tuple[int, int], SharedSpace]

    def neighbours(self, arm: int) -> tuple[int, ...]:
        """The arms to which ``arm`` can pass an object."""
        return tuple(other for other in range(len(self.names)) if (min(arm, other), max(arm, other)) in self.edges)

    @cached_property
    def components(self) -> tuple[tuple[int, ...], ...]:
        """Arms between which an object can travel, group by group."""
        count = len(self.names)
        adjacency = np.zeros((count, count), bool)
        for i, j in self.edges:
            adjacency[i, j] = True
        groups, label = connected_components(adjacency, directed=False)
        return tuple(tuple(int(arm) for arm in np.flatnonzero(label == group)) for group in range(groups))

    @property
    def is_connected(self) -> bool:
        """Whether every arm can pass to every other, by way of others if need be."""
        return len(self.components) == 1


SAMPLES = 65
"""Radii of each arm at which a shared space is looked for: a piece narrower than about 2 mm is no place to hand anything over."""

_ALIKE_MM = 1e-6


@dataclass(frozen=True)
class SharedSpace:
    """The places that both of two arms reach.

    Attributes:
        first: an arm of the cell.
        second: another one.
        inset: part of the chart that is in use.
        charted: ``paper``, ``angle``, or None: the paper's where both arms have the same ring, else by hand-over angles.
    """

    first: Arm
    second: Arm
    inset: float = 1.0
    charted: str | None = None

    @property
    def base_distance_mm(self) -> float:
        """How far apart the two bases stand."""
        return math.dist(self.first.base.position_mm, self.second.base.position_mm)

    @cached_property
    def frame(self) -> SE2:
        """The frame of the chart: its origin lies midway between the bases, +y points to the first one."""
        one, other = self.first.base.position_mm, self.second.base.position_mm
        x_mm, y_mm = (one + other) / 2
        up = (one - other) / self.base_distance_mm
        return SE2(float(x_mm), float(y_mm), (float(up[1]), float(-up[0])))

    @cached_property
    def is_empty(self) -> bool:
        """Whether there is no such place."""
        distance = self.base_distance_mm
        r_1 = np.linspace(self.first.r_min_mm, self.first.r_max_mm, SAMPLES)[:, None, None]
        r_2 = np.linspace(self.second.r_min_mm, self.second.r_max_mm, SAMPLES)[None, :, None]
        # Circles around both bases meet at two points of the frame, on either side of the base line.
        y = (r_2**2 - r_1**2) / (2 * distance)
        square = r_1**2 - (distance / 2 - y) ** 2
        x = np.sqrt(np.maximum(square, 0.0)) * np.array([-1.0, 1.0])
        points = self.frame.to_world(np.stack(np.broadcast_arrays(x, y), axis=-1))
        return not bool(((square >= 0) & self.first.reaches(points) & self.second.reaches(points)).any())

    @cached_property
    def chart(self) -> Chart:
        """The chart of the space, in :attr:`frame`.

        Raises:
            NoSharedSpace: both reach nothing, or the space is not what the chart is for: the paper's takes the whole lens that two equal
                annuli have in common.
        """
        one, other = self.first, self.second
        alike = max(abs(one.r_min_mm - other.r_min_mm), abs(one.r_max_mm - other.r_max_mm)) < _ALIKE_MM
        alike &= one.lateral_mm == other.lateral_mm == 0
        if self.charted == "angle" or (self.charted is None and not alike):
            return AngleChart(one, other, self.inset)
        if not alike:
            reach = f"arms {one.name!r} and {other.name!r} reach {one.r_min_mm:g} to {one.r_max_mm:g} and {other.r_min_mm:g} to "
            reason = f"{reach}{other.r_max_mm:g} mm; cell.chart=paper needs equal rings and no lateral offset, cell.chart=angle does not"
            raise NoSharedSpace(self.base_distance_mm, one.r_min_mm, one.r_max_mm, reason)
        return self._lens()

    def _lens(self) -> PaperChart:
        one, other, distance = self.first, self.second, self.base_distance_mm
        chart = PaperChart(one.r_min_mm, one.r_max_mm, distance, self.inset)
        tip = math.atan2(chart.x_max_mm, distance / 2)
        for arm, partner in ((one, other), (other, one)):
            ahead = arm.base.to_local(partner.base.position_mm)
            towards = math.atan2(ahead[1], ahead[0])
            # The bases of a mirrored pair face each other up to rounding.
            low, high = towards - tip + 1e-12, towards + tip - 1e-12
            if arm.yaw_rad[0] > low or arm.yaw_rad[1] < high:
                straight, (least, most) = abs(towards) < 1e-9, np.degrees(arm.yaw_rad)
                needed = f"+-{math.degrees(tip):.1f}" if straight else f"{math.degrees(low):.1f} to {math.degrees(high):.1f}"
                reason = f"its tips need a base yaw of {needed} deg, the arm has {least:.1f} to {most:.1f} deg"
                raise NoSharedSpace(distance, arm.r_min_mm, arm.r_max_mm, reason)
        return chart

    def to_table(self, alpha: Array, beta: Array) -> Array:
        """World position (..., 2) in mm of chart coordinates, each of shape (...)."""
        return self.in_world(self.chart.to_table(alpha, beta))

    def from_table(self, position_mm: Array) -> tuple[Array, Array]:
        """Chart coordinates (alpha, beta), each (...), of a world position (..., 2) in mm."""
        return self.chart.from_table(self.in_frame(position_mm))

    def in_world(self, position_mm: Array) -> Array:
        """Points (..., 2) of :attr:`frame` in the world; numpy or torch."""
        if self._is_world:
            return position_mm
        frame, (cos, sin) = self.frame, self.frame.facing
        x, y = position_mm[..., 0], position_mm[..., 1]
        return namespace(position_mm).stack([frame.x_mm + cos * x - sin * y, frame.y_mm + sin * x + cos * y], -1)

    def in_frame(self, position_mm: Array) -> Array:
        """World points (..., >= 2) in :attr:`frame`; numpy or torch."""
        if self._is_world:
            return position_mm
        frame, (cos, sin) = self.frame, self.frame.facing
        dx, dy = position_mm[..., 0] - frame.x_mm, position_mm[..., 1] - frame.y_mm
        return namespace(position_mm).stack([cos * dx + sin * dy, cos * dy - sin * dx], -1)

    @cached_property
    def _is_world(self) -> bool:
        """Whether the frame is the world's, as a mirrored pair has it."""
        return self.frame == SE2(0.0, 0.0, (1.0, 0.0))
