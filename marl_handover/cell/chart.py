"""Charts (alpha, beta) of what two arms share, and the hand-over angles that are to be had there.

Both charts have the same frame: its origin is midway between the bases, +y points to the first arm's. The hand-over angle of a place is
gamma = psi_first - psi_second, the difference of the two grippers' world yaws there; of a transfer from one arm to the other and on, it is
all that matters to the object's orientation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from marl_handover.arrays import Array, namespace, wrap
from marl_handover.cell.arm import REACH_TOLERANCE_MM, Arm
from marl_handover.errors import InvalidSetting, NoSharedSpace
from marl_handover.geometry.arm_model import Floats


class Arc(NamedTuple):
    """An interval of hand-over angles: the lowest angle from the first arm to the second, and the lowest one back, both in [0, 2 pi)."""

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


SAMPLES = 4001
"""Hand-over angles at which the shared space is looked for; a piece between two of them is found where it is widest."""

GAP = 1e-3
"""Between what two arcs have of alpha: one half of it belongs to the end of either, so that rounding does not change the arc."""

_NARROW_MM = 1e-9
_QUARTER, _STEEP = math.pi / 2, 1.4

Eta = tuple[float, float]


@dataclass(frozen=True)
class AngleChart:
    """The angle chart of any two annulus sectors: alpha is the hand-over angle, beta says where among the places that have it.

    With a_1 and a_2 the angles at the bases from the base line to the grippers' directions, both counted towards +x, the hand-over angle is
    gamma = pi + eta with eta = a_1 + a_2. ``alpha`` maps onto the arcs of eta by length, a :data:`GAP` between them; ``beta`` maps onto
    the difference of the distances, second minus first, that the curve of eta offers. Distances are those in the arms' own vertical planes,
    R = sqrt(rho^2 - delta^2) with the lateral offset delta. With D between the bases, phi = (a_2 - a_1) / 2 and h = eta / 2, the law of
    sines gives

        R_1 - R_2 = (D sin(phi) - (delta_1 + delta_2) cos(h)) / sin(h)
        R_1 + R_2 = (D cos(phi) + (delta_1 - delta_2) sin(h)) / cos(h)

    which solved for phi is smooth on the base line, too, where h = 0. As long as neither a_1 nor a_2 passes a quarter turn, R_1 rises and
    R_2 falls with the difference: each limit of a radius or a yaw is one bound of it, and every curve is in one piece.

    Attributes:
        first, second: the arms.
        inset: factor on both coordinates, about the middle of each arc and of each curve.

    Raises:
        NoSharedSpace: they share nothing, or places that one of them sees more than a quarter turn off the base line.
    """

    first: Arm
    second: Arm
    inset: float = 1.0

    def __post_init__(self) -> None:
        self._require_ahead()
        if not self._eta_arcs:
            most = self.first.r_max_mm + self.second.r_max_mm
            fix = f"stand them less than {most:g} mm apart" if most <= self._distance_mm else "turn them to face each other"
            raise self._none(f"{self._reach}; they have no place in common: {fix}")

    @property
    def arcs(self) -> tuple[Arc, ...]:
        """All hand-over angles that its places have."""
        return tuple(Arc(math.pi + c - self.inset * half, math.pi - c - self.inset * half) for c, half in self._eta_arcs)

    @property
    def skew_rad(self) -> float | None:
        """How far the middle of the hand-over angles is above pi; None for several arcs."""
        return self._eta_arcs[0][0] if len(self._eta_arcs) == 1 else None

    def to_table(self, alpha: Array, beta: Array) -> Array:
        """Position (..., 2) in mm, in the chart's frame, of coordinates that are each of shape (...)."""
        xp = namespace(alpha)
        if alpha.dtype == xp.float32 and self._is_steep:
            place = self._on_table(*(part * xp.ones_like(part, dtype=xp.float64) for part in (alpha, beta)))
            return place.astype(alpha.dtype) if xp is np else place.to(alpha.dtype)
        return self._on_table(alpha, beta)

    def _on_table(self, alpha: Array, beta: Array) -> Array:
        xp, arcs = namespace(alpha), self._eta_arcs
        if len(arcs) == 1:
            return self._place(arcs[0][0] + alpha * (self.inset * arcs[0][1]), beta)
        eta = 0 * alpha
        for (centre, half), middle in zip(arcs, self._middles, strict=True):
            there = (alpha - middle) * self._stretch
            eta = xp.where(there >= -half - self._stretch * GAP / 2, centre + self.inset * xp.clip(there, -half, half), eta)
        return self._place(eta, beta)

    def from_table(self, position_mm: Array) -> tuple[Array, Array]:
        """Coordinates (alpha, beta), each (...), of a position (..., 2) in mm; outside the square where it is outside.

        Where a curve is a single point, as at the ends of an arc, beta has no meaning and is 0.
        """
        xp, arcs = namespace(position_mm), self._eta_arcs
        (r_1, a_1), (r_2, a_2) = self._seen(position_mm)
        eta = a_1 + a_2
        alpha = 0 * eta
        for number, ((centre, half), middle) in enumerate(zip(arcs, self._middles, strict=True)):
            begins = -math.inf if number == 0 else (sum(arcs[number - 1]) + centre - half) / 2
            alpha = xp.where(eta >= begins, middle + (eta - centre) / (self.inset * self._stretch), alpha)
        low, high = self._bounds(eta)
        half_mm = self.inset * (high - low) / 2
        some, one = half_mm > _NARROW_MM, xp.ones_like(eta)
        beta = ((low + high) / 2 - (r_1 - r_2)) / xp.where(some, half_mm, one)
        return alpha, xp.where(some, beta, xp.where(half_mm < -_NARROW_MM, 2 * one, 0 * one))

    def at_angle(self, gamma_rad: Array) -> Array:
        """A place (..., 2) in the middle of those that have the hand-over angle ``gamma_rad`` (...)."""
        eta = wrap(gamma_rad - math.pi)
        return self._place(eta, 0 * eta)

    def _place(self, eta: Array, beta: Array) -> Array:
        """The place (..., 2) at ``beta`` (...) on the curve of ``eta`` (...)."""
        xp, distance, (delta_1, delta_2) = namespace(eta), self._distance_mm, self._lateral_mm
        low, high = self._bounds(eta)
        difference = (low + high) / 2 - self.inset * beta * (high - low) / 2
        sin_h, cos_h = xp.sin(eta / 2), xp.cos(eta / 2)
        sin_phi = (difference * sin_h + (delta_1 + delta_2) * cos_h) / distance
        cos_phi = _cosine(sin_phi)
        r_1 = ((distance * cos_phi + (delta_1 - delta_2) * sin_h) / cos_h + difference) / 2
        sin_a, cos_a = sin_h * cos_phi - cos_h * sin_phi, cos_h * cos_phi + sin_h * sin_phi  # of a_1 = h - phi
        x, y = r_1 * sin_a, distance / 2 - r_1 * cos_a
        return xp.stack([x + delta_1 * cos_a, y + delta_1 * sin_a] if delta_1 else [x, y], -1)

    def _seen(self, position_mm: Array) -> list[tuple[Array, Array]]:
        """(R_1, a_1) and (R_2, a_2), each (...), of positions (..., 2)."""
        xp = namespace(position_mm)
        x, y, half, seen = position_mm[..., 0], position_mm[..., 1], self._distance_mm / 2, []
        for ahead, delta in ((half - y, self._lateral_mm[0]), (half + y, -self._lateral_mm[1])):
            plane = xp.sqrt(xp.clip(x * x + ahead * ahead - delta * delta, 0.0, None))
            seen.append((plane, wrap(xp.atan2(x, ahead) - xp.atan2(0 * plane + delta, plane))))
        return seen

    def _bounds(self, eta: Array) -> tuple[Array, Array]:
        """Lowest and highest difference R_1 - R_2 in mm on the curves of ``eta`` (...)."""
        low, high = self._radial_bounds(eta)
        for arm, at_most, limit in self._binding_turns:
            low, high = self._turned(arm, at_most, limit, eta, low, high)
        return low, high

    def _radial_bounds(self, eta: Array) -> tuple[Array, Array]:
        """The same as the radii alone have it."""
        xp, (first, second) = namespace(eta), self._plane_mm
        sin, cos = xp.sin(eta), xp.cos(eta)
        low = xp.maximum(self._difference(0, first[0], sin, cos), self._difference(1, second[1], sin, cos))
        return low, xp.minimum(self._difference(0, first[1], sin, cos), self._difference(1, second[0], sin, cos))

    def _difference(self, arm: int, radius_mm: float, sin: Array, cos: Array) -> Array:
        """R_1 - R_2 where one arm is at a limit of its radius; where it cannot be on this side of a quarter turn, as near as it can be."""
        (delta_1, delta_2), distance = self._lateral_mm, self._distance_mm
        beside = delta_2 + delta_1 * cos if arm == 0 else -delta_1 - delta_2 * cos
        radius = radius_mm
        if radius_mm + abs(delta_1) + abs(delta_2) > distance:
            radius = namespace(sin).clip(self._farthest(beside, sin), None, radius_mm)
        across = (radius * sin + beside) / distance
        other = distance * _cosine(across) - radius * cos + (delta_1 if arm == 0 else -delta_2) * sin
        return radius - other if arm == 0 else other - radius

    def _farthest(self, beside: Array, sin: Array) -> Array:
        """The radius at which the other arm sees the curve a quarter turn off the base line."""
        xp = namespace(sin)
        return (self._distance_mm - xp.where(sin > 0, beside, -beside)) / xp.clip(abs(sin), 1e-12, None)

    def _turned(self, arm: int, at_most: bool, limit: float, eta: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """The bounds, with that of a_1 (``arm`` 0) or a_2 at ``limit``."""
        xp, h = namespace(eta), eta / 2
        phi = xp.clip(h - limit if arm == 0 else limit - h, -_QUARTER, _QUARTER)
        sin_h = xp.sin(h)
        sin_h = xp.where(abs(sin_h) < 1e-12, 1e-12 + 0 * h, sin_h)
        there = (self._distance_mm * xp.sin(phi) - sum(self._lateral_mm) * xp.cos(h)) / sin_h
        least = (sin_h > 0) == (at_most == (arm == 0))
        return xp.where(least, xp.maximum(low, there), low), xp.where(least, high, xp.minimum(high, there))

    @cached_property
    def _is_steep(self) -> bool:
        """Whether places are so near to a quarter turn off the base line that single precision would put them beside the ring."""
        alpha, beta = np.meshgrid(np.linspace(-1, 1, 201), np.linspace(-1, 1, 5))
        return any(bool((abs(turn) > _STEEP).any()) for _, turn in self._seen(self._on_table(alpha, beta)))

    @cached_property
    def _stretch(self) -> float:
        """Radians of eta for one of alpha."""
        return sum(half for _, half in self._eta_arcs) / (1 - GAP * (len(self._eta_arcs) - 1) / 2)

    @cached_property
    def _middles(self) -> list[float]:
        """Alpha in the middle of each arc."""
        found, start = [], -1.0
        for _, half in self._eta_arcs:
            found.append(start + half / self._stretch)
            start += 2 * half / self._stretch + GAP
        return found

    @cached_property
    def _distance_mm(self) -> float:
        return math.dist(self.first.base.position_mm, self.second.base.position_mm)

    @cached_property
    def _lateral_mm(self) -> tuple[float, float]:
        return self.first.lateral_mm, self.second.lateral_mm

    @cached_property
    def _plane_mm(self) -> list[tuple[float, float]]:
        """Least and greatest R of each arm."""
        return [
            (math.sqrt(max(arm.r_min_mm**2 - arm.lateral_mm**2, 0.0)), math.sqrt(max(arm.r_max_mm**2 - arm.lateral_mm**2, 0.0)))
            for arm in (self.first, self.second)
        ]

    @cached_property
    def _towards(self) -> tuple[float, float]:
        """The base yaw at which each arm faces the other's base."""
        ahead = self.first.base.to_local(self.second.base.position_mm), self.second.base.to_local(self.first.base.position_mm)
        return math.atan2(ahead[0][1], ahead[0][0]), math.atan2(ahead[1][1], ahead[1][0])

    @cached_property
    def _turns(self) -> list[tuple[float, float]]:
        """Least and greatest a_1 and a_2 within a quarter turn; the first is the greater where there are none."""
        found = []
        for arm, towards, handed in ((self.first, self._towards[0], 1), (self.second, self._towards[1], -1)):
            low, high = sorted(handed * (yaw - towards) for yaw in arm.yaw_rad)
            if high - low > 2 * math.pi - 1e-6:
                low, high = -math.pi, math.pi
            pieces = [(max(low + turn, -_QUARTER), min(high + turn, _QUARTER)) for turn in (0.0, 2 * math.pi, -2 * math.pi)]
            pieces = [(least, most) for least, most in pieces if least < most] or [(_QUARTER, -_QUARTER)]
            if len(pieces) > 1:
                raise self._none(f"the gap in the yaw range of arm {arm.name!r} lies within a quarter turn of the base line; turn that arm")
            found.append(pieces[0])
        return found

    @cached_property
    def _binding_turns(self) -> list[tuple[int, bool, float]]:
        """Arm, whether it is an upper limit, and value of those limits of a_1 and a_2 that cut a curve."""
        eta = self._sampled
        limits = [(arm, at_most, self._turns[arm][at_most]) for arm in (0, 1) for at_most in (False, True)]
        low, high = self._radial_bounds(eta)
        found = []
        for arm, at_most, limit in limits:
            if abs(limit) < _QUARTER - 1e-12 or (limit > 0) != at_most:
                lower, higher = self._turned(arm, at_most, limit, eta, low, high)
                if bool(((low < high) & ((lower > low) | (higher < high))).any()):
                    found.append((arm, at_most, limit))
        return found

    @cached_property
    def _sampled(self) -> Floats:
        return np.linspace(-math.pi, math.pi, SAMPLES + 2)[1:-1]

    def _width_mm(self, eta: Array) -> Array:
        """How much the difference varies on curves of ``eta`` (...); negative where there is none."""
        low, high = self._bounds(eta)
        width = high - low
        sin, cos, (delta_1, delta_2) = np.sin(eta), np.cos(eta), self._lateral_mm
        for arm, beside in ((0, delta_2 + delta_1 * cos), (1, -delta_1 - delta_2 * cos)):
            width = np.minimum(width, self._farthest(beside, sin) - self._plane_mm[arm][0])
        return width

    @cached_property
    def _eta_arcs(self) -> tuple[Eta, ...]:
        """Centre and half of the width of each interval of eta on which there are places."""
        from scipy.optimize import brentq, minimize_scalar  # here: the paper's chart needs neither, and they take their time to load

        eta = self._sampled
        width = self._width_mm(eta)
        for index in np.flatnonzero((width[1:-1] <= 0) & (width[1:-1] > width[:-2]) & (width[1:-1] >= width[2:])) + 1:
            peak = minimize_scalar(
                lambda at: -float(self._width_mm(np.float64(at))), bounds=(eta[index - 1], eta[index + 1]), method="bounded"
            )
            if -peak.fun > _NARROW_MM:
                eta, width = np.append(eta, peak.x), np.append(width, -peak.fun)
        order = np.argsort(eta)
        eta, inside = eta[order], width[order] > 0
        ends = np.flatnonzero(inside[1:] != inside[:-1])
        roots = [float(brentq(lambda at: float(self._width_mm(np.float64(at))), eta[end], eta[end + 1], xtol=1e-15)) for end in ends]
        arcs = [((low + high) / 2, (high - low) / 2) for low, high in zip(roots[::2], roots[1::2], strict=True)]
        # What is narrower than the tolerance of reach is no place.
        return tuple(arc for arc in arcs if self._width_mm(arc[0] + arc[1] * np.linspace(-0.9, 0.9, 19)).max() > REACH_TOLERANCE_MM)

    def _require_ahead(self) -> None:
        """Raise :class:`NoSharedSpace` for a common place that an arm sees more than a quarter turn off the base line."""
        distance = self._distance_mm
        for arm in (self.first, self.second):
            radius, angle = np.meshgrid(np.linspace(arm.r_min_mm, arm.r_max_mm, 65), np.linspace(-math.pi, math.pi, 361))
            sign = -1 if arm is self.first else 1
            points = np.stack([radius * np.sin(angle), sign * (radius * np.cos(angle) - distance / 2)], -1)
            shared, far = np.ones(radius.shape, bool), np.zeros(radius.shape, bool)
            places = zip(self._seen(points), self._plane_mm, (self.first, self.second), self._towards, (1, -1), strict=True)
            for (plane, turn), (least, most), reaching, towards, handed in places:
                yaw = wrap(towards + handed * turn)
                shared &= (plane >= least) & (plane <= most) & (yaw >= reaching.yaw_rad[0]) & (yaw <= reaching.yaw_rad[1])
                far |= abs(turn) > _QUARTER + 1e-9
            if (shared & far).any():
                radii = [(each.r_min_mm, each.r_max_mm) for each in (self.first, self.second)]
                apart = math.sqrt(max(radii[0][1] ** 2 - radii[1][0] ** 2, radii[1][1] ** 2 - radii[0][0] ** 2))
                raise self._none(f"{self._reach}; {arm.name!r} is too near the other base: {apart:.0f} mm between the bases are enough")

    @property
    def _reach(self) -> str:
        reach = [f"{arm.r_min_mm:g} to {arm.r_max_mm:g}" for arm in (self.first, self.second)]
        return f"arms {self.first.name!r} and {self.second.name!r} reach {reach[0]} and {reach[1]} mm"

    def _none(self, reason: str) -> NoSharedSpace:
        return NoSharedSpace(self._distance_mm, self.first.r_min_mm, self.first.r_max_mm, reason)


def _cosine(sine: Array) -> Array:
    """The cosine, not negative, of angles with this sine (...); its slope is finite everywhere."""
    xp = namespace(sine)
    return xp.sqrt(xp.clip(1 - sine * sine, 1e-30, None))
