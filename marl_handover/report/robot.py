"""The picture of a robot: the arm from the side at three places of its ring, and the ring from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle, Wedge

from marl_handover.config import RobotConfig
from marl_handover.geometry.closed_form import ClosedFormArm, pitch_frames
from marl_handover.report.figure_style import FAINT, GREY, INK, arm_colour

_SHADES = (0.35, 0.65, 1.0)


def robot_figure(arm: ClosedFormArm, settings: RobotConfig, ring_mm: Sequence[float]) -> Figure:
    """The arm in its own vertical plane with its hand at both ends and in the middle of its ring, and the ring with its yaws from above."""
    figure = Figure(figsize=(9.6, 4.8), layout="constrained")
    side, above = figure.subplots(1, 2)
    _draw_side(side, arm, settings, ring_mm)
    _draw_above(above, arm, ring_mm)
    figure.suptitle(
        f"{settings.name or arm.description.name}: ring {ring_mm[0]:.0f} to {ring_mm[1]:.0f} mm by joint limits, hand at "
        f"{settings.pitch_deg:g}°, {settings.pick_height_mm:g} mm over the table",
        fontsize=10,
    )
    return figure


def _draw_side(axes: Any, arm: ClosedFormArm, settings: RobotConfig, ring_mm: Sequence[float]) -> None:
    height = settings.pick_height_mm
    axes.axhline(0.0, color=INK, linewidth=1.2)
    axes.plot(ring_mm, [height, height], color=arm_colour(1), linewidth=5, alpha=0.35, solid_capstyle="butt", label="ring")
    hand = np.asarray(arm.description.joint("wrist_roll").axis)[[0, 2]]
    for shade, radius in zip(_SHADES, (ring_mm[0], sum(ring_mm) / 2, ring_mm[1]), strict=True):
        plane = math.sqrt(max(radius**2 - arm.lateral_mm**2, 0.0))
        branches = arm.ik([plane, arm.lateral_mm, height])
        # An end of the ring is the last place within the limits, to a hundredth of a millimetre.
        over = np.nan_to_num(np.maximum(branches - arm.upper_rad, arm.lower_rad - branches), nan=np.inf)[..., 1:4].max(axis=-1)
        q = branches[int(over.argmin())]
        r, z, _, _ = pitch_frames(arm.planar, q)
        line_r, line_z = [0.0, *r[:1], *r, plane], [0.0, *z[:1], *z, height]
        axes.plot([0.0, 0.0], [0.0, z[0]], color=INK, linewidth=4, alpha=shade, solid_capstyle="round")
        axes.plot(line_r[1:], line_z[1:], color=arm_colour(0), linewidth=3, alpha=shade, solid_capstyle="round")
        axes.plot([0.0, r[0]], [z[0], z[0]], color=INK, linewidth=3, alpha=shade)
        axes.scatter(r, z, color=INK, s=16, alpha=shade, zorder=3)
        axes.annotate("", (plane, height), (plane - 30 * hand[0], height - 30 * hand[1]), arrowprops={"arrowstyle": "-|>", "color": INK})
    axes.set_aspect("equal")
    axes.margins(0.08)
    axes.set_title("from the side: the hand at both ends and in the middle", fontsize=9)
    axes.set_xlabel("ahead of the yaw axis [mm]")
    axes.set_ylabel("over the table [mm]")
    axes.legend(loc="upper right", frameon=False, fontsize=8)
    axes.grid(color=FAINT, linewidth=0.6)


def _draw_above(axes: Any, arm: ClosedFormArm, ring_mm: Sequence[float]) -> None:
    aside = math.degrees(math.asin(min(max(arm.lateral_mm / ring_mm[1], -1.0), 1.0)))
    low, high = (math.degrees(float(limit)) + aside for limit in (arm.lower_rad[0], arm.upper_rad[0]))
    width = ring_mm[1] - ring_mm[0]
    axes.add_patch(Wedge((0.0, 0.0), ring_mm[1], low, high, width=width, facecolor=arm_colour(1), alpha=0.3, edgecolor=INK))
    axes.add_patch(Rectangle((-8.0, -8.0), 16.0, 16.0, color=INK))
    arrow = {"arrowstyle": "-|>", "color": GREY}
    axes.annotate("", (0.5 * ring_mm[1], 0.0), (0.0, 0.0), arrowprops=arrow)
    axes.annotate("yaw 0 of the URDF", (0.0, 0.0), (0, -14), textcoords="offset points", fontsize=8, color=GREY)
    edge = 1.08 * ring_mm[1]
    axes.set_xlim(-edge, edge)
    axes.set_ylim(-edge, edge)
    axes.set_aspect("equal")
    axes.set_title(f"from above: yaw {low:.0f} to {high:.0f} deg", fontsize=9)
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.grid(color=FAINT, linewidth=0.6)
