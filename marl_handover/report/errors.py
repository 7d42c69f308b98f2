"""The error figure: how far from the goal each episode of a trace left the block, in orientation and in position."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from marl_handover.report.palette import FAINT, HATCHES, INK, OUTCOMES, PAPER
from marl_handover.report.table import Axes
from marl_handover.report.traces import Trace, errors_at_end
from marl_handover.task.rules import Outcome
from marl_handover.wording import counted

Floats = NDArray[np.float64]

SCALES = ("log", "linear")
BINS_A_DECADE, LINEAR_BINS = 8, 40

_LEAST = 0.01
"""Degrees and mm: errors below stand in the first bar of a logarithmic axis."""


class _Measure(NamedTuple):
    """One panel: its name and unit, what is too little and what too much to be told apart, and a value at which two bins meet."""

    name: str
    unit: str
    least: float
    most: float
    border: float


def errors_figure(trace: Trace, symmetry_order: int = 1, scale: str = "log", title: str = "") -> Figure:
    """Histograms of both errors at the first verdict, stacked by how the episode ended.

    Args:
        trace: the episodes.
        symmetry_order: of the block; errors count modulo 360° / k.
        scale: log or linear. On log, all errors below 0.01° or 0.01 mm stand in the first bar; two bars meet at epsilon.
        title: what the trace is of.
    """
    away_mm, turned_rad = errors_at_end(trace, symmetry_order)
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    epsilon_deg = math.degrees(float(np.median(trace.epsilon_rad)))
    _histogram(left, np.degrees(turned_rad), trace, _Measure("orientation", "°", _LEAST, 180.0, epsilon_deg), scale)
    left.axvline(epsilon_deg, color=INK, linewidth=1.1, linestyle="--")
    left.annotate(
        f"ε = {epsilon_deg:g}°", (epsilon_deg, 1.0), xycoords=("data", "axes fraction"), xytext=(4, -3), textcoords="offset points",
        ha="left", va="top", fontsize=8, color=INK, bbox={"boxstyle": "square,pad=0.1", "facecolor": PAPER, "edgecolor": "none"},
    )  # fmt: skip
    _histogram(right, away_mm, trace, _Measure("position", " mm", _LEAST, 600.0, 1.0), scale)
    left.set_ylabel("episodes")
    shown = [outcome for outcome in OUTCOMES if (trace.outcome == int(Outcome[outcome.upper()])).any()]
    patches = [Patch(facecolor=OUTCOMES[key], hatch=HATCHES[key], edgecolor=PAPER, label=key.replace("_", " ")) for key in shown]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=8, frameon=False)
    figure.suptitle(f"{title}{': ' if title else ''}error at the end of {counted(len(away_mm), 'episode')}", fontsize=10)
    return figure


def _histogram(axes: Axes, values: Floats, trace: Trace, measure: _Measure, scale: str) -> None:
    edges = _edges(values, measure, scale)
    floor = np.zeros(len(edges) - 1)
    for name, colour in OUTCOMES.items():
        group = np.clip(values[trace.outcome == int(Outcome[name.upper()])], edges[0], edges[-1])
        count = np.histogram(group, edges)[0]
        style = {"color": colour, "hatch": HATCHES[name], "edgecolor": PAPER, "linewidth": 0}
        axes.bar(edges[:-1], count, width=np.diff(edges), align="edge", bottom=floor, **style)
        floor = floor + count
    if scale == "log":
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"≤ {value:g}" if value <= measure.least else f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(0, 1.12 * max(1.0, float(floor.max())))
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.set_xlabel(f"{measure.name} error [{measure.unit.strip()}]")
    axes.set_title(_summary(values, measure), fontsize=9)
    axes.grid(axis="y", color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(labelsize=8)


def _edges(values: Floats, measure: _Measure, scale: str) -> Floats:
    """Borders of the bins, one of them at ``measure.border``."""
    if scale == "log":
        low, high = (BINS_A_DECADE * math.log10(limit / measure.border) for limit in (measure.least, measure.most))
        steps = np.arange(math.floor(low + 1e-9), math.ceil(high - 1e-9) + 1)
        return np.asarray(measure.border * 10.0 ** (steps / BINS_A_DECADE), float)
    most = max(float(values.max()), measure.border)
    share = most / LINEAR_BINS / measure.border  # of a bin in what lies below the border
    width = measure.border * (math.ceil(share) if share >= 1 else 1 / math.floor(1 / share))
    return np.asarray(width * np.arange(math.ceil(most / width + 1e-9) + 1), float)


def _summary(values: Floats, measure: _Measure) -> str:
    if values.max() < measure.least:
        return f"all within {measure.least:g}{measure.unit}"
    middle, most = np.percentile(values, (50, 95))
    return f"median {_short(middle)}{measure.unit}, 95 % up to {_short(most)}{measure.unit}"


def _short(value: float) -> str:
    """Three digits; what is nothing but rounding is 0."""
    return "0" if value < 1e-4 else f"{value:.3g}"
