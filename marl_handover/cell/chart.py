"""Charts (alpha, beta) of what two arms share, and the hand-over angles that are to be had there.

Both charts have the same frame: its origin is midway between the bases, +y points to the first arm's. The hand-over angle of a place is
gamma = psi_first - psi_second, the difference of the two grippers' world yaws there; of a transfer from one arm to the other and on, it is
all that matters to the object's orientation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from types import SimpleNamespace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Array, Floats, namespace
from marl_handover.cell.arm import Arm, Disc
from marl_handover.errors import InvalidSetting, NoSharedSpace
from marl_handover.geometry.se2 import SE2
from marl_handover.progress import working


class Arc(NamedTuple):
    """An interval of hand-over angles: the lowest angle from the first arm to the second, and the lowest one back.

    Both are in [0, 2 pi), but where the interval contains the angle 0.
    """

    low_rad: float
    back_low_rad: float

    @property
    def width_rad(self) -> float:
        """From the lowest to the highest."""
        return (math.pi - self.low_rad) + (math.pi - self.back_low_rad)


class Chart(Protocol):
    """One-to-one map from [-1, 1]^2 onto what two arms share (onto its inner part where ``inset`` < 1)."""

    @property
    def inset(self) -> float:
        """Factor on both coordinates."""
        ...

    @property
    def arcs(self) -> tuple[Arc, ...]:
        """All hand-over angles that its places have."""
        ...

    @property
    def skew_rad(self) -> float | None:
        """How far the middle of the hand-over angles is above pi, as limits of yaw or lateral offsets may put it; None for several arcs."""
        ...

    def to_table(self, alpha: Array, beta: Array) -> Array:
        """Position (..., 2) in mm, in the chart's frame, of coordinates that are each of shape (...)."""
        ...

    def from_table(self, position_mm: Array) -> tuple[Array, Array]:
        """Coordinates (alpha, beta), each (...), of a position (..., 2) in mm; outside the square where it is outside."""
        ...

    def at_angle(self, gamma_rad: Array) -> Array:
        """A place (..., 2) in the middle of those that have the hand-over angle ``gamma_rad`` (...)."""
        ...


