"""``marl-handover tune``: what it leaves, continuing, errors."""

from __future__ import annotations

import csv
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import yaml

from marl_handover.cli import main
from marl_handover.commands import train
from marl_handover.commands.tune import SCHEMA
from marl_handover.compose import compose, from_yaml
from marl_handover.experiments.tune import OF_THE_RUN
from marl_handover.learning.settings import TrainConfig

SPACE = """
algorithm.gamma: {type: float, low: 0.9, high: 0.99}
algorithm.actor_hidden: {type: categorical, choices: [[128, 128], [64, 64]]}
replay.symmetry: {type: categorical, choices: [false, true]}
"""
TINY = (
    *("preset=smoke", "progress=false", "steps=256", "num_envs=16", "evaluation_interval=64", "evaluation_episodes=20", "jobs=1"),
    *("algorithm.learning_starts=64", "algorithm.env_steps_per_gradient_step=32", "algorithm.batch_size=32", "epsilon_deg=9"),
)
WAIT_S = 120


def arguments(folder, *more):
    space = folder.parent / f"{folder.name}.yaml"
    space.write_text(SPACE)
    return [*TINY, f"search={space}", f"out={folder}", *more]


def rows(folder):
    with (folder / "trials.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a study, and what the command printed."""
    folder = tmp_path_factory.mktemp("tune") / "study"
    command = [sys.executable, "-m", "marl_handover.cli", "tune", *arguments(folder, "trials=3", "seed=4")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=500)
    return folder, done.stdout


def test_every_trial_has_a_row_and_a_run(finished):
    folder, _ = finished
    table = rows(folder)
    assert [row["number"] for row in table] == ["0", "1", "2"]
    assert {row["state"] for row in table} == {"COMPLETE"}
    for row in table:
        config = yaml.safe_load((folder / "trials" / f"{int(row['number']):04d}" / "config.yaml").read_text())
        assert float(row["algorithm.gamma"]) == config["algorithm"]["gamma"]
        assert yaml.safe_load(row["algorithm.actor_hidden"]) == config["algorithm"]["actor_hidden"]
        assert int(row["seed"]) == config["seed"]
        assert row["folder"] == config["out"]
        assert float(row["score"]) <= float(row["success_rate"]) <= 1


def best_run(folder):
    best = max(rows(folder), key=lambda row: float(row["score"]))
    return from_yaml(TrainConfig, folder / "trials" / f"{int(best['number']):04d}" / "config.yaml", train.GROUPS)


def assert_trains_alike(config, run):
    """Equal in all but how long and where it runs."""
    apart = {name: getattr(run, name) for name in (*OF_THE_RUN, "out", "progress")}
    config.validate()
    assert replace(config, **apart) == run


def test_the_preset_holds_the_settings_of_the_best_trial(finished):
    folder, _ = finished
    config = compose(train.SCHEMA, [f"preset={folder / 'best.yaml'}"], groups=train.GROUPS, aliases=train.ALIASES)
    assert_trains_alike(config, best_run(folder))
    assert config.steps == TrainConfig().steps


def test_so_does_the_line_to_paste(finished):
    folder, out = finished
    program, command, *overrides = shlex.split(next(line for line in out.splitlines() if line.startswith("marl-handover train")))
    assert (program, command) == ("marl-handover", "train")
    assert_trains_alike(compose(train.SCHEMA, overrides, groups=train.GROUPS, aliases=train.ALIASES), best_run(folder))


def test_the_best_is_told(finished):
    folder, out = finished
    best = max(rows(folder), key=lambda row: float(row["score"]))
    assert f"best of 3 trials: {best['number']}, score {float(best['score']):.4f}" in out


def test_calling_again_does_nothing_and_tells_the_same(finished, capsys):
    folder, out = finished
    before = (folder / "trials.csv").read_bytes()
    assert main(["tune", *arguments(folder, "trials=3", "seed=4")]) == 0
    assert capsys.readouterr().out == out
    assert (folder / "trials.csv").read_bytes() == before


def test_other_settings_need_another_study(finished, capsys):
    folder, _ = finished
    assert main(["tune", *arguments(folder, "trials=3", "seed=5")]) == 2
    err = capsys.readouterr().err
    assert "begun with seed = 4" in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_a_killed_search_continues(tmp_path):
    folder = tmp_path / "study"
    wanted = arguments(folder, "trials=2")
    process = subprocess.Popen([sys.executable, "-m", "marl_handover.cli", "tune", *wanted])
    deadline = time.monotonic() + WAIT_S
    while not (metrics := folder / "trials" / "0000" / "metrics.csv").exists() or len(metrics.read_text().splitlines()) < 2:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert main(["tune", *wanted]) == 0
    table = rows(folder)
    assert [row["state"] for row in table] == ["FAIL", "COMPLETE", "COMPLETE"]
    assert table[1]["algorithm.gamma"] == table[0]["algorithm.gamma"]
    assert table[1]["seed"] == table[0]["seed"]


def test_a_search_without_a_result_says_why(tmp_path, capsys):
    arguments(tmp_path / "study")
    (tmp_path / "study.yaml").write_text("cell.base_distance_mm: {type: categorical, choices: [4000]}")
    assert main(["tune", *TINY, f"search={tmp_path / 'study.yaml'}", f"out={tmp_path / 'study'}", "trials=1"]) == 1
    err = capsys.readouterr().err
    assert "no trial of study sac was completed: NoSharedSpace" in err
    assert "4000" in rows(tmp_path / "study")[0]["error"]


def test_a_folder_holds_one_study(tmp_path, capsys):
    assert main(["tune", *arguments(tmp_path / "study", "trials=1")]) == 0
    kept = (tmp_path / "study" / "trials.csv").read_bytes()
    assert main(["tune", *arguments(tmp_path / "study", "trials=1", "study=another")]) == 2
    assert "has the trials of study sac" in capsys.readouterr().err
    assert (tmp_path / "study" / "trials.csv").read_bytes() == kept


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("trials=0", ("trials", "between 1 and 100000")),
        ("jobs=-1", ("jobs",)),
        ("pruner=hope", ("median, hyperband, none",)),
        ("launcher=slurm", ("loky, ray",)),
        ("address=auto", ("address", "launcher=loky")),
        ("search=nowhere", ("nowhere", "sac", "dqn")),
        ("search=./nowhere.yaml", ("nowhere.yaml",)),
        ("fixed=[algorithm.gama]", ("algorithm.gama", "algorithm.gamma")),
        ("resume=runs/x", ("resume",)),
        ("algorithm=a3c", ("a3c", "sac")),
        ("steps=0", ("steps",)),
        ("trialz=5", ("trialz", "trials")),
        ("storage=postgresql://me:secret@127.0.0.1:1/x", ("storage=postgresql://me:***@127.0.0.1:1/x",)),
        ("storage=postgresql:me:secret@here", ("URL",)),
        ("storage=martian://me:secret@here", ("martian",)),
        ("storage=sqlite://", ("in memory", "sqlite:///file")),
        ("storage=sqlite:///:memory:", ("in memory",)),
        ("storage=sqlite:////nowhere/at/all.db", ("sqlite:////nowhere/at/all.db", "cannot be opened")),
        ("storage=/proc/nowhere/study.journal", ("/proc/nowhere",)),
    ],
)
def test_bad_input_is_one_line_and_exit_2(capsys, tmp_path, argument, words):
    assert main(["tune", *TINY, f"out={tmp_path / 'study'}", argument]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1, captured.err
    assert "Traceback" not in captured.err
    assert "secret" not in captured.err + captured.out
    for word in words:
        assert word in captured.err
    assert not (tmp_path / "study" / "trials").exists()


def test_the_defaults_are_valid_settings_of_training():
    config = compose(SCHEMA, [], groups=train.GROUPS, aliases=train.ALIASES)
    config.validate()
    assert config.evaluation_interval * 4 <= config.steps < TrainConfig().steps
