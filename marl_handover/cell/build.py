"""From settings to a cell: URDF -> arm -> 5 mm grid -> annulus fit -> :class:`Cell`."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from marl_handover.cell.cell import Cell, mirrored_pair
from marl_handover.cell.chart import Chart
from marl_handover.cell.spaces import AnnulusFit, ManipulationGrid, fit_annulus, manipulation_grid
from marl_handover.compose import from_yaml, to_yaml
from marl_handover.config import CellConfig, require_choice
from marl_handover.errors import MissingFile
from marl_handover.files import expanded
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.urdf import read_urdf
from marl_handover.resources import resource_path


class CellModel(NamedTuple):
    """A cell with everything it was computed from."""

    cell: Cell
    arm: ClosedFormArm
    grid: ManipulationGrid
    fit: AnnulusFit


def urdf_path(urdf: str) -> Path:
    """A URDF by path, or by the name of a shipped one."""
    path = expanded(urdf)
    if path.exists() or path.parent != Path():
        return path
    try:
        return resource_path(f"urdf/{urdf}")
    except MissingFile as error:
        raise MissingFile("URDF", urdf, "name a file here, a path, or one of those that are shipped: al5a.urdf") from error


def build_cell(config: CellConfig) -> CellModel:
    """Compute the cell of ``config``.

    Raises:
        InvalidSetting, MissingFile, UrdfError, NoSharedSpace: where a setting, the URDF or the geometry cannot be.
    """
    config.validate()
    arm = ClosedFormArm(read_urdf(urdf_path(config.urdf), config.grasp_link), config.joint_limits_deg)
    bases = mirrored_pair(config.base_distance_mm)
    grid = manipulation_grid(arm, config, bases)
    fit = fit_annulus(grid, config.fit_rounding_mm)
    Chart(fit.r_min_mm, fit.r_max_mm, config.base_distance_mm, config.chart_inset)
    cell = Cell(bases, fit.r_min_mm, fit.r_max_mm, (fit.yaw_lower_rad, fit.yaw_upper_rad), config)
    return CellModel(cell, arm, grid, fit)


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
