"""The error figure shows every episode once, on the right side of epsilon."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Rectangle

from marl_handover.report.evaluation import SCALES, errors_figure
from marl_handover.report.figure_style import OUTCOMES
from marl_handover.report.traces import Trace
from marl_handover.task.rules import Outcome

EPSILON_DEG = 5.0


def made(turned_deg, away_mm, outcome):
    """A trace of episodes that ended with these errors."""
    count = len(turned_deg)
    goal = np.zeros((count, 3))
    end = np.stack([away_mm, np.zeros(count), np.radians(turned_deg)], -1)
    none, arm = np.zeros(count, int), np.zeros(count, bool)
    names = np.array([int(Outcome[name.upper()]) for name in outcome])
    epsilon = np.full(count, np.radians(EPSILON_DEG))
    return Trace(np.arange(count), goal, goal, goal, end, none, arm, names, none, epsilon, arm, goal[:, :2], arm, none)


def bars(axes):
    """Left end, right end and height of every bar that is not empty, by outcome."""
    found = {}
    for bar in axes.patches:
        if isinstance(bar, Rectangle) and bar.get_height() > 0:
            name = next(name for name, colour in OUTCOMES.items() if colour.lower() == to_hex(bar.get_facecolor()))
            found.setdefault(name, []).append((bar.get_x(), bar.get_x() + bar.get_width(), bar.get_height()))
    return found


@pytest.mark.parametrize("scale", SCALES)
def test_every_episode_is_in_both_panels_and_epsilon_parts_success_from_failure(scale, assert_tidy):
    random = np.random.default_rng(0)
    turned = np.concatenate([[0.0], 10.0 ** random.uniform(-3, 2.2, 500)])
    outcome = ["success" if value <= EPSILON_DEG else "wrong_orientation" for value in turned]
    figure = errors_figure(made(turned, 10.0 ** random.uniform(-3, 2.6, 501), outcome), scale=scale, title="random")
    orientation, position = figure.axes
    assert_tidy(figure)
    shown = bars(orientation)
    for name, pieces in shown.items():
        assert sum(height for *_, height in pieces) == outcome.count(name)
    assert max(right for _, right, _ in shown["success"]) <= EPSILON_DEG * (1 + 1e-9)
    assert min(left for left, *_ in shown["wrong_orientation"]) >= EPSILON_DEG * (1 - 1e-9)
    assert sum(height for pieces in bars(position).values() for *_, height in pieces) == 501
    assert [line.get_xdata()[0] for line in orientation.lines] == pytest.approx([EPSILON_DEG])


def test_symmetry_and_exact_positions(assert_tidy):
    figure = errors_figure(made([90.0, 89.0], [0.0, 0.0], ["success"] * 2), symmetry_order=4)
    assert_tidy(figure)
    assert max(right for _, right, _ in bars(figure.axes[0])["success"]) < 1.5
    assert figure.axes[1].get_title() == "all within 0.01 mm"


@pytest.mark.parametrize("scale", SCALES)
def test_errors_beyond_the_axis_stand_in_its_last_bar(scale):
    figure = errors_figure(made([180.0] * 3, [5e3] * 3, ["timeout"] * 3), scale=scale)
    for axes in figure.axes:
        assert sum(height for *_, height in bars(axes)["timeout"]) == 3
