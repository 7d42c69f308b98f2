"""The plan figure: one panel a transfer, the table from above. It draws what ``plan … json=FILE`` wrote."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

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
    """Grid points of each arm alone and of several, annulus sectors with their yaw limits, a pair's chart, obstacles, bases."""
    cell, grid = model.cell, model.grid
    columns = 4 if cell.num_arms == 2 else 3
    figure = Figure(figsize=(WORKSPACE_INCHES, _workspace_height(cell, columns)), layout="constrained")
    axes = figure.add_subplot()
    dot = _dot(cell)
    points = np.stack(np.meshgrid(grid.x_mm, grid.y_mm, indexing="ij"), -1)
    reached = grid.masks.sum(0)
    for arm, mask in enumerate(grid.masks):
        alone = points[mask & (reached == 1)]
        label = f"grid: {cell.labels[arm]} alone, {len(alone)}"
        axes.scatter(alone[:, 0], alone[:, 1], s=2.5 * dot, color=arm_colour(arm), linewidths=0, label=label, rasterized=True)
    both = points[reached > 1]
    who = "both" if cell.num_arms == 2 else "two or more"
    axes.scatter(both[:, 0], both[:, 1], s=4.5 * dot, color=SHARED, linewidths=0, label=f"grid: {who}, {len(both)}", rasterized=True)
    draw_circles(axes, cell)
    draw_sectors(axes, cell, strength=0.06, labelled=True)
    if cell.num_arms == 2:
        draw_chart(axes, cell)
    else:
        draw_shared(axes, cell, strength=0.25)
    draw_obstacles(axes, cell, labelled=True)
    draw_bases(axes, cell)
    frame_table(axes, cell)
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_title(
        f"cell {cell.config.name}: {_rings(cell)}{_apart(cell)}, grid {cell.config.grid_mm:g} mm",
        fontsize=10,
    )
    figure.legend(loc="outside lower center", ncols=columns, fontsize=8, markerscale=3 / math.sqrt(dot), frameon=False)
    return figure


WORKSPACE_INCHES = 7.6


def _workspace_height(cell: Cell, columns: int) -> float:
    """Height in inches of the figure of a cell, which is wide enough for a pair's chart and legend, or for what many arms need."""
    if cell.num_arms == 2:
        return 6.4
    entries = 2 * cell.num_arms + 2 + (2 if cell.config.obstacles else 0)
    return (WORKSPACE_INCHES - 1.0) * _aspect(cell) + 1.0 + 0.2 * math.ceil(entries / columns)


def _dot(cell: Cell) -> float:
    """Area of a grid point, as a part of a pair's: in large cells points of that size would run into each other."""
    if cell.num_arms == 2:
        return 1.0
    points_a_step = 72 * (WORKSPACE_INCHES - 1.0) * cell.config.grid_mm / (2 * cell.extent_mm[0])
    return float(np.clip(points_a_step / 4.5, 0.25, 1.0)) ** 2


def _rings(cell: Cell) -> str:
    rings = list(dict.fromkeys(f"{arm.r_min_mm:g} to {arm.r_max_mm:g} mm" for arm in cell.arms))
    if len(rings) > 2:
        return f"annuli within {min(arm.r_min_mm for arm in cell.arms):g} to {max(arm.r_max_mm for arm in cell.arms):g} mm"
    return f"annulus {rings[0]}" if len(rings) == 1 else f"annuli {', '.join(rings)}"


def _apart(cell: Cell) -> str:
    return f", bases {cell.base_distance_mm:g} mm apart" if cell.num_arms == 2 else ""


PANEL_INCHES, LEGEND_INCHES = 2.9, 7.5
COLUMNS = 4
WIDE = 0.5
"""Panels of a table with less height for its width than this are twice as wide."""


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
    wide = 2 if _aspect(cell) < WIDE else 1
    columns = min(len(transfers), COLUMNS // wide)
    rows = math.ceil(len(transfers) / columns)
    entries = _legend(cell)
    inches = PANEL_INCHES * wide
    across = len(entries) if inches * columns > LEGEND_INCHES else 3
    size = (max(inches * columns, 5.2), (inches * _aspect(cell) + 0.35) * rows + 0.35 + 0.2 * math.ceil(len(entries) / across))
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


def _aspect(cell: Cell) -> float:
    """Height of the framed table over its width."""
    axes = Figure().add_subplot()
    frame_table(axes, cell)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    return float((high - low) / (right - left))


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


def _legend(cell: Cell) -> list[Line2D | Patch]:
    block: dict[str, Any] = {"marker": "s", "linestyle": "none", "markersize": 9}
    entries: list[Line2D | Patch] = [
        Line2D([], [], markerfacecolor="none", markeredgecolor=GREY, label="block before", **block),
        Line2D([], [], markerfacecolor=FAINT, markeredgecolor=INK, label="block after", **block),
        Line2D([], [], color=GOAL, linestyle="--", label="goal"),
        Line2D([], [], color=INK, linestyle=":", label="arm at pick-up"),
        Line2D([], [], color=INK, linestyle="-", label="arm at drop-off"),
    ]
    if cell.num_arms != 2:
        entries.append(Patch(facecolor=SHARED, alpha=0.45, label="shared"))
    if cell.config.obstacles:
        entries.append(Patch(facecolor=GREY, edgecolor=INK, hatch="///", label="obstacle"))
    return entries
