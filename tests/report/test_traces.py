"""Reading traces: what ``evaluate`` writes comes back, and exact arms do what was foreseen of them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from marl_handover.cell import load_cell
from marl_handover.config import TaskChanges, TaskConfig
from marl_handover.control.evaluation import AssessmentConfig, assess
from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile
from marl_handover.report.traces import errors_at_end, foreseen, read_trace, symmetry_of
from marl_handover.task.rules import Outcome, Rules

EPISODES = 80


def evaluated(tmp_path, policy, architecture, episodes=EPISODES, **settings):
    """An evaluation and its trace, read back."""
    config = AssessmentConfig(policy=policy, episodes=episodes, seed=3, task=TaskChanges(architecture=architecture), **settings)
    done = assess(config, traced=True)
    (tmp_path / "trace.jsonl").write_text(done.trace_text())
    return done, read_trace(tmp_path / "trace.jsonl")


@pytest.fixture(scope="module")
def rules():
    return Rules(load_cell("paper"), TaskConfig())


@pytest.mark.parametrize("policy", ["exact", "random", "greedy"])
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_what_evaluate_writes_comes_back_and_exact_arms_do_what_is_foreseen(tmp_path, rules, policy, architecture):
    done, trace = evaluated(tmp_path, policy, architecture)
    episodes = done.result.episodes
    np.testing.assert_array_equal(trace.episode, np.arange(EPISODES))
    np.testing.assert_array_equal(trace.outcome, episodes.outcome)
    np.testing.assert_array_equal(trace.transfers, episodes.transfers)
    np.testing.assert_allclose(trace.end, episodes.pose)
    assert not trace.looped.any()
    expected = foreseen(trace, rules)
    # A hand-over that can be done leaves an episode open; what ends it then is the number of transfers.
    np.testing.assert_array_equal(np.where(expected == Outcome.NONE, Outcome.TIMEOUT, expected), trace.outcome)
    assert (trace.external == (architecture == "A")).all()
    away_mm, turned_rad = errors_at_end(trace, 1)
    assert (away_mm[trace.solved] < 1e-2).all()
    assert (turned_rad[trace.solved] <= trace.epsilon_rad[trace.solved] + 1e-4).all()


def test_a_noisy_loops_episodes_end_at_their_first_verdict(tmp_path, rules):
    done, trace = evaluated(tmp_path, "exact", "B", 30, backend="noisy", missed_grasps=0.5)
    assert trace.looped.all()
    np.testing.assert_array_equal(trace.transfers, done.result.episodes.transfers)
    expected = foreseen(trace, rules)
    missed = trace.outcome == Outcome.WRONG_POSITION
    # The fingers closed on nothing: that was not the policy's doing.
    assert missed.sum() > 3
    assert (expected[missed & trace.final] == Outcome.SUCCESS).mean() > 0.9


@pytest.mark.parametrize("backend", ["kinematic", "noisy"])
def test_the_symmetry_is_written_and_a_setting_against_it_refused(tmp_path, backend):
    done = assess(AssessmentConfig(policy="exact", episodes=3, seed=3, backend=backend, task=TaskChanges(symmetry_order=4)), traced=True)
    (tmp_path / "trace.jsonl").write_text(done.trace_text())
    assert {json.loads(line)["symmetry_order"] for line in done.trace_text().splitlines()} == {4}
    trace = read_trace(tmp_path / "trace.jsonl")
    assert symmetry_of(trace) == symmetry_of(trace, 4) == 4
    with pytest.raises(InvalidSetting, match="symmetry_order = 1: must be 4, as the trace says"):
        symmetry_of(trace, 1)


def test_a_file_that_does_not_say_its_symmetry_is_of_order_1_unless_told(write_trace):
    trace = read_trace(write_trace({}, {"episode": 1}))
    assert (symmetry_of(trace), symmetry_of(trace, 2)) == (1, 2)
    with pytest.raises(InvalidSetting, match="of one block"):
        symmetry_of(read_trace(write_trace({"symmetry_order": 2}, {"episode": 1, "symmetry_order": 4})))


def test_what_came_after_the_first_verdict_is_left_out(write_trace):
    path = write_trace(
        {"attempt": 0},
        {"attempt": 0, "final": True, "outcome": "wrong_position", "next_state": [1.0, 2.0, 3.0]},
        {"attempt": 1, "final": True, "outcome": "success"},
    )
    trace = read_trace(path)
    assert (trace.transfers.tolist(), trace.outcome.tolist()) == ([2], [int(Outcome.WRONG_POSITION)])
    assert trace.end.tolist() == [[1.0, 2.0, 3.0]]
    assert trace.final.tolist() == [True]


def test_an_episode_in_which_nobody_moves_any_more_is_a_time_out(write_trace):
    assert read_trace(write_trace({}, {"step": 1})).outcome.tolist() == [int(Outcome.TIMEOUT)]


@pytest.mark.parametrize(
    "broken",
    [{"state": [1, 2]}, {"goal": None}, {"arm": "X"}, {"outcome": "won"}, {"next_state": [1, 2, float("nan")]}, {"episode": "one"}]
    + [{"place": [1]}, {"symmetry_order": 0}, {"symmetry_order": True}, {"symmetry_order": 1.5}, {"symmetry_order": None}],
)
def test_a_line_that_is_no_step_is_named(write_trace, broken):
    with pytest.raises(CorruptFile, match="line 2 is no step"):
        read_trace(write_trace({}, broken, {}))


def test_files_that_are_no_traces(tmp_path):
    with pytest.raises(MissingFile):
        read_trace(tmp_path / "none.jsonl")
    for content, said in ((b"", "it holds no step"), (b"\xff\xfe\x00", "line 1"), (b"[1]\n", "line 1"), (b'{"episode": 0', "line 1")):
        (tmp_path / "a.jsonl").write_bytes(content)
        with pytest.raises(CorruptFile, match=said):
            read_trace(tmp_path / "a.jsonl")


@pytest.mark.parametrize(("turn_deg", "order", "left_deg"), [(350, 1, 10), (100, 4, 10), (179, 2, 1), (45, 4, 45), (-361, 1, 1)])
def test_orientation_errors_are_modulo_the_symmetry(write_trace, turn_deg, order, left_deg):
    trace = read_trace(write_trace({"goal": [3.0, 0.0, 0.5], "next_state": [0.0, 4.0, 0.5 + np.radians(turn_deg)], "outcome": "timeout"}))
    away_mm, turned_rad = errors_at_end(trace, order)
    assert away_mm[0] == pytest.approx(5)
    assert np.degrees(turned_rad[0]) == pytest.approx(left_deg)
