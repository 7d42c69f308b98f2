"""What never moves in the scene: the table, each arm's manipulation space, and the space they share with its chart."""

from __future__ import annotations

import math

import numpy as np
import viser
from numpy.typing import NDArray

from marl_handover.cell import Cell
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.palette import SHARED, arm_colour
from marl_handover.viewer.units import metres, rgb

Floats = NDArray[np.float64]

WOOD = (240, 238, 233)
MARGIN_MM = 45.0
"""Table beyond the last place that an arm reaches."""

# Heights in mm: what is drawn on the table lies in layers, so that no two fight for the same pixels.
_SHADE_MM, _CHART_MM, _OUTLINE_MM = 0.4, 0.8, 1.2
_CHART_LINES = 5
_POINTS = 61
_NAMES = {"L": "left arm", "R": "right arm"}


def add_table(server: viser.ViserServer, cell: Cell) -> None:
    """Put everything that stays where it is into the scene."""
    outlines = [sector_outline(cell, arm) for arm in range(cell.num_arms)]
    corners = np.concatenate([*outlines, [[base.x_mm, base.y_mm] for base in cell.bases]])
    half = np.abs(corners).max(0) + MARGIN_MM
    server.scene.add_box("/table", color=WOOD, dimensions=metres([2 * half[0], 2 * half[1], 15.0]), position=metres([0, 0, -7.5]))
    for arm, outline in enumerate(outlines):
        _add_line(server, f"/reach_{arm}", outline, arm_colour(arm), _OUTLINE_MM, 1.6)
        base, name = cell.bases[arm], _NAMES.get(ARM_LETTERS[arm], f"arm {ARM_LETTERS[arm]}")
        beyond = 1 + 35.0 / math.hypot(base.x_mm, base.y_mm)
        server.scene.add_label(f"/name_{arm}", name, position=metres([base.x_mm * beyond, base.y_mm * beyond, 0.0]), anchor="center-center")
    vertices, faces = shared_mesh(cell)
    server.scene.add_mesh_simple(
        "/shared", metres(vertices), faces, color=rgb(SHARED), opacity=0.45, side="double", cast_shadow=False, receive_shadow=False
    )
    for number, line in enumerate(chart_lines(cell)):
        _add_line(server, f"/chart_{number}", line, SHARED, _CHART_MM, 0.7)


def sector_outline(cell: Cell, arm: int) -> Floats:
    """The closed outline (n, 2) in mm of the annulus sector where an arm can pick and place."""
    base, (low, high) = cell.bases[arm], cell.yaw_rad
    angles = base.facing_rad + np.linspace(low, high, _POINTS)
    rays = np.stack([np.cos(angles), np.sin(angles)], -1)
    around = np.concatenate([cell.r_max_mm * rays, cell.r_min_mm * rays[::-1], cell.r_max_mm * rays[:1]])
    return base.position_mm + around


def shared_mesh(cell: Cell) -> tuple[Floats, NDArray[np.uint32]]:
    """Vertices (n, 3) in mm and triangles (m, 3) of the space both arms reach: a strip between its two long sides."""
    alpha = np.linspace(-1.0, 1.0, _POINTS)
    sides = np.stack([cell.chart.to_table(alpha, np.full(_POINTS, beta)) for beta in (-1.0, 1.0)], 1).reshape(-1, 2)
    vertices = np.concatenate([sides, np.full((len(sides), 1), _SHADE_MM)], -1)
    first = 2 * np.arange(_POINTS - 1)[:, None]
    faces = np.concatenate([first + [0, 2, 1], first + [1, 2, 3]])
    return vertices, faces.astype(np.uint32)


def chart_lines(cell: Cell) -> list[Floats]:
    """Lines (n, 2) in mm of constant alpha and of constant beta."""
    values, along = np.linspace(-1.0, 1.0, _CHART_LINES), np.linspace(-1.0, 1.0, _POINTS)
    across = np.array([-1.0, 1.0])
    lines = [cell.chart.to_table(along, np.full(_POINTS, beta)) for beta in values]
    return lines + [cell.chart.to_table(np.full(2, alpha), across) for alpha in values[1:-1]]


def _add_line(server: viser.ViserServer, name: str, points_mm: Floats, colour: str, height_mm: float, width_px: float) -> None:
    points = metres(np.concatenate([points_mm, np.full((len(points_mm), 1), height_mm)], -1))
    segments = np.stack([points[:-1], points[1:]], 1)
    server.scene.add_line_segments(name, segments, colors=rgb(colour), thickness=width_px, thickness_units="screen")
