"""The evaluation figure: how episodes ended, and how many transfers they took against the optimum."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from marl_handover.errors import CorruptFile
from marl_handover.report.figure_style import BLUE, FAINT, GREY, OUTCOMES, PAPER, YELLOW
from marl_handover.report.table import Axes
from marl_handover.wording import counted


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
    _tidy(axes)


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
    _tidy(axes)


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
    _tidy(axes)


def _tidy(axes: Axes) -> None:
    axes.grid(axis="y", color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
