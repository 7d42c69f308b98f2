"""Reading metrics.csv, whole, unfinished and broken; putting seeds together."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.learning.recorder import COLUMNS, NEEDED, OPTIONAL, common_curve, read_metrics
from marl_handover.report.learning import stage_changes


def write(folder, text):
    folder.mkdir(exist_ok=True)
    (folder / "metrics.csv").write_text(text)
    return folder


def test_the_recorder_writes_every_column_that_is_read():
    assert {*NEEDED, *OPTIONAL} <= set(COLUMNS)


def test_empty_values_and_an_unfinished_last_line(tmp_path):
    run = write(tmp_path, "step,success_rate,steps_ratio\n10,0,\n20,0.5,1.2\n30,0.")
    metrics = read_metrics(run)
    np.testing.assert_array_equal(metrics["step"], [10, 20])
    assert math.isnan(metrics["steps_ratio"][0])
    assert np.isnan(metrics["epsilon_low_deg"]).all()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "lacks: step, success_rate"),
        ("step,loss\n1,2\n", "lacks: success_rate"),
        ("step,success_rate\n", "no row yet"),
        ("step,success_rate\n1\n", "line 2 has 1 values"),
        ("step,success_rate\n1,0.5\n2,x\n", "line 3"),
        ("step,success_rate\n2,0.5\n1,0.5\n", "do not rise"),
        ("step,success_rate\n,0.5\n", "do not rise"),
    ],
)
def test_broken_tables(tmp_path, text, reason):
    with pytest.raises(CorruptFile, match=reason):
        read_metrics(write(tmp_path, text))


def test_missing_runs(tmp_path):
    for run in (tmp_path / "none", tmp_path):
        with pytest.raises(MissingFile):
            read_metrics(run)


def test_seeds_meet_over_their_common_steps(tmp_path):
    first = read_metrics(write(tmp_path / "a", "step,success_rate,epsilon_low_deg,epsilon_high_deg\n0,0,5,9\n10,1,5,9\n20,1,1,9\n"))
    second = read_metrics(write(tmp_path / "b", "step,success_rate\n5,0\n15,1\n"))
    steps, values = common_curve([first, second], "success_rate")
    np.testing.assert_array_equal(steps, [5, 10, 15])
    np.testing.assert_allclose(values, [[0.5, 1, 1], [0, 0.5, 1]])
    assert common_curve([second], "steps_ratio")[1].size == 0
    assert stage_changes(first) == [10]
    assert stage_changes(second) == []
