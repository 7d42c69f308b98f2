"""``marl-handover robot FILE``: how a URDF is read as an arm, what ring it reaches, and what was assumed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from marl_handover.cell.reach import bound_by, feasible
from marl_handover.config import PICK_HEIGHT_MM, PITCH_DEG, SHAPES, BlockConfig, RobotConfig, bounded, check_bounds, chosen, path_field
from marl_handover.errors import MissingExtra, MissingFile
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.robot import bare_arm, robot_config, shaped_arm
from marl_handover.geometry.urdf import ARM_JOINTS

FILE, PICTURE = "robot.json", "robot.png"


@dataclass
class RobotCommandConfig:
    """Keys of ``robot``; the file may stand first, without its key. What is null here is the robot's own."""

    robot: str = path_field("al5a")  # a URDF, a robot's YAML file, or the name of a shipped one
    tip: str = ""  # link in whose origin things are held
    pick_height_mm: float | None = bounded(None, *PICK_HEIGHT_MM)
    pitch_deg: float | None = bounded(None, *PITCH_DEG)  # of the hand where it picks and places
    shapes: str | None = chosen(None, SHAPES)  # file, links or none; null: the robot's own, or none where its meshes are missing
    json: str = path_field()  # file for what is printed
    out: str = path_field()  # folder for robot.json and robot.png, a picture of the arm and its ring


SCHEMA: type = RobotCommandConfig
ALIASES: dict[str, str] = {}
GROUPS: dict[str, dict[str, type]] = {}
POSITIONAL = "robot"


def run(config: RobotCommandConfig) -> int:
    """Read the robot, print what was found, write what is asked for."""
    check_bounds(config)
    own = robot_config(config.robot)
    said = {name: value for name in ("pick_height_mm", "pitch_deg", "shapes") if (value := getattr(config, name)) is not None}
    settings = replace(own, tip=config.tip or own.tip, **said)
    settings.validate()
    arm = _read(settings, may_lack_meshes=config.shapes is None)
    summary = robot_summary(arm, settings)
    print(_text(summary, arm, settings))
    written = [Path(config.json)] if config.json else []
    if config.out:
        written.append(Path(config.out) / FILE)
    if written:
        from marl_handover.report.figure_style import save_figure, write_json

        for path in written:
            write_json(path, summary)
        if config.out:
            from marl_handover.report.robot import robot_figure

            written.append(Path(config.out) / PICTURE)
            save_figure(robot_figure(arm, settings, summary["ring_mm"]), written[-1])
        print(f"written: {', '.join(str(path) for path in written)}")
    return 0


def _read(settings: RobotConfig, may_lack_meshes: bool) -> ClosedFormArm:
    """The robot's kinematics and shapes; without shapes where its meshes are missing and that may be."""
    arm = bare_arm(settings, needs_speed=False)
    try:
        return shaped_arm(arm, settings)
    except (MissingFile, MissingExtra) as error:
        if not may_lack_meshes:
            raise
        note = f"shapes: none here, for want of one ({error}); cells need them, or shapes=links"
        bare = shaped_arm(arm, replace(settings, shapes="none")).description
        return ClosedFormArm(replace(bare, assumed=(*arm.description.assumed, note)), settings.joint_limits_deg)


def robot_summary(arm: ClosedFormArm, settings: RobotConfig) -> dict[str, Any]:
    """What ``robot … json=FILE`` holds: mm and rad. The ring is that of the joint limits alone."""
    description = arm.description
    joints = [source.joint for source in description.sources]
    gripper = description.gripper
    return {
        "robot": settings.name or description.name,
        "class": "yaw, three pitches" + (" and roll" if joints[4] else ""),
        "roles": {
            "yaw": joints[0],
            "pitch": joints[1:4],
            "roll": joints[4],
            "locked": dict(description.locked),
            "gripper": {"kind": gripper.kind, "joints": list(gripper.joints), "travel_mm": round(gripper.travel_mm, 3)},
        },
        "tip": description.tip or None,
        "ring_mm": [round(end, 2) for end in arm.ring_mm(settings.pick_height_mm) or ()],
        "yaw_range_rad": [float(arm.lower_rad[0]), float(arm.upper_rad[0])],
        "limits_rad": {role: [float(arm.lower_rad[k]), float(arm.upper_rad[k])] for k, role in enumerate(ARM_JOINTS)},
        "limits_from": {role: _owner(settings, role, joints[k]) for k, role in enumerate(ARM_JOINTS)},
        "pick_height_mm": settings.pick_height_mm,
        "pitch_deg": settings.pitch_deg,
        "lateral_mm": round(arm.lateral_mm, 4) + 0.0,
        "assumed": list(description.assumed),
    }


