"""The group of four symmetries of the mirrored cell: identity, M_y, M_x and their product (method section 4).

M_y mirrors the table in the plane between the arms and swaps them; M_x mirrors it along the base line. Together with
:mod:`marl_handover.cell.cell` this is the only module that knows left from right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from marl_handover.arrays import Array, namespace, wrap

NO_ARM, LEFT, RIGHT = -1, 0, 1
ARM_LETTERS = ("L", "R")


@dataclass(frozen=True)
class Symmetry:
    """One element of the group: which of the two mirror planes are applied."""

    mirror_x: bool = False  # M_x: (x, y, theta) -> (-x, y, pi - theta), alpha -> -alpha
    mirror_y: bool = False  # M_y: (x, y, theta) -> (x, -y, -theta), L <-> R, beta -> -beta

    def pose(self, pose: Array) -> Array:
        """Image of poses (..., 3): x_mm, y_mm, theta_rad."""
        xp = namespace(pose)
        x_mm, y_mm, theta_rad = pose[..., 0], pose[..., 1], pose[..., 2]
        if self.mirror_x:
            x_mm, theta_rad = -x_mm, math.pi - theta_rad
        if self.mirror_y:
            y_mm, theta_rad = -y_mm, -theta_rad
        return xp.stack([x_mm, y_mm, wrap(theta_rad)], -1)

    def arm(self, arm: Array) -> Array:
        """Image of arm indices (...): LEFT and RIGHT swap under M_y, NO_ARM stays."""
        if not self.mirror_y:
            return arm
        return namespace(arm).where(arm < 0, arm, 1 - arm)

    def chart(self, alpha: Array, beta: Array) -> tuple[Array, Array]:
        """Image of chart coordinates."""
        return (-alpha if self.mirror_x else alpha), (-beta if self.mirror_y else beta)

    def action(self, action: Array) -> Array:
        """Image of actions (..., 4): final, arm, alpha, beta, where a positive arm means R."""
        xp = namespace(action)
        alpha, beta = self.chart(action[..., 2], action[..., 3])
        # Zero means L, so the swapped value of 0 has to come out positive.
        arm = xp.where(action[..., 1] > 0, -xp.ones_like(alpha), xp.ones_like(alpha)) if self.mirror_y else action[..., 1]
        return xp.stack([action[..., 0], arm, alpha, beta], -1)

    def then(self, other: Symmetry) -> Symmetry:
        """The product of two elements (the group is commutative)."""
        return Symmetry(self.mirror_x != other.mirror_x, self.mirror_y != other.mirror_y)


GROUP = tuple(Symmetry(mirror_x, mirror_y) for mirror_x in (False, True) for mirror_y in (False, True))
