"""Bars of a suite: one measure of every row on each evaluation, and how episodes ended. Rows are lines, so that long labels have room."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from marl_handover.report.palette import BLUE, FAINT, GREY, HATCHES, INK, OUTCOMES, PAPER, RED
from marl_handover.report.table import Axes
from marl_handover.wording import counted

Tree = Mapping[str, Any]

LINE_IN, HEAD_IN, PANEL_IN, LABEL_IN = 0.3, 1.35, 3.1, 0.075
"""Inches: height of a row, of title, axis and legend; width of a panel, of a letter of the longest label."""

LEGEND_LINE_IN = 0.17

MEASURES = {
    "success_rate": ("success", 100.0, "{:.2f} %"),
    "success_in_the_end": ("success in the end", 100.0, "{:.2f} %"),
    "mean_steps_success": ("mean transfers, solved episodes", 1.0, "{:.2f}"),
    "steps_ratio": ("transfers ÷ optimum, solved episodes", 1.0, "{:.3f}"),
    "path_mm": ("way of the grip in a transfer, mm", 1.0, "{:.0f}"),
    "executor_path_mm": ("executors' on the same way, mm", 1.0, "{:.0f}"),
}
KINDS = {"continuous": (BLUE, ""), "discretised": (RED, "//"), "not learned": (GREY, "..")}
"""What a row's bar says by colour and hatching."""

SHOWN_PERCENT = 7.0
"""Narrower pieces of a bar carry no number."""


def bars_figure(results: Tree, spec: Tree) -> Figure | None:
    """A panel for each evaluation: interquartile mean, 95 % interval, and a dot for each run."""
    panels = [item for item in results["evaluations"] if not spec["evaluations"] or item["name"] in spec["evaluations"]]
    rows = [row for row in _rows(results, spec) if any(_found(row, item, spec) for item in panels)]
    panels = [item for item in panels if any(_found(row, item, spec) for row in rows)]
    if not panels:
        return None
    figure = _canvas(rows, len(panels))
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    title, scale, form = MEASURES[spec["measure"]]
    for axes, item in zip(all_axes, panels, strict=True):
        for line, row in enumerate(rows):
            found = _found(row, item, spec)
            colour, hatch = KINDS[kind_of(row)]
            if found is None:
                axes.text(0.02, line, "not run", transform=axes.get_yaxis_transform(), va="center", fontsize=7, color=GREY)
                continue
            axes.barh(line, scale * found["value"], height=0.62, color=colour, alpha=0.75, hatch=hatch, edgecolor=PAPER, linewidth=0)
            _spread(axes, line, row, item, spec, scale)
            axes.text(1.02, line, form.format(scale * found["value"]), transform=axes.get_yaxis_transform(), va="center", fontsize=8)
        axes.set_title(item["label"] or item["name"], fontsize=9)
        axes.set_xlabel(f"{title} [%]" if scale == 100 else title, fontsize=9)
        _ruled(axes)
        if scale == 100:
            axes.set_xlim(0, 100)
        elif spec["measure"] == "steps_ratio":
            # What is shown is the excess over the optimum; below it one only comes by lucky noise.
            axes.set_xlim(left=min([1.0, *(found["value"] for row in rows if (found := _found(row, item, spec)))]))
    _named(all_axes[0], rows)
    kinds = [kind for kind in KINDS if any(kind_of(row) == kind for row in rows)]
    patches = [Patch(facecolor=KINDS[kind][0], alpha=0.75, hatch=KINDS[kind][1], edgecolor=PAPER, label=kind) for kind in kinds]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(kinds), fontsize=8, frameon=False)
    _titled(figure, spec)
    return figure


