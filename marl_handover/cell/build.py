"""From settings to a cell: robots -> arms -> 5 mm grid -> annulus fit -> :class:`Cell`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from marl_handover.cell.arm import Arm, mirrored_pair
from marl_handover.cell.cell import Cell
from marl_handover.cell.reach import AnnulusFit, ManipulationGrid, fit_annulus, manipulation_grid, require_grasps
from marl_handover.compose import from_yaml, to_yaml
from marl_handover.config import CellConfig, RobotConfig, require_choice
from marl_handover.errors import InvalidSetting, UnequalArms
from marl_handover.files import expanded, resource_path
from marl_handover.geometry.capsules import base_radius_mm
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.robot import read_robot, robot_config
from marl_handover.geometry.se2 import SE2


class CellModel(NamedTuple):
    """A cell with everything it was computed from.

    Attributes:
        cell: the arms and what they have in common.
        arms: each arm's kinematics.
        grid: what each of them reaches, point by point.
        fits: the annulus sector that stands for it; arms of one robot have one in common.
        robots: each arm's robot, with what the cell says for all arms.
    """

    cell: Cell
    arms: tuple[ClosedFormArm, ...]
    grid: ManipulationGrid
    fits: tuple[AnnulusFit, ...]
    robots: tuple[RobotConfig, ...]

    @property
    def arm(self) -> ClosedFormArm:
        """The kinematics that all arms have. Raises :class:`UnequalArms` where they differ."""
        if any(arm is not self.arms[0] for arm in self.arms):
            raise UnequalArms("robot", {arm.name: arm.robot for arm in self.cell.arms})
        return self.arms[0]

    @property
    def fit(self) -> AnnulusFit:
        """The annulus sector that all arms have. Raises :class:`UnequalArms` where they differ."""
        if any(fit is not self.fits[0] for fit in self.fits):
            raise UnequalArms("reach", {arm.name: arm.robot for arm in self.cell.arms})
        return self.fits[0]


def build_cell(config: CellConfig) -> CellModel:
    """Compute the cell of ``config``.

    Raises:
        InvalidSetting, MissingFile, UrdfError, NoSharedSpace, UnconnectedArms: where a setting, the URDF or the geometry cannot be.
    """
    config.validate()
    names, bases, robots = _standing(config)
    settings = {robot: robot_of(config, robot) for robot in dict.fromkeys(robots)}
    models = {robot: read_robot(each) for robot, each in settings.items()}
    arms = tuple(models[robot] for robot in robots)
    _require_apart(names, bases, arms)
    grid = manipulation_grid(arms, config, bases, [settings[robot].pick_height_mm for robot in robots])
    fits = {}
    for robot in settings:
        alike = [index for index, each in enumerate(robots) if each == robot]
        if not grid.masks[alike].any():
            require_grasps(models[robot], settings[robot].pick_height_mm, config.block)
        fits[robot] = fit_annulus(grid, config.fit_rounding_mm, arms=alike, within_mm=(config.r_min_mm, config.r_max_mm))
    listed = []
    for name, base, robot in zip(names, bases, robots, strict=True):
        fit, height_mm = fits[robot], settings[robot].pick_height_mm
        yaw = fit.yaw_lower_rad, fit.yaw_upper_rad
        listed.append(Arm(name, base, fit.r_min_mm, fit.r_max_mm, yaw, robot, _lateral_mm(models[robot]), height_mm))
    each = tuple(fits[robot] for robot in robots), tuple(settings[robot] for robot in robots)
    return CellModel(Cell(tuple(listed), config), arms, grid, *each)


def _lateral_mm(model: ClosedFormArm) -> float:
    return float(getattr(model, "lateral_mm", 0.0))


def _standing(config: CellConfig) -> tuple[tuple[str, ...], tuple[SE2, ...], tuple[str, ...]]:
    """Name, base and robot of each arm."""
    if not config.arms:
        return ("left", "right"), mirrored_pair(config.base_distance_mm), (config.robot, config.robot)
    names = tuple(arm.name for arm in config.arms)
    for index, name in enumerate(names):
        if not name or name in names[:index]:
            raise InvalidSetting(f"cell.arms[{index}].name", name, "a name that no other arm has")
    if len(names) < 2:
        raise InvalidSetting("cell.arms", len(names), "two arms at least; without any: a mirrored pair")
    bases = tuple(SE2.facing_deg(arm.x_mm, arm.y_mm, arm.facing_deg) for arm in config.arms)
    return names, bases, tuple(arm.robot or config.robot for arm in config.arms)


def robot_of(config: CellConfig, robot: str) -> RobotConfig:
    """Settings of one of the cell's robots: its own, and over them what the cell says for all arms."""
    own = robot_config(robot)
    said = {name: value for name in ("pick_height_mm", "pitch_deg", "shapes") if (value := getattr(config, name)) is not None}
    limits = {**own.joint_limits_deg, **config.joint_limits_deg}
    changed = replace(own, tip=config.grasp_link or own.tip, joint_limits_deg=limits, **said)
    changed.validate()
    return changed


def _require_apart(names: Sequence[str], bases: Sequence[SE2], arms: Sequence[ClosedFormArm]) -> None:
    """Raise :class:`InvalidSetting` if a base stands inside another arm's."""
    for second in range(len(names)):
        for first in range(second):
            apart = math.dist(bases[first].position_mm, bases[second].position_mm)
            least = base_radius_mm(arms[first].description) + base_radius_mm(arms[second].description)
            if apart < least:
                what = f"at least {least:.1f} mm from that of {names[first]!r}, whose base stands there"
                raise InvalidSetting(f"the base of arm {names[second]!r}, {apart:.1f} mm away,", bases[second].position_mm.tolist(), what)


def cell_config(name: str) -> CellConfig:
    """Settings of a shipped cell by name, or of a YAML file by path.

    Raises:
        UnknownChoice, MissingFile, CorruptFile: if there is none.
    """
    path = expanded(name)
    if path.suffix not in (".yaml", ".yml"):
        folder = resource_path("configs/cell")
        require_choice("cell", name, tuple(sorted(file.stem for file in folder.glob("*.yaml"))))
        path = folder / f"{name}.yaml"
    config: CellConfig = from_yaml(CellConfig, path)
    return config


_CELLS: dict[str, Cell] = {}


def load_cell(cell: str | CellConfig = "paper") -> Cell:
    """The cell of a shipped name, a YAML path or settings; computed once for each."""
    config = cell_config(cell) if isinstance(cell, str) else cell
    key = to_yaml(config)
    if key not in _CELLS:
        _CELLS[key] = build_cell(config).cell
    return _CELLS[key]
