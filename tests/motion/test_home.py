"""Parked poses: the one that is given, the robot's own, or one that is found; and what is wrong with one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from marl_handover.cell.build import build_cell
from marl_handover.config import CellConfig, MotionConfig
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.capsules import ground_clearance_mm, self_clearance_mm
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.motion.home import parked_poses
from marl_handover.motion.planner import MotionPlanner
from tests.canonical_arms import MEDIUM, PARKED_DEG, SO101

LOW = replace(MEDIUM, name="low", limits={**MEDIUM.limits, "shoulder": (-34, 118), "elbow": (-160, -20)})
"""An arm whose upper arm does not lean back as far as the upright pose wants."""


@pytest.mark.parametrize("robot", ["al5a_paper", "al5a", "al5a.urdf"])
def test_the_al5a_parks_upright(robot):
    poses = parked_poses(build_cell(CellConfig(robot=robot, base_distance_mm=400.0, grid_mm=10.0)), MotionConfig())
    np.testing.assert_array_equal(poses, np.tile(np.radians(PARKED_DEG), (2, 1)))


@pytest.mark.parametrize("lengths", [MEDIUM, SO101, LOW], ids=lambda lengths: lengths.name)
def test_a_pose_is_found_that_is_clear_of_all_and_reached_from_everywhere(tmp_path, lengths):
    model = build_cell(lengths.cell(tmp_path, grid_mm=10.0))
    planner = MotionPlanner(model)
    pose, arm, ring = planner.home_rad, model.arm, model.cell.arms[0]
    assert arm.within_limits(pose)
    assert self_clearance_mm(arm, pose) >= planner.motion.self_clearance_mm
    assert ground_clearance_mm(arm, pose) >= planner.motion.ground_clearance_mm
    for radius in (ring.r_min_mm, ring.r_max_mm):
        for yaw in 0.98 * np.linspace(*ring.yaw_rad, 5):
            pin = ring.at(radius, yaw)
            for leaving in (False, True):
                planner.reach(0, pose, pin, planner.others_home_rad(0), leaving=leaving)


def test_a_robot_and_the_motion_settings_may_say_where(tmp_path):
    robot = tmp_path / "own.yaml"
    robot.write_text(f"urdf: {MEDIUM.write(tmp_path)}\nparked_deg: [10, 130, -120, 60, 0]\n", encoding="utf-8")
    model = build_cell(MEDIUM.cell(tmp_path, robot=str(robot), grid_mm=10.0))
    np.testing.assert_allclose(np.degrees(parked_poses(model, MotionConfig())), [[10, 130, -120, 60, 0]] * 2)
    np.testing.assert_allclose(np.degrees(parked_poses(model, MotionConfig(parked_deg=PARKED_DEG))), [PARKED_DEG] * 2)


@pytest.mark.parametrize(
    ("parked_deg", "words"),
    [
        ([0, 190, -115, 70, 0], r"motion.parked_deg = \[0, 190, -115, 70, 0\]: must be 5 angles within the joint limits of arm 'left'"),
        ([0, -20, -30, 0, 0], r"clear of the table; this one is .* mm in it"),
        ([0, 90, -160, -110, 0], r"clear of itself; this one is .* mm in it"),
    ],
)
def test_a_pose_no_arm_can_take_is_named(tmp_path, parked_deg, words):
    model = build_cell(MEDIUM.cell(tmp_path, grid_mm=10.0))
    with pytest.raises(InvalidSetting, match=words):
        parked_poses(model, MotionConfig(parked_deg=parked_deg))


def test_without_any_pose_that_is_clear_it_is_asked_for(tmp_path):
    """The same arm with joints that keep it low."""
    model = build_cell(MEDIUM.cell(tmp_path, grid_mm=10.0))
    limits = {"shoulder": [-60.0, -35.0], "elbow": [-10.0, 10.0], "wrist_pitch": [-10.0, 10.0]}
    low = ClosedFormArm(model.arm.description, limits)
    with pytest.raises(InvalidSetting, match="parked_deg = None: must be given: within .* no posture is"):
        parked_poses(model._replace(arms=(low, low)), MotionConfig())
