"""Where the arms of a cell park: upright or folded, off the table, the block and themselves, as far back as they can be."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import product

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.cell.cell import Cell
from marl_handover.config import MotionConfig, RobotConfig
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.capsules import capsule_pairs, ground_clearance_mm, joints_before, self_clearance_mm
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.se3 import apply
from marl_handover.motion.proportions import UPRIGHT, proportions

STEPS = 13
"""Values of each pitch joint among which a parked pose is looked for where the upright one cannot be."""

SPARE_MM = 3.0
"""What a parked pose that is looked for keeps off table and itself, beyond what is demanded."""


def parked_deg(cell: Cell, motion: MotionConfig, index: int, robot: RobotConfig, arm: ClosedFormArm) -> list[float]:
    """The parked pose in degrees of a cell's arm ``index``: the one of ``motion``, else its robot's own, else one that is found.

    Raises:
        InvalidSetting: there is none to be found.
    """
    said = robot.parked_deg if motion.parked_deg is None else motion.parked_deg
    if said is not None:
        return list(said)
    block = cell.config.block
    clearances_mm = motion.self_clearance_mm + SPARE_MM, motion.ground_clearance_mm + SPARE_MM
    room_mm = cell.arms[index].r_min_mm - block.side_mm / math.sqrt(2) - motion.block_clearance_mm
    return list(found_deg(arm, clearances_mm, room_mm, block.pin_top_mm + SPARE_MM))


def parked_poses(model: CellModel, motion: MotionConfig) -> Floats:
    """The parked pose of each of a cell's arms: (num_arms, 5) in rad.

    Raises:
        InvalidSetting: an arm cannot take the pose it is given, or none can be found for it.
    """
    poses = []
    for index, (arm, name) in enumerate(zip(model.arms, model.cell.names, strict=True)):
        degrees = parked_deg(model.cell, motion, index, model.robots[index], arm)
        pose, where = np.radians(np.asarray(degrees, float)), "motion.parked_deg"
        if motion.parked_deg is None:
            where = f"parked_deg of robot {model.robots[index].name!r}"
        if pose.shape != arm.lower_rad.shape or not arm.within_limits(pose):
            limits = np.degrees(np.stack([arm.lower_rad, arm.upper_rad], -1)).round(1).tolist()
            raise InvalidSetting(where, degrees, f"{len(arm.lower_rad)} angles within the joint limits of arm {name!r}: {limits}")
        for gap_mm, what in ((ground_clearance_mm(arm, pose), "the table"), (self_clearance_mm(arm, pose), "itself")):
            if gap_mm < 0.0:
                raise InvalidSetting(where, degrees, f"a pose in which arm {name!r} is clear of {what}; this one is {-gap_mm:.1f} mm in it")
        poses.append(pose)
    return np.stack(poses)


@lru_cache(maxsize=64)
def found_deg(
    arm: ClosedFormArm, clearances_mm: tuple[float, float], room_mm: float, low_mm: float
) -> tuple[float, float, float, float, float]:
    """A parked pose of an arm in degrees: upright if it can be, else the one that reaches forward least.

    Args:
        arm: its kinematics.
        clearances_mm: to itself and to the table.
        room_mm: how far from the yaw axis anything lower than ``low_mm`` may be: farther out the block may stand.
        low_mm: see above.

    Raises:
        InvalidSetting: no posture within the limits is clear.
    """
    lower, upper = np.degrees(arm.lower_rad), np.degrees(arm.upper_rad)
    yaw = float(np.clip(0.0, lower[0], upper[0]))
    upright = proportions(arm.planar).postures_rad[UPRIGHT]
    grid = product(*(np.linspace(lower[joint], upper[joint], STEPS)[1:-1] for joint in (1, 2, 3)))
    for pitches in ([np.degrees(upright).round(6)], np.array(list(grid)).round(1)):
        poses = np.array([[yaw, *pitch, 0.0] for pitch in pitches])
        poses = poses[arm.within_limits(np.radians(poses))]
        forward, clear = _forward_mm(arm, poses, clearances_mm, room_mm, low_mm)
        if clear.any():
            best = poses[int(np.argmin(np.where(clear, forward, np.inf)))]
            return float(best[0]), float(best[1]), float(best[2]), float(best[3]), float(best[4])
    limits = np.stack([lower, upper], -1).round(1).tolist()
    raise InvalidSetting("parked_deg", None, f"given: within {limits} deg no posture is {clearances_mm} mm clear of the arm and the table")


def _forward_mm(
    arm: ClosedFormArm, poses_deg: Floats, clearances_mm: tuple[float, float], room_mm: float, low_mm: float
) -> tuple[Floats, np.ndarray]:
    """How far from the yaw axis postures (n, 5) reach at most, and which of them are clear of all, both (n,)."""
    q = np.radians(poses_deg)
    clear = self_clearance_mm(arm, q) >= clearances_mm[0]
    frames, forward, levels = arm.link_transforms(q), np.zeros(len(q)), joints_before(arm.description)
    for capsule in capsule_pairs(arm.description)[0]:
        ends = np.stack([apply(frames[capsule.link], end) for end in (capsule.start_mm, capsule.end_mm)])
        reach, lowest = np.hypot(ends[..., 0], ends[..., 1]).max(0) + capsule.radius_mm, ends[..., 2].min(0) - capsule.radius_mm
        forward = np.maximum(forward, reach)
        if levels[capsule.link] > 1:  # base and turret stand on the table
            clear &= (lowest >= clearances_mm[1]) & ((lowest >= low_mm) | (reach <= max(room_mm, 0.0)))
    return forward, clear
