"""``marl-handover robot``: how a URDF is read, printed and written; what cannot be read, in one line."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.image
import pytest
from cases import PUBLIC, RINGS_MM, SMALL, needs_cases

from marl_handover import cli
from marl_handover.files import resource_path
from marl_handover.geometry.urdf import ARM_JOINTS

TEXT = resource_path("urdf/al5a.urdf").read_text()
KEYS = {"robot", "class", "roles", "tip", "ring_mm", "yaw_range_rad", "pick_height_mm", "pitch_deg", "lateral_mm", "assumed"}


def test_a_shipped_robot_by_name(tmp_path, capsys):
    assert cli.main(["robot", "robot=al5a", f"json={tmp_path / 'r.json'}", f"out={tmp_path / 'out'}"]) == 0
    out = capsys.readouterr().out
    assert "elbow        elbow: -167.0 to 0.0 deg by the robot's settings" in out
    written = json.loads((tmp_path / "r.json").read_text())
    assert written == json.loads((tmp_path / "out" / "robot.json").read_text())
    assert written.keys() >= KEYS
    assert written["roles"] == {
        "yaw": "base_yaw",
        "pitch": ["shoulder", "elbow", "wrist_pitch"],
        "roll": "wrist_roll",
        "locked": {},
        "gripper": {"kind": "fingers", "joints": ["finger_left", "finger_right"], "travel_mm": 16.0},
    }
    assert written["ring_mm"] == pytest.approx([141.8, 313.8], abs=0.1)  # by joint limits alone; the cell has 143 to 313
    assert matplotlib.image.imread(tmp_path / "out" / "robot.png").shape[0] > 300


def test_a_file_may_stand_without_its_key(tmp_path, capsys):
    path = tmp_path / "mine.urdf"
    path.write_text(TEXT)
    assert cli.main(["robot", str(path), "pitch_deg=-60", f"json={tmp_path / 'r.json'}"]) == 0
    written = json.loads((tmp_path / "r.json").read_text())
    assert (written["robot"], written["pitch_deg"]) == ("mine", -60)
    assert set(written["limits_from"].values()) == {"the URDF"}
    assert "hand at -60 deg" in capsys.readouterr().out


@needs_cases
@pytest.mark.parametrize("name", RINGS_MM)
@pytest.mark.parametrize("shapes", ["links", "none"])
def test_public_arms_are_read_unchanged_without_their_meshes(name, shapes, tmp_path, capsys):
    arguments = [str(PUBLIC / f"{name}.urdf"), f"pick_height_mm={RINGS_MM[name][0]}", f"shapes={shapes}", f"json={tmp_path / 'r.json'}"]
    assert cli.main(["robot", *arguments]) == 0
    written = json.loads((tmp_path / "r.json").read_text())
    assert written["ring_mm"][1] == pytest.approx(RINGS_MM[name][2], abs=5)
    assert len(written["roles"]["pitch"]) == 3
    assert written["roles"]["locked"] == ({"joint4": 0.0} if name == "lite6" else {})


@needs_cases
def test_missing_meshes_are_named_where_they_are_asked_for(capsys):
    assert cli.main(["robot", str(PUBLIC / "so101.urdf"), "shapes=file"]) == 2
    assert "shapes=links" in capsys.readouterr().err
    assert cli.main(["robot", str(PUBLIC / "so101.urdf")]) == 0
    assert "mesh of link 'base_link', not found" in capsys.readouterr().out


def test_a_robot_without_a_level_ring_is_told_a_pitch_that_has_one(tmp_path, capsys):
    path = tmp_path / "steep.urdf"
    path.write_text(TEXT.replace('lower="-1.65806" upper="1.74533"', 'lower="-1.65806" upper="-0.9"'))
    assert cli.main(["robot", str(path)]) == 2
    told = capsys.readouterr().err
    assert "leave no ring in which the hand is level at pick_height_mm = 45; pitch_deg=" in told
    pitch = told.partition("pitch_deg=")[2].split()[0]
    assert cli.main(["robot", str(path), f"pitch_deg={pitch}"]) == 0


LINES = {
    "xacro": (TEXT.replace("</robot>", "<xacro:arm/></robot>"), "run xacro first"),
    "sdf": ("<sdf/>", "this is an SDF"),
    "mjcf": ("<mujoco/>", "this is an MJCF"),
    "laughs": ('<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>' + TEXT, "DOCTYPE"),
    "merge": (TEXT.replace("<link", "\n<<<<<<< HEAD\n<link", 1), "unfinished merge"),
    "loop": (TEXT.replace('<parent link="wrist"/>', '<parent link="grip"/>'), "loop"),
    "mass": (TEXT.replace('<mass value="0.19"/>', '<mass value="-1"/>'), "mass of -1 kg"),
    "still": (TEXT.replace('effort="1.29" velocity="4.55"', 'effort="0" velocity="0"'), "joint 'shoulder' has velocity 0 and effort 0"),
    "slides": (TEXT.replace('name="elbow" type="revolute"', 'name="elbow" type="prismatic"'), "joint 'elbow' slides"),
}


@pytest.mark.parametrize("kind", LINES)
def test_what_is_no_arm_is_one_short_line(kind, tmp_path, capsys):
    text, words = LINES[kind]
    Path(tmp_path / "bad.urdf").write_text(text)
    assert cli.main(["robot", str(tmp_path / "bad.urdf")]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert len(told) <= 300


@needs_cases
def test_a_joint_without_speed_or_effort_is_refused_where_something_is_to_move(capsys):
    for command in (["robot", str(SMALL / "vel0.urdf")], ["workspace", f"cell.urdf={SMALL / 'vel0.urdf'}"]):
        assert cli.main(command) == 2
        assert "vel0.urdf: joint 'base_yaw' has velocity 0 and effort 0" in capsys.readouterr().err


def test_every_role_is_printed(capsys):
    assert cli.main(["robot"]) == 0
    out = capsys.readouterr().out
    assert all(f"\n{role}" in out for role in ARM_JOINTS)
