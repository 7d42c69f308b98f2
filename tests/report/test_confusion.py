"""Confusion of end states: every episode in one cell, exact arms on the diagonal, two policies the right way round."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.cell import load_cell
from marl_handover.config import TaskChanges, TaskConfig
from marl_handover.control.evaluation import AssessmentConfig, assess
from marl_handover.errors import InvalidSetting
from marl_handover.report.evaluation import endings_against, meant_figure
from marl_handover.report.traces import read_trace
from marl_handover.task.rules import Outcome, Rules

COUNT = 90


def trace_of(folder, policy, seed=0, episodes=COUNT, **settings):
    done = assess(AssessmentConfig(policy=policy, episodes=episodes, seed=seed, **settings), traced=True)
    (folder / f"{policy}{seed}.jsonl").write_text(done.trace_text())
    return read_trace(folder / f"{policy}{seed}.jsonl"), done.report["outcomes"]


def cells(figure):
    """Counts (4, 4) as they are written."""
    texts = [text.get_text().split("\n")[0] for text in figure.axes[0].texts]
    return np.array([int(text.replace(",", "")) for text in texts]).reshape(4, 4)


@pytest.fixture(scope="module")
def traces(tmp_path_factory):
    folder = tmp_path_factory.mktemp("traces")
    return {name: trace_of(folder, name) for name in ("exact", "greedy", "random")}


@pytest.mark.parametrize("policy", ["exact", "greedy", "random"])
def test_exact_arms_do_what_is_expected_of_them(traces, policy, assert_tidy):
    trace, outcomes = traces[policy]
    figure = meant_figure(trace, Rules(load_cell("paper"), TaskConfig()), policy)
    assert_tidy(figure)
    counts = cells(figure)
    assert counts.sum() == COUNT
    assert counts.sum(0).tolist() == list(outcomes.values())
    assert np.count_nonzero(counts - np.diag(np.diag(counts))) == 0


def test_refused_hand_overs_are_wrong_decisions(traces):
    trace, _ = traces["random"]
    refused = ~trace.final & (trace.outcome == Outcome.WRONG_POSITION)
    assert refused.sum() > 5  # else the law above says nothing of them
    counts = cells(meant_figure(trace, Rules(load_cell("paper"), TaskConfig())))
    assert counts[2, 2] == (trace.outcome == Outcome.WRONG_POSITION).sum()


def test_in_architecture_a_a_refused_hand_over_goes_on(tmp_path):
    trace, outcomes = trace_of(tmp_path, "random", task=TaskChanges(architecture="A", max_steps=2))
    counts = cells(meant_figure(trace, Rules(load_cell("paper"), TaskConfig())))
    refused = (trace.before == trace.end).all(-1) & ~trace.final
    assert refused.sum() > 5
    assert counts.sum(0).tolist() == list(outcomes.values())
    assert np.count_nonzero(counts - np.diag(np.diag(counts))) == 0


def test_noise_leaves_the_diagonal(tmp_path):
    trace, outcomes = trace_of(tmp_path, "exact", episodes=30, backend="noisy", missed_grasps=0.5)
    counts = cells(meant_figure(trace, Rules(load_cell("paper"), TaskConfig())))
    assert counts[0, 2] > 5
    assert counts.sum() == sum(outcomes.values()) == 30


def test_two_policies_on_the_same_problems(traces, assert_tidy):
    (exact, _), (greedy, outcomes) = traces["exact"], traces["greedy"]
    figure = endings_against(exact, greedy, ("exact", "greedy"))
    assert_tidy(figure)
    counts = cells(figure)
    assert counts[0].tolist() == list(outcomes.values())  # exact solves all
    assert counts[1:].sum() == 0
    np.testing.assert_array_equal(cells(endings_against(greedy, exact, ("greedy", "exact"))), counts.T)
    assert f"only the first {COUNT - outcomes['success']}" in figure.get_suptitle()
    some = greedy.take(np.arange(0, COUNT, 3))
    assert cells(endings_against(exact, some, ("exact", "some"))).sum() == COUNT // 3


def test_other_problems_are_refused(traces, tmp_path):
    exact, _ = traces["exact"]
    other, _ = trace_of(tmp_path, "exact", seed=1)
    with pytest.raises(InvalidSetting, match="two traces of the same problems"):
        endings_against(exact, other, ("a", "b"))
    with pytest.raises(InvalidSetting, match="same problems"):
        endings_against(exact, exact._replace(symmetry_order=np.full(COUNT, 4)), ("a", "b"))
    nothing = exact.take(np.zeros(0, int))
    with pytest.raises(InvalidSetting, match="same problems"):
        endings_against(exact, nothing, ("a", "b"))
