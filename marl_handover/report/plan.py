"""The plan figure: one panel a transfer, the table from above. It draws what ``plan … json=FILE`` wrote."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from marl_handover.cell import CellModel
from marl_handover.cell.cell import Cell
from marl_handover.errors import CorruptFile, counted
from marl_handover.report.arm_labels import arm_index, stored_labels
from marl_handover.report.figure_style import FAINT, GOAL, GREY, INK, SHARED, arm_colour
from marl_handover.report.table import (
    Axes,
    bare,
    draw_bases,
    draw_block,
    draw_chart,
    draw_circles,
    draw_obstacles,
    draw_sectors,
    draw_shared,
    frame_table,
)


def workspace_figure(model: CellModel) -> Figure:
    """Grid points of each arm alone and of both, annulus sectors with their yaw limits, chart, bases."""
    cell, grid = model.cell, model.grid
    figure = Figure(figsize=(7.6, 6.4), layout="constrained")
    axes = figure.add_subplot()
    points = np.stack(np.meshgrid(grid.x_mm, grid.y_mm, indexing="ij"), -1)
    reached = grid.masks.sum(0)
    for arm, mask in enumerate(grid.masks):
        alone = points[mask & (reached == 1)]
        label = f"grid: {cell.labels[arm]} alone, {len(alone)}"
        axes.scatter(alone[:, 0], alone[:, 1], s=2.5, color=arm_colour(arm), linewidths=0, label=label, rasterized=True)
    both = points[reached > 1]
    who = "both" if cell.num_arms == 2 else "two or more"
    axes.scatter(both[:, 0], both[:, 1], s=4.5, color=SHARED, linewidths=0, label=f"grid: {who}, {len(both)}", rasterized=True)
    draw_circles(axes, cell)
    draw_sectors(axes, cell, strength=0.06, labelled=True)
    if cell.num_arms == 2:
        draw_chart(axes, cell)
    draw_obstacles(axes, cell, labelled=True)
    draw_bases(axes, cell)
    frame_table(axes, cell)
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_title(
        f"cell {cell.config.name}: {_rings(cell)}{_apart(cell)}, grid {cell.config.grid_mm:g} mm",
        fontsize=10,
    )
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, markerscale=3, frameon=False)
    return figure


def _rings(cell: Cell) -> str:
    rings = [f"{arm.r_min_mm:g} to {arm.r_max_mm:g} mm" for arm in cell.arms]
    return f"annulus {rings[0]}" if len(set(rings)) == 1 else f"annuli {', '.join(rings)}"


def _apart(cell: Cell) -> str:
    return f", bases {cell.base_distance_mm:g} mm apart" if cell.num_arms == 2 else ""


PANEL_INCHES, LEGEND_INCHES = 2.9, 7.5
COLUMNS = 4


def check_plan(plan: Mapping[str, Any], path: Path) -> None:
    """Raise :class:`CorruptFile` unless ``plan``, read from ``path``, has what the figure needs."""
    try:
        poses = [plan["start"], plan["goal"], *(transfer[key] for transfer in plan["transfers"] for key in ("from", "to"))]
        if not (np.isfinite(np.array(poses, float)).all() and all(len(pose) == 3 for pose in poses)):
            raise ValueError("a pose is not three finite numbers")
        labels = stored_labels(plan)
        for transfer in plan["transfers"]:
            labels.index(transfer["arm"])
            bool(transfer["final"])
        [plan[key] for key in ("policy", "outcome")]
        if not plan["transfers"]:
            raise ValueError("it has no transfers")
    except KeyError as error:
        raise CorruptFile("plan", path, f"it lacks {error.args[0]!r}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise CorruptFile("plan", path, str(error)) from error


def plan_figure(plan: Mapping[str, Any], cell: Cell) -> Figure:
    """A strip of panels: the block before (outline) and after (filled) each transfer, the acting arm's rays, the goal (dashed)."""
    transfers: Sequence[Mapping[str, Any]] = plan["transfers"]
    columns = min(len(transfers), COLUMNS)
    rows = math.ceil(len(transfers) / columns)
    entries = _legend()
    across = len(entries) if PANEL_INCHES * columns > LEGEND_INCHES else 3
    size = (max(PANEL_INCHES * columns, 5.2), _panel_height(cell) * rows + (0.55 if across > 3 else 0.75))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for index, (axes, transfer) in enumerate(zip(grid, transfers, strict=False)):
        _draw_transfer(axes, cell, transfer, plan["goal"])
        weight = "bold" if transfer["final"] else "normal"
        axes.set_title(_caption(index, transfer), fontsize=9, fontweight=weight, color=arm_colour(arm_index(cell, transfer["arm"])))
    for axes in grid[len(transfers) :]:
        axes.set_axis_off()
    figure.suptitle(_headline(plan), fontsize=10)
    figure.legend(handles=entries, loc="outside lower center", ncols=across, fontsize=8, frameon=False)
    return figure


