"""Laws of forward and inverse kinematics."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from marl_handover.arrays import wrap
from marl_handover.errors import InvalidSetting, UnknownKey, UnsupportedKinematics
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.closed_form import ClosedFormArm, grip_in_plane, grip_speed, into_plane, out_of_plane, planar_ik
from marl_handover.geometry.robot import describe, robot_config
from marl_handover.geometry.se3 import rotation, transform
from marl_handover.geometry.urdf import ARM_JOINTS, ArmDescription

DESCRIPTION = describe(robot_config("al5a"))
WIDE = {name: [-179.0, 179.0] for name in ARM_JOINTS}


def moved(description: ArmDescription, **shifts_mm: tuple[float, float, float]) -> ArmDescription:
    """The arm with some joints' origins shifted."""
    joints = tuple(
        replace(joint, xyz_mm=tuple(a + b for a, b in zip(joint.xyz_mm, shifts_mm.get(joint.name, (0, 0, 0)), strict=True)))
        for joint in description.joints
    )
    return replace(description, joints=joints)


# Upward offsets in every link, as a real bracket has them.
BENT = moved(DESCRIPTION, shoulder=(-3, 0, 9), elbow=(2, 0, 11), wrist_pitch=(0, 0, -7), wrist_roll=(0, 0, 5), grasp=(4, 0, 0))
ARMS = [ClosedFormArm(DESCRIPTION, WIDE), ClosedFormArm(BENT, WIDE)]
ASIDE = [ClosedFormArm(moved(BENT, grasp=(0, side, 0)), WIDE) for side in (-12.0, 30.0)]
angle = st.floats(-3.1, 3.1)


@pytest.mark.parametrize("arm", ARMS, ids=["shipped", "bent"])
@settings(max_examples=150, deadline=None)
@given(yaw=angle, shoulder=angle, elbow=angle, pitch=angle, roll=angle)
def test_fk_of_ik_is_identity_on_both_branches(arm: ArmModel, yaw: float, shoulder: float, elbow: float, pitch: float, roll: float) -> None:
    """Any pose whose grip is before the yaw axis comes back from both branches, and one of them is the joint vector it came from."""
    q = np.array([yaw, shoulder, elbow, wrap(pitch - shoulder - elbow), roll])
    T_base_grip = arm.fk(q)
    forward = math.cos(yaw) * T_base_grip[0, 3] + math.sin(yaw) * T_base_grip[1, 3]
    assume(forward > 1.0)  # nearer to the yaw axis, or behind it, the yaw is not the direction of the point
    back = arm.ik(T_base_grip[:3, 3], pitch, roll)
    assert back.shape == (2, 5)
    assert np.isfinite(back).all()
    np.testing.assert_allclose(arm.fk(back), np.broadcast_to(T_base_grip, (2, 4, 4)), atol=1e-5)
    same = np.abs(wrap(back - q)).max(axis=-1)
    assert same.min() < 1e-5  # acos near a stretched elbow costs half the digits


@pytest.mark.parametrize("arm", ASIDE, ids=["right", "left"])
@settings(max_examples=150, deadline=None)
@given(yaw=angle, shoulder=angle, elbow=angle, pitch=angle)
def test_a_grip_beside_the_plane_is_turned_less_than_its_place_is_seen(
    arm: ClosedFormArm, yaw: float, shoulder: float, elbow: float, pitch: float
) -> None:
    """psi = atan2(y, x) - asin(offset / distance), in fk, ik, the plane and speeds alike; nearer than the offset there is no pose."""
    q = np.array([yaw, shoulder, elbow, wrap(pitch - shoulder - elbow), 0.0])
    T_base_grip = arm.fk(q)
    x, y, _ = T_base_grip[:3, 3]
    np.testing.assert_allclose(arm.grip_mm(q), T_base_grip[:3, 3], atol=1e-9)
    rates = np.array([0.3, -0.7, 0.2, 1.1, 0.0])
    assert float(grip_speed(arm.planar, q, rates)) == pytest.approx(np.linalg.norm(arm.jacobian(q)[:3] @ rates), abs=1e-9)
    r, _ = grip_in_plane(arm.planar, q)
    np.testing.assert_allclose(out_of_plane(arm.planar, r, q[0]), (x, y), atol=1e-9)
    assume(r > 1.0)
    distance = math.hypot(x, y)
    radius, turned = into_plane(arm.planar, torch.tensor(distance, dtype=torch.float64), torch.atan2(torch.tensor(y), torch.tensor(x)))
    assert float(radius) == pytest.approx(float(r), abs=1e-6)
    assert abs(wrap(float(turned) - yaw)) < 1e-6
    assert abs(wrap(math.atan2(y, x) - math.asin(arm.lateral_mm / distance) - yaw)) < 1e-6
    back = arm.ik(T_base_grip[:3, 3], pitch)
    np.testing.assert_allclose(arm.fk(back), np.broadcast_to(T_base_grip, (2, 4, 4)), atol=1e-5)
    assert np.isnan(arm.ik([0.9 * arm.lateral_mm, 0.0, 50.0])).all()


