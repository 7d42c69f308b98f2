"""The shipped robots beside the AL5A: kinematics against PyBullet and the public files, cells, exact plans, motions."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import PUBLIC

from marl_handover import cli
from marl_handover.cell import build_cell, cell_config, load_cell
from marl_handover.cell.reach import bound_by
from marl_handover.config import TaskConfig
from marl_handover.errors import InvalidSetting
from marl_handover.files import resource_path
from marl_handover.geometry.robot import read_robot, robot_config
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.motion.planner import MotionPlanner
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules

ROBOTS = ("so101", "px100")
RINGS = {"so101": (150.0, 230.0), "so101_wide": (120.0, 348.0), "px100": (180.0, 316.0)}
"""Of the cells: the paper's; nearly what the joint limits allow at this pick pitch; what they allow, 60 mm over the table."""


@pytest.fixture(scope="module", params=RINGS)
def model(request):
    return build_cell(cell_config(request.param))


def postures(arm, count, seed=0):
    return np.random.default_rng(seed).uniform(arm.lower_rad, arm.upper_rad, (count, 5))


def file_joints(arm, q):
    """Values of the URDF's own joints at canonical joints (5,)."""
    sources = zip(arm.description.sources, q, strict=True)
    return {source.joint: source.sign * value + source.offset_rad for source, value in sources if source.joint is not None}


@pytest.mark.parametrize("name", ROBOTS)
def test_forward_kinematics_are_those_of_pybullet(name):
    pybullet = pytest.importorskip("pybullet")
    arm = read_robot(robot_config(name))
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(resource_path(f"urdf/{name}.urdf")), useFixedBase=True, physicsClientId=client)
        count = pybullet.getNumJoints(body, physicsClientId=client)
        about = [pybullet.getJointInfo(body, index, physicsClientId=client) for index in range(count)]
        index = {row[1].decode(): row[0] for row in about}
        grip = next(row[0] for row in about if row[12].decode() == "grip")
        zero = None
        for q in postures(arm, 500):
            for joint, value in file_joints(arm, q).items():
                pybullet.resetJointState(body, index[joint], value, physicsClientId=client)
            state = pybullet.getLinkState(body, grip, computeForwardKinematics=True, physicsClientId=client)
            R = np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))
            T = arm.fk(q)
            np.testing.assert_allclose(1000.0 * np.array(state[4]), T[:3, 3], atol=0.01)
            # The file's grip frame is turned against the canonical one in one and the same way in every posture.
            turn = R.T @ T[:3, :3]
            zero = turn if zero is None else zero
            np.testing.assert_allclose(turn, zero, atol=1e-5)
    finally:
        pybullet.disconnect(client)


@pytest.mark.parametrize(("name", "public", "tolerance_mm"), [("so101", "so101", 0.3), ("px100", "px100", 0.05)])
def test_lengths_are_those_of_the_public_file(name, public, tolerance_mm):
    """To the rounding of the numbers that were read off, and the 0.18 mm by which the public SO-101's roll axis is beside the plane."""
    path = PUBLIC / f"{public}.urdf"
    if not path.is_file():
        pytest.skip("the public files are not here")
    own = read_robot(robot_config(name))
    other = read_robot(replace(robot_config(str(path)), pitch_deg=robot_config(name).pitch_deg, shapes="links"))
    stands_mm = 2.4 if name == "so101" else 0.0  # the public base frame is that much over the table
    np.testing.assert_allclose(own.planar[:6], other.planar[:6] + [0.0, stands_mm, 0.0, 0.0, 0.0, 0.0], atol=tolerance_mm)
    np.testing.assert_allclose(own.planar[6:8], other.planar[6:8], atol=tolerance_mm)
    np.testing.assert_allclose(own.lower_rad[:4], other.lower_rad[:4], atol=1e-3)
    np.testing.assert_allclose(own.upper_rad[:4], other.upper_rad[:4], atol=1e-3)
    assert {source.joint for source in own.description.sources} == {source.joint for source in other.description.sources}


