"""The cell: arms from their URDF, what they reach, what they share and how it is charted, who can pass to whom, its symmetries."""

from marl_handover.cell.arm import Arm
from marl_handover.cell.build import CellModel, build_cell, build_whole_cell, carry_robots, cell_config, load_cell, with_carried_robots
from marl_handover.cell.cell import Cell
from marl_handover.cell.chart import AngleChart, Chart, PaperChart
from marl_handover.cell.layouts import layout_cell
from marl_handover.cell.symmetry import LEFT, NO_ARM, RIGHT, Symmetry

__all__ = [
    "LEFT",
    "NO_ARM",
    "RIGHT",
    "AngleChart",
    "Arm",
    "Cell",
    "CellModel",
    "Chart",
    "PaperChart",
    "Symmetry",
    "build_cell",
    "build_whole_cell",
    "carry_robots",
    "cell_config",
    "layout_cell",
    "load_cell",
    "with_carried_robots",
]