def test_branch_0_is_elbow_up() -> None:
    arm = ARMS[0]
    q = arm.ik([200.0, 0.0, 45.0])
    heights = [arm.link_transforms(branch)["forearm"][2, 3] for branch in q]
    assert heights[0] > heights[1]
    assert q[0, 2] < 0 < q[1, 2]


@given(x=st.floats(-250, 250), y=st.floats(-250, 250))
@settings(max_examples=100, deadline=None)
def test_level_grip_points_away_from_the_base(x: float, y: float) -> None:
    """With pitch = roll = 0 the gripper's yaw is the base yaw, atan2 of the point: the arm is under-actuated."""
    assume(140 < math.hypot(x, y) < 300)
    q = ARMS[0].ik([x, y, 45.0])[0]
    T = ARMS[0].fk(q)
    assert wrap(q[0] - math.atan2(y, x)) == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(T[:3, :3], rotation(np.asarray(math.atan2(y, x)), (0, 0, 1)), atol=1e-12)


def test_sign_convention() -> None:
    arm = ARMS[0]
    np.testing.assert_allclose(arm.fk(np.zeros(5)), transform((315.0, 0.0, 67.0), (0, 0, 0)), atol=1e-9)
    for joint in (1, 2, 3):
        assert arm.fk(0.1 * np.eye(5)[joint])[2, 3] > 67
    assert arm.fk(0.1 * np.eye(5)[0])[1, 3] > 0
    assert arm.fk(0.1 * np.eye(5)[4])[2, 1] > 0  # the grip's left side rises


def test_batches_equal_single_calls() -> None:
    arm = ARMS[1]
    q = np.random.default_rng(0).uniform(-2, 2, (3, 4, 5))
    T = arm.fk(q)
    assert T.shape == (3, 4, 4, 4)
    np.testing.assert_array_equal(T[2, 1], arm.fk(q[2, 1]))
    points, pitch = T[..., :3, 3], np.linspace(-1, 1, 4)
    assert arm.ik(points, pitch).shape == (3, 4, 2, 5)
    np.testing.assert_allclose(arm.ik(points, pitch)[2, 1], arm.ik(points[2, 1], pitch[1]), atol=1e-12, equal_nan=True)
    assert arm.fk(np.zeros((0, 5))).shape == (0, 4, 4)


def test_link_transforms_agree_with_fk_and_open_the_fingers() -> None:
    arm = ARMS[1]
    q = np.random.default_rng(1).uniform(-2, 2, (6, 5))
    np.testing.assert_allclose(arm.link_transforms(q)["grip"], arm.fk(q), atol=1e-9)
    for gripper_mm, apart_mm in ((0.0, 0.0), (5.0, 10.0), (None, 32.0)):
        frames = arm.link_transforms(q, gripper_mm)
        gap = frames["finger_left_link"][:, :3, 3] - frames["finger_right_link"][:, :3, 3]
        np.testing.assert_allclose(np.linalg.norm(gap, axis=-1), apart_mm, atol=1e-9)


def test_out_of_reach_is_nan_and_within_no_limit() -> None:
    arm = ARMS[0]
    q = arm.ik([[316.0, 0.0, 67.0], [314.9, 0.0, 67.0], [115.0, 0.0, 67.0]])
    assert np.isnan(q[0]).all()
    assert np.isfinite(q[1]).all()
    assert np.isnan(q[2]).all()  # the wrist would lie on the shoulder, but the links differ by 12 mm
    assert not arm.within_limits(q[0]).any()


def test_stretched_arm_is_reachable() -> None:
    arm = ARMS[0]
    np.testing.assert_allclose(arm.ik([315.0, 0.0, 67.0]), np.zeros((2, 5)), atol=1e-6)


def test_limits_have_a_tiny_tolerance() -> None:
    arm = ClosedFormArm(DESCRIPTION, {"elbow": [-100, -10]})
    inside = np.radians([0.0, 10.0, -10.0, 0.0, 0.0])
    assert arm.within_limits(inside)
    assert arm.within_limits(inside + [0, 0, 5e-10, 0, 0])
    assert not arm.within_limits(inside + [0, 0, 1e-8, 0, 0])
    assert not arm.within_limits(inside - [0, 0, math.radians(90) + 1e-8, 0, 0])
    assert not arm.within_limits(inside + [math.radians(96), 0, 0, 0, 0])  # the other joints keep the URDF's limits
    assert arm.within_limits(np.stack([inside, inside + 1])).tolist() == [True, False]


def test_solutions_beyond_half_a_turn_are_found_within_limits() -> None:
    q = np.radians([0.0, 150.0, -150.0, 0.0, 0.0])
    point = ARMS[0].fk(q)[:3, 3]
    arm = ClosedFormArm(DESCRIPTION, {**WIDE, "shoulder": [-220.0, -200.0]})
    assert math.degrees(arm.ik(point)[0, 1]) == pytest.approx(-210.0)


