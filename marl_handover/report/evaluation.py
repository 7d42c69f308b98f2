"""Figures of an evaluation: how episodes ended, their transfers against the optimum, what was to come, how far off the block was left."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.errors import CorruptFile, InvalidSetting, counted
from marl_handover.report.figure_style import BLUE, GREY, HATCHES, INK, OUTCOMES, PAPER, YELLOW, ruled
from marl_handover.report.table import Axes
from marl_handover.report.traces import Trace, errors_at_end, foreseen, symmetry_of
from marl_handover.task.rules import Outcome, Rules

Integers = NDArray[np.int64]

ENDINGS = (Outcome.SUCCESS, Outcome.WRONG_ORIENTATION, Outcome.WRONG_POSITION, Outcome.TIMEOUT)
MEANT = (Outcome.SUCCESS, Outcome.WRONG_ORIENTATION, Outcome.WRONG_POSITION, Outcome.NONE)

SAME_GOAL = 1e-6
"""Goals (mm, rad) that differ by less are one."""

_DARK = 0.55

SCALES = ("log", "linear")
BINS_A_DECADE, LINEAR_BINS = 8, 40

_LEAST = 0.01
"""Degrees and mm: errors below stand in the first bar of a logarithmic axis."""


def check_evaluation(result: Mapping[str, Any], path: Path) -> None:
    """Raise :class:`CorruptFile` unless ``result``, read from ``path``, has what the figure needs."""
    try:
        counts = [int(result["outcomes"][name]) for name in OUTCOMES]
        if min(counts) < 0 or sum(counts) < 1:
            raise ValueError("it counts no episodes")
        low, high = (float(value) for value in result["success_ci95"])
        [float(value) for value in (low, high, result["success_rate"], result["mean_steps"], result["epsilon_deg"])]
        [float(result[name]) for name in ("mean_steps_success", "optimal_mean_steps") if result[name] is not None]
        str(result["policy"])
    except KeyError as error:
        raise CorruptFile("evaluation", path, f"it lacks {error.args[0]!r}") from error
    except (TypeError, ValueError) as error:
        raise CorruptFile("evaluation", path, str(error)) from error


def evaluation_figure(
    result: Mapping[str, Any], transfers: NDArray[np.int64] | None = None, optimal: NDArray[np.int64] | None = None
) -> Figure:
    """Outcomes, and transfers against the optimum.

    Args:
        result: what ``evaluate … json=FILE`` wrote.
        transfers: of each successful episode (n,), for a histogram; without them the means are shown.
        optimal: fewest transfers of the same episodes (n,).
    """
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    _outcomes(left, result)
    if transfers is not None and optimal is not None and len(transfers):
        _histogram(right, transfers, optimal)
    else:
        _means(right, result)
    name = Path(str(result["policy"])).name
    kind = f"architecture {result['architecture']}, " if "architecture" in result else ""
    figure.suptitle(
        f"policy {name}: {kind}ε = {result['epsilon_deg']:g}°, {counted(sum(result['outcomes'].values()), 'episode')}", fontsize=10
    )
    return figure


def _outcomes(axes: Axes, result: Mapping[str, Any]) -> None:
    counts = [int(result["outcomes"][name]) for name in OUTCOMES]
    shares = [100 * count / sum(counts) for count in counts]
    bars = axes.bar([name.replace("_", "\n") for name in OUTCOMES], shares, color=list(OUTCOMES.values()), width=0.7)
    axes.bar_label(bars, [f"{share:.2f} %\n({count:,})" for share, count in zip(shares, counts, strict=True)], fontsize=8, padding=2)
    axes.set_ylim(0, 118)
    axes.set_yticks(range(0, 101, 20))
    axes.set_ylabel("episodes [%]")
    low, high = (100 * float(value) for value in result["success_ci95"])
    axes.set_title(f"success, 95 % interval: {low:.2f} to {high:.2f} %", fontsize=9)
    ruled(axes)


def _histogram(axes: Axes, transfers: NDArray[np.int64], optimal: NDArray[np.int64]) -> None:
    numbers = np.arange(1, max(transfers.max(), optimal.max()) + 1)
    for values, label, colour, shift in ((optimal, "optimum", YELLOW, -0.2), (transfers, "policy", BLUE, 0.2)):
        share = [100 * float(np.mean(values == number)) for number in numbers]
        axes.bar(numbers + shift, share, width=0.4, color=colour, label=f"{label}, mean {values.mean():.2f}")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("transfers")
    axes.set_ylabel("successful episodes [%]")
    axes.set_title(f"transfers of {len(transfers):,} successful episodes", fontsize=9)
    axes.margins(y=0.2)  # room for the legend
    axes.legend(fontsize=8, ncols=2, loc="upper center", facecolor=PAPER, edgecolor="none", framealpha=1.0)
    ruled(axes)


def _means(axes: Axes, result: Mapping[str, Any]) -> None:
    wanted = (
        ("optimum", "optimal_mean_steps", YELLOW),
        ("policy,\nsuccesses", "mean_steps_success", BLUE),
        ("policy,\nall episodes", "mean_steps", GREY),
    )
    known = [(label, float(result[key]), colour) for label, key, colour in wanted if result.get(key) is not None]
    bars = axes.bar([label for label, _, _ in known], [value for _, value, _ in known], color=[colour for _, _, colour in known], width=0.6)
    axes.bar_label(bars, [f"{value:.3f}" for _, value, _ in known], fontsize=8, padding=2)
    axes.margins(y=0.12)
    axes.set_ylabel("mean transfers")
    ratio = result.get("steps_ratio")
    axes.set_title("" if ratio is None else f"transfers ÷ optimum, over successes: {ratio:.3f}", fontsize=9)
    ruled(axes)


def meant_figure(trace: Trace, rules: Rules, title: str = "") -> Figure:
    """What exact arms would have made of each episode's last transfer, against how the episode ended."""
    counts = _table(foreseen(trace, rules), trace.outcome, MEANT, ENDINGS)
    # Exact arms miss a place only by not going there.
    rows = [*(f"final:\n{_name(outcome)}" for outcome in MEANT[:2]), "refused:\nwrong position", "a hand-over"]
    heading = f"{title}{': ' if title else ''}last transfers of {counted(len(trace.episode), 'episode')}"
    return _figure(counts, rows, "expected of the last transfer", "how the episode ended", heading)


