"""The URDF reader: what it reads from the shipped arm, and that a faulty file is refused by name."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest

from marl_handover.errors import MissingFile, UrdfError
from marl_handover.files import resource_path
from marl_handover.geometry.robot import describe, robot_config
from marl_handover.geometry.urdf import ARM_JOINTS, read_urdf

SHIPPED = resource_path("urdf/al5a.urdf")
TEXT = SHIPPED.read_text(encoding="utf-8")


def without(tag: str, name: str) -> str:
    """The shipped URDF less one element."""
    robot = ET.fromstring(TEXT)
    robot.remove(next(element for element in robot.findall(tag) if element.get("name") == name))
    return ET.tostring(robot, encoding="unicode")


def test_shipped_arm_has_the_measured_geometry_in_mm() -> None:
    arm = describe(robot_config("al5a"))
    assert tuple(joint.name for joint in arm.chain() if joint.kind != "fixed") == ARM_JOINTS
    x_mm = sum(joint.xyz_mm[0] for joint in arm.chain())
    z_mm = sum(joint.xyz_mm[2] for joint in arm.chain())
    assert (x_mm, z_mm) == pytest.approx((15 + 94 + 106 + 100, 67))
    assert arm.joint("elbow").xyz_mm == pytest.approx((94, 0, 0))
    assert math.degrees(arm.joint("shoulder").upper) == pytest.approx(149.6, abs=1e-3)


def test_fingers_are_prismatic_in_mm_and_part_sideways() -> None:
    arm = describe(robot_config("al5a"))
    left, right = arm.joint("finger_left"), arm.joint("finger_right")
    assert (left.kind, right.kind) == ("prismatic", "prismatic")
    assert (left.lower, left.upper) == pytest.approx((0, 16)) == (right.lower, right.upper)
    assert (left.axis, right.axis) == ((0, 1, 0), (0, -1, 0))


def test_hand_clears_the_block_at_pick_height() -> None:
    hand = next(link for link in read_urdf(SHIPPED).links if link.name == "hand")
    assert hand.collisions
    assert all(abs(shape.xyz_mm[2]) + shape.size_mm[2] / 2 <= 14 for shape in hand.collisions)


def test_inertias_are_those_of_a_possible_body() -> None:
    inertials = ET.fromstring(TEXT).findall("link/inertial")
    assert len(inertials) == 9
    for inertial in inertials:
        moments = sorted(float(inertial.find("inertia").get(key)) for key in ("ixx", "iyy", "izz"))  # type: ignore[union-attr,arg-type]
        assert float(inertial.find("mass").get("value")) > 0  # type: ignore[union-attr,arg-type]
        assert moments[0] > 0
        assert moments[0] + moments[1] >= moments[2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (without("link", "grip").replace('"grip"', '"tip"'), "'tip', which is missing"),
        (without("joint", "elbow"), "2 links without a parent (base_link, forearm)"),
        (TEXT.replace("<robot", '<!DOCTYPE robot [<!ENTITY x "y">]><robot', 1), "DOCTYPE"),
        (TEXT.replace('xyz="0.094 0 0"', 'xyz="nan 0 0"'), "nan 0 0"),
        (TEXT.replace('xyz="0.094 0 0"', 'xyz="0.094 0"'), "it must have 3"),
        (TEXT.replace('xyz="0.094 0 0"', 'xyz="one 0 0"'), "is not a number"),
        (TEXT.replace('<mass value="0.19"/>', '<mass value="inf"/>'), "inf"),
        (TEXT.replace('velocity="9.5"', ""), "lacks its 'velocity'"),
        (TEXT.replace('lower="-1.65806" upper="1.65806"', 'lower="1" upper="-1"'), "lower limit above"),
        (TEXT.replace('<limit lower="-1.65806" upper="1.65806" effort="0.59" velocity="5.8"/>', ""), "joint 'base_yaw' lacks its <limit>"),
        (TEXT.replace('<box size="0.084 0.022 0.016"/>', "<mesh/>"), "lacks its 'filename'"),
        (TEXT.replace('<mass value="0.19"/>', '<mass value="-0.19"/>'), "link 'forearm' has a mass of -0.19 kg"),
        (TEXT.replace('type="prismatic"', 'type="planar"', 1), "joint 'finger_left' has type 'planar'"),
        (
            TEXT.replace("<robot", '<robot xmlns:xacro="http://ros.org/xacro"').replace("</robot>", "<xacro:arm/></robot>"),
            "run xacro first: xacro faulty.urdf",
        ),
        (TEXT.replace("</robot>", "<xacro:arm/></robot>"), "run xacro first"),
        (TEXT.replace('xyz="0.094 0 0"', 'xyz="${length} 0 0"'), "run xacro first"),
        (TEXT.replace("<link", "\n<<<<<<< HEAD\n<link", 1), "is a marker of an unfinished merge"),
        ("<sdf version='1.6'/>", "this is an SDF"),
        ("<mujoco/>", "this is an MJCF"),
        (TEXT.replace('velocity="0.095"/>', 'velocity="0.095"/><mimic joint="thumb"/>', 1), "mimics joint 'thumb', which is missing"),
        (TEXT.replace('velocity="0.095"/>', 'velocity="0.095"/><mimic joint="finger_left"/>', 1), "mimics itself"),
        (TEXT.replace('<box size="0.084 0.022 0.016"/>', '<box size="0.084 0 0.016"/>'), "not above 0"),
        (TEXT.replace('<parent link="hand"/>', '<parent link="nowhere"/>', 1), "'nowhere', which is missing"),
        (TEXT.replace('<child link="finger_left_link"/>', '<child link="hand"/>'), "child link 'hand' is there 2 times"),
        (TEXT.replace('<parent link="wrist"/>', '<parent link="grip"/>'), "part of a loop"),
        (TEXT[:-20], "malformed XML"),
        ("<model/>", "must be <robot>"),
        ("", "malformed XML"),
    ],
)
def test_faulty_files_are_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "faulty.urdf"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UrdfError) as caught:
        read_urdf(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_doctype_in_another_encoding_is_refused_too(tmp_path: Path) -> None:
    path = tmp_path / "hidden.urdf"
    path.write_bytes('<?xml version="1.0" encoding="utf-16"?><!DOCTYPE robot [<!ENTITY x "y">]><robot name="&x;"/>'.encode("utf-16"))
    with pytest.raises(UrdfError, match="UTF-8"):
        read_urdf(path)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match=r"none\.urdf"):
        read_urdf(tmp_path / "none.urdf")


def test_another_tip_is_looked_for() -> None:
    with pytest.raises(UrdfError, match="link 'claw', the tip, is missing; it has: .*grip"):
        describe(replace(robot_config("al5a"), tip="claw"))


def test_what_a_generator_leaves_behind_says_nothing(tmp_path):
    """A xacro property that nothing uses, shapes of size 0, limits that are as good as none."""
    text = TEXT.replace("<robot", '<robot xmlns:xacro="http://ros.org/xacro"', 1).replace(
        "</robot>", '<xacro:property name="w" value="1"/></robot>'
    )
    text = text.replace('<box size="0.084 0.022 0.016"/>', '<sphere radius="0.0"/>').replace('effort="0.59"', 'effort="1e16"')
    (tmp_path / "left.urdf").write_text(text)
    tree = read_urdf(tmp_path / "left.urdf")
    assert next(link for link in tree.links if link.name == "upper_arm").collisions == ()
    assert tree.assumed == ("shapes of size 0 are none: those of upper_arm",)
    assert next(joint for joint in tree.joints if joint.name == "base_yaw").effort == 1e16
