from __future__ import annotations

import json

import numpy as np
import pytest

from marl_handover import cli
from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile
from marl_handover.viewer.trace_file import read_trace

LINE = {
    "episode": 0, "step": 0, "state": [-160.0, 90.0, 0.5], "goal": [10.0, 0.0, 1.0], "previous_arm": None, "arm": "L", "final": False,
    "place": [-60.0, 0.0], "alpha": 0.1, "beta": 0.0, "next_state": [-60.0, 0.0, 1.2], "reward": -1.0, "terminated": False,
    "truncated": False, "outcome": None, "epsilon_rad": 0.0873,
}  # fmt: skip


@pytest.fixture
def written(tmp_path):
    def write(*rows):
        path = tmp_path / "trace.jsonl"
        path.write_text("".join((row if isinstance(row, str) else json.dumps(row)) + "\n" for row in rows))
        return path

    return write


@pytest.mark.parametrize("policy", ["exact", "pretrained_a", "pretrained_b"])
def test_what_evaluate_writes_is_read_line_for_line(tmp_path, policy):
    path = tmp_path / "trace.jsonl"
    assert cli.main(["evaluate", f"policy={policy}", "episodes=20", f"trace={path}", "progress=false"]) == 0
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    trace = read_trace(path)
    assert (len(trace.steps), trace.episodes) == (len(rows), len({row["episode"] for row in rows}))
    for step, row in zip(trace.steps, rows, strict=True):
        np.testing.assert_array_equal(step.state, row["state"])
        np.testing.assert_array_equal(step.next_state, row["next_state"])
        assert ("LR"[step.arm], step.final, step.outcome) == (row["arm"], row["final"], row["outcome"] or "")
    assert trace.cell is None


def test_moments_are_each_episodes_start_and_its_transfers_one_by_one(written):
    trace = read_trace(
        written(*({**LINE, "episode": episode, "step": step} for episode, count in ((0, 2), (3, 1), (4, 3)) for step in range(count)))
    )
    seen = [tuple(trace.moment(number)) for number in range(trace.moments)]
    assert seen == [(e, done, count, first) for e, (count, first) in enumerate([(2, 0), (1, 2), (3, 3)]) for done in range(count + 1)]
    assert [trace.start_of(episode) for episode in range(3)] == [0, 3, 5]
    assert trace.names == [0, 3, 4]


def test_a_refused_transfer_says_why(written):
    refused = {**LINE, "next_state": LINE["state"], "refusal": "out_of_reach", "detail": "too far"}
    silent = {**LINE, "next_state": LINE["state"]}
    trace = read_trace(written(LINE, refused, silent))
    assert [step.trouble for step in trace.steps] == ["", "out_of_reach too far", "nothing moved"]


def test_a_sessions_log_gives_its_transfers_the_arms_path_and_the_cell(written):
    transfer = {"t_s": 3.0, "event": "transfer", **{key: value for key, value in LINE.items() if key not in ("episode", "step")}}
    parked, moved = [[0.0] * 5] * 2, [[0.1] * 5, [0.0] * 5]
    rows = [{"t_s": 0.0, "event": "session", "cell": {"name": "paper"}}, {"t_s": 0.1, "event": "episode", "seed": 0}]
    states = [
        {"t_s": 1.0 + 0.5 * n, "event": "state", "joints_rad": joints, "gripper_mm": [12.0, 12.0]}
        for n, joints in enumerate((parked, moved))
    ]
    other = {"t_s": 9.0, "event": "episode", "seed": 1}
    trace = read_trace(written(*rows, *states, {"t_s": 2.0, "event": "seen", "pose": None, "goal": None}, transfer, other, transfer))
    assert trace.cell == {"name": "paper"}
    assert (trace.episodes, len(trace.steps)) == (2, 2)
    np.testing.assert_array_equal(trace.steps[0].recorded.t_s, [0.0, 0.5])
    np.testing.assert_array_equal(trace.steps[0].recorded.joints_rad, [parked, moved])
    assert trace.steps[1].recorded is None