@dataclass(frozen=True)
class PaperChart:
    """The paper's chart of two equal annuli: method section 2, with its missing +-d/2 terms put back.

    The shared space is the set of points that are between ``r_min`` and ``r_max`` away from *both* bases. It is symmetric in x and y.

    Attributes:
        r_min_mm, r_max_mm: radii of the annulus around each base.
        base_distance_mm: distance d between the bases; d/2 must lie strictly between the radii.
        inset: factor on both coordinates.
    """

    r_min_mm: float
    r_max_mm: float
    base_distance_mm: float
    inset: float = 1.0

    def __post_init__(self) -> None:
        if not self.r_min_mm < self.base_distance_mm / 2 < self.r_max_mm:
            raise NoSharedSpace(self.base_distance_mm, self.r_min_mm, self.r_max_mm)

    @property
    def arcs(self) -> tuple[Arc, ...]:
        """From the angle at one tip to the angle at the other.

        Raises:
            InvalidSetting: the bases are so near that smaller ones are to be had off the axis y = 0.
        """
        if self.base_distance_mm**2 + self.r_min_mm**2 < self.r_max_mm**2:
            limit = math.sqrt(self.r_max_mm**2 - self.r_min_mm**2)
            raise InvalidSetting("base_distance_mm", self.base_distance_mm, f"at least {limit:.1f} for the exact planner")
        lowest = 2 * math.atan2(self.base_distance_mm / 2, self.inset * self.x_max_mm)
        return (Arc(lowest, lowest),)

    @property
    def skew_rad(self) -> float | None:
        """The space is the same on both sides of the base line."""
        return 0.0

    @property
    def x_max_mm(self) -> float:
        """Half the length of the shared space: the x of its two tips."""
        return math.sqrt(self.r_max_mm**2 - self.base_distance_mm**2 / 4)

    @property
    def x_switch_mm(self) -> float:
        """The |x| below which the inner circles bound the shared space, above which the outer ones do (the paper's x')."""
        d, low, high = self.base_distance_mm, self.r_min_mm, self.r_max_mm
        return math.sqrt(max(4 * d**2 * high**2 - (d**2 - low**2 + high**2) ** 2, 0.0)) / (2 * d)

    def y_max_mm(self, x_mm: Array) -> Array:
        """Half the width of the shared space at ``x_mm``; any shape; 0 beyond the tips."""
        xp = namespace(x_mm)
        half = self.base_distance_mm / 2
        square = x_mm * x_mm
        outer = xp.sqrt(xp.clip(self.r_max_mm**2 - square, 0.0, None)) - half
        inner = half - xp.sqrt(xp.clip(self.r_min_mm**2 - square, 0.0, None))
        return xp.clip(xp.minimum(outer, inner), 0.0, None)

    def to_table(self, alpha: Array, beta: Array) -> Array:
        """Table position (..., 2) in mm of chart coordinates, each of shape (...)."""
        xp = namespace(alpha)
        x_mm = alpha * (self.inset * self.x_max_mm)
        return xp.stack([x_mm, beta * self.inset * self.y_max_mm(x_mm)], -1)

    def from_table(self, position_mm: Array) -> tuple[Array, Array]:
        """Chart coordinates (alpha, beta), each (...), of a position (..., 2) in mm. At the tips, where beta has no meaning, it is 0."""
        xp = namespace(position_mm)
        x_mm, y_mm = position_mm[..., 0], position_mm[..., 1]
        width = self.inset * self.y_max_mm(x_mm)
        safe = xp.where(width > 0, width, xp.ones_like(width))
        return x_mm / (self.inset * self.x_max_mm), xp.where(width > 0, y_mm / safe, xp.zeros_like(width))

    def at_angle(self, gamma_rad: Array) -> Array:
        """The place (..., 2) with this hand-over angle (...) on the axis y = 0."""
        xp = namespace(gamma_rad)
        x_mm = -(self.base_distance_mm / 2) / xp.tan(gamma_rad / 2)
        return xp.stack([x_mm, 0 * x_mm], -1)


class EdgeTable:
    """What pairs of arms share, one edge a row, for the compiled charts; see :mod:`marl_handover.cell.fibres`.

    Attributes:
        pairs: (E, 15) geometry of each pair of arms.
        discs: (E, M, 3) keep-out discs in the frame of the pair; the first ``n_discs`` (E,) of a row are meant.
        arcs: (E, K, 2) centre and half of each interval of eta; the first ``n_arcs`` (E,) of a row are meant.
        inset: factor on both chart coordinates.
    """

    def __init__(self, pairs: Floats, discs: Sequence[Floats], arcs: Sequence[Floats], inset: float) -> None:
        self.pairs, self.inset = np.ascontiguousarray(pairs), float(inset)
        self.discs, self.n_discs = _padded(discs, 3)
        self.arcs, self.n_arcs = _padded(arcs, 2)

    def to_world(self, edge: Array, alpha: Array, beta: Array) -> Array:
        """World places (..., 2) in mm of chart coordinates (...) on edges (...), with a gradient; NaN where an edge is negative."""
        out = np.empty((*alpha.shape, 2))
        rows = _rows(edge, np.int64, alpha.shape), _rows(alpha), _rows(beta)
        _compiled().places(self.pairs, self.discs, self.n_discs, self.arcs, self.n_arcs, self.inset, *rows, out.reshape(-1, 2))
        place = _like(out, alpha)
        if not (getattr(alpha, "requires_grad", False) or getattr(beta, "requires_grad", False)):
            return place
        slopes = np.empty((*alpha.shape, 2, 2))
        _compiled().place_slopes(self.pairs, self.discs, self.n_discs, self.arcs, self.n_arcs, self.inset, *rows, slopes.reshape(-1, 2, 2))
        chart = namespace(alpha).stack([alpha, beta], -1)
        return place + (_like(slopes, alpha) * (chart - chart.detach())[..., None, :]).sum(-1)  # adds 0, and the gradient

    def from_world(self, edge: Array, position_mm: Array) -> tuple[Array, Array]:
        """Chart coordinates (alpha, beta), each (...), of world places (..., 2); beyond [-1, 1] where they are not shared."""
        shape = position_mm.shape[:-1]
        out, at = np.empty((*shape, 2)), _rows(position_mm).reshape(-1, 2)
        rows = _rows(edge, np.int64, shape), at
        _compiled().chart_coordinates(self.pairs, self.discs, self.n_discs, self.arcs, self.n_arcs, self.inset, *rows, out.reshape(-1, 2))
        found = _like(out, position_mm)
        return found[..., 0], found[..., 1]

    def at_angle(self, edge: Array, gamma_rad: Array) -> Array:
        """World places (..., 2) in the middle of the longest piece of those that have the hand-over angle ``gamma_rad`` (...)."""
        out = np.empty((*gamma_rad.shape, 2))
        rows = _rows(edge, np.int64, gamma_rad.shape), _rows(gamma_rad) - math.pi
        _compiled().middles(self.pairs, self.discs, self.n_discs, self.arcs, self.n_arcs, *rows, out.reshape(-1, 2))
        return _like(out, gamma_rad)