@pytest.mark.parametrize("limits", [[10, -10], [1.0], [0, math.inf], [math.nan, 1]])
def test_bad_limits_are_named(limits: list[float]) -> None:
    with pytest.raises(InvalidSetting, match=r"joint_limits_deg\.elbow"):
        ClosedFormArm(DESCRIPTION, {"elbow": limits})


def test_unknown_joint_is_named() -> None:
    with pytest.raises(UnknownKey, match="knee.*elbow"):
        ClosedFormArm(DESCRIPTION, {"knee": [0, 1]})


@pytest.mark.parametrize(
    ("joint", "changes", "message"),
    [
        ("shoulder", {"axis": (0.0, 1.0, 0.0)}, "joint 'shoulder' has axis (0.0, 1.0, 0.0)"),
        ("base_yaw", {"axis": (1.0, 0.0, 0.0)}, "joint 'base_yaw' has axis"),
        ("elbow", {"rpy_rad": (0.0, 0.0, 0.1)}, "joint 'elbow' turns its frame"),
        ("elbow", {"xyz_mm": (94.0, 3.0, 0.0)}, "joint 'elbow' is 3 mm off the arm's plane"),
        ("base_yaw", {"xyz_mm": (2.0, 0.0, 24.0)}, "joint 'base_yaw' is 2 mm off"),
        ("wrist_pitch", {"xyz_mm": (0.0, 0.0, 0.0)}, "has no length"),
        ("wrist_pitch", {"kind": "prismatic"}, "'wrist_pitch' is prismatic"),
    ],
)
def test_a_description_that_is_not_canonical_is_refused(joint: str, changes: dict[str, object], message: str) -> None:
    joints = tuple(replace(each, **changes) if each.name == joint else each for each in DESCRIPTION.joints)
    with pytest.raises(UnsupportedKinematics) as caught:
        ClosedFormArm(replace(DESCRIPTION, joints=joints))
    assert message in str(caught.value)


def test_rotation_follows_urdf_rpy() -> None:
    """Fixed-axis roll, pitch, yaw, as the URDF standard has it, against the rotation matrices written out."""
    r, p, y = 0.3, -0.7, 1.1
    roll = [[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]]
    pitch = [[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]]
    yaw = [[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]]
    np.testing.assert_allclose(transform((1, 2, 3), (r, p, y))[:3, :3], np.array(yaw) @ pitch @ roll, atol=1e-12)


@pytest.mark.parametrize("arm", ARMS, ids=["shipped", "bent"])
@settings(max_examples=60, deadline=None)
@given(yaw=angle, shoulder=angle, elbow=angle, pitch=angle, roll=angle)
def test_the_jacobian_is_what_finite_differences_give(
    arm: ClosedFormArm, yaw: float, shoulder: float, elbow: float, pitch: float, roll: float
) -> None:
    q, h = np.array([yaw, shoulder, elbow, pitch, roll]), 1e-6
    J, T = arm.jacobian(q), arm.fk(q)
    for joint in range(5):
        step = h * np.eye(5)[joint]
        before, after = arm.fk(q - step), arm.fk(q + step)
        np.testing.assert_allclose(J[:3, joint], (after - before)[:3, 3] / (2 * h), atol=1e-4)
        turn = (after - before)[:3, :3] / (2 * h) @ T[:3, :3].T  # the skew matrix of the angular velocity
        np.testing.assert_allclose(J[3:, joint], [turn[2, 1], turn[0, 2], turn[1, 0]], atol=1e-6)


@pytest.mark.parametrize("arm", ARMS, ids=["shipped", "bent"])
@settings(max_examples=60, deadline=None)
@given(yaw=angle, shoulder=angle, elbow=angle, pitch=angle, roll=angle)
def test_the_plane_agrees_with_space_in_numpy_and_in_torch(
    arm: ClosedFormArm, yaw: float, shoulder: float, elbow: float, pitch: float, roll: float
) -> None:
    q, rates = np.array([yaw, shoulder, elbow, pitch, roll]), np.array([0.3, -0.7, 0.2, 1.1, 0.9])
    np.testing.assert_allclose(arm.grip_mm(q), arm.fk(q)[:3, 3], atol=1e-9)
    speed = np.linalg.norm(arm.jacobian(q)[:3] @ rates)
    assert float(grip_speed(arm.planar, q, rates)) == pytest.approx(speed, abs=1e-9)
    r, z = grip_in_plane(arm.planar, torch.tensor(q))
    np.testing.assert_allclose([float(r), float(z)], grip_in_plane(arm.planar, q), atol=1e-9)
    for elbow_sign in (-1, 1):
        found = planar_ik(
            arm.planar, *(torch.tensor(value, dtype=torch.float64) for value in (float(r), float(z), shoulder + elbow + pitch)), elbow_sign
        )
        expected = planar_ik(arm.planar, float(r), float(z), shoulder + elbow + pitch, elbow_sign)
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)