def _owner(settings: RobotConfig, role: str, joint: str | None) -> str:
    return "the robot's settings" if role in settings.joint_limits_deg else "the URDF" if joint else "no such joint: held at 0"


def _text(summary: dict[str, Any], arm: ClosedFormArm, settings: RobotConfig) -> str:
    roles, gripper = summary["roles"], summary["roles"]["gripper"]
    joints = dict(zip(ARM_JOINTS, [roles["yaw"], *roles["pitch"], roles["roll"]], strict=True))
    rows = [("robot", f"{summary['robot']}: {summary['class']}")]
    for index, (role, source) in enumerate(zip(ARM_JOINTS, arm.description.sources, strict=True)):
        low, high = math.degrees(arm.lower_rad[index]), math.degrees(arm.upper_rad[index])
        by = f"{low:.1f} to {high:.1f} deg by {summary['limits_from'][role]}"
        way = f"{'along' if source.sign > 0 else 'against'} it, 0 at its {round(math.degrees(source.offset_rad), 3) + 0.0:g}"
        rows.append((role, f"{joints[role]}: {by}, {way}" if source.joint else "none: held at 0"))
    rows += [("locked", f"{name} at {math.degrees(angle):.4g} deg") for name, angle in roles["locked"].items()]
    opens = f", each pad opens {gripper['travel_mm']:.3g} mm" if gripper["joints"] else "things stick to the tip"
    rows.append(("gripper", f"{gripper['kind']}: {', '.join(gripper['joints'])}{opens}"))
    low, high = summary["ring_mm"]
    ring = f"{low:.1f} to {high:.1f} mm from the yaw axis by joint limits, pick height {settings.pick_height_mm:g} mm, "
    rows.append(("ring", ring + (f"hand at {settings.pitch_deg:g} deg" if settings.pitch_deg else "hand level")))
    if any(link.collisions for link in arm.description.links):
        rows.append(("", _clear_ring(arm, settings)))
    beside = f" - asin({arm.lateral_mm:.3g} / distance)" if abs(arm.lateral_mm) > 1e-3 else ""
    rows.append(("yaw law", f"base yaw = direction of the place{beside}; what is held turns with it"))
    rows += [("not checked", f"{one} against {other}: they touch in every posture") for one, other in arm.description.ignored]
    return "\n".join([*(f"{name:<12} {value}" for name, value in rows), *(f"assumed      {note}" for note in summary["assumed"])])


def _clear_ring(arm: ClosedFormArm, settings: RobotConfig) -> str:
    """What is left of the ring, straight ahead, where links keep clear of each other and of the table; and what binds."""
    height, block = settings.pick_height_mm, BlockConfig()
    low, high = arm.ring_mm(height) or (0.0, 0.0)
    radii = np.arange(math.ceil(low), math.floor(high) + 1.0)
    yaw = min(max(0.0, float(arm.lower_rad[0])), float(arm.upper_rad[0]))
    good = feasible(arm, radii[:, None] * np.array([math.cos(yaw), math.sin(yaw)]), height, block)
    runs = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]]))).reshape(-1, 2)
    if not len(runs):
        return f"none of it with shapes: {bound_by(arm, float(radii[len(radii) // 2]), height, block)}"
    first, end = max(runs, key=lambda run: int(run[1] - run[0]))
    binding = [bound_by(arm, float(radii[k]), height, block) for k in (first - 1, end) if 0 <= k < len(radii)]
    why = f", bound by {'; '.join(dict.fromkeys(name for name in binding if name))}" if any(binding) else ""
    return f"with shapes {radii[first]:g} to {radii[end - 1]:g} mm{why}"
