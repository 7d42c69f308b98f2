"""The pictures of docs/concepts/many-arms.md, drawn from the package's own charts and plans; ``docs_images.py`` writes them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Arc as ArcPatch
from matplotlib.patches import Circle

from marl_handover.cell import Cell, layout_cell
from marl_handover.commands.plan import solve
from marl_handover.config import CellConfig, TaskConfig
from marl_handover.files import package_path
from marl_handover.learning.graph_network import HandoverGraphs, embedded, hand_over_value
from marl_handover.policies import ExactPolicy
from marl_handover.policies.files import read_policy
from marl_handover.policies.graph_policy import GraphPolicy
from marl_handover.report.figure_style import BLUE, FAINT, GREY, INK, PAPER, RED, SHARED, arm_colour
from marl_handover.report.plan import plan_figure
from marl_handover.report.table import bare, draw_bases, draw_obstacles
from marl_handover.task.observations import observe
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules

PAPER_RING, AL5A_RING = (150.0, 230.0), (143.0, 313.0)
GREEN = arm_colour(2)
RAINBOW = matplotlib.colormaps["cividis"]
"""Of hand-over angles: light is high; it can be told without seeing red or green."""

START_DEG, GOAL_DEG = (-250.0, 60.0, 0.0), (250.0, 60.0, 0.0)
"""The example: x, y in mm and theta in deg."""


def pair(distance_mm: float, ring_mm: tuple[float, float], left_yaw_deg: float, right_yaw_deg: float, discs: Iterable[Any] = ()) -> Cell:
    """Two arms L and R face to face, as in the shipped cell, with yaw limits of plus and minus so much, and discs (x, y, radius)."""
    half = distance_mm / 2
    arms = [record("L", 0.0, half, -90.0, ring_mm, left_yaw_deg), record("R", 0.0, -half, 90.0, ring_mm, right_yaw_deg)]
    obstacles = [{"x_mm": x, "y_mm": y, "radius_mm": radius} for x, y, radius in discs]
    return layout_cell(arms, obstacles, CellConfig(chart="angle"))


def record(name: str, x_mm: float, y_mm: float, facing_deg: float, ring_mm: tuple[float, float], yaw_deg: float) -> dict[str, Any]:
    """An arm as ``layout_cell`` takes it."""
    yaw_rad = math.radians(yaw_deg)
    place = {"name": name, "x_mm": x_mm, "y_mm": y_mm, "facing_rad": math.radians(facing_deg)}
    return {**place, "r_min_mm": ring_mm[0], "r_max_mm": ring_mm[1], "yaw_range_rad": [-yaw_rad, yaw_rad]}


def ring(count: int, side_mm: float = 360.0) -> list[dict[str, Any]]:
    """Arms A, B, ... on a regular polygon that stands on the side from A to B; each faces its middle."""
    radius = side_mm / (2 * math.sin(math.pi / count))
    turns = [270.0 + 180.0 / count * (2 * arm - 1) for arm in range(count)]
    places = [(radius * math.cos(math.radians(turn)), radius * math.sin(math.radians(turn))) for turn in turns]
    return [record("ABCDEFGH"[arm], *places[arm], turns[arm] + 180.0, PAPER_RING, 90.0) for arm in range(count)]


def coloured(gamma_deg: float) -> Any:
    """The colour of a hand-over angle."""
    return RAINBOW((gamma_deg - 80.0) / 200.0)


def curve(cell: Cell, gamma_deg: float, points: int = 800) -> np.ndarray:
    """The places (points, 2) of one hand-over angle, with NaN between its pieces."""
    chart, gamma = cell.shared.chart, np.array(math.radians(gamma_deg))
    alpha = chart.from_table(chart.at_angle(gamma))[0]
    return broken(cell.shared.to_table(np.full(points, alpha), np.linspace(-1.0, 1.0, points)))


def broken(line: np.ndarray) -> np.ndarray:
    """A line (n, 2) with NaN where it jumps."""
    line = line.copy()
    line[1:][np.hypot(*np.diff(line, axis=0).T) > 6.0] = math.nan
    return line


def offered(cell: Cell, gamma_deg: float) -> bool:
    """Whether the shared space of a pair offers a hand-over angle."""
    return any((math.radians(gamma_deg) - arc.low_rad) % (2 * math.pi) <= arc.width_rad for arc in cell.shared.chart.arcs)


def shade(axes: Any, cell: Cell, half_mm: tuple[float, float], step_mm: float = 1.0) -> None:
    """The shared space, in yellow."""
    x, y = (np.arange(-end, end + step_mm, step_mm) for end in half_mm)
    shared = cell.reaches(np.stack(np.meshgrid(x, y), -1)).sum(-1) > 1
    axes.contourf(x, y, shared, levels=[0.5, 1.5], colors=[SHARED], alpha=0.35, zorder=1)


def window(axes: Any, half_mm: tuple[float, float]) -> None:
    """Equal axes without ticks, so far to each side of the origin."""
    axes.set(xlim=(-half_mm[0], half_mm[0]), ylim=(-half_mm[1], half_mm[1]), aspect="equal")
    bare(axes)


def write(axes: Any, place_mm: Any, text: str, **style: Any) -> None:
    """Words on white, so that lines below do not disturb."""
    box = {"facecolor": PAPER, "edgecolor": "none", "alpha": 0.8, "pad": 0.8}
    axes.text(*place_mm, text, **{"fontsize": 9, "ha": "center", "va": "center", "bbox": box, "zorder": 20, **style})


def hand_over_angle() -> Figure:
    """What the angle is; that places on one arc see the bases at the same angle; the curves over the shared space."""
    cell, half = pair(360.0, PAPER_RING, 90.0, 90.0), (190.0, 215.0)
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    panels = figure.subplots(1, 3)
    titles = ("The angle at which p sees the bases", "The same all along an arc of a circle", "Curves over the shared space")
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title, fontsize=10)
        window(axes, half)
        draw_bases(axes, cell)
    place = np.array([-95.0, 15.0])
    _sight(panels[0], cell, place, thick=True)
    write(panels[0], place + (-24, 2), "p", fontstyle="italic", fontsize=12)
    gamma = math.degrees(_gamma(cell, place))
    for arm, name in enumerate("LR"):
        base = cell.bases[arm].position_mm
        tip = place + 62 * (place - base) / math.dist(place, base)
        arrow = {"arrowstyle": "-|>", "color": arm_colour(arm), "linewidth": 2.2, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 14}
        panels[0].annotate("", xy=tip, xytext=place, arrowprops=arrow, zorder=8)
        write(panels[0], tip + (-8, -14 if arm == 0 else 14), f"$\\psi_{name}$", color=arm_colour(arm), fontsize=12)
    write(panels[0], place + (86, -2), f"γ = {gamma:.0f}°", fontsize=11)
    write(panels[0], (95, 180), "L's hand at p\npoints away from L", color=arm_colour(0), fontsize=8)
    write(panels[0], (95, -180), "R's hand at p\npoints away from R", color=arm_colour(1), fontsize=8)
    centre = 180.0 / math.tan(math.radians(gamma))
    panels[1].add_patch(Circle((-centre, 0.0), math.hypot(180.0, centre), fill=False, edgecolor=GREY, linestyle=":", zorder=2))
    line = curve(cell, gamma)
    panels[1].plot(*line.T, color=INK, linewidth=3.5, zorder=6, solid_capstyle="round")
    radius = math.hypot(180.0, centre)
    for turn in (-38.0, 0.0, 38.0):
        turn = math.radians(180.0 - turn)
        _sight(panels[1], cell, np.array([radius * math.cos(turn) - centre, radius * math.sin(turn)]))
    write(panels[1], (85, 0), f"γ = {gamma:.0f}° at each\nof the three", fontsize=9)
    write(panels[1], (85, -75), "thick: what lies in\nboth arms' rings", fontsize=8.5)
    shade(panels[2], cell, half)
    for value in range(105, 256, 15):
        line = curve(cell, value)
        panels[2].plot(*line.T, color=coloured(value), linewidth=3, zorder=5)
        if value % 30 == 0:
            top = line[np.nanargmax(line[:, 1])]
            write(panels[2], top + (0, 13), f"{value}°", fontsize=8.5)
    write(panels[2], (-120, -78), "γ < 180°", color=GREY)
    write(panels[2], (120, -78), "γ > 180°", color=GREY)
    return figure


def _gamma(cell: Cell, place: np.ndarray) -> float:
    yaw = cell.gripper_yaw(cell.polar(place)[1])
    return float((yaw[0] - yaw[1]) % (2 * math.pi))


def _sight(axes: Any, cell: Cell, place: np.ndarray, thick: bool = False) -> None:
    """Both lines of sight of a place, and the angle between them."""
    directions = []
    for arm, base in enumerate(cell.bases):
        axes.plot([base.x_mm, place[0]], [base.y_mm, place[1]], color=arm_colour(arm), linewidth=1.6 if thick else 1.0, zorder=4)
        directions.append(math.degrees(math.atan2(base.y_mm - place[1], base.x_mm - place[0])))
    size = 60 if thick else 40
    axes.add_patch(ArcPatch(tuple(place), size, size, theta1=directions[1], theta2=directions[0], color=INK, linewidth=1.6, zorder=7))
    axes.plot(*place, "o", color=INK, markersize=6, zorder=9)


def offered_angles() -> Figure:
    """Curves of equal angle and the set Gamma: all of it, with a disc in mid-curve, with one across, with a yaw limit."""
    cells = {
        "Nothing in the way": pair(440.0, AL5A_RING, 95.0, 95.0),
        "A disc in mid-curve:\nΓ as before": pair(440.0, AL5A_RING, 95.0, 95.0, [(60.0, 0.0, 12.0)]),
        "Discs from side to side:\na gap in Γ": pair(440.0, AL5A_RING, 95.0, 95.0, [(75.0, 45.0, 25.0), (75.0, -45.0, 25.0)]),
        "L turns by ±25° only:\nΓ ends earlier": pair(440.0, AL5A_RING, 25.0, 95.0),
    }
    figure = Figure(figsize=(9.2, 4.2), layout="constrained")
    tables, dials = figure.add_gridspec(2, 4, height_ratios=(1.15, 1)), []
    for column, (title, cell) in enumerate(cells.items()):
        axes = figure.add_subplot(tables[0, column])
        half = (235.0, 115.0)
        shade(axes, cell, half)
        window(axes, half)
        for value in range(92, 270, 8):
            if offered(cell, value):
                axes.plot(*curve(cell, value).T, color=coloured(value), linewidth=2, zorder=3)
        draw_obstacles(axes, cell)
        axes.set_title(title, fontsize=9.5)
        dials.append(figure.add_subplot(tables[1, column], projection="polar"))
        dial(dials[-1])
        for arc in cell.shared.chart.arcs:
            low, high = math.degrees(arc.low_rad), math.degrees(arc.low_rad + arc.width_rad)
            for angle in np.arange(low, high, 2.0):
                band(dials[-1], angle, min(angle + 2.2, high), coloured(angle))
        ends = [(math.degrees(arc.low_rad), math.degrees(arc.low_rad + arc.width_rad)) for arc in cell.shared.chart.arcs]
        dials[-1].text(0, 0, "Γ\n" + "\n".join(f"{low:.0f}° … {high:.0f}°" for low, high in ends), ha="center", va="center", fontsize=9)
    return figure


def dial(axes: Any, ticks: bool = True) -> None:
    """A circle of angles: 0 to the right, counted to the left."""
    axes.set_ylim(0, 1.02)
    axes.set_yticks([])
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["0°", "90°", "180°", "270°"] if ticks else [""] * 4, fontsize=8)
    axes.tick_params(pad=-2)
    axes.grid(False)
    axes.spines["polar"].set_color(FAINT)


def band(axes: Any, low_deg: float, high_deg: float, colour: Any) -> None:
    """The arc from one angle to another, at most all around."""
    low, width = math.radians(low_deg), math.radians(min(high_deg - low_deg, 360.0))
    axes.bar(low, 0.28, width=width, bottom=0.7, align="edge", color=colour, linewidth=0)


def charts() -> Figure:
    """Lines of constant alpha and beta: the paper's chart, the angle chart, close bases, a disc."""
    far = ("L", 0.0, 180.0, -90.0, PAPER_RING, 90.0), ("R", 0.0, -180.0, 90.0, PAPER_RING, 90.0)
    panels = {
        "The paper's chart": (layout_cell([record(*arm) for arm in far]), (170.0, 70.0)),
        "The angle chart of the same space": (pair(360.0, PAPER_RING, 90.0, 90.0), (170.0, 70.0)),
        "Bases inside each other's ring, 180 mm apart": (pair(180.0, PAPER_RING, 120.0, 120.0), (255.0, 105.0)),
        "With a disc, in the cell al5a's rings": (pair(440.0, AL5A_RING, 95.0, 95.0, [(60.0, 0.0, 12.0)]), (255.0, 105.0)),
    }
    figure = Figure(figsize=(8.4, 4.6), layout="constrained")
    for axes, (title, (cell, half)) in zip(figure.subplots(2, 2).reshape(-1), panels.items(), strict=True):
        shade(axes, cell, half)
        window(axes, half)
        along = np.linspace(-1.0, 1.0, 1601)
        for value in np.linspace(-1.0, 1.0, 17):
            axes.plot(*broken(cell.shared.to_table(value + 0 * along, along)).T, color=BLUE, linewidth=1.1, zorder=4)
        for value in np.linspace(-1.0, 1.0, 9):
            axes.plot(
                *broken(cell.shared.to_table(along, value + 0 * along)).T, color=RED, linewidth=0.9, linestyle=(0, (4, 1.5)), zorder=3
            )
        draw_obstacles(axes, cell)
        if cell.bases[0].y_mm < half[1]:
            draw_bases(axes, cell)
        axes.set_title(title, fontsize=10)
    lines = [Line2D([], [], color=BLUE, label="α the same: in the angle chart, the hand-over angle γ is the same")]
    lines.append(Line2D([], [], color=RED, linestyle=(0, (4, 1.5)), label="β the same"))
    figure.legend(handles=lines, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure


def planner_of(cell: Cell) -> ExactPlanner:
    """With the default task: within 5 degrees."""
    return ExactPlanner(Rules(cell, TaskConfig(epsilon_deg=5.0)))


def adding_up() -> Figure:
    """The sets S_n from A to B and from A back to A, transfer by transfer, for two arms and for three."""
    two, three = layout_cell(ring(3)[:2]), layout_cell(ring(3))
    start, goal = (np.array([*pose[:2], math.radians(pose[2])]) for pose in (START_DEG, GOAL_DEG))
    psi, goal_psi = (three.gripper_yaw(three.polar(pose)[1]) for pose in (start, goal))
    across = float(goal[2] - start[2] + psi[0] - goal_psi[1])
    rows = [(two, 1, across), (three, 1, across), (two, 0, math.pi), (three, 0, math.pi)]
    names = [f"{count} arms,\n{way}" for way in ("A to B", "A back to A") for count in ("two", "three")]
    figure = Figure(figsize=(7.6, 6.6), layout="constrained")
    for row, ((cell, last, needed), name) in enumerate(zip(rows, names, strict=True)):
        planner, solved = planner_of(cell), False
        for count in range(1, 6):
            axes = figure.add_subplot(4, 5, 5 * row + count, projection="polar")
            dial(axes, ticks=False)
            walks = [walk for walk in planner.walks if (walk[0], walk[-1], len(walk)) == (0, last, count)]
            arcs = [planner.interval(walk) for walk in walks]
            for low, high in arcs:
                band(axes, math.degrees(low), max(math.degrees(high), math.degrees(low) + 3), BLUE if cell is two else GREEN)
            meets = any((needed - low + 0.0873) % (2 * math.pi) <= high - low + 0.1745 for low, high in arcs)
            axes.plot([needed, needed], [0.55, 1.02], color=INK, linewidth=2.4, solid_capstyle="butt", zorder=9)
            first = meets and not solved
            solved |= meets
            axes.text(0, 0, "✓" if first else "" if walks else "–", ha="center", va="center", fontsize=20, color=INK)
            if row == 0:
                axes.set_title(f"$S_{count}$", fontsize=12)
            if count == 1:
                name = f"{name},\nneeded {math.degrees(needed):.0f}°"
                axes.text(-0.25, 0.5, name, transform=axes.transAxes, ha="right", va="center", fontsize=10)
    lines = [Line2D([], [], color=INK, linewidth=2.4, label="the angle that is needed")]
    for colour, who in ((BLUE, "two"), (GREEN, "three")):
        lines.append(Line2D([], [], color=colour, linewidth=8, label=f"what {who} arms can add up to"))
    lines.append(Line2D([], [], color=INK, linestyle="none", marker="$✓$", markersize=10, label="the first that has it"))
    lines.append(Line2D([], [], color=INK, linestyle="none", marker="_", markersize=7, label="no such chain of arms"))
    figure.legend(handles=lines, loc="outside lower center", ncols=3, fontsize=9, frameon=False, handlelength=1.5)
    return figure


def example(count: int) -> Figure:
    """The exact plan of the example in the triangle's first ``count`` arms."""
    cell = layout_cell(ring(3)[:count])
    rules = Rules(cell, TaskConfig(epsilon_deg=5.0))
    start, goal = (np.array([*pose[:2], math.radians(pose[2])]) for pose in (START_DEG, GOAL_DEG))
    return plan_figure(solve(ExactPolicy(rules), start, goal), cell)


def ring_sizes() -> Figure:
    """How many transfers random problems need in regular rings of 2 to 8 arms."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    colours = [RAINBOW(value) for value in (0.0, 0.25, 0.5, 0.75, 0.95)]
    for row, count in enumerate((2, 3, 4, 5, 6, 8)):
        cell = layout_cell(ring(count))
        start, goal = (poses.numpy() for poses in sample_problems(cell, 100_000, torch.Generator().manual_seed(0)))
        transfers = planner_of(cell).plan(start, goal).transfers
        left = 0.0
        for number in range(1, 6):
            share = 100 * float((transfers == number).mean())
            axes.barh(row, share, left=left, color=colours[number - 1], edgecolor=PAPER, label=f"{number}" if row == 0 else None)
            if share > 6:
                ink = PAPER if number < 4 else INK
                axes.text(left + share / 2, row, f"{number}", ha="center", va="center", color=ink, fontsize=9)
            left += share
        axes.text(101, row, f"{transfers.mean():.2f}", va="center", fontsize=9)
    axes.text(101, -0.75, "mean", fontsize=9, va="center")
    figure.legend(loc="outside upper center", ncols=6, title="fewest transfers", title_fontsize=9, fontsize=9, frameon=False)
    axes.set_yticks(range(6), [f"{count} arms" for count in (2, 3, 4, 5, 6, 8)])
    axes.set(xlim=(0, 100), ylim=(5.5, -0.5), xlabel="share of random problems [%], by the fewest transfers they need")
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    return figure


def learned_values() -> Figure:
    """The learned value of each arm that carries the block, over the angle, above the fewest transfers from there."""
    cell = layout_cell(ring(3))
    rules = Rules(cell, TaskConfig(epsilon_deg=5.0))
    arrays = read_policy(package_path("pretrained/any.npz"))
    policy = GraphPolicy(rules, "any", arrays, json.loads(str(arrays["about"])))
    angles = np.linspace(-math.pi, math.pi, 721)
    goal = np.array([*GOAL_DEG[:2], math.radians(GOAL_DEG[2])])
    goals = np.broadcast_to(goal, (len(angles), 3))
    graph = HandoverGraphs(observe(rules, "graph", goals, goals, np.full(len(angles), -1)).astype(np.float32), 3)
    mirrored = graph.with_mirror()
    known = embedded(policy.layers, policy.shape, mirrored)
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey="row")
    places = sample_problems(cell, 1000, torch.Generator().manual_seed(0))[0].numpy()[:, :2]
    only = cell.reaches(places) & (cell.reaches(places).sum(-1, keepdims=True) == 1)  # where one arm has the block to itself
    for arm in range(3):
        rows = np.flatnonzero(graph.arm == arm)
        here = np.array([places[np.argmax(only[:, arm])]] * len(angles))
        yaw = cell.polar(here)[1][:, arm]
        starts = np.column_stack([here, angles + goal[2] + yaw])
        images = np.concatenate([rows, rows + len(graph.arm)])  # the mirrored problems come after all others
        both = hand_over_value(policy.layers, policy.shape, mirrored, known, images, np.concatenate([angles, -angles]).astype(np.float32))
        learned = both.min(0).reshape(2, -1).mean(0)
        needed = planner_of(cell).plan(starts, goals).transfers
        above, below = panels[:, arm]
        above.plot(np.degrees(angles), learned, color=arm_colour(arm), linewidth=1.6)
        below.step(np.degrees(angles), needed, color=INK, linewidth=1.6, where="mid")
        above.set_title(f"{cell.names[arm]} has the block", fontsize=10)
        below.set(xlabel="angle u at which it carries it [deg]", xlim=(-180, 180), xticks=range(-180, 181, 90))
        for axes in (above, below):
            axes.grid(color=FAINT, linewidth=0.6)
            for side in ("top", "right"):
                axes.spines[side].set_visible(False)
    panels[0, 0].set_ylabel("learned value")
    panels[1, 0].set(ylabel="fewest transfers left\n(exact planner)", ylim=(4.5, 0.5), yticks=range(1, 5))
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "hand_over_angle": hand_over_angle,
    "offered_angles": offered_angles,
    "charts": charts,
    "adding_up": adding_up,
    "example_two_arms": lambda: example(2),
    "example_three_arms": lambda: example(3),
    "ring_sizes": ring_sizes,
    "learned_values": learned_values,
}
