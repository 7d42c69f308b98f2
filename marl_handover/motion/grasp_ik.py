"""Where an arm's joints are when it holds the pin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell import CellModel
from marl_handover.motion.trajectory import OutOfArmsReach

Floats = NDArray[np.float64]

EDGE_RAD = 1e-4
"""A pose at the very edge may need a joint this far past its limit; the joint stays at the limit, the grip is some 20 um off."""


def grasp_joints(model: CellModel, arm: int, what: str, position_mm: Floats) -> Floats:
    """Joints (5,) with the grip at the pick height over a world position (2,), pitch = roll = 0; ``what`` the arm is to do there.

    Raises:
        OutOfArmsReach: no joint vector within the limits does it.
    """
    base, arm_model = model.cell.bases[arm], model.arm
    x, y = base.to_local(position_mm)
    q = arm_model.ik(np.array([x, y, model.cell.config.pick_height_mm]))
    inside = np.clip(q, arm_model.lower_rad, arm_model.upper_rad)
    good = (np.abs(q - inside) <= EDGE_RAD).all(axis=-1)  # NaN, out of reach, is not
    if not good.any():
        raise OutOfArmsReach(arm, what, position_mm)
    return np.asarray(inside[int(np.argmax(good))])