@cache
def _compiled() -> SimpleNamespace:
    """The compiled functions, which the paper's chart does without; where compiling them takes long, stderr is told."""
    from marl_handover.cell import angle_arcs, angle_kernels, fibres

    found = SimpleNamespace(**vars(fibres) | vars(angle_kernels) | vars(angle_arcs))
    with working("compiling the charts; once, they are cached"):
        row, discs = np.array([300.0, 150.0, 230.0, 150.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0]), np.empty((0, 3))
        arcs, edge, zero, one = found.angle_arcs(row, discs)[None], np.zeros(1, np.int64), np.zeros(1), np.ones(1, np.int64)
        found.places(row[None], discs[None], edge, arcs, one, 1.0, edge, zero, zero, np.empty((1, 2)))
        found.chart_coordinates(row[None], discs[None], edge, arcs, one, 1.0, edge, np.zeros((1, 2)), np.empty((1, 2)))
        found.middles(row[None], discs[None], edge, arcs, one, edge, zero, np.empty((1, 2)))
    return found


def _padded(rows: Sequence[Floats], width: int) -> tuple[Floats, NDArray[np.int64]]:
    """Rows (n_i, width) as one array (E, largest n_i, width), and the n_i."""
    lengths = np.array([len(row) for row in rows], np.int64)
    table = np.zeros((len(rows), int(lengths.max(initial=0)), width))
    for number, row in enumerate(rows):
        table[number, : len(row)] = row
    return table, lengths


def _rows(values: Array, dtype: type = np.float64, shape: tuple[int, ...] | None = None) -> Any:
    """Values as one contiguous row of numpy's, broadcast to ``shape``."""
    array = values.detach().cpu().numpy() if hasattr(values, "detach") else np.asarray(values)
    if shape is not None and array.shape != tuple(shape):
        array = np.broadcast_to(array, shape)
    return np.ascontiguousarray(array, dtype).reshape(-1)


def _like(values: Floats, like: Array) -> Array:
    """Values as an array of the kind of ``like``."""
    if isinstance(like, (np.ndarray, np.generic)):
        return values.astype(like.dtype, copy=False)
    return namespace(like).from_numpy(values).to(like.device, like.dtype)


def arm_row(arm: Arm) -> Floats:
    """An arm (8,) as the compiled functions have it: x, y, facing, least and greatest radius and yaw, lateral offset."""
    base = arm.base
    return np.array([base.x_mm, base.y_mm, base.facing_rad, arm.r_min_mm, arm.r_max_mm, *arm.yaw_rad, arm.lateral_mm])


