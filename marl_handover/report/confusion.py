"""The confusion figure: what the last transfers of a trace were to bring against what came, or one policy's endings against another's.

One trace says where execution went another way than exact arms would have: on the kinematic backend all lies on the diagonal, so that a
wrong ending was a wrong decision; with noise, physics or a camera, what is off the diagonal was the arms' doing. Two traces of the same
problems say whether one policy solves what the other does not, which two success rates cannot tell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from marl_handover.errors import InvalidSetting
from marl_handover.report.palette import BLUE, GREY, INK, PAPER
from marl_handover.report.traces import Trace, foreseen, symmetry_of
from marl_handover.task.rules import Outcome, Rules
from marl_handover.wording import counted

Integers = NDArray[np.int64]

ENDINGS = (Outcome.SUCCESS, Outcome.WRONG_ORIENTATION, Outcome.WRONG_POSITION, Outcome.TIMEOUT)
MEANT = (Outcome.SUCCESS, Outcome.WRONG_ORIENTATION, Outcome.WRONG_POSITION, Outcome.NONE)

SAME_GOAL = 1e-6
"""Goals (mm, rad) that differ by less are one."""

_DARK = 0.55


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