def endings_against(first: Trace, second: Trace, names: tuple[str, str]) -> Figure:
    """Endings of two policies on the same problems.

    Raises:
        InvalidSetting: if the traces have no problem in common, or the same number means different ones, or their blocks differ.
    """
    both, in_first, in_second = np.intersect1d(first.episode, second.episode, return_indices=True)
    one, other = first.take(in_first), second.take(in_second)
    if not len(both) or np.abs(one.goal - other.goal).max() > SAME_GOAL or symmetry_of(first) != symmetry_of(second):
        raise InvalidSetting("trace", f"[{', '.join(names)}]", "two traces of the same problems, evaluated with one seed and count")
    counts = _table(one.outcome, other.outcome, ENDINGS, ENDINGS)
    kept, lost, gained = counts[0, 0], counts[0, 1:].sum(), counts[1:, 0].sum()
    heading = f"{counted(len(both), 'problem')}: both solve {kept:,}, only the first {lost:,}, only the second {gained:,}"
    return _figure(counts, [_name(outcome, "\n") for outcome in ENDINGS], names[0], names[1], heading)


def _table(rows: Integers, columns: Integers, of_rows: Sequence[Outcome], of_columns: Sequence[Outcome]) -> Integers:
    return np.array([[int(((rows == row) & (columns == column)).sum()) for column in of_columns] for row in of_rows])


def _name(outcome: Outcome, space: str = " ") -> str:
    return outcome.name.lower().replace("_", space)


def _figure(counts: Integers, rows: Sequence[str], beside: str, below: str, heading: str) -> Figure:
    """Cells with their count and its share of all; agreement is framed."""
    figure = Figure(figsize=(6.4, 4.8), layout="constrained")
    axes = figure.add_subplot()
    share = counts / counts.sum()
    # The root lets a few episodes among thousands be seen.
    axes.imshow(np.sqrt(share), cmap=LinearSegmentedColormap.from_list("share", [PAPER, BLUE]), vmin=0, vmax=1, aspect="auto")
    for row, column in np.ndindex(counts.shape):
        count = int(counts[row, column])
        colour = PAPER if share[row, column] ** 0.5 > _DARK else INK if count else GREY
        text = f"{count:,}\n{_percent(share[row, column])}" if count else "0"
        axes.text(column, row, text, ha="center", va="center", fontsize=9, color=colour)
        if row == column:
            axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=INK, linewidth=1.6, zorder=3, clip_on=False))
    axes.set_xticks(range(len(ENDINGS)), [_name(outcome, "\n") for outcome in ENDINGS], fontsize=9)
    axes.set_yticks(range(len(rows)), rows, fontsize=9)
    axes.set_xlabel(below)
    axes.set_ylabel(beside)
    axes.tick_params(length=0)
    for border in np.arange(0.5, 3.5):
        axes.axhline(border, color=GREY, linewidth=0.4)
        axes.axvline(border, color=GREY, linewidth=0.4)
    figure.suptitle(heading, fontsize=10)
    return figure


def _percent(share: float) -> str:
    """A share that is not all and not nothing is never said to be."""
    percent = 100 * share
    if percent < 0.1:
        return "< 0.1 %"
    return "> 99.9 %" if 99.95 <= percent < 100 else f"{percent:.1f} %"


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
    _error_histogram(left, np.degrees(turned_rad), trace, _Measure("orientation", "°", _LEAST, 180.0, epsilon_deg), scale)
    left.axvline(epsilon_deg, color=INK, linewidth=1.1, linestyle="--")
    left.annotate(
        f"ε = {epsilon_deg:g}°", (epsilon_deg, 1.0), xycoords=("data", "axes fraction"), xytext=(4, -3), textcoords="offset points",
        ha="left", va="top", fontsize=8, color=INK, bbox={"boxstyle": "square,pad=0.1", "facecolor": PAPER, "edgecolor": "none"},
    )  # fmt: skip
    _error_histogram(right, away_mm, trace, _Measure("position", " mm", _LEAST, 600.0, 1.0), scale)
    left.set_ylabel("episodes")
    shown = [outcome for outcome in OUTCOMES if (trace.outcome == int(Outcome[outcome.upper()])).any()]
    patches = [Patch(facecolor=OUTCOMES[key], hatch=HATCHES[key], edgecolor=PAPER, label=key.replace("_", " ")) for key in shown]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=8, frameon=False)
    figure.suptitle(f"{title}{': ' if title else ''}error at the end of {counted(len(away_mm), 'episode')}", fontsize=10)
    return figure


def _error_histogram(axes: Axes, values: Floats, trace: Trace, measure: _Measure, scale: str) -> None:
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
    ruled(axes)
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