@pytest.mark.parametrize("first", [{"t_s": 0.0, "event": "session", "cell": {"name": "paper"}, "symmetry_order": 4}, LINE])
def test_the_blocks_symmetry_is_the_files_and_a_setting_against_it_is_refused(written, first):
    trace = read_trace(written(first, {**LINE, "symmetry_order": 4}))
    assert trace.symmetry(None) == trace.symmetry(4) == 4
    with pytest.raises(InvalidSetting, match="task.symmetry_order = 2: must be 4, as the trace says"):
        trace.symmetry(2)
    old = read_trace(written(LINE))
    assert (old.symmetry(None), old.symmetry(2)) == (1, 2)


def test_lines_of_two_blocks_are_no_trace(written):
    with pytest.raises(CorruptFile, match=r"line 2\b.*symmetry_order was 4 before"):
        read_trace(written({**LINE, "symmetry_order": 4}, {**LINE, "symmetry_order": 2}))


STATE = {"t_s": 1.0, "event": "state", "joints_rad": [[0.0] * 5] * 2, "gripper_mm": [12.0, 12.0]}
BAD = [
    ("{", "is not JSON"),
    ("[1]", "not an object"),
    ({**LINE, "state": [1.0, 2.0]}, "is not 3 numbers"),
    ({**LINE, "goal": [1.0, 2.0, float("nan")]}, "not finite"),
    ({**LINE, "arm": "X"}, "no transfer"),
    ({**LINE, "arm": 7}, "no transfer"),
    ({**LINE, "final": "no"}, "final"),
    ({**LINE, "outcome": 3}, "outcome"),
    ({**LINE, "symmetry_order": 0}, "symmetry_order"),
    ({**LINE, "symmetry_order": "4"}, "symmetry_order"),
    ({**LINE, "place": None}, "no transfer"),
    ({**LINE, "epsilon_rad": "x"}, "no transfer"),
    ({**LINE, "next_state": {"x": 1}}, "no transfer"),
    ({key: value for key, value in LINE.items() if key != "state"}, "'state' is missing"),
    ({key: value for key, value in LINE.items() if key != "episode"}, "'episode' is missing"),
    ({**LINE, "outcome": "<img src=x onerror=alert(1)>"}, "outcome"),
    ({**LINE, "outcome": "none"}, "outcome"),
    ({"event": "state", "t_s": 0.0}, "'joints_rad' is missing"),
    ({**STATE, "joints_rad": [[0.0] * 5]}, "is not 2 x 5 numbers"),
    ({**STATE, "joints_rad": [[0.0] * 4] * 2}, "is not 2 x 5 numbers"),
    ({**STATE, "joints_rad": [[0.0] * 5, [float("inf")] * 5]}, "is not finite"),
    ({**STATE, "joints_rad": None}, "is not 2 x 5 numbers"),
    ({**STATE, "gripper_mm": [12.0]}, "is not 2 numbers"),
    ({**STATE, "t_s": float("nan")}, "is not finite"),
    ({**STATE, "t_s": [1.0]}, "is not a number"),
    ({"event": "session", "cell": 3}, "no transfer"),
]


@pytest.mark.parametrize(("row", "words"), BAD)
def test_a_bad_line_is_named_with_its_number(written, row, words):
    with pytest.raises(CorruptFile, match=rf"line 3\b.*{words}"):
        read_trace(written(LINE, "", row, LINE))


def test_a_state_line_before_the_one_before_is_named_with_its_number(written):
    with pytest.raises(CorruptFile, match=r"line 3\b.*t_s = 0\.5 goes back"):
        read_trace(written(STATE, {**STATE, "t_s": 1.0}, {**STATE, "t_s": 0.5}))


def test_a_file_without_a_transfer_and_one_that_is_not_there_are_named(written, tmp_path):
    with pytest.raises(CorruptFile, match="no transfer"):
        read_trace(written(""))
    with pytest.raises(MissingFile, match="trace file"):
        read_trace(tmp_path / "none.jsonl")
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CorruptFile):
        read_trace(tmp_path / "bytes")


def test_a_trace_of_other_arms_than_a_pairs_says_so(tmp_path):
    path = tmp_path / "trace.jsonl"
    path.write_text(json.dumps({**LINE, "arm": "north", "receiver": "west"}) + "\n")
    with pytest.raises(
        CorruptFile, match="its arm is 'north', and those of the cell are L, R; say in which cell it was recorded: cell=NAME"
    ):
        read_trace(path)