def _panel_height(cell: Cell) -> float:
    """Height in inches of one panel that is PANEL_INCHES wide, its caption included."""
    figure = Figure()
    axes = figure.add_subplot()
    frame_table(axes, cell)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    return PANEL_INCHES * (high - low) / (right - left) + 0.35


def _draw_transfer(axes: Axes, cell: Cell, transfer: Mapping[str, Any], goal: Sequence[float]) -> None:
    side_mm = cell.config.block.side_mm
    arm = arm_index(cell, transfer["arm"])
    base, colour = cell.bases[arm], arm_colour(arm)
    draw_sectors(axes, cell, strength=0.05, width=0.5)
    if cell.num_arms != 2:
        draw_shared(axes, cell)
    draw_obstacles(axes, cell)
    rays = [(transfer["from"], ":")] if transfer.get("refused") else [(transfer["from"], ":"), (transfer["to"], "-")]
    for point, style in rays:
        axes.plot([base.x_mm, point[0]], [base.y_mm, point[1]], color=colour, linestyle=style, linewidth=1.6, zorder=4)
    draw_block(axes, transfer["from"], side_mm, GREY, order=5)
    draw_block(axes, transfer["to"], side_mm, colour, face=FAINT, order=7)
    draw_block(axes, goal, side_mm, GOAL, line="--", order=9)  # on top, so that what is left of the error shows
    draw_bases(axes, cell, size=10)
    frame_table(axes, cell)
    bare(axes)


def _caption(index: int, transfer: Mapping[str, Any]) -> str:
    x_mm, y_mm, theta_rad = transfer["to"]
    if transfer.get("refused"):
        return f"{index + 1}: {transfer['arm']} refuses"
    last = ", final" if transfer["final"] else ""
    x, y, degrees = (round(value) for value in (x_mm, y_mm, math.degrees(theta_rad)))  # whole numbers know no -0
    return f"{index + 1}: {transfer['arm']} → ({x}, {y}), {degrees}°{last}"


def _headline(plan: Mapping[str, Any]) -> str:
    count, optimum = len(plan["transfers"]), plan.get("optimal_transfers")
    compared = "" if optimum is None else f" (optimum {optimum})"
    outcome = str(plan["outcome"]).replace("_", " ")
    return f"policy {plan['policy']}: {outcome}, {counted(count, 'transfer')}{compared}"


def _legend() -> list[Line2D]:
    block: dict[str, Any] = {"marker": "s", "linestyle": "none", "markersize": 9}
    return [
        Line2D([], [], markerfacecolor="none", markeredgecolor=GREY, label="block before", **block),
        Line2D([], [], markerfacecolor=FAINT, markeredgecolor=INK, label="block after", **block),
        Line2D([], [], color=GOAL, linestyle="--", label="goal"),
        Line2D([], [], color=INK, linestyle=":", label="arm at pick-up"),
        Line2D([], [], color=INK, linestyle="-", label="arm at drop-off"),
    ]
