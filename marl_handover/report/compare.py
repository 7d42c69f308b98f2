"""Figures of a suite, drawn from the content of its ``results.json``: learning curves, bars, endings, profiles, the workspace."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter

from marl_handover.cell import build_cell
from marl_handover.config import CellConfig
from marl_handover.report.compare_bars import bars_figure, endings_figure, legend_below
from marl_handover.report.palette import FAINT, GREY, INK, PAPER, series_marker, series_style
from marl_handover.report.table import Axes
from marl_handover.report.workspace import workspace_figure
from marl_handover.wording import counted

Tree = Mapping[str, Any]

MEASURES = {
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
        "workspace": lambda results, spec: workspace_figure(build_cell(CellConfig())),
    }
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
    axes.set_ylabel(MEASURES[spec["measure"]])
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


def _frame(figure: Figure, axes: Axes, spec: Tree) -> None:
    """Title, grid, and a legend that covers nothing."""
    axes.grid(color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_color(GREY)
    if spec["title"]:
        axes.set_title(spec["title"], fontsize=10, color=INK)
    legend_below(figure, axes)