def endings_figure(results: Tree, spec: Tree) -> Figure | None:
    """How the episodes of all runs of a row ended on one evaluation, as shares."""
    names = spec["evaluations"] or [item["name"] for item in results["evaluations"]]
    shown = [(row, name) for name in names for row in _rows(results, spec) if name in row["evaluations"]]
    if not shown:
        return None
    labels = {item["name"]: item["label"] or item["name"] for item in results["evaluations"]}
    lines = [{**row, "label": row["label"] + (f", {labels[name]}" if len(names) > 1 else "")} for row, name in shown]
    figure = _canvas(lines, 1, width_in=4.6)
    axes = figure.add_subplot()
    for line, (row, name) in enumerate(shown):
        found = row["evaluations"][name]
        left = 0.0
        for ending, hatch in HATCHES.items():
            share = 100 * found["outcomes"][ending] / found["episodes"]
            axes.barh(line, share, left=left, height=0.62, color=OUTCOMES[ending], hatch=hatch, edgecolor=PAPER, linewidth=0)
            if share >= SHOWN_PERCENT:
                box = {"boxstyle": "round,pad=0.15", "facecolor": PAPER, "edgecolor": "none", "alpha": 0.85}
                axes.text(left + share / 2, line, f"{share:.1f}", ha="center", va="center", fontsize=7, color=INK, bbox=box)
            left += share
        axes.text(1.02, line, counted(found["episodes"], "episode"), transform=axes.get_yaxis_transform(), va="center", fontsize=7)
    axes.set_xlim(0, 100)
    axes.set_xlabel("episodes [%]", fontsize=9)
    _ruled(axes)
    _named(axes, lines)
    patches = [Patch(facecolor=OUTCOMES[key], hatch=hatch, edgecolor=PAPER, label=key.replace("_", " ")) for key, hatch in HATCHES.items()]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=8, frameon=False)
    _titled(figure, spec)
    return figure


def kind_of(row: Tree) -> str:
    """What a row is, of :data:`KINDS`."""
    if row["settings"] is None:
        return "not learned"
    return "discretised" if row["settings"]["algorithm.name"] == "dqn" else "continuous"


def legend_below(figure: Figure, axes: Axes) -> None:
    """A legend under the axes, in as many columns as its longest label leaves room for; the page grows by its lines."""
    handles, labels = axes.get_legend_handles_labels()
    longest = max(len(label) for label in labels)
    columns = max(1, min(len(labels), int(105 / (longest + 8))))
    figure.set_figheight(figure.get_figheight() + LEGEND_LINE_IN * (math.ceil(len(labels) / columns) - 1))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=8, frameon=False, handlelength=3.2)


def _rows(results: Tree, spec: Tree) -> list[Tree]:
    rows = {row["name"]: row for row in results["rows"]}
    return [rows[name] for name in spec["rows"] or rows if name in rows]


def _found(row: Tree, item: Tree, spec: Tree) -> Tree | None:
    found: Tree | None = row["evaluations"].get(item["name"], {}).get(spec["measure"])
    return found


def _spread(axes: Axes, line: int, row: Tree, item: Tree, spec: Tree, scale: float) -> None:
    """The interval, and the runs beside one another so that equal ones are seen."""
    found = row["evaluations"][item["name"]][spec["measure"]]
    if found["low"] is not None:
        ends = [[scale * (found["value"] - found["low"])], [scale * (found["high"] - found["value"])]]
        axes.errorbar(scale * found["value"], line, xerr=ends, color=INK, capsize=2.5, linewidth=1.1, zorder=4)
    values = [run["evaluations"].get(item["name"], {}).get(spec["measure"]) for run in row["runs"]]
    known = [scale * value for value in values if value is not None]
    places = line + np.linspace(-0.2, 0.2, len(known)) if len(known) > 1 else [line]
    axes.plot(known, places, "o", color=PAPER, markeredgecolor=INK, markersize=2.6, markeredgewidth=0.6, zorder=5, clip_on=False)


def _canvas(rows: list[Any], panels: int, width_in: float = PANEL_IN) -> Figure:
    longest = max(len(row["label"]) for row in rows)
    return Figure(figsize=(LABEL_IN * longest + panels * width_in + 0.9, HEAD_IN + LINE_IN * len(rows)), layout="constrained")


def _named(axes: Axes, rows: list[Any]) -> None:
    """Row labels, the first on top."""
    axes.set_yticks(range(len(rows)), [row["label"] for row in rows], fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


def _ruled(axes: Axes) -> None:
    axes.grid(axis="x", color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
    axes.tick_params(axis="x", labelsize=8)
    axes.tick_params(axis="y", length=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _titled(figure: Figure, spec: Tree) -> None:
    if spec["title"]:
        figure.suptitle(spec["title"], fontsize=10, color=INK)
