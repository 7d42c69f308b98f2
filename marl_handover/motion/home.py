"""Where the arms of a cell park: out of each other's way, and ready to reach for the block."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.errors import InvalidSetting

Floats = NDArray[np.float64]


def parked_poses(model: CellModel, motion: MotionConfig) -> Floats:
    """The parked pose of each of a cell's arms: (num_arms, 5) in rad.

    Raises:
        InvalidSetting: ``motion.parked_deg`` is none that every arm can take.
    """
    poses = np.tile(np.radians(np.asarray(motion.parked_deg, float)), (model.cell.num_arms, 1))
    for pose, arm, name in zip(poses, model.arms, model.cell.names, strict=True):
        if pose.shape != arm.lower_rad.shape or not arm.within_limits(pose):
            limits = f"{len(arm.lower_rad)} angles within the joint limits of arm {name!r}"
            raise InvalidSetting("motion.parked_deg", motion.parked_deg, limits)
    return poses
