"""From settings to a cell: robots -> arms -> 5 mm grid -> annulus fit -> :class:`Cell`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from marl_handover.cell.arm import PAIR_NAMES, Arm, mirrored_pair
from marl_handover.cell.cell import Cell
from marl_handover.cell.reach import AnnulusFit, ManipulationGrid, fit_annulus, manipulation_grid, require_grasps
from marl_handover.cell.shared_space import SharedSpace
from marl_handover.compose import from_yaml, to_yaml
from marl_handover.config import CellConfig, RobotConfig, require_choice
from marl_handover.errors import InvalidSetting, NoSharedSpace, UnequalArms
from marl_handover.files import expanded, resource_path
from marl_handover.geometry.capsules import base_radius_mm
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.robot import carried_robot, carry_robot, read_robot, robot_config
from marl_handover.geometry.se2 import SE2

SPREAD = 0.78
"""Distance between two bases, as a part of the sum of their outer radii: 360 mm for the paper's ring."""

CARRIED = "robots"
"""Folder of a run's own robots."""


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

    def with_arms(self, names: Sequence[str]) -> CellModel:
        """The model of :meth:`Cell.with_arms`, in which the others do not stand at all."""
        cell, grid = self.cell.with_arms(names), self.grid
        left = [self.cell.names.index(name) for name in cell.names]
        heights, masks = tuple(grid.pick_heights_mm[arm] for arm in left), grid.masks[left]
        masks.setflags(write=False)
        return CellModel(
            cell,
            tuple(self.arms[arm] for arm in left),
            ManipulationGrid(grid.x_mm, grid.y_mm, masks, cell.bases, heights),
            tuple(self.fits[arm] for arm in left),
            tuple(self.robots[arm] for arm in left),
        )

    def without_obstacles(self) -> CellModel:
        """The model as motions take it: they do not go around obstacles."""
        config = replace(self.cell.config, obstacles=[])
        return self._replace(cell=replace(self.cell, config=config)) if self.cell.keep_out else self

    def relaid(self, config: CellConfig) -> CellModel:
        """The model of ``config``, for those who move its arms by hand: robots that are here are taken over with their sectors, unread.

        That takes a millisecond. Arms that are out of order stand in it, and arms may be unable to pass to each other; its grid is empty.

        Raises:
            InvalidSetting, MissingFile, UrdfError: a setting cannot be, as of a base that stands inside another one.
        """
        config.validate()
        names, robots = _named(config)
        here = {arm.robot: index for index, arm in reversed(list(enumerate(self.cell.arms)))}
        kinds = {robot: _Kind(self.robots[here[robot]], self.arms[here[robot]]) for robot in set(robots) & set(here)}
        fits = {robot: self.fits[here[robot]] for robot in kinds}
        for robot in dict.fromkeys(robots):
            if robot not in kinds:
                settings = robot_of(config, robot)
                kinds[robot] = _Kind(settings, read_robot(settings))
                fits |= _fit_alone(config, robot, kinds[robot])
        bases, arms = _bases(config), tuple(kinds[robot].model for robot in robots)
        _require_apart(names, bases, arms)
        cell = Cell(_arms(names, bases, robots, fits, kinds), replace(config, enabled=list(names)))
        each = tuple(kinds[robot].settings for robot in robots)
        grid = ManipulationGrid(np.empty(0), np.empty(0), np.empty((len(arms), 0, 0), bool), bases, cell.pick_heights_mm)
        return CellModel(cell, arms, grid, tuple(fits[robot] for robot in robots), each)


def build_cell(config: CellConfig) -> CellModel:
    """Compute the cell of ``config``, with the arms that are in order.

    Raises:
        InvalidSetting, MissingFile, UrdfError, NoSharedSpace, UnconnectedArms: where a setting, the URDF or the geometry cannot be.
    """
    config.validate()
    if config.enabled is not None:
        return build_cell(replace(config, enabled=None)).with_arms(config.enabled)
    names, robots = _named(config)
    settings = {robot: robot_of(config, robot) for robot in dict.fromkeys(robots)}
    kinds = {robot: _Kind(each, read_robot(each)) for robot, each in settings.items()}
    if config.base_distance_mm is None and _face_to_face(config):
        config = replace(config, base_distance_mm=_automatic_distance_mm(config, names, robots, kinds))
    bases = _bases(config)
    arms = tuple(kinds[robot].model for robot in robots)
    _require_apart(names, bases, arms)
    grid = manipulation_grid(arms, config, bases, [settings[robot].pick_height_mm for robot in robots])
    fits = _fits(config, grid, robots, kinds)
    each = tuple(fits[robot] for robot in robots), tuple(settings[robot] for robot in robots)
    return CellModel(Cell(_arms(names, bases, robots, fits, kinds), config), arms, grid, *each)


def build_whole_cell(config: CellConfig) -> CellModel:
    """As :func:`build_cell`, with the arms that are out of order, too: they stand in the way of the others."""
    return build_cell(replace(config, enabled=None))


class _Kind(NamedTuple):
    """A robot of the cell: settings and kinematics."""

    settings: RobotConfig
    model: ClosedFormArm

    @property
    def lateral_mm(self) -> float:
        """What is beside the plane by no more than rounding is in it."""
        return self.model.lateral_mm if abs(self.model.lateral_mm) > 1e-6 else 0.0