@dataclass(frozen=True)
class AngleChart:
    """The angle chart of any two annulus sectors: alpha is the hand-over angle, beta says where among the places that have it.

    ``alpha`` maps onto the arcs of hand-over angles by length, a small gap between them; ``beta`` onto the pieces of the curve of an angle,
    joined, by the angle a_2 at the second base, from the first arm's end (+1) to the second's (-1). A keep-out disc in mid-curve leaves a
    gap that no coordinates hit. It works for rings, yaw ranges and lateral offsets that differ, and for bases inside each other's ring.

    Attributes:
        first, second: the arms.
        inset: factor on both coordinates, about the middle of each arc and of each piece.
        discs: keep-out discs, in the world.

    Raises:
        NoSharedSpace: they share nothing.
    """

    first: Arm
    second: Arm
    inset: float = 1.0
    discs: tuple[Disc, ...] = ()

    def __post_init__(self) -> None:
        if not len(self._arcs):
            least, most = abs(self.first.r_min_mm - self.second.r_max_mm), self.first.r_max_mm + self.second.r_max_mm
            reach = [f"{arm.r_min_mm:g} to {arm.r_max_mm:g}" for arm in (self.first, self.second)]
            rings = f"arms {self.first.name!r} and {self.second.name!r} reach {reach[0]} and {reach[1]} mm"
            fix = f"stand them less than {most:g} mm apart" if most <= self._row[0] else "turn them to face each other"
            if self.discs and least < self._row[0] < most:
                fix = "move the obstacles or turn the arms"
            reason = f"{rings}; they have no place in common: {fix}"
            raise NoSharedSpace(float(self._row[0]), self.first.r_min_mm, self.first.r_max_mm, reason)

    @property
    def arcs(self) -> tuple[Arc, ...]:
        """All hand-over angles that its places have."""
        return tuple(Arc(math.pi + c - self.inset * half, math.pi - c - self.inset * half) for c, half in self._arcs.tolist())

    @property
    def skew_rad(self) -> float | None:
        """How far the middle of the hand-over angles is above pi; None for several arcs."""
        return float(self._arcs[0, 0]) if len(self._arcs) == 1 else None

    def to_table(self, alpha: Array, beta: Array) -> Array:
        """Position (..., 2) in mm, in the chart's frame, of coordinates that are each of shape (...)."""
        return self._table.to_world(np.zeros((), int), alpha, beta)

    def from_table(self, position_mm: Array) -> tuple[Array, Array]:
        """Coordinates (alpha, beta), each (...), of a position (..., 2) in mm; outside the square where it is outside.

        Where a curve is a single point, as at the ends of an arc, beta has no meaning and is 0.
        """
        return self._table.from_world(np.zeros((), int), position_mm)

    def at_angle(self, gamma_rad: Array) -> Array:
        """A place (..., 2) in the middle of the longest piece of those that have the hand-over angle ``gamma_rad`` (...)."""
        return self._table.at_angle(np.zeros((), int), gamma_rad)

    @property
    def row(self) -> tuple[Floats, Floats, Floats]:
        """The row of an :class:`EdgeTable` whose places are in the world: geometry, discs, arcs."""
        row = np.empty(_compiled().PAIR_SIZE)
        _compiled().pair_row(np.stack([arm_row(self.first), arm_row(self.second)]), 0, 1, row)
        return row, self._discs, self._arcs

    @cached_property
    def _row(self) -> Floats:
        """The geometry in the pair's own frame."""
        row = np.empty(_compiled().PAIR_SIZE)
        _compiled().pair_row(np.stack([arm_row(self.first), arm_row(self.second)]), 0, 1, row)
        row[11:] = 0.0, 0.0, 1.0, 0.0
        return row

    @cached_property
    def _discs(self) -> Floats:
        """The discs (M, 3) in the pair's frame."""
        frame = pair_frame(self.first, self.second)
        return np.array([[*frame.to_local((disc.x_mm, disc.y_mm)), disc.radius_mm] for disc in self.discs]).reshape(-1, 3)

    @cached_property
    def _arcs(self) -> Floats:
        return np.asarray(_compiled().angle_arcs(self._row, self._discs))

    @cached_property
    def _table(self) -> EdgeTable:
        return EdgeTable(self._row[None], [self._discs], [self._arcs], self.inset)


def pair_frame(first: Arm, second: Arm) -> SE2:
    """The frame of a pair: its origin lies midway between the bases, +y points to the first one."""
    one, other = first.base.position_mm, second.base.position_mm
    x_mm, y_mm = (one + other) / 2
    up = (one - other) / math.dist(one, other)
    return SE2(float(x_mm), float(y_mm), (float(up[1]), float(-up[0])))
