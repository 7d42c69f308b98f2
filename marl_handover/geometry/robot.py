"""From a robot's settings to its kinematics."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from pathlib import Path

from marl_handover.compose import from_yaml, to_yaml
from marl_handover.config import MotionConfig, RobotConfig
from marl_handover.errors import MissingFile, UnknownChoice, UnsupportedKinematics
from marl_handover.files import copy_whole, expanded, make_folder, resource_path, write_whole
from marl_handover.geometry.canonical import LEAST_RING_MM, PITCHES_DEG, canonical_arm, require_moving
from marl_handover.geometry.capsules import touching_links
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.link_shapes import with_shapes
from marl_handover.geometry.urdf import ArmDescription, mesh_files, read_urdf
from marl_handover.schema import option_names

_CARRIED, _CARRIED_URDF = "robot.yaml", "robot.urdf"
_YAML = (".yaml", ".yml")


def robot_config(robot: str) -> RobotConfig:
    """Settings of a robot: of a shipped one by name, of a YAML file or of a bare URDF by path. Its ``urdf`` is a path to read then.

    Raises:
        UnknownChoice, MissingFile, CorruptFile: if there is none.
    """
    path = expanded(robot)
    if path.suffix in _YAML:
        return _from_file(path)
    if path.suffix or path.parent != Path() or not robot:
        return RobotConfig(name=path.stem, urdf=str(urdf_path(robot)))
    folder = resource_path("configs/robot")
    names = option_names(folder)
    if robot not in names:
        raise UnknownChoice("robot", robot, (*names, "a path such as ./my.urdf or ./my.yaml"))
    return _from_file(folder / f"{robot}.yaml")


def _from_file(path: Path) -> RobotConfig:
    config: RobotConfig = from_yaml(RobotConfig, path)
    beside = path.parent / expanded(config.urdf)  # of an absolute path: that path
    found = beside if config.urdf and beside.is_file() else urdf_path(config.urdf)
    return replace(config, name=config.name or path.stem, urdf=str(found))


def urdf_path(urdf: str) -> Path:
    """A URDF by path, or by the name of a shipped one. Raises :class:`MissingFile`."""
    path = expanded(urdf)
    if urdf and (path.exists() or path.parent != Path()):
        return path
    try:
        return resource_path(f"urdf/{urdf}")
    except MissingFile as error:
        shipped = ", ".join(sorted(file.name for file in resource_path("urdf").glob("*.urdf")))
        raise MissingFile("URDF", urdf, f"name a file here, a path, or one of those that are shipped: {shipped}") from error


def read_robot(config: RobotConfig) -> ClosedFormArm:
    """The kinematics of a robot, by its settings.

    Raises:
        MissingFile, UrdfError, UnsupportedKinematics: of a URDF that is none, or of another class.
        UnknownKey, InvalidSetting: of limits.
    """
    return shaped_arm(bare_arm(config), config)


def bare_arm(config: RobotConfig, needs_speed: bool = True) -> ClosedFormArm:
    """The same before its shapes are looked for; ``needs_speed`` and errors as :func:`require_moving` and :func:`read_robot` have them."""
    description = describe(config)
    require_moving(description, needs_speed)
    arm = ClosedFormArm(description, config.joint_limits_deg)
    require_ring(arm, config)
    return arm


def shaped_arm(arm: ClosedFormArm, config: RobotConfig) -> ClosedFormArm:
    """The arm with the collision shapes that its settings ask for.

    Raises as :func:`~marl_handover.geometry.link_shapes.with_shapes` does.
    """
    limits, shaped = config.joint_limits_deg, with_shapes(arm, config.shapes)
    arm = arm if shaped is arm.description else ClosedFormArm(shaped, limits)
    ignored = touching_links(arm, MotionConfig())
    if not ignored:
        return arm
    notes = tuple(f"links {one!r} and {other!r} touch in every posture, so that nobody keeps them apart" for one, other in ignored)
    return ClosedFormArm(replace(shaped, ignored=ignored, assumed=(*shaped.assumed, *notes)), limits)


def require_ring(arm: ClosedFormArm, config: RobotConfig) -> None:
    """Raise :class:`UnsupportedKinematics` for an arm whose joint limits leave it no ring at its pick height and pitch.

    The line names the pitch nearest to that one that has a ring, if any has.
    """
    if _width_mm(arm.ring_mm(config.pick_height_mm)) >= LEAST_RING_MM:
        return
    asked = config.pitch_deg
    others = {pitch: arm.ring_mm(config.pick_height_mm, math.radians(pitch - asked)) for pitch in PITCHES_DEG}
    widths = {pitch: _width_mm(ring) for pitch, ring in others.items()}
    enough = max(LEAST_RING_MM, 0.5 * max(widths.values()))
    wide = [pitch for pitch in sorted(others, key=lambda pitch: abs(pitch - asked)) if widths[pitch] >= enough]
    how = "level" if asked == 0 else f"at {asked:g} deg"
    fix = "change pick_height_mm"
    if wide and (ring := others[wide[0]]) is not None:
        fix = f"pitch_deg={wide[0]:g} has one of {ring[0]:.0f} to {ring[1]:.0f} mm"
    what = f"its joint limits leave no ring in which the hand is {how} at pick_height_mm = {config.pick_height_mm:g}; {fix}"
    raise UnsupportedKinematics(arm.description.path, what)


def _width_mm(ring: tuple[float, float] | None) -> float:
    return 0.0 if ring is None else ring[1] - ring[0]


def describe(config: RobotConfig) -> ArmDescription:
    """A robot as the canonical arm. Raises as :func:`~marl_handover.geometry.canonical.canonical_arm` does."""
    return canonical_arm(read_urdf(config.urdf), config)


def carry_robot(robot: str, folder: Path) -> None:
    """Copy a robot that is not a shipped one, its settings, URDF and meshes, into ``folder``, where :func:`carried_robot` finds it.

    Raises as :func:`robot_config` does, and :class:`CannotWrite`.
    """
    place = folder / _carried_name(robot)
    if _is_shipped(robot) or folder in Path(robot).parents:
        return
    config = robot_config(robot)
    source = Path(config.urdf)
    make_folder(place)
    copy_whole(source, place / _CARRIED_URDF)
    copy_whole(source, place / _CARRIED_URDF)
    for filename, mesh in mesh_files(source).items():
        inside = Path(filename.partition("://")[2].partition("/")[2] if "://" in filename else filename)
        if mesh.is_file() and not inside.is_absolute() and ".." not in inside.parts:
            make_folder((place / inside).parent)
            copy_whole(mesh, place / inside)
    write_whole(place / _CARRIED, to_yaml(replace(config, urdf=_CARRIED_URDF)))


def carried_robot(robot: str, folder: Path) -> str:
    """The robot as ``folder`` carries it: the path of its settings there; ``robot`` as it is where it is shipped, or is not carried."""
    if _is_shipped(robot):
        return robot
    parts = Path(robot).parts
    name = parts[-2] if parts[-1:] == (_CARRIED,) and len(parts) > 1 else _carried_name(robot)
    found = folder / name / _CARRIED
    return str(found) if found.is_file() else robot


def _is_shipped(robot: str) -> bool:
    if Path(robot).parent != Path() or Path(robot).is_file():
        return False
    return robot in option_names(resource_path("configs/robot")) or (resource_path("urdf") / robot).is_file()


def _carried_name(robot: str) -> str:
    return f"{Path(robot).stem}-{hashlib.sha256(robot.encode()).hexdigest()[:8]}"
