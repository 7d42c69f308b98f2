"""The cell: arms from their URDF, what they reach, the chart of what they share, its symmetries."""

from marl_handover.cell.build import CellModel, build_cell, cell_config, load_cell
from marl_handover.cell.cell import Base, Cell
from marl_handover.cell.chart import Chart
from marl_handover.cell.symmetry import GROUP, LEFT, NO_ARM, RIGHT, Symmetry

__all__ = [
    "GROUP",
    "LEFT",
    "NO_ARM",
    "RIGHT",
    "Base",
    "Cell",
    "CellModel",
    "Chart",
    "Symmetry",
    "build_cell",
    "cell_config",
    "load_cell",
]
