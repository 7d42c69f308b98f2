"""Figures of cells with other than two arms: every arm is marked, texts lie apart."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.commands.plan import solve
from marl_handover.policies import load
from marl_handover.report.arm_labels import marks
from marl_handover.report.plan import plan_figure, workspace_figure
from tests.layouts import BLOCKED, SHIPPED


@pytest.fixture(params=[*SHIPPED, "blocked"])
def model(request, tmp_path):
    if request.param in SHIPPED:
        return build_cell(cell_config(request.param))
    path = tmp_path / "blocked.yaml"
    path.write_text(BLOCKED)
    return build_cell(cell_config(str(path)))


def test_figures_are_tidy_and_mark_every_arm(model, assert_tidy):
    figure = workspace_figure(model)
    assert_tidy(figure)
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts == marks(model.cell)
    assert len(set(texts)) == model.cell.num_arms
    start = np.append(model.cell.arms[0].at(200.0, 0.9), 0.0)
    goal = np.append(model.cell.arms[-1].at(200.0, -0.9), 2.5)
    plan = solve(load("exact", model.cell), start, goal)
    assert_tidy(plan_figure(plan, model.cell))
    assert plan["outcome"] == "success"
