"""What the package asks of an arm's kinematics."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.geometry.urdf import ArmDescription

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LIMIT_TOLERANCE_RAD = 1e-9
"""Joint values may pass a limit by this much: inverse kinematics at a limit are exact only up to rounding."""


class ArmModel(Protocol):
    """Kinematics of one arm in its base frame, which lies on the table under the first joint.

    Joint vectors q (..., joints) are in rad and in the order of the URDF's chain. The capsules around its links:
    :func:`~marl_handover.geometry.capsules.capsule_pairs` of its ``description``.

    Attributes:
        description: the URDF's tree.
        lower_rad, upper_rad: joint limits (joints,).
        reach_mm: a bound on the grip's distance from the base frame's z axis.
        lateral_mm: how far the grip is to the left of the vertical plane through the yaw axis in which the arm moves.
    """

    description: ArmDescription
    lower_rad: Floats
    upper_rad: Floats
    reach_mm: float
    lateral_mm: float

    def fk(self, q: ArrayLike) -> Floats:
        """Grasp frames T_base_grip (..., 4, 4)."""
        ...

    def grip_mm(self, q: ArrayLike) -> Floats:
        """Positions (..., 3) of the grasp frame: the last column of :meth:`fk`."""
        ...

    def jacobian(self, q: ArrayLike) -> Floats:
        """Geometric Jacobians (..., 6, joints) of the grip: mm/rad above, rad/rad below, both in the base frame."""
        ...

    def link_transforms(self, q: ArrayLike, gripper_mm: float | None = None) -> dict[str, Floats]:
        """Link name -> T_base_link (..., 4, 4); ``gripper_mm``: how far each pad is from closed, None: fully open."""
        ...

    def ik(self, position_mm: ArrayLike, pitch_rad: ArrayLike = 0.0, roll_rad: ArrayLike = 0.0) -> Floats:
        """Joint vectors (..., branches, joints) with the grip at a position (..., 3); NaN where there is none."""
        ...

    def within_limits(self, q: ArrayLike) -> Bools:
        """Whether joint vectors are within the joint limits, up to :data:`LIMIT_TOLERANCE_RAD`; shape (...). NaN is not."""
        ...
