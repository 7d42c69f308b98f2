"""No text of any figure is cut off or covers another, in the smallest case and in a crowded one."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config, load_cell
from marl_handover.commands.plan import solve
from marl_handover.policies import adapted
from marl_handover.report.evaluation import evaluation_figure
from marl_handover.report.learning import learning_figure
from marl_handover.report.plan import plan_figure, workspace_figure


@pytest.mark.parametrize("name", ["paper", "al5a"])
def test_workspaces(name, assert_tidy):
    assert_tidy(workspace_figure(build_cell(cell_config(name))))


@pytest.mark.parametrize(
    ("start", "goal"), [((60, -10, 0), (-60, -10, -0.61)), ((130, -60, 0), (-130, 60, 3.1)), ((-120, 60, 0), (150, 90, 2))]
)
@pytest.mark.parametrize("policy", ["exact", "random"])
def test_plans(start, goal, policy, assert_tidy):
    plan = solve(adapted(policy, None, 0), np.array(start, float), np.array(goal, float))
    for times in (1, 3):
        figure = plan_figure({**plan, "transfers": times * plan["transfers"]}, load_cell("paper"))
        assert_tidy(figure)


def run(count, stages):
    """Metrics of a run with so many evaluations."""
    step = 4000.0 * np.arange(1, count + 1)
    low = np.where(step <= step[-1] / 2, 15.0, 5.0) if stages else np.full(count, 0.7)
    rising = step / step[-1]
    return {
        "step": step, "gradient_step": step / 8, "success_rate": rising, "steps_ratio": 2 - rising, "mean_steps": 3 + rising,
        "epsilon_low_deg": low, "epsilon_high_deg": np.full(count, 15.0), "training_success_rate": rising, "training_mean_length": rising,
    }  # fmt: skip


@pytest.mark.parametrize("count", [1, 2, 60])
@pytest.mark.parametrize("stages", [False, True])
@pytest.mark.parametrize("names", [["a"], ["/a/" + 100 * "long"], ["x/a", "y/b", "z/c"], [f"{100 * 'x'}/same", f"{100 * 'y'}/same"]])
def test_learning_curves(count, stages, names, assert_tidy):
    assert_tidy(learning_figure({name: run(count, stages) for name in names}))


@pytest.mark.parametrize("counts", [(10_000, 0, 0, 0), (1, 1, 1, 1), (123_456, 12_345, 1_234, 123), (0, 0, 0, 7)])
def test_evaluations(counts, assert_tidy):
    known = None if counts[0] == 0 else 2.5
    result = {
        "policy": "runs/with/a/long/name", "architecture": "B", "epsilon_deg": 5.0, "success_rate": 0.5, "success_ci95": [0.1, 0.9],
        "mean_steps": 12.5, "mean_steps_success": known, "optimal_mean_steps": known, "steps_ratio": known,
        "outcomes": dict(zip(("success", "wrong_orientation", "wrong_position", "timeout"), counts, strict=True)),
    }  # fmt: skip
    assert_tidy(evaluation_figure(result))
    transfers = np.random.default_rng(0).integers(1, 21, min(counts[0], 500))
    assert_tidy(evaluation_figure(result, transfers, np.maximum(transfers - 1, 1)))
