"""The chart (alpha, beta) of the shared space: method section 2, with the paper's missing +-d/2 terms put back.

The shared space is the set of points that are between ``r_min`` and ``r_max`` away from *both* bases. It is symmetric in x and y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from marl_handover.arrays import Array, namespace
from marl_handover.errors import NoSharedSpace


@dataclass(frozen=True)
class Chart:
    """One-to-one map from [-1, 1]^2 onto the shared space (onto its inner part where ``inset`` < 1).

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
