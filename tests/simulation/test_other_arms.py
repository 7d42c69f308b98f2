"""Arms of other sizes and hands in physics: the file that is loaded, what holds the block, how near it is put, and joints too weak."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marl_handover.cell.build import build_cell
from marl_handover.config import BlockConfig, MotionConfig, RobotConfig, TaskConfig
from marl_handover.envs.backends import make_backend
from marl_handover.errors import UrdfError
from marl_handover.geometry.robot import read_robot, robot_config
from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.urdf import Inertial
from marl_handover.motion.planner import MotionPlanner
from marl_handover.simulation.arm import SimulatedArm
from marl_handover.simulation.arm_file import arm_file, is_canonical, whole, written
from marl_handover.simulation.camera import TOP, view
from marl_handover.simulation.effort import holding_n_m, require_effort
from marl_handover.simulation.engine import Scene, open_engine
from marl_handover.simulation.world import SimulatedCell
from tests.canonical_arms import MEDIUM, SO101, WX250


def arm_of(path):
    return read_robot(RobotConfig(urdf=str(path)))


BARE = replace(MEDIUM, name="bare", hand="none")


def test_the_al5a_is_loaded_from_its_own_file(model):
    description = model.arm.description
    assert is_canonical(description)
    with arm_file(description) as path:
        assert path == description.path


@pytest.mark.parametrize("lengths", [MEDIUM, BARE], ids=lambda lengths: lengths.name)
def test_a_written_file_says_what_the_description_does(tmp_path, lengths):
    arm = arm_of(lengths.write(tmp_path))
    reversed_ = replace(arm.description, links=tuple(reversed(arm.description.links)))
    assert not is_canonical(reversed_)
    path = tmp_path / "written.urdf"
    path.write_text(written(whole(reversed_)), encoding="utf-8")
    again = arm_of(path)
    assert {link.name: link.collisions for link in again.description.links} == {
        link.name: link.collisions for link in arm.description.links
    }
    np.testing.assert_array_equal(again.lower_rad, arm.lower_rad)
    q = np.random.default_rng(0).uniform(-1, 1, (20, 5))
    for name, T in arm.link_transforms(q, 3.0).items():
        np.testing.assert_allclose(again.link_transforms(q, 3.0)[name], T, atol=1e-9)


@pytest.mark.parametrize("robot", ["al5a_paper", "so101", "px100"])
def test_an_arm_in_physics_stands_where_its_kinematics_say(robot, engine):
    arm, at = read_robot(robot_config(robot)), SE2(120.0, -80.0, (0.6, 0.8))
    world = open_engine(engine, Scene([arm], [at], BlockConfig(), [False]))
    world.reset()
    body = SimulatedArm(world, 0, arm)
    random, base = np.random.default_rng(2), at.matrix()
    for q in random.uniform(arm.lower_rad, arm.upper_rad, (20, 5)):
        body.place(q, 5.0)
        np.testing.assert_allclose(body.grip_mm(), (base @ arm.fk(q))[:3, 3], atol=0.02)
        np.testing.assert_allclose(body.joints_rad(), q, atol=1e-9)
        assert body.gripper_mm() == pytest.approx(5.0, abs=1e-6)
    world.close()


def test_masses_that_are_not_said_are_made_up_and_told(tmp_path):
    description = arm_of(MEDIUM.write(tmp_path)).description
    bare = replace(description, links=tuple(replace(link, inertial=None) for link in description.links))
    made = whole(bare)
    assert all(link.inertial is not None and link.inertial.mass_kg > 0 for link in made.links)
    assert all(min(np.linalg.eigvalsh(tensor(link.inertial))) > 0 for link in made.links)
    assert any("upper_arm" in words and " g" in words for words in made.assumed)
    inertial = Inertial(0.2, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0), (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4))
    said = replace(bare, links=tuple(replace(link, inertial=inertial) for link in bare.links))
    assert whole(said).links == said.links
    assert whole(said).assumed == said.assumed


def tensor(inertial):
    xx, xy, xz, yy, yz, zz = inertial.inertia_kg_m2
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def carried_out(model, engine, count, seed=3):
    """Position [mm] and orientation [deg] errors (n,) of transfers that were carried out, and what failed."""
    planner, random, errors, failures = MotionPlanner(model), np.random.default_rng(seed), [], []
    backend = make_backend(engine, model, TaskConfig(), planner.motion)
    try:
        for _ in range(count):
            arm = int(random.integers(2))
            ring = model.cell.arms[arm]
            radii, yaws = random.uniform(ring.r_min_mm, ring.r_max_mm, 2), 0.97 * random.uniform(*ring.yaw_rad, 2)
            pick, place = ring.at(radii, yaws)
            backend.reset(np.array([*pick, 0.4]), 0)
            paths = planner.plan_paths(arm, pick, place, planner.homes_rad[arm], planner.others_home_rad(arm)).paths
            done = backend.execute(arm, paths)
            turned = done.pose[2] - 0.4 - (paths.transfer[-1, 0] - paths.transfer[0, 0])
            errors.append([math.dist(done.pose[:2], place), abs(math.degrees(math.remainder(turned, 2 * math.pi)))])
            failures += [] if done.refusal is None else [done.refusal]
        return *np.array(errors).T, failures, backend.notes
    finally:
        backend.close()


@pytest.mark.parametrize(("lengths", "sticks"), [(MEDIUM, False), (SO101, False), (BARE, True)], ids=["medium", "down", "no fingers"])
def test_other_arms_put_the_block_where_they_are_told(tmp_path, engine, lengths, sticks):
    away_mm, turned_deg, failures, notes = carried_out(build_cell(lengths.cell(tmp_path, grid_mm=10.0)), engine, 4)
    assert not failures
    assert away_mm.max() < 2.0
    assert np.median(turned_deg) < 0.3
    assert turned_deg.max() < 1.5
    assert any("sticks to its hand" in note for note in notes) == sticks


def test_a_block_that_hangs_low_below_two_pads_is_held_by_a_rigid_joint_unless_friction_is_asked_for(tmp_path, engine):
    model = build_cell(MEDIUM.cell(tmp_path, grid_mm=10.0, pick_height_mm=60.0))
    away_mm, turned_deg, failures, notes = carried_out(model, engine, 3)
    assert not failures
    assert away_mm.max() < 0.2
    assert turned_deg.max() < 0.1
    assert "rigid joint" in notes[0]
    with SimulatedCell(model, MotionConfig(), engine=engine, grasp="friction") as cell:
        assert not cell.notes


def test_a_joint_too_weak_to_hold_the_arm_is_named(tmp_path):
    strong = build_cell(MEDIUM.cell(tmp_path, grid_mm=10.0))
    stretched = strong.arm.ik([strong.cell.arms[0].r_max_mm, 0.0, 45.0])[:1]
    needed = float(np.abs(holding_n_m(strong.arm, stretched))[0, 0])
    homes = MotionPlanner(strong).homes_rad
    require_effort(strong, MotionConfig(), homes)
    weak = build_cell(replace(MEDIUM, name="weak", effort=0.5 * needed).cell(tmp_path, grid_mm=10.0))
    with pytest.raises(UrdfError, match=r"weak.urdf: joint 'shoulder' has effort .* N m in its <limit>, and needs .* to hold the arm up"):
        require_effort(weak, MotionConfig(), homes)
    unknown = build_cell(replace(MEDIUM, name="unknown", effort=0.0).cell(tmp_path, grid_mm=10.0))
    assert any("effort 0 of base_yaw" in note for note in unknown.arm.description.assumed)
    with pytest.raises(UrdfError, match=r"unknown.urdf: joint 'base_yaw' has effort 0 in its <limit>"):
        require_effort(unknown, MotionConfig(), homes)


def test_what_holds_an_arm_up_is_the_slope_of_its_height(tmp_path):
    """Torques against the change of potential energy as a joint turns."""
    arm, h = arm_of(MEDIUM.write(tmp_path)), 1e-6
    links = [link for link in whole(arm.description).links if link.inertial is not None]

    def energy_j(q):
        frames = arm.link_transforms(q)
        return sum(9.81e-3 * link.inertial.mass_kg * (frames[link.name] @ np.append(link.inertial.xyz_mm, 1.0))[2] for link in links)

    for q in np.random.default_rng(1).uniform(-1.2, 1.2, (5, 5)):
        q[4] = 0.0
        slopes = [(energy_j(q + h * np.eye(5)[k]) - energy_j(q - h * np.eye(5)[k])) / (2 * h) for k in (1, 2, 3)]
        np.testing.assert_allclose(holding_n_m(arm, q[None])[0], slopes, atol=1e-6)


def test_the_picture_shows_what_large_arms_reach(model, tmp_path):
    assert view("top", model.cell) is TOP
    large = build_cell(WX250.cell(tmp_path, grid_mm=20.0)).cell
    assert view("top", large).eye_mm[2] > 1.9 * TOP.eye_mm[2]
