"""Figures of a suite, drawn from the content of its ``results.json``: learning curves, bars, endings, profiles, the workspace."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter

from marl_handover.cell import build_cell
from marl_handover.config import CellConfig
from marl_handover.errors import counted
from marl_handover.policies.registry import PRETRAINED
from marl_handover.report.figure_style import BLUE, FAINT, GREY, HATCHES, INK, OUTCOMES, PAPER, RED, ruled, series_marker, series_style
from marl_handover.report.plan import workspace_figure
from marl_handover.report.table import Axes

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
        return "continuous" if row.get("policy") in PRETRAINED else "not learned"
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
    ruled(axes, "x")
    axes.tick_params(axis="x", labelsize=8)
    axes.tick_params(axis="y", length=0)


def _titled(figure: Figure, spec: Tree) -> None:
    if spec["title"]:
        figure.suptitle(spec["title"], fontsize=10, color=INK)


CURVE_MEASURES = {
    "success_rate": "success in validation",
    "mean_steps": "mean transfers an episode, validation",
    "steps_ratio": "transfers ÷ optimum, validation",
    "training_success_rate": "success in training",
    "training_mean_length": "mean transfers an episode in training",
}
MARKERS = 14
"""On a curve, at most."""

SHARES = ("success_rate", "training_success_rate")


def make_figures(results: Tree) -> Iterator[tuple[str, Figure | None]]:
    """Name and picture of every figure of the suite; None for one without any values yet."""
    makers: dict[str, Callable[[Tree, Tree], Figure | None]] = {
        "curves": curves_figure,
        "bars": bars_figure,
        "end_states": endings_figure,
        "profiles": profiles_figure,
        "arms": arms_figure,
        "workspace": lambda results, spec: workspace_figure(build_cell(CellConfig())),
    }
    plain = [{**row, "label": row["label"].replace("`", "")} for row in results["rows"]]  # tables are Markdown, pictures are not
    results = {**results, "rows": plain}
    for spec in results["figures"]:
        yield spec["name"], makers[spec["kind"]](results, spec)


def curves_figure(results: Tree, spec: Tree) -> Figure | None:
    """Interquartile mean over the seeds and its 95 % band, against transfers or against the share of training that is done."""
    names = spec["rows"] or [row["name"] for row in results["rows"]]
    rows = {row["name"]: row for row in results["rows"]}
    shown = [rows[name] for name in names if name in rows and spec["measure"] in rows[name]["curves"]]
    if not shown:
        return None
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.add_subplot()
    for index, row in enumerate(shown):
        _curve(axes, row, spec, {**series_style(index), "marker": series_marker(index)})
    if spec["measure"] in SHARES:
        axes.set_ylim(-0.03, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.set_ylabel(CURVE_MEASURES[spec["measure"]])
    axes.set_xlim(left=0)
    if spec["x"] == "share":
        axes.set_xlim(0, 1)
        axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.set_xlabel("share of the run's transfers in training")
    else:
        axes.xaxis.set_major_locator(MaxNLocator(7, integer=True))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        axes.set_xlabel("transfers in training")
    _frame(figure, axes, spec)
    return figure


def _curve(axes: Axes, row: Tree, spec: Tree, style: Mapping[str, Any]) -> None:
    curve = row["curves"][spec["measure"]]
    scale = 1.0 / row["settings"]["steps"] if spec["x"] == "share" else 1.0
    steps = scale * np.array(curve["step"])
    label = f"{row['label']} ({counted(curve['runs'], 'seed')})"
    every = math.ceil(len(steps) / MARKERS)
    axes.plot(
        steps,
        curve["value"],
        label=label,
        linewidth=1.6,
        markersize=4.5,
        markeredgecolor=PAPER,
        markeredgewidth=0.5,
        markevery=every,
        **style,
    )
    axes.fill_between(steps, curve["low"], curve["high"], color=style["color"], alpha=0.18, linewidth=0)
    for stage in row["settings"]["curriculum"][:-1]:
        if 0 < stage["until_step"] < row["settings"]["steps"]:
            axes.axvline(scale * stage["until_step"], color=style["color"], linewidth=0.9, linestyle=":")


def profiles_figure(results: Tree, spec: Tree) -> Figure | None:
    """Share of the runs whose success lies above a threshold."""
    profiles = results["profiles"].get(spec["name"], {"rows": {}})
    labels = {row["name"]: row["label"] for row in results["rows"]}
    if not profiles["rows"]:
        return None
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.add_subplot()
    thresholds = np.array(profiles["thresholds"])
    names = [name for name in spec["rows"] or profiles["rows"] if name in profiles["rows"]]  # the other figures' order: colours agree
    for index, name in enumerate(names):
        band = profiles["rows"][name]
        style: Mapping[str, Any] = series_style(index)
        # Where curves lie on each other, the lower ones show beside the upper.
        width = 1.4 + 2.6 * (1 - (index + 1) / len(names))
        axes.plot(thresholds, band["value"], label=labels[name], linewidth=width, drawstyle="steps-post", **style)
        axes.fill_between(thresholds, band["low"], band["high"], color=style["color"], alpha=0.15, linewidth=0, step="post")
    axes.set_xlim(thresholds[0], thresholds[-1] + 0.02 * (thresholds[-1] - thresholds[0]))
    axes.set_ylim(-0.03, 1.05)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("success rate τ")
    axes.set_ylabel("runs above τ")
    _frame(figure, axes, spec)
    return figure


BY_ARMS = {
    "success_rate": ("success", 100.0),
    "steps_ratio": ("transfers ÷ optimum, solved", 1.0),
    "decision_ms": ("one decision, ms", 1.0),
}
"""Panels by the number of arms: key, title, scale."""


def arms_figure(results: Tree, spec: Tree) -> Figure | None:
    """Success, steps against the optimum and the time of a decision by the number of arms; bars are intervals over the runs."""
    shown = [(row, _of_arms(row, spec)) for row in _rows(results, spec)]
    shown = [(row, found) for row, found in shown if found]
    if not shown:
        return None
    figure = Figure(figsize=(9.6, 3.9), layout="constrained")
    for axes, (key, (title, scale)) in zip(figure.subplots(1, len(BY_ARMS)), BY_ARMS.items(), strict=True):
        for index, (row, found) in enumerate(shown):
            known = {arms: part[key] for arms, part in found.items() if part[key] is not None}
            parts = [part if isinstance(part, Mapping) else {"value": part, "low": None, "high": None} for part in known.values()]
            values = scale * np.array([part["value"] for part in parts])
            ends = [[0.0 if part[end] is None else scale * abs(part[end] - part["value"]) for part in parts] for end in ("low", "high")]
            style: Mapping[str, Any] = {**series_style(index), "marker": series_marker(index), "markersize": 4.5, "linewidth": 1.4}
            axes.errorbar(list(known), values, yerr=ends, capsize=2, label=row["label"], **style)
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("arms", fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.tick_params(labelsize=8)
        ruled(axes)
        if scale == 100:
            axes.yaxis.set_major_formatter(PercentFormatter(100))
        elif key == "decision_ms":
            axes.set_yscale("log")
    _titled(figure, spec)
    legend_below(figure, figure.axes[0])
    return figure


def _of_arms(row: Tree, spec: Tree) -> dict[int, Tree]:
    """What a row has of each number of arms, in the evaluations together."""
    parts = {int(arms): found for name in spec["evaluations"] for arms, found in row["by_arms"].get(name, {}).items()}
    return dict(sorted(parts.items()))


def _frame(figure: Figure, axes: Axes, spec: Tree) -> None:
    """Title, grid, and a legend that covers nothing."""
    axes.grid(color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_color(GREY)
    if spec["title"]:
        axes.set_title(spec["title"], fontsize=10, color=INK)
    legend_below(figure, axes)
