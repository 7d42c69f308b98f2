"""The workspace figure: what each arm reaches on the grid, the annuli fitted to it, and the chart of what they share."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from marl_handover.cell import CellModel
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.report.palette import SHARED, arm_colour
from marl_handover.report.table import draw_bases, draw_chart, draw_circles, draw_sectors, frame_table


def workspace_figure(model: CellModel) -> Figure:
    """Grid points of each arm alone and of both, annulus sectors with their yaw limits, chart, bases."""
    cell, grid = model.cell, model.grid
    figure = Figure(figsize=(7.6, 6.4), layout="constrained")
    axes = figure.add_subplot()
    points = np.stack(np.meshgrid(grid.x_mm, grid.y_mm, indexing="ij"), -1)
    reached = grid.masks.sum(0)
    for arm, mask in enumerate(grid.masks):
        alone = points[mask & (reached == 1)]
        label = f"grid: {ARM_LETTERS[arm]} alone, {len(alone)}"
        axes.scatter(alone[:, 0], alone[:, 1], s=2.5, color=arm_colour(arm), linewidths=0, label=label, rasterized=True)
    both = points[reached > 1]
    axes.scatter(both[:, 0], both[:, 1], s=4.5, color=SHARED, linewidths=0, label=f"grid: both, {len(both)}", rasterized=True)
    draw_circles(axes, cell)
    draw_sectors(axes, cell, strength=0.06, labelled=True)
    draw_chart(axes, cell)
    draw_bases(axes, cell)
    frame_table(axes, cell)
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_title(
        f"cell {cell.config.name}: annulus {cell.r_min_mm:g} to {cell.r_max_mm:g} mm, bases {cell.config.base_distance_mm:g} mm apart, "
        f"grid {cell.config.grid_mm:g} mm",
        fontsize=10,
    )
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, markerscale=3, frameon=False)
    return figure