def _fits(config: CellConfig, grid: ManipulationGrid, robots: Sequence[str], kinds: Mapping[str, _Kind]) -> dict[str, AnnulusFit]:
    """The sector of each robot, over all its arms."""
    fits = {}
    for robot, kind in kinds.items():
        alike = [index for index, each in enumerate(robots) if each == robot]
        if not grid.masks[alike].any():
            require_grasps(kind.model, kind.settings.pick_height_mm, config.block)
        within = config.r_min_mm, config.r_max_mm
        fits[robot] = fit_annulus(grid, config.fit_rounding_mm, arms=alike, lateral_mm=kind.lateral_mm, within_mm=within)
    return fits


def _fit_alone(config: CellConfig, robot: str, kind: _Kind) -> dict[str, AnnulusFit]:
    """The sector of a robot, which hardly depends on where its arms stand."""
    alone = manipulation_grid([kind.model], config, [SE2(0.0, 0.0, (0.0, 1.0))], [kind.settings.pick_height_mm])
    return _fits(config, alone, [robot], {robot: kind})


def _arms(
    names: Sequence[str],
    bases: Sequence[SE2],
    robots: Sequence[str],
    fits: Mapping[str, AnnulusFit],
    kinds: Mapping[str, _Kind],
) -> tuple[Arm, ...]:
    listed = []
    for name, base, robot in zip(names, bases, robots, strict=True):
        fit, kind = fits[robot], kinds[robot]
        yaw = fit.yaw_lower_rad, fit.yaw_upper_rad
        listed.append(Arm(name, base, fit.r_min_mm, fit.r_max_mm, yaw, robot, kind.lateral_mm, kind.settings.pick_height_mm))
    return tuple(listed)


def _automatic_distance_mm(config: CellConfig, names: Sequence[str], robots: Sequence[str], kinds: Mapping[str, _Kind]) -> float:
    """How far apart two arms face each other if nothing is said: :data:`SPREAD` of the sum of their outer radii, on whole centimetres.

    Where there is no shared space with a chart then, or it is pinched in the middle, the nearest distance that gives one.

    Raises :class:`NoSharedSpace` if none does.
    """
    fits: dict[str, AnnulusFit] = {}
    for robot, kind in kinds.items():
        fits |= _fit_alone(config, robot, kind)
    one, other = (fits[robot] for robot in robots)
    least, most = one.r_min_mm + other.r_min_mm, one.r_max_mm + other.r_max_mm
    nominal = max(SPREAD * most, least + 0.25 * (most - least))
    candidates = 10.0 * np.arange(1, int(most // 10) + 1)
    alike = "paper" if config.chart is None and one == other else config.chart  # a lens before anything else
    for charted in dict.fromkeys((alike, config.chart)):
        for distance in candidates[np.argsort(abs(candidates - round(nominal, -1)), kind="stable")]:
            first, second = _arms(names, mirrored_pair(float(distance)), robots, fits, kinds)
            try:
                _ = SharedSpace(first, second, 1.0, charted).chart.arcs
            except (NoSharedSpace, InvalidSetting):
                continue
            return float(distance)
    if config.chart == "paper" and one != other:
        _ = SharedSpace(first, second, 1.0, config.chart).chart  # says what that chart needs
    rings = " and ".join(f"{name} {fits[robot].r_min_mm:g} to {fits[robot].r_max_mm:g}" for name, robot in zip(names, robots, strict=True))
    reason = f"none works for these rings ({rings} mm); choose another cell.pick_height_mm or cell.pitch_deg, which change them"
    raise NoSharedSpace(nominal, one.r_min_mm, one.r_max_mm, reason)


def _face_to_face(config: CellConfig) -> bool:
    """Whether the arms are two that stand :attr:`CellConfig.base_distance_mm` apart."""
    return not config.arms or (len(config.arms) == 2 and all(arm.x_mm == arm.y_mm == arm.facing_deg == 0 for arm in config.arms))


def _bases(config: CellConfig) -> tuple[SE2, ...]:
    if _face_to_face(config):
        assert config.base_distance_mm is not None
        return mirrored_pair(config.base_distance_mm)
    return tuple(SE2.facing_deg(arm.x_mm, arm.y_mm, arm.facing_deg) for arm in config.arms)


def _named(config: CellConfig) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Name and robot of each arm."""
    if not config.arms:
        return PAIR_NAMES, (config.robot, config.robot)
    names = tuple(arm.name for arm in config.arms)
    for index, name in enumerate(names):
        if not name or name in names[:index]:
            raise InvalidSetting(f"cell.arms[{index}].name", name, "a name that no other arm has")
    if len(names) < 2:
        raise InvalidSetting("cell.arms", len(names), "two arms at least; without any: a mirrored pair")
    return names, tuple(arm.robot or config.robot for arm in config.arms)


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


def carry_robots(config: CellConfig, folder: Path) -> None:
    """Copy the cell's own robots into ``folder``/robots, so that :func:`with_carried_robots` finds them there, wherever the folder goes."""
    for robot in {config.robot, *(arm.robot for arm in config.arms)} - {""}:
        carry_robot(robot, folder / CARRIED)


def with_carried_robots(config: CellConfig, folder: Path) -> CellConfig:
    """The cell with the robots that ``folder`` carries."""
    arms = [replace(arm, robot=arm.robot and carried_robot(arm.robot, folder / CARRIED)) for arm in config.arms]
    return replace(config, robot=carried_robot(config.robot, folder / CARRIED), arms=arms)


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
        whole = replace(config, enabled=None)
        _CELLS[key] = build_cell(config).cell if config.enabled is None else load_cell(whole).with_arms(config.enabled)
    return _CELLS[key]
