"""The learning figure: success, transfers against the optimum, epsilon and gradient steps over environment steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter

from marl_handover.learning.recorder import Metrics, common_curve
from marl_handover.report.figure_style import BLUE, FAINT, GREY, INK, RED, YELLOW
from marl_handover.report.table import Axes

LONGEST = 64
"""Letters of a title that have room."""


def learning_figure(runs: Mapping[str, Metrics]) -> Figure:
    """Learning curves of named runs. Several are seeds of one experiment: each thin, and over the steps that all have, mean and band."""
    tables = list(runs.values())
    figure = Figure(figsize=(7.2, 7.2), layout="constrained")
    success, ratio, stage = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 2))
    _curve(success, tables, "success_rate", BLUE)
    success.set_ylim(-0.03, 1.03)
    success.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    success.set_ylabel("success in evaluation")
    _curve(ratio, tables, "steps_ratio", RED)
    ratio.axhline(1.0, color=INK, linewidth=0.8, linestyle=":")
    ratio.margins(y=0.08)
    ratio.set_ylabel("transfers ÷ optimum")
    _stages(stage, tables[0])
    _gradient_steps(stage.twinx(), tables)
    for axes in (success, ratio, stage):
        axes.grid(color=FAINT, linewidth=0.5)
        for step in stage_changes(tables[0]):
            axes.axvline(step, color=GREY, linewidth=0.8, linestyle="--")
    stage.set_xlabel("environment steps")
    stage.set_xlim(left=0)
    stage.xaxis.set_major_locator(MaxNLocator(7, integer=True))
    stage.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    figure.align_ylabels([success, ratio, stage])
    success.set_title(_title(list(runs)), fontsize=10)
    return figure


def stage_changes(run: Metrics) -> list[float]:
    """Environment steps at which the range of epsilon changed. A row tells the range up to it, so that is the last row with the old one."""
    low, high = run["epsilon_low_deg"], run["epsilon_high_deg"]
    changed = (np.diff(low) != 0) | (np.diff(high) != 0)
    known = np.isfinite(low) & np.isfinite(high)
    return [float(step) for step in run["step"][:-1][changed & known[1:] & known[:-1]]]


def _title(names: list[str]) -> str:
    folders = [Path(name).name for name in names]
    shown = [_end(name, LONGEST) for name in (folders if len(set(folders)) == len(names) > 1 else names)]
    if len(names) == 1:
        return shown[0]
    text = ", ".join(shown)
    if len(text) > LONGEST:
        text = f"{_end(shown[0], LONGEST // 2)} and {len(names) - 1} more"
    return f"{text}: mean, worst and best"


def _end(name: str, longest: int) -> str:
    return name if len(name) <= longest else f"… {name[-longest:]}"


def _curve(axes: Axes, runs: list[Metrics], column: str, colour: str) -> None:
    steps, values = common_curve(runs, column)
    if not len(values):
        axes.text(0.5, 0.75, "no values yet", transform=axes.transAxes, ha="center", va="center", color=GREY)
        axes.set_yticks([])
        return
    if len(values) > 1:
        axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.2, linewidth=0)
        for run in runs:
            known = np.isfinite(run[column])
            axes.plot(run["step"][known], run[column][known], color=colour, linewidth=0.6, alpha=0.6)
    marker = "o" if len(steps) <= 40 else None
    axes.plot(steps, values.mean(0), color=colour, marker=marker, markersize=3)


def _stages(axes: Axes, run: Metrics) -> None:
    """The range of epsilon that episodes are drawn from; each row shows what the steps before it had."""
    axes.set_ylabel("ε in training [°]")
    known = np.isfinite(run["epsilon_low_deg"]) & np.isfinite(run["epsilon_high_deg"])
    if not known.any():
        return
    step, low, high = (np.concatenate([run[key][known][:1], run[key][known]]) for key in ("step", "epsilon_low_deg", "epsilon_high_deg"))
    step[0] = 0
    axes.fill_between(step, low, high, color=YELLOW, alpha=0.35, linewidth=0, step="pre")
    for edge in (low, high):
        axes.plot(step, edge, color=YELLOW, drawstyle="steps-pre")
    axes.set_yscale("log")
    marks = sorted({float(value) for value in (*low, *high)})
    if len(marks) <= 6:
        axes.set_yticks(marks, [f"{mark:g}" for mark in marks])
        axes.minorticks_off()
    axes.set_ylim(marks[0] / 1.5, marks[-1] * 1.5)


def _gradient_steps(axes: Axes, runs: list[Metrics]) -> None:
    axes.set_ylabel("gradient steps (–·–)")
    for run in runs:
        axes.plot(
            run["step"], run["gradient_step"], color=INK, linestyle="-.", linewidth=1.2, marker="." if len(run["step"]) == 1 else None
        )
    known = [float(np.nanmax(run["gradient_step"])) for run in runs if np.isfinite(run["gradient_step"]).any()]
    axes.set_ylim(0, max([1.0, *known]) * 1.1)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
