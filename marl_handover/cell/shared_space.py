"""What two arms share: where one can hand an object to the other, with its chart; and over all arms, who can pass to whom."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from marl_handover.arrays import Array, namespace
from marl_handover.cell.arm import Arm, Disc
from marl_handover.cell.chart import AngleChart, Chart, EdgeTable, PaperChart, pair_frame
from marl_handover.errors import InvalidSetting, NoSharedSpace
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
    def table(self) -> EdgeTable:
        """The angle charts of all edges, in the order of :attr:`edges`."""
        rows = [space.angle_chart.row for space in self.edges.values()]
        pairs, discs, arcs = zip(*rows, strict=True) if rows else ((), (), ())
        inset = next((space.inset for space in self.edges.values()), 1.0)
        return EdgeTable(np.reshape(pairs, (-1, 15)), discs, arcs, inset)

    @cached_property
    def number(self) -> NDArray[np.int64]:
        """Row of :attr:`table` of what arms i and j share, either way round (num_arms, num_arms); -1 where they share nothing."""
        number = np.full((len(self.names), len(self.names)), -1)
        for row, (i, j) in enumerate(self.edges):
            number[i, j] = number[j, i] = row
        return number

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


_ALIKE_MM = 1e-6


@dataclass(frozen=True)
class SharedSpace:
    """The places that both of two arms reach.

    Attributes:
        first: an arm of the cell.
        second: another one.
        inset: part of the chart that is in use.
        charted: ``paper``, ``angle``, or None: the paper's where both arms have the same ring, if it can be, else by hand-over angles.
        discs: where nothing may be put.
    """

    first: Arm
    second: Arm
    inset: float = 1.0
    charted: str | None = None
    discs: tuple[Disc, ...] = ()

    @property
    def base_distance_mm(self) -> float:
        """How far apart the two bases stand."""
        return math.dist(self.first.base.position_mm, self.second.base.position_mm)

    @cached_property
    def frame(self) -> SE2:
        """The frame of the chart: its origin lies midway between the bases, +y points to the first one."""
        return pair_frame(self.first, self.second)

    @cached_property
    def is_empty(self) -> bool:
        """Whether there is no such place."""
        if self.base_distance_mm >= self.first.r_max_mm + self.second.r_max_mm:
            return True
        try:
            _ = self.angle_chart
        except NoSharedSpace:
            return True
        return False

    @cached_property
    def angle_chart(self) -> AngleChart:
        """The chart by hand-over angles, in :attr:`frame`. Raises :class:`NoSharedSpace` where there is no place."""
        return AngleChart(self.first, self.second, self.inset, self.discs)

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
        if self.charted == "angle" or (self.charted is None and (not alike or self.discs)):
            return self.angle_chart
        if self.charted is None:
            try:
                lens = self._lens()
                _ = lens.arcs
            except (NoSharedSpace, InvalidSetting) as error:
                if self.is_empty:
                    raise error from None
                return self.angle_chart
            return lens
        reach = f"arms {one.name!r} and {other.name!r} reach {one.r_min_mm:g} to {one.r_max_mm:g} and {other.r_min_mm:g} to "
        reach += f"{other.r_max_mm:g} mm; cell.chart=paper needs equal rings, no lateral offset and no obstacles, cell.chart=angle does not"
        if not alike or self.discs:
            raise NoSharedSpace(self.base_distance_mm, one.r_min_mm, one.r_max_mm, reach)
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
