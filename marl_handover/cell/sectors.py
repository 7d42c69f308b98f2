"""What arms reach, elementwise for numpy and torch: of one cell, or of a batch of cells of their own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sized
from typing import Self

from marl_handover.arrays import Array, namespace, select, wrap
from marl_handover.cell.arm import REACH_TOLERANCE_MM

ARC_GAP = 1e-3
"""Between what two intervals of hand-over angles have of alpha: one half of it belongs to the end of either, so that rounding does not
change the interval."""


class Sectors(ABC):
    """Arms that are annulus sectors. Positions are (..., >= 2); in a batch of cells their first axis is that of the cells."""

    @property
    @abstractmethod
    def num_arms(self) -> int:
        """Number of arms."""

    @property
    def chart_name(self) -> str:
        """``paper`` or ``angle``: the numbers in which actions tell places."""
        return "angle"

    @property
    @abstractmethod
    def keep_out(self) -> Sized:
        """Where nothing may be put; empty if nowhere."""

    @abstractmethod
    def is_clear(self, position_mm: Array) -> Array:
        """Whether an object may stand at positions (..., >= 2), whoever puts it there: bool (...)."""

    @abstractmethod
    def place_mm(self, arm: Array, receiver: Array, alpha: Array, beta: Array) -> Array:
        """World position (..., 2) in mm of chart coordinates in what ``arm`` and ``receiver`` (...) share; NaN where they share nothing."""

    @abstractmethod
    def hand_over_arcs(self, like: Array) -> tuple[Array, Array]:
        """Middle and half [rad] of the hand-over angles psi_i - psi_j of each two arms: (num_arms, num_arms, K); half is -1 for none.

        Of a batch of cells (cells, num_arms, num_arms, K).
        """

    @abstractmethod
    def at_angle(self, giver: Array, receiver: Array, angle_rad: Array) -> Array:
        """World place (..., 2) in mm of a hand-over at the angle psi_giver - psi_receiver (...), in the middle of those that have it.

        NaN where the two arms share nothing.
        """

    @abstractmethod
    def coordinates(self, giver: Array, receiver: Array, place_mm: Array) -> Array:
        """Chart coordinates (..., 2) of world places (..., 2) in what ``giver`` and ``receiver`` (...) share."""

    def take(self, rows: Array) -> Self:
        """The cells of some rows of a batch, by number or by a mask; one cell is the same for all."""
        return self

    @property
    @abstractmethod
    def _has_lateral(self) -> bool:
        """Whether the grip of any arm is beside its plane."""

    @abstractmethod
    def _constants(self, like: Array) -> Array:
        """Facts of the arms as arrays (10, num_arms) of the kind of ``like``, of a batch (10, cells, ..., num_arms).

        The base's x, y, facing vector and facing angle; least and greatest squared radius and yaw, tolerances included; the lateral offset.
        """

    @property
    def _sector(self) -> tuple[float, float, float, float] | None:
        """The limits of every arm's sector, if they are the same: comparing with numbers is quicker than with rows of them."""
        return None

    def polar(self, position_mm: Array) -> tuple[Array, Array]:
        """Squared radius [mm^2] and base yaw [rad] of positions (..., >= 2) seen from each arm, both (..., num_arms)."""
        xp = namespace(position_mm)
        base_x, base_y, facing_x, facing_y = self._constants(position_mm)[:4]
        dx, dy = position_mm[..., 0:1] - base_x, position_mm[..., 1:2] - base_y
        forward = facing_x * dx + facing_y * dy
        left = facing_x * dy - facing_y * dx
        square, yaw = forward * forward + left * left, xp.atan2(left, forward)
        if self._has_lateral:
            lateral = self._constants(position_mm)[9]
            yaw = wrap(yaw - xp.atan2(lateral, xp.sqrt(xp.clip(square - lateral * lateral, 1e-12, None))))
        return square, yaw

    def seen(self, position_mm: Array) -> tuple[Array, Array]:
        """Which arms can place at positions (..., >= 2), and at what base yaw [rad]: bool and float (..., num_arms)."""
        square, yaw = self.polar(position_mm)
        return self.reached(square, yaw, position_mm), yaw

    def reached(self, square_mm2: Array, yaw_rad: Array, position_mm: Array) -> Array:
        """The same of positions that were seen at squared radii and yaws (..., num_arms)."""
        reached = self.within(square_mm2, yaw_rad)
        return reached & self.is_clear(position_mm)[..., None] if self.keep_out else reached

    def in_sector(self, square_mm2: Array, yaw_rad: Array) -> tuple[Array, Array]:
        """Where in each arm's ring and range of yaw that is: -1 at the lower limit, 1 at the upper one; both (..., num_arms)."""
        xp = namespace(yaw_rad)
        low, high, yaw_low, yaw_high = self._constants(yaw_rad)[5:9]
        inner, outer = xp.sqrt(low), xp.sqrt(high)
        return (2 * xp.sqrt(square_mm2) - inner - outer) / (outer - inner), (2 * yaw_rad - yaw_low - yaw_high) / (yaw_high - yaw_low)

    def standing(self, yaw_rad: Array) -> Array:
        """Which arms are there at all: bool (..., num_arms)."""
        return yaw_rad == yaw_rad

    def gripper_yaw(self, yaw_rad: Array) -> Array:
        """World yaw psi of each gripper, (..., num_arms), from base yaws; not wrapped."""
        return yaw_rad + self._constants(yaw_rad)[4]

    def within(self, square_mm2: Array, yaw_rad: Array) -> Array:
        """Whether each arm's squared radius and base yaw, both (..., num_arms), lie in its annulus sector, to 1 um."""
        low, high, yaw_low, yaw_high = self._sector or self._constants(square_mm2)[5:9]
        return (square_mm2 >= low) & (square_mm2 <= high) & (yaw_rad >= yaw_low) & (yaw_rad <= yaw_high)

    def reaches(self, position_mm: Array) -> Array:
        """Which arms can place at positions (..., >= 2): bool (..., num_arms)."""
        return self.seen(position_mm)[0]


def sector_limits(r_min_mm: float, r_max_mm: float, yaw_low_rad: float, yaw_high_rad: float) -> tuple[float, float, float, float]:
    """Least and greatest squared radius [mm^2] and yaw [rad] of an arm's sector, tolerances included."""
    low, high = r_min_mm - REACH_TOLERANCE_MM, r_max_mm + REACH_TOLERANCE_MM
    slack = REACH_TOLERANCE_MM / r_min_mm
    return low * low, high * high, yaw_low_rad - slack, yaw_high_rad + slack


def chart_alpha(half_rad: Array, arc: Array, place: Array) -> Array:
    """The angle chart's alpha (...) of ``place`` (...), which goes from -1 to 1 over interval ``arc`` (...) of hand-over angles.

    ``half_rad`` (..., K): half widths of all intervals of the pair, below 0 for none. Places are of the first arm handing to the second;
    the other way round they count backwards.
    """
    xp = namespace(half_rad)
    halves = xp.clip(half_rad, 0, None)
    unit = halves.sum(-1) / (1 - ARC_GAP * ((half_rad >= 0).sum(-1) - 1) / 2)
    before = select(xp.cumsum(halves, -1) - halves, arc)
    return -1 + ARC_GAP * arc + (2 * before + select(halves, arc) * (1 + place)) / unit
