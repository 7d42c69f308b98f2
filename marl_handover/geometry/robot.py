"""From a robot's settings to its kinematics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from marl_handover.compose import from_yaml
from marl_handover.config import MotionConfig, RobotConfig
from marl_handover.errors import MissingFile, UnknownChoice
from marl_handover.files import expanded, resource_path
from marl_handover.geometry.canonical import canonical_arm, require_moving
from marl_handover.geometry.capsules import touching_links
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.link_shapes import with_shapes
from marl_handover.geometry.urdf import ArmDescription, read_urdf
from marl_handover.schema import option_names

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
    description, limits = describe(config), config.joint_limits_deg
    require_moving(description, config)
    arm = ClosedFormArm(description, limits)
    shaped = with_shapes(arm, config.shapes)
    arm = arm if shaped is description else ClosedFormArm(shaped, limits)
    ignored = touching_links(arm, MotionConfig())
    return ClosedFormArm(replace(shaped, ignored=ignored), limits) if ignored else arm


def describe(config: RobotConfig) -> ArmDescription:
    """A robot as the canonical arm. Raises as :func:`~marl_handover.geometry.canonical.canonical_arm` does."""
    return canonical_arm(read_urdf(config.urdf), config)