def test_rings(model):
    assert (model.fit.r_min_mm, model.fit.r_max_mm) == pytest.approx(RINGS[model.cell.config.name], abs=1.0)
    assert model.fit.false_inside_rate == 0.0
    assert model.fit.missed_rate < 0.02


def test_without_limits_of_the_cell_joints_and_lengths_end_the_ring():
    """The shapes leave what a check against the hulls of the real hand and base leaves, too."""
    config = replace(cell_config("so101_wide"), r_min_mm=None, r_max_mm=None)
    model = build_cell(config)
    assert (model.fit.r_min_mm, model.fit.r_max_mm) == pytest.approx((118.0, 352.0), abs=1.5)
    assert bound_by(model.arm, model.fit.r_min_mm - 5.0, 45.0, config.block) == "the limits of shoulder"


@pytest.mark.parametrize(("key", "value"), [("r_min_mm", 400.0), ("r_max_mm", 100.0)])
def test_a_ring_of_nothing_is_refused(key, value):
    config = replace(cell_config("so101"), r_min_mm=None, r_max_mm=None)
    with pytest.raises(InvalidSetting, match=key):
        build_cell(replace(config, **{key: value}))


def test_nothing_of_an_arm_always_touches(model):
    assert model.arm.description.ignored == ()
    assert model.arm.description.assumed == ()


def test_inverse_kinematics_hold_the_pin(model):
    """Over the whole ring the grip comes out at the point, its frame level, its x towards the point."""
    arm, generator = model.arm, np.random.default_rng(3)
    radius = generator.uniform(model.fit.r_min_mm, model.fit.r_max_mm, 300)
    yaw = generator.uniform(model.fit.yaw_lower_rad, model.fit.yaw_upper_rad, 300)
    point = np.stack([radius * np.cos(yaw), radius * np.sin(yaw), np.full(300, model.cell.pick_height_mm)], axis=-1)
    q = arm.ik(point)
    good = arm.within_limits(q)
    assert good.any(axis=-1).all()
    T = arm.fk(q[good])
    np.testing.assert_allclose(T[:, :3, 3], np.repeat(point, good.sum(axis=-1), axis=0), atol=1e-6)
    np.testing.assert_allclose(T[:, 2, 2], 1.0, atol=1e-9)
    assert len(ARM_JOINTS) == q.shape[-1]


def test_every_place_can_be_picked_from(model):
    planner, fit, generator = MotionPlanner(model), model.fit, np.random.default_rng(4)
    for number in range(8):
        arm = number % 2
        base = model.cell.bases[arm]
        radii = fit.r_min_mm, fit.r_max_mm, *generator.uniform(fit.r_min_mm, fit.r_max_mm, 6)
        pick = base.around(radii[number], generator.uniform(-1.0, -0.1))
        place = base.around(generator.uniform(fit.r_min_mm, fit.r_max_mm), generator.uniform(0.1, 1.0))
        motion = planner.plan_paths(arm, pick, place, planner.homes_rad[arm], planner.homes_rad[1 - arm])
        assert motion.min_clearance_mm >= planner.motion.arm_clearance_mm - 1e-6


@pytest.mark.parametrize(("name", "fewest"), [("so101", 2.95), ("so101_wide", 2.99)])
def test_problems_are_as_hard_as_those_of_the_paper(name, fewest):
    """Mean fewest transfers at 5 degrees, against a computation that knows nothing of this package."""
    rules = Rules(load_cell(name), TaskConfig(epsilon_deg=5.0))
    start, goal = sample_problems(rules.cell, 20_000, torch.Generator().manual_seed(0))
    assert ExactPlanner(rules).plan(start.numpy(), goal.numpy()).transfers.mean() == pytest.approx(fewest, abs=0.04)


def test_the_shipped_policy_fits_the_so101_as_it_is(capsys, tmp_path):
    """The rings are those of the paper, so the problem is, too."""
    out = tmp_path / "table.json"
    assert cli.main(["evaluate", "policy=pretrained_b", "cell=so101", "episodes=1000", f"json={out}", "progress=false"]) == 0
    table = json.loads(out.read_text())
    assert table["success_rate"] >= 0.99
    assert table["steps_ratio"] <= 1.02
