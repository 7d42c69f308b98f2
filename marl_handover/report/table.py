"""The table from above: bases, annulus sectors, the chart, and the block. World frame, mm; x to the right, y up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.patches import Circle, Polygon

from marl_handover.arrays import Floats
from marl_handover.cell.cell import Cell
from marl_handover.report.arm_labels import marks
from marl_handover.report.figure_style import FAINT, GREY, INK, PAPER, SHARED, arm_colour, arm_line

Axes = Any
"""matplotlib's, which has no types of its own here."""


def sector_mm(cell: Cell, arm: int, points: int = 90) -> Floats:
    """Outline (n, 2) of an arm's annulus sector."""
    each = cell.arms[arm]
    yaw = np.linspace(*each.yaw_rad, points)
    along = np.linspace(each.r_max_mm, each.r_min_mm, points)  # a grip beside the plane moves along a curve
    sides = [each.at(along, each.yaw_rad[1]), each.at(along[::-1], each.yaw_rad[0])] if each.lateral_mm else []
    return np.concatenate([each.at(each.r_max_mm, yaw), *sides[:1], each.at(each.r_min_mm, yaw[::-1]), *sides[1:]])


def frame_table(axes: Axes, cell: Cell, margin_mm: float = 25.0) -> None:
    """Equal axes around all that the arms reach, bases included."""
    points = np.concatenate([sector_mm(cell, arm) for arm in range(cell.num_arms)])
    points = np.concatenate([points, [(base.x_mm, base.y_mm) for base in cell.bases]])
    low, high = points.min(0) - margin_mm, points.max(0) + margin_mm
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")


def draw_sectors(axes: Axes, cell: Cell, strength: float = 0.1, width: float = 1.2, labelled: bool = False) -> None:
    """Annulus sector of each arm; its straight sides are the yaw limits."""
    for arm in range(cell.num_arms):
        outline, colour = sector_mm(cell, arm), arm_colour(arm)
        axes.add_patch(Polygon(outline, closed=True, facecolor=colour, edgecolor="none", alpha=strength, zorder=1))
        label = f"annulus sector of {_marked(cell, arm)}" if labelled else None
        edge = Polygon(outline, closed=True, fill=False, edgecolor=colour, linewidth=width, linestyle=arm_line(arm), label=label, zorder=3)
        axes.add_patch(edge)


def draw_circles(axes: Axes, cell: Cell) -> None:
    """Both whole circles around each base, faint, to show what the yaw limits cut off."""
    label: str | None = "beyond the yaw limits"
    for arm, base in enumerate(cell.bases):
        for radius in (cell.arms[arm].r_min_mm, cell.arms[arm].r_max_mm):
            style: dict[str, Any] = {"linewidth": 0.7, "linestyle": ":", "alpha": 0.7, "zorder": 2}
            axes.add_patch(Circle((base.x_mm, base.y_mm), radius, fill=False, edgecolor=arm_colour(arm), label=label, **style))
            label = None


def draw_bases(axes: Axes, cell: Cell, size: float = 13.0) -> None:
    """A square at each base, with the arm's mark; ``size`` in points."""
    for arm, (base, mark) in enumerate(zip(cell.bases, marks(cell), strict=True)):
        axes.plot(base.x_mm, base.y_mm, "s", color=arm_colour(arm), markersize=size, zorder=11)
        letter = {"color": PAPER, "ha": "center", "va": "center", "fontsize": 0.65 * size, "fontweight": "bold", "zorder": 12}
        axes.text(base.x_mm, base.y_mm, mark, **letter)


def _marked(cell: Cell, arm: int) -> str:
    """An arm's label, with the mark at its base in front unless it begins with that."""
    mark, label = marks(cell)[arm], cell.labels[arm]
    return label if label.startswith(mark) else f"{mark}: {label}"


def draw_shared(axes: Axes, cell: Cell, strength: float = 0.45, step_mm: float = 2.0) -> None:
    """What any two arms share, shaded."""
    frame_table(axes, cell)
    x, y = (np.arange(low, high, step_mm) for low, high in (axes.get_xlim(), axes.get_ylim()))
    shared = cell.reaches(np.stack(np.meshgrid(x, y), -1)).sum(-1) > 1
    axes.contourf(x, y, shared, levels=[0.5, 1.5], colors=[SHARED], alpha=strength, zorder=2)


def draw_obstacles(axes: Axes, cell: Cell, labelled: bool = False) -> None:
    """Obstacles, and dashed how far the block's centre keeps away from them."""
    for number, (obstacle, keep_out) in enumerate(zip(cell.config.obstacles, cell.keep_out, strict=True)):
        label = "obstacle" if labelled and not number else None
        body = Circle((obstacle.x_mm, obstacle.y_mm), obstacle.radius_mm, facecolor=GREY, edgecolor=INK, hatch="///", zorder=4, label=label)
        axes.add_patch(body)
        label = "kept clear by the block's centre" if label else None
        edge = {"fill": False, "edgecolor": INK, "linestyle": "--", "linewidth": 0.9, "zorder": 4, "label": label}
        axes.add_patch(Circle((keep_out.x_mm, keep_out.y_mm), keep_out.radius_mm, **edge))


def draw_chart(axes: Axes, cell: Cell, inner: Sequence[float] = (-0.5, 0.0, 0.5), label: str | None = "chart (α, β)") -> None:
    """Outline of the chart, and lines of constant alpha and beta at ``inner``."""
    along = np.linspace(-1.0, 1.0, 201)
    for value in (-1.0, *inner, 1.0):
        border = abs(value) == 1
        style = {"color": INK, "linewidth": 1.4 if border else 0.6, "zorder": 4}
        for line in (cell.shared.to_table(along, value + 0 * along), cell.shared.to_table(value + 0 * along, along)):
            axes.plot(line[:, 0], line[:, 1], label=label if border else None, **style)
            label = label if not border else None


def square_mm(pose: Sequence[float], side_mm: float) -> Floats:
    """Corners (4, 2) of the block at ``pose``: x [mm], y [mm], theta [rad]."""
    corners = side_mm / 2 * np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array(pose[:2], float) + corners @ np.array([(cos, sin), (-sin, cos)])


def draw_block(axes: Axes, pose: Sequence[float], side_mm: float, colour: str, face: str = "none", line: str = "-", order: int = 5) -> None:
    """The block, with an arrow from its centre along its orientation."""
    axes.add_patch(
        Polygon(square_mm(pose, side_mm), closed=True, facecolor=face, edgecolor=colour, linewidth=1.3, linestyle=line, zorder=order)
    )
    reach = 0.95 * side_mm
    tip = (pose[0] + reach * math.cos(pose[2]), pose[1] + reach * math.sin(pose[2]))
    arrow = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.3, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}
    axes.annotate("", xy=tip, xytext=(pose[0], pose[1]), arrowprops=arrow, zorder=order + 1)


def bare(axes: Axes) -> None:
    """No ticks, and a faint frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(FAINT)
