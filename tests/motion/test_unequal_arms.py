"""Arms of other sizes, arms that differ, grips beside the arm's plane and hands that point down: planned as the AL5A is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from marl_handover.cell.build import build_cell
from marl_handover.config import ArmConfig, CellConfig, CentralisedConfig
from marl_handover.envs.cycle_check import CycleCheck
from marl_handover.errors import UnequalArms
from marl_handover.motion.batched_paths import MotionNumbers, ends_of
from marl_handover.motion.executor import ExecutorAgent
from marl_handover.motion.initial_guesses import proportions
from marl_handover.motion.pick_place import timed_phases
from marl_handover.motion.planner import MotionPlanner
from marl_handover.report.motion import clearances_mm
from tests.canonical_arms import MEDIUM, SO101, WX250, ArmLengths


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Two AL5A and a larger arm on the corners of a triangle."""
    medium = str(MEDIUM.write(tmp_path_factory.mktemp("mixed")))
    places = [(0.0, 230.0, -90.0, ""), (-190.0, -115.0, 30.0, medium), (190.0, -115.0, 150.0, "")]
    arms = [ArmConfig(f"arm{k}", *place) for k, place in enumerate(places)]
    return MotionPlanner(build_cell(replace(CellConfig(grid_mm=10.0), arms=arms)))


def random_transfers(planner, arm, count, seed=0):
    """World positions (2,), (2,) in an arm's ring."""
    ring, generator = planner.model.cell.arms[arm], np.random.default_rng(seed)
    for _ in range(count):
        radii, yaws = generator.uniform(ring.r_min_mm, ring.r_max_mm, 2), generator.uniform(*ring.yaw_rad, 2)
        yield ring.at(radii, yaws)


def test_arms_of_one_robot_share_a_collision_model_and_others_do_not(mixed):
    first, other, third = mixed.collision_models
    assert first is third
    assert first is not other
    assert other.reach_mm > first.reach_mm
    with pytest.raises(UnequalArms, match="arm1 .*medium.urdf"):
        _ = mixed.collision_model


def test_each_arm_moves_by_its_own_lengths_and_limits_past_the_others_own_shapes(mixed):
    model = mixed.model
    for arm in range(3):
        kinematics, others = model.arms[arm], mixed.others_home_rad(arm)
        assert len(mixed._other(arm, others)) == sum(len(mixed.collision_models[k].capsules) for k in range(3) if k != arm)
        for pick, place in random_transfers(mixed, arm, 4, seed=arm):
            motion = mixed.pick_place(arm, pick, place, mixed.homes_rad[arm], others)
            joints = np.concatenate([phase.joints_rad for phase in motion.phases])
            assert kinematics.within_limits(joints).all()
            named = {phase.name: phase for phase in motion.phases}
            for q, world in ((named["grasp"].joints_rad[-1], pick), (named["release"].joints_rad[0], place)):
                T = kinematics.fk(q)
                np.testing.assert_allclose(T[:3, 3], [*mixed.in_base(arm, world), mixed.pick_height_mm], atol=0.05)
                np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-6)
            to_arms, to_table = clearances_mm(model, mixed.motion, motion)  # from the URDFs' shapes, not the kernels'
            assert to_arms.min() >= mixed.motion.arm_clearance_mm - 0.1
            assert to_table.min() >= mixed.motion.ground_clearance_mm
            speeds = np.abs(np.diff(joints, axis=0))
            steps = np.diff(np.concatenate([phase.t_s for phase in motion.phases]))
            moving = steps > 1e-9
            limits = np.array([kinematics.description.joint(name).velocity for name in ("base_yaw", "shoulder", "elbow")])
            assert (speeds[moving, :3] / steps[moving, None] <= mixed.motion.velocity_scale * limits * 1.001).all()


def test_agents_and_the_check_of_cycles_know_each_arm(mixed):
    check, model = CycleCheck(mixed.model, mixed.motion), mixed.model
    arm = 1
    agent = ExecutorAgent("arm_arm1", model)
    assert agent.arm == arm
    pick, place = next(random_transfers(mixed, arm, 1, seed=8))
    seen = {"object": [*pick, 0.0], "target": place, "joints": mixed.homes_rad[arm], "other_joints": mixed.others_home_rad(arm)}
    action = agent.act(seen)
    assert action["grasp"] == 1, agent.last_refusal
    paths = mixed.plan_paths(arm, pick, place, mixed.homes_rad[arm], mixed.others_home_rad(arm)).paths
    np.testing.assert_allclose(action["paths"], np.stack(paths), atol=1e-5)
    assert check(arm, paths, mixed.homes_rad[arm], pick, place) is None
    assert check(0, paths, mixed.homes_rad[0], pick, place) is not None
    assert timed_phases(paths, model.arms[arm], mixed.motion, mixed.pick_height_mm)[-1].name == "retreat"


def test_guesses_of_the_al5a_are_what_was_measured_for_it(planner):
    size = proportions(planner.collision_model.planar)
    assert size[:6] == (300.0, 45.0, 75.0, 120.0, 150.0, 0.0)
    for found, degrees in zip(size.postures_rad, ((120, -130, 60), (140, -115, 70), (130, -160, 60)), strict=True):
        np.testing.assert_array_equal(found, np.radians(degrees))


@pytest.mark.parametrize("lengths", [MEDIUM, SO101, WX250, replace(MEDIUM, name="aside", lateral=30.0)], ids=lambda lengths: lengths.name)
def test_an_arm_of_another_size_finds_its_paths(tmp_path, lengths: ArmLengths):
    """The yaw at both ends is that of the law for a grip beside the plane."""
    planner = MotionPlanner(build_cell(lengths.cell(tmp_path, grid_mm=10.0)))
    arm_model = planner.model.arms[0]
    for pick, place in random_transfers(planner, 0, 12):
        motion_found = planner.plan_paths(0, pick, place, planner.homes_rad[0], planner.others_home_rad(0))
        start, end = motion_found.paths.transfer[[0, -1]]
        for q, world in ((start, pick), (end, place)):
            seen = planner.in_base(0, world)
            np.testing.assert_allclose(arm_model.grip_mm(q), [*seen, 45.0], atol=0.05)
            turned = math.atan2(seen[1], seen[0]) - math.asin(lengths.lateral / math.hypot(*seen))
            assert q[0] == pytest.approx(turned, abs=2e-4)


def test_batched_ends_of_grips_beside_the_plane_are_those_of_the_planner(tmp_path):
    planner = MotionPlanner(build_cell(SO101.cell(tmp_path, grid_mm=10.0)))
    model = planner.model
    numbers = MotionNumbers(model, planner.motion, CentralisedConfig())
    pick, place = next(random_transfers(planner, 1, 1))
    ends = ends_of(model.cell, torch.tensor([1]), *(torch.tensor(end[None]) for end in (pick, place)))
    expected = np.stack([planner.grasp_joints(1, "hold", end)[:4] for end in (pick, place)])
    np.testing.assert_allclose(numbers.end_joints(ends)[0].numpy(), expected, atol=2e-4)
    np.testing.assert_allclose(ends.places_mm[0].numpy(), [planner.in_base(1, end) for end in (pick, place)], atol=1e-3)
