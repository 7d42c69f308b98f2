"""A robot is the same arm however its URDF is written: names, order, signs, zeros and frames say nothing."""

from __future__ import annotations

import math
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from cases import PUBLIC, RINGS_MM, SMALL, needs_cases
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover.config import RobotConfig
from marl_handover.errors import InvalidSetting, UnknownChoice, UnsupportedKinematics, UrdfError
from marl_handover.files import resource_path
from marl_handover.geometry.canonical import require_moving
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.robot import describe, robot_config
from marl_handover.geometry.se3 import rotation, rpy_of, transform
from marl_handover.geometry.urdf import ARM_JOINTS, Gripper

SHIPPED = resource_path("urdf/al5a.urdf")
TEXT = SHIPPED.read_text()


def read(path: Path, **settings_: object) -> ClosedFormArm:
    config = RobotConfig(urdf=str(path), **settings_)  # type: ignore[arg-type]
    return ClosedFormArm(describe(config))


def rewritten(draw: st.DrawFn) -> tuple[str, dict[str, tuple[str, int, float]]]:
    """The shipped arm written otherwise, and role -> (joint, sign, offset) as it should be read."""
    robot = ET.fromstring(TEXT)
    joints, links = robot.findall("joint"), robot.findall("link")
    names = draw(st.permutations([f"part_{index}" for index in range(len(joints) + len(links))]))
    renamed = dict(zip([each.get("name") for each in [*joints, *links]], names, strict=True))
    turned: dict[str, np.ndarray] = {"base_link": np.eye(4)}
    expected = {}
    for joint in joints:
        name, child = joint.get("name"), joint.find("child").get("link")
        origin = joint.find("origin")
        T = transform(*([float(word) for word in origin.get(key).split()] for key in ("xyz", "rpy")))
        new = np.eye(4)
        new[:3, :3] = rotation(np.asarray(draw(st.floats(-3, 3))), np.eye(3)[draw(st.integers(0, 2))])
        axis = np.array([float(word) for word in joint.find("axis").get("xyz").split()]) if joint.find("axis") is not None else None
        if name in ARM_JOINTS:
            sign, zero = draw(st.sampled_from((1, -1))), draw(st.floats(-0.7, 0.7)) if name != "base_yaw" else 0.0
            # A frame that is turned and shifted along the axis, a joint that is counted the other way and from elsewhere.
            shift = np.eye(4)
            shift[:3, 3] = axis * draw(st.floats(-0.02, 0.02))
            zeroed = np.eye(4)
            zeroed[:3, :3] = rotation(np.asarray(-zero), axis)
            T, new = T @ zeroed, shift @ new
            limit = joint.find("limit")
            ends = sorted(sign * (float(limit.get(key)) + zero) for key in ("lower", "upper"))
            limit.set("lower", repr(ends[0]))
            limit.set("upper", repr(ends[1]))
            axis = sign * axis
            expected[name] = (renamed[name], sign, sign * zero)
        placed = np.linalg.inv(turned[joint.find("parent").get("link")]) @ T @ new
        if axis is not None:
            joint.find("axis").set("xyz", " ".join(map(repr, (new[:3, :3].T @ axis).tolist())))
        origin.set("xyz", " ".join(map(repr, placed[:3, 3].tolist())))
        origin.set("rpy", " ".join(map(repr, rpy_of(placed[:3, :3]))))
        turned[child] = new
    for link in links:
        for origin in link.iter("origin"):
            T = np.linalg.inv(turned.get(link.get("name"), np.eye(4))) @ transform(
                *([float(word) for word in origin.get(key).split()] for key in ("xyz", "rpy"))
            )
            origin.set("xyz", " ".join(map(repr, T[:3, 3].tolist())))
            origin.set("rpy", " ".join(map(repr, rpy_of(T[:3, :3]))))
    for each in [*joints, *links]:
        each.set("name", renamed[each.get("name")])
    for joint in joints:
        for tag in ("parent", "child"):
            joint.find(tag).set("link", renamed[joint.find(tag).get("link")])
    parts = draw(st.permutations([*links, *joints]))
    for part in [*links, *joints]:
        robot.remove(part)
    robot.extend(parts)
    return ET.tostring(robot, encoding="unicode"), expected


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_a_robot_that_is_written_otherwise_is_the_same_arm(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    text, expected = rewritten(data.draw)
    path = tmp_path_factory.mktemp("robot") / "other.urdf"
    path.write_text(text)
    arm, same = read(path), read(SHIPPED)
    for role, source in zip(ARM_JOINTS, arm.description.sources, strict=True):
        name, sign, offset = expected[role]
        assert (source.joint, source.sign) == (name, sign)
        assert source.offset_rad == pytest.approx(offset, abs=1e-9)
    np.testing.assert_allclose(arm.planar, same.planar, atol=1e-6)
    np.testing.assert_allclose(arm.lower_rad, same.lower_rad, atol=1e-9)
    np.testing.assert_allclose(arm.upper_rad, same.upper_rad, atol=1e-9)
    assert arm.ring_mm(45.0) == pytest.approx(same.ring_mm(45.0), abs=0.02)
    q = np.random.default_rng(0).uniform(same.lower_rad, same.upper_rad, (50, 5))
    np.testing.assert_allclose(arm.fk(q), same.fk(q), atol=1e-6)
    gripper = arm.description.gripper
    assert (gripper.kind, gripper.travel_mm) == ("fingers", pytest.approx(16.0))


def test_the_shipped_arm_is_taken_as_it_is() -> None:
    """To the last bit: frames, limits and shapes of the file."""
    description = describe(robot_config("al5a"))
    assert description.grasp_link == description.tip == "grip"
    assert [joint.name for joint in description.joints][:5] == list(ARM_JOINTS)
    assert description.joint("elbow").xyz_mm == (94.0, 0.0, 0.0)
    assert all(source.sign == 1 and source.offset_rad == 0.0 for source in description.sources)
    assert not any(any(link.file_xyz_mm) or any(link.file_rpy_rad) for link in description.links)


@pytest.mark.parametrize("pitch_deg", [0.0, -30.0, -60.0, 20.0])
def test_the_pick_pitch_turns_the_hand_and_leaves_the_grip_frame_level(pitch_deg: float) -> None:
    level, tilted = read(SHIPPED), read(SHIPPED, pitch_deg=pitch_deg)
    for q in tilted.ik([180.0, 40.0, 45.0]):
        T = tilted.fk(q)
        np.testing.assert_allclose(T[:3, 3], [180.0, 40.0, 45.0], atol=1e-6)
        np.testing.assert_allclose(T[:3, 2], [0.0, 0.0, 1.0], atol=1e-9)
        file = np.array([source.sign * value + source.offset_rad for source, value in zip(tilted.description.sources, q, strict=True)])
        assert math.degrees(file[1:4].sum()) == pytest.approx(pitch_deg, abs=1e-6)
        np.testing.assert_allclose(level.fk(file)[:3, 3], T[:3, 3], atol=1e-6)
        shape = tilted.link_transforms(q)["hand"], level.link_transforms(file)["hand"]
        own = next(link for link in tilted.description.links if link.name == "hand")
        np.testing.assert_allclose(shape[0] @ transform(own.file_xyz_mm, own.file_rpy_rad), shape[1], atol=1e-6)


def test_straight_down_is_refused_where_the_roll_would_do_everything() -> None:
    with pytest.raises(InvalidSetting, match="the wrist roll alone turns the object by any angle"):
        read(SHIPPED, pitch_deg=-90.0)


def without_roll(text: str = TEXT) -> str:
    robot = ET.fromstring(text)
    joint = next(each for each in robot.findall("joint") if each.get("name") == "wrist_roll")
    joint.set("type", "fixed")
    return ET.tostring(robot, encoding="unicode")


def test_an_arm_without_roll_is_the_same_with_a_locked_one(tmp_path: Path) -> None:
    path = tmp_path / "four.urdf"
    path.write_text(without_roll())
    four, five = read(path), read(SHIPPED)
    assert four.description.sources[4].joint is None
    assert (four.lower_rad[4], four.upper_rad[4]) == (0.0, 0.0)
    assert four.ring_mm(45.0) == pytest.approx(five.ring_mm(45.0), abs=0.02)
    q = np.random.default_rng(1).uniform(five.lower_rad, five.upper_rad, (50, 5)) * [1, 1, 1, 1, 0]
    np.testing.assert_allclose(four.fk(q), five.fk(q), atol=1e-9)
    assert read(path, pitch_deg=-90.0).ik([150.0, 0.0, 60.0]).shape == (2, 5)


def test_a_grip_beside_the_roll_axis_is_reached_with_the_hand_rolled_too(tmp_path: Path) -> None:
    path = tmp_path / "side.urdf"
    path.write_text(TEXT.replace('<origin xyz="0.064 0 0" rpy="0 0 0"/>', '<origin xyz="0.064 0.007 -0.004" rpy="0 0 0"/>'))
    arm = read(path)
    assert arm.lateral_mm == pytest.approx(7.0)
    for roll in (0.0, 0.4, -1.1):
        q = arm.ik([200.0, -60.0, 60.0], -0.3, roll)
        np.testing.assert_allclose(arm.fk(q)[..., :3, 3], np.tile([200.0, -60.0, 60.0], (2, 1)), atol=1e-6)
        yaw = math.atan2(-60.0, 200.0) - math.asin(arm.fk(np.array([0, 0, 0, 0, roll]))[1, 3] / math.hypot(200.0, 60.0))
        assert q[0, 0] == pytest.approx(yaw, abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"joints": {"knee": "elbow"}}, UnknownChoice, "knee"),
        ({"joints": {"elbow": "knee"}}, UnknownChoice, "robot.joints.elbow = 'knee'"),
        ({"locked": {"knee": 0.0}}, UnknownChoice, "robot.locked.knee"),
        ({"gripper": ["thumb"]}, UnknownChoice, r"robot.gripper\[0\]"),
        ({"tip": "nose"}, UrdfError, "link 'nose', the tip, is missing"),
        ({"tip": "grip", "approach": "+y"}, UrdfError, "approach .y of the tip is along a pitch axis"),
        ({"locked": {"elbow": 0.0}}, UnsupportedKinematics, "no wrist pitch"),
    ],
)
def test_settings_that_do_not_fit_the_robot_are_named(changes: dict[str, object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        read(SHIPPED, **changes)


def test_a_locked_joint_is_a_fixed_one(tmp_path: Path) -> None:
    arm = read(SHIPPED, locked={"wrist_roll": 90.0})
    assert arm.description.sources[4].joint is None
    assert arm.description.locked == (("wrist_roll", math.pi / 2),)


def two_hands() -> str:
    """The shipped arm with a second hand on a second wrist."""
    robot = ET.fromstring(TEXT)
    for part in ("wrist", "hand", "finger_left_link", "finger_right_link"):
        ET.SubElement(robot, "link", name=f"{part}_2")
    for joint in list(robot.findall("joint")):
        if joint.get("name") in ("wrist_pitch", "wrist_roll", "finger_left", "finger_right"):
            copy = ET.fromstring(ET.tostring(joint))
            copy.set("name", f"{joint.get('name')}_2")
            copy.find("child").set("link", f"{joint.find('child').get('link')}_2")
            if joint.get("name") != "wrist_pitch":
                copy.find("parent").set("link", f"{joint.find('parent').get('link')}_2")
            robot.append(copy)
    return ET.tostring(robot, encoding="unicode")


def test_a_robot_with_two_hands_asks_which(tmp_path: Path) -> None:
    path = tmp_path / "two.urdf"
    path.write_text(two_hands())
    with pytest.raises(UrdfError, match=r"more than one hand \(hand, hand_2\); say which with tip"):
        read(path)
    assert read(path, tip="grip").description.sources[4].joint == "wrist_roll"


def missing(*names: str) -> str:
    """The shipped arm with joints made fixed."""
    robot = ET.fromstring(TEXT)
    for joint in robot.findall("joint"):
        if joint.get("name") in names:
            joint.set("type", "fixed")
    return ET.tostring(robot, encoding="unicode")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (missing("wrist_pitch"), "no wrist pitch"),
        (missing("wrist_pitch", "wrist_roll"), "not enough joints"),
        (TEXT.replace('name="elbow" type="revolute"', 'name="elbow" type="prismatic"'), "joint 'elbow' slides"),
        (TEXT.replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 -1 0.2"/>', 1), "no wrist pitch"),
    ],
)
def test_another_class_is_refused_with_what_it_lacks(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "other.urdf"
    path.write_text(text)
    with pytest.raises(UnsupportedKinematics, match=message) as caught:
        read(path)
    assert str(path) in str(caught.value)


@needs_cases
@pytest.mark.parametrize("name", [name for name in RINGS_MM if name != "lite6"])
def test_public_arms_have_the_rings_of_independent_kinematics(name: str) -> None:
    height, low, high = RINGS_MM[name]
    assert read(PUBLIC / f"{name}.urdf", pick_height_mm=float(height)).ring_mm(height) == pytest.approx((low, high), abs=5.0)


@needs_cases
@pytest.mark.parametrize("name", sorted(path.stem for path in SMALL.glob("*.urdf")) or ["none here"])
def test_one_convention_more_is_the_same_arm(name: str) -> None:
    refused = {"conflict": "merge", "planar": "'cam' has type 'floating'", "no_velocity": "joint 'base_yaw' lacks its 'effort'"}
    if name in refused:
        with pytest.raises(UrdfError, match=refused[name]):
            read(SMALL / f"{name}.urdf")
        return
    arm, base = read(SMALL / f"{name}.urdf"), read(SMALL / "base.urdf")
    if name == "upright_zero":
        assert arm.ring_mm(45.0) == pytest.approx((304, 658), abs=1.0)
    else:
        beside = {"grip_offset": 5.0, "grip_side": 0.3}.get(name, 0.1)
        assert arm.ring_mm(45.0) == pytest.approx(base.ring_mm(45.0), abs=beside)
    kinds = {"jaw": "jaw", "no_fingers": "none", "upright_zero": "none"}
    assert arm.description.gripper.kind == kinds.get(name, "fingers")


SIX_AXES = [  # joint, origin xyz, rpy: three parallel pitches, then two joints that turn a flange
    ("j1", "0 0 0.13", "0 0 0"),
    ("j2", "0 0 0", "0 1.5707963 -1.5707963"),
    ("j3", "-0.11 0 0", "0 0 0"),
    ("j4", "-0.096 0 0.064", "0 0 -1.5707963"),
    ("j5", "0 -0.073 0", "1.5707963 -1.5707963 0"),
    ("j6", "0 0.045 0", "-1.5707963 0 0"),
]


def six_axes() -> str:
    links = "".join(
        f'<link name="l{index}"><visual><geometry><mesh filename="package://x/{index}.dae"/></geometry></visual></link>'
        for index in range(7)
    )
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="l{index}"/><child link="l{index + 1}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
        '<axis xyz="0 0 1"/><limit effort="1000.0" lower="-3.14" upper="3.14159" velocity="0"/></joint>'
        for index, (name, xyz, rpy) in enumerate(SIX_AXES)
    )
    head = '<robot name="six" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="unused" value=".2"/>'
    return f"{head}{links}{joints}</robot>"


def test_six_axes_without_masses_shapes_or_speed_are_read(tmp_path: Path) -> None:
    path = tmp_path / "six.urdf"
    path.write_text(six_axes())
    description = describe(RobotConfig(urdf=str(path)))
    assert [source.joint for source in description.sources] == ["j1", "j2", "j3", "j4", "j6"]
    assert description.locked == (("j5", 0.0),)
    require_moving(description, needs_speed=False)
    with pytest.raises(UrdfError, match="joint 'j1' has velocity 0"):
        require_moving(description)


def test_a_finger_is_no_wrist_pitch(tmp_path: Path) -> None:
    """Yaw, two pitches and a roll with a hinged finger, which would be parallel to the pitches if the roll were locked."""
    robot = ET.fromstring(missing("wrist_pitch"))
    for joint in list(robot.findall("joint")):
        if joint.get("name") == "finger_right":
            robot.remove(joint)
        elif joint.get("name") == "finger_left":
            joint.set("type", "revolute")
            joint.find("axis").set("xyz", "0 0 1")  # type: ignore[union-attr]
    path = tmp_path / "jaw.urdf"
    path.write_text(ET.tostring(robot, encoding="unicode"))
    with pytest.raises(UnsupportedKinematics, match="no wrist pitch"):
        read(path)


@pytest.mark.parametrize("factor", [1.0, -1.0])
def test_fingers_that_mimic_each_other_or_a_third_open_as_the_free_ones_do(tmp_path: Path, factor: float) -> None:
    text = TEXT
    if factor < 0:
        text = text.replace(
            '<axis xyz="0 -1 0"/>\n    <limit lower="0" upper="0.016"', '<axis xyz="0 1 0"/>\n    <limit lower="-0.016" upper="0"'
        )
    mimicking = text.replace(
        'velocity="0.095"/>\n  </joint>\n\n  <joint name="grasp"',
        f'velocity="0.095"/><mimic joint="finger_left" multiplier="{factor}"/>\n  </joint>\n\n  <joint name="grasp"',
    )
    assert mimicking.count("<mimic") == 1
    path = tmp_path / "mimic.urdf"
    path.write_text(mimicking)
    values = describe(RobotConfig(urdf=str(path))).gripper.joint_values(10.0)
    assert values == pytest.approx({"finger_left": 10.0, "finger_right": 10.0 * factor})


def test_the_gripper_knows_how_far_it_is_open() -> None:
    jaw = Gripper("jaw", ("hinge",), (-0.2,), (1.0,), pads=1, lever_mm=70.0, travel_mm=40.0)
    for kind in (jaw, describe(robot_config("al5a")).gripper):
        for opening_mm in (0.0, 3.0, 12.0):
            values = kind.joint_values(opening_mm)
            assert kind.gripper_mm([values[name] for name in kind.joints]) == pytest.approx(opening_mm)
    assert jaw.joint_values(5.0)["hinge"] == pytest.approx(-0.2 + 2 * math.asin(10.0 / 140.0))
    assert Gripper().joint_values(5.0) == {}


def many_arms(arms: int, joints: int, bars: int) -> str:
    """Chains of joints that turn about all axes, with fixed links on each: a file that takes its time."""
    links, parts = ['<link name="base"/>'], []
    for arm in range(arms):
        parent = "base"
        for index in range(joints):
            child = f"l{arm}_{index}"
            links.append(f'<link name="{child}"/>')
            axis = ("0 0 1", "0 1 0", "1 0 0")[index % 3]
            parts.append(
                f'<joint name="j{arm}_{index}" type="continuous"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
                f'<origin xyz="0.1 0.0{index} 0"/></joint>'
            )
            parent = child
            for bar in range(bars):
                links.append(f'<link name="{child}_{bar}"/>')
                parts.append(f'<joint name="{child}_{bar}" type="fixed"><parent link="{child}"/><child link="{child}_{bar}"/></joint>')
    return f"<robot name='many'>{''.join(links)}{''.join(parts)}</robot>"


@pytest.mark.parametrize(("arms", "joints", "bars"), [(1, 400, 0), (8, 7, 7), (7, 8, 7)])
def test_a_file_of_many_joints_is_answered_soon(tmp_path: Path, arms: int, joints: int, bars: int) -> None:
    path = tmp_path / "many.urdf"
    path.write_text(many_arms(arms, joints, bars))
    started = time.perf_counter()
    with pytest.raises((UrdfError, UnsupportedKinematics)):
        read(path)
    assert time.perf_counter() - started < 20.0
