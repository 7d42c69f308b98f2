"""The timed cycle of one transfer: parked, to the pin, grasp, over the table, release, back to parked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from marl_handover.config import MotionConfig, require_between, require_positive
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.motion.time_parametrization import time_path
from marl_handover.motion.trajectory import JointTrajectory, Phase, PickPlacePaths

Floats = NDArray[np.float64]

LIFTED_MM = 10.0
"""A grip this far above the pick height is no longer being lifted, and not yet being lowered: that names the phases, no more."""

REACH_MM = 315.0
"""How far an arm may reach that accelerates as fast as ``motion.acceleration_deg_s2`` says: the AL5A does."""

JOINED_RAD = 1e-9
"""The end of a path and the beginning of the next are the same up to rounding."""


def timed_phases(paths: PickPlacePaths, arm: ArmModel, motion: MotionConfig, pick_height_mm: float) -> tuple[Phase, ...]:
    """The timed phases of a cycle, in the order of :data:`~marl_handover.motion.trajectory.PHASES`.

    Approach, transfer and retreat each go from rest to rest, as fast as the limits allow: ``motion.velocity_scale`` of the URDF's joint
    velocities, ``motion.acceleration_deg_s2``. The transfer is one motion without a stop; what it does below :data:`LIFTED_MM` at its
    beginning and at its end is named lift and lower. A transfer that never comes so high is all transfer, and one that has left that
    height, or is back, within one sample lacks the piece.

    Args:
        paths: the three splines; each begins where the one before ended.
        arm: the arm that moves.
        motion: degree, limits, times and sampling.
        pick_height_mm: height of the grip above the table at both ends of the transfer.

    Returns:
        The phases. Times run on from 0; each phase begins with the last sample of the one before.

    Raises:
        NotFinite: a control point is not finite.
        InvalidSetting: a setting is out of its limits, control points are of the wrong shape, or a path does not begin where the one
            before ended.
    """
    for before, after, name in zip(paths, paths[1:], paths._fields[1:], strict=False):
        gap_rad = float(np.abs(before[-1] - after[0]).max())
        if gap_rad > JOINED_RAD:
            raise InvalidSetting(f"the gap in rad before the path {name!r}", gap_rad, f"at most {JOINED_RAD:g}")
    limits = motion_limits(arm, motion)
    approach, transfer, retreat = (time_path(path, motion.degree, *limits, motion.sample_s) for path in paths)
    opened = motion.finger_travel_mm
    pieces = [("approach", approach.t_s, approach.joints_rad, np.full(len(approach.t_s), opened))]
    pieces.append(("grasp", *_still(transfer.joints_rad[0], opened, 0.0, motion.grasp_s, motion.sample_s)))
    for name, part in _transfer_parts(transfer, arm, pick_height_mm):
        t_s = transfer.t_s[part]
        pieces.append((name, t_s - t_s[0], transfer.joints_rad[part], np.zeros(len(t_s))))
    pieces.append(("release", *_still(transfer.joints_rad[-1], 0.0, opened, motion.release_s, motion.sample_s)))
    pieces.append(("retreat", retreat.t_s, retreat.joints_rad, np.full(len(retreat.t_s), opened)))
    phases: list[Phase] = []
    begin_s = 0.0
    for name, t_s, joints_rad, gripper_mm in pieces:
        phases.append(Phase(name, begin_s + t_s, joints_rad, gripper_mm))
        begin_s = float(phases[-1].t_s[-1])
    return tuple(phases)


def motion_limits(arm: ArmModel, motion: MotionConfig) -> tuple[Floats, Floats]:
    """Velocity and acceleration limits (5,) in rad/s and rad/s^2; an arm that reaches farther than the AL5A accelerates less, so that its
    hand does not. Raises :class:`InvalidSetting`.
    """
    require_between("motion.velocity_scale", motion.velocity_scale, 0.01, 1.0)
    require_positive("motion.acceleration_deg_s2", motion.acceleration_deg_s2)
    velocities = np.array([arm.description.joint(name).velocity for name in ARM_JOINTS])
    acceleration_deg_s2 = min(1.0, REACH_MM / round(arm.reach_mm, 6)) * motion.acceleration_deg_s2
    return motion.velocity_scale * velocities, np.full(len(ARM_JOINTS), math.radians(acceleration_deg_s2))


def _still(q: Floats, from_mm: float, to_mm: float, duration_s: float, sample_s: float) -> tuple[Floats, Floats, Floats]:
    """Times, joints and fingers of an arm that holds the joints ``q`` (5,) while its fingers move evenly."""
    require_positive("the time in which the fingers move", duration_s)
    samples = max(1, math.ceil(duration_s / sample_s - 1e-9)) + 1
    return np.linspace(0.0, duration_s, samples), np.tile(q, (samples, 1)), np.linspace(from_mm, to_mm, samples)


def _transfer_parts(transfer: JointTrajectory, arm: ArmModel, pick_height_mm: float) -> list[tuple[str, slice]]:
    """The samples of lift, transfer and lower, each beginning with the last of the one before."""
    last = len(transfer.t_s) - 1
    lifted = np.flatnonzero(arm.fk(transfer.joints_rad)[:, 2, 3] >= pick_height_mm + LIFTED_MM)
    # The piece in between needs two samples as well.
    up, down = (int(lifted[0]), int(lifted[-1])) if len(lifted) > 1 else (0, last)
    parts = [("lift", slice(0, up + 1)), ("transfer", slice(up, down + 1)), ("lower", slice(down, last + 1))]
    return [(name, part) for name, part in parts if part.stop - part.start > 1]
