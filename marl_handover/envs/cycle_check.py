"""What can be wrong with a transfer, by name, and what can be seen to be wrong with one before anything moves."""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell import CellModel
from marl_handover.config import MotionConfig
from marl_handover.motion.home import parked_poses
from marl_handover.motion.trajectory import PickPlacePaths, knots, sampled_basis

END_TOLERANCE_MM = 1.0
"""How far the grip may be from the object when it closes, and from the commanded place when it opens."""

LEVEL_TOLERANCE_RAD = 1e-2
"""How far pitch and roll may be from 0 there."""

JOIN_TOLERANCE_RAD = 1e-4
"""How far one path may start from where the one before ended, and the last one end from the parked pose; float32 commands are 1e-7 off."""

SERVO_TOLERANCE_RAD = 0.02
"""How far the first path may start from where the arm is measured to be: servos hold a pose to about a degree."""

LENGTH_SAMPLES = 101


class Refusal(StrEnum):
    """Why a transfer was refused, or failed."""

    OUT_OF_REACH = "out_of_reach"  # the supervisor named an arm that cannot pick up there, or not place there
    WRONG_SHAPE = "wrong_shape"  # the action is not of its space: keys, shapes, choices
    NOT_FINITE = "not_finite"
    DECLINED = "declined"  # the arm's answer, without a reason
    NO_PATH = "no_path"  # the arm's answer: it found no collision-free path
    JOINT_LIMITS = "joint_limits"
    NOT_CONTINUOUS = "not_continuous"  # a path does not start where the arm is then
    OBJECT_ELSEWHERE = "object_elsewhere"  # the grip would close where the object's pin is not
    WRONG_PLACE = "wrong_place"  # the grip would open away from the commanded place
    CANNOT_PARK = "cannot_park"
    COLLISION = "collision"
    MISSED_GRASP = "missed_grasp"
    DROPPED = "dropped"
    TIPPED = "tipped"
    UNSEEN = "unseen"  # nobody knows where the object is: it does not show itself
    STALLED = "stalled"  # the arm does nothing, time and again


FAILURES = frozenset({Refusal.MISSED_GRASP, Refusal.DROPPED})
"""What went wrong with a transfer that was tried and left an object that can be handled, to be judged by where it lies. All other reasons:
it was refused, the object was not touched or had better not been; one that has tipped over cannot be gripped."""


class CycleCheck:
    """Whether a commanded cycle is one that an arm of the cell can carry out, by its ends and its joint limits.

    Args:
        model: the cell.
        motion: the parked pose and the splines' degree.

    Attributes:
        homes_rad: (num_arms, 5) where each arm parks.

    Raises:
        InvalidSetting: for a setting of ``motion`` out of its limits, or a pose the arm cannot park in.
    """

    def __init__(self, model: CellModel, motion: MotionConfig) -> None:
        motion.validate()
        self.model, self.motion = model, motion
        knots(motion.control_points, motion.degree)  # refuses settings that are no spline
        self.homes_rad = parked_poses(model, motion)

    def __call__(
        self, arm: int, paths: PickPlacePaths, joints_rad: Floats, object_mm: Floats, target_mm: Floats | None = None
    ) -> Refusal | None:
        """The first thing that is wrong, or None.

        Args:
            arm: whose cycle it is.
            paths: its splines.
            joints_rad: (5,) of that arm now.
            object_mm: (2,), world, where the pin is.
            target_mm: (2,), world, where the arm was told to put it; None: anywhere.
        """
        points = np.concatenate(paths)
        if not np.isfinite(points).all():
            return Refusal.NOT_FINITE
        if not self.model.arms[arm].within_limits(points).all():
            return Refusal.JOINT_LIMITS
        jump = max(_apart(paths.approach[-1], paths.transfer[0]), _apart(paths.transfer[-1], paths.retreat[0]))
        if jump > JOIN_TOLERANCE_RAD or _apart(joints_rad, paths.approach[0]) > SERVO_TOLERANCE_RAD:
            return Refusal.NOT_CONTINUOUS
        if not self._level_at(arm, paths.transfer[0], object_mm):
            return Refusal.OBJECT_ELSEWHERE
        if not self._level_at(arm, paths.transfer[-1], target_mm):
            return Refusal.WRONG_PLACE
        if _apart(paths.retreat[-1], self.homes_rad[arm]) > JOIN_TOLERANCE_RAD:
            return Refusal.CANNOT_PARK
        return None

    def grip_mm(self, arm: int, joints_rad: Floats) -> Floats:
        """World position (..., 3) of an arm's grip at joints (..., 5)."""
        return self.model.cell.bases[arm].to_world(self.model.arms[arm].grip_mm(joints_rad))

    def path_mm(self, arm: int, control_points: Floats) -> float:
        """Length of the grip's path along a spline (N, 5)."""
        samples = sampled_basis(LENGTH_SAMPLES, len(control_points), self.motion.degree) @ control_points
        steps = np.diff(self.grip_mm(arm, samples), axis=0)
        return float(np.sqrt((steps**2).sum(-1)).sum())

    def _level_at(self, arm: int, joints_rad: Floats, place_mm: Floats | None) -> bool:
        """Whether the grip is level, at the pick height and, unless it is None, at ``place_mm``."""
        x, y, z = self.grip_mm(arm, joints_rad)
        pitch, roll = joints_rad[1] + joints_rad[2] + joints_rad[3], joints_rad[4]
        across = 0.0 if place_mm is None else math.hypot(x - place_mm[0], y - place_mm[1])
        distance = math.hypot(across, z - self.model.cell.pick_heights_mm[arm])
        return distance <= END_TOLERANCE_MM and max(abs(pitch), abs(roll)) <= LEVEL_TOLERANCE_RAD


def welded(paths: PickPlacePaths) -> PickPlacePaths:
    """The same cycle, each path beginning exactly where the one before ends; the check lets :data:`JOIN_TOLERANCE_RAD` pass."""
    transfer, retreat = paths.transfer.copy(), paths.retreat.copy()
    transfer[0], retreat[0] = paths.approach[-1], transfer[-1]
    return PickPlacePaths(paths.approach, transfer, retreat)


def _apart(one: Floats, other: Floats) -> float:
    return float(abs(one - other).max())
