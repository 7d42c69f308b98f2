"""``marl-handover train``: what a run directory holds, resuming, errors."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys

import pytest
import torch
import yaml

from marl_handover.cli import main
from marl_handover.commands.train import SCHEMA
from marl_handover.compose import compose
from marl_handover.learning.recorder import COLUMNS
from marl_handover.learning.settings import ALGORITHMS
from marl_handover.policies import load

TINY = (
    *("preset=smoke", "progress=false", "steps=768", "num_envs=16", "evaluation_interval=256", "checkpoint_interval=256"),
    *("evaluation_episodes=20", "algorithm.learning_starts=300", "algorithm.env_steps_per_gradient_step=32", "algorithm.batch_size=32"),
)


HOLDER = """
import sys
from pathlib import Path
from marl_handover.locks import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run directory that the command made."""
    folder = tmp_path_factory.mktemp("train") / "run=1"
    assert main(["train", *TINY, f"out={folder}", "architecture=A", "seed=5"]) == 0
    return folder


def rows(folder):
    with (folder / "metrics.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_run_directory_holds_what_it_should(finished):
    config = yaml.safe_load((finished / "config.yaml").read_text())
    assert (config["steps"], config["seed"], config["task"]["architecture"], config["algorithm"]["name"]) == (768, 5, "A", "sac")
    assert torch.load(finished / "checkpoint.pt", weights_only=True)["counters"]["step"] == 768
    assert list(finished.glob("events.out.tfevents.*"))
    assert not list(finished.glob("*.tmp"))
    table = rows(finished)
    assert list(table[0]) == list(COLUMNS)
    assert [int(row["step"]) for row in table] == [256, 512, 768]
    assert all(0 <= float(row["success_rate"]) <= 1 and float(row["mean_steps"]) >= 1 for row in table)
    assert float(table[0]["wall_s"]) < float(table[2]["wall_s"])
    assert int(table[2]["gradient_step"]) == int((768 - 300) / 32)
    assert float(table[2]["loss_critic"]) > 0
    summary = json.loads((finished / "summary.json").read_text())
    assert (summary["step"], summary["gradient_step"], summary["seed"]) == (768, 14, 5)
    assert summary["validation"]["success_rate"] == pytest.approx(float(table[2]["success_rate"]), rel=1e-5)


def test_the_run_is_a_policy(finished):
    policy = load(str(finished))
    assert policy.rules.config.architecture == "A"
    action = policy({"state": [0.0, 100.0, 1.0], "goal": [10.0, -120.0, -2.0], "previous_arm": 0})
    assert action["final"] == 0


def test_resuming_a_finished_run_changes_nothing(finished, capsys):
    before = rows(finished)
    weights = torch.load(finished / "checkpoint.pt", weights_only=True)["algorithm"]["loss"]
    assert main(["train", f"resume={finished}", "progress=false"]) == 0
    assert "768 environment steps" in capsys.readouterr().err
    after = torch.load(finished / "checkpoint.pt", weights_only=True)["algorithm"]["loss"]
    assert rows(finished) == before
    assert all(torch.equal(value, after[key]) for key, value in weights.items())


@pytest.mark.parametrize("key", ["out", "resume"])
def test_a_folder_in_which_another_training_runs_is_left_as_it_is(finished, tmp_path, capsys, key):
    folder = tmp_path / "run"
    if key == "resume":
        shutil.copytree(finished, folder)
    else:
        folder.mkdir()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    other = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "held\n"
    assert main(["train", *(TINY if key == "out" else ["progress=false"]), f"{key}={folder}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "another training writes into it" in line
    other.communicate("")
    (folder / ".lock").unlink(missing_ok=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        name: content for name, content in before.items() if name != ".lock"
    }


def test_a_run_killed_before_its_first_checkpoint_starts_again(finished, tmp_path):
    config = yaml.safe_load((finished / "config.yaml").read_text())
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({**config, "out": str(tmp_path)}))
    (tmp_path / "metrics.csv").write_text("step,gradi")
    assert main(["train", f"resume={tmp_path}", "progress=false"]) == 0
    without_clock = [[{**row, "wall_s": ""} for row in rows(folder)] for folder in (finished, tmp_path)]
    assert without_clock[0] == without_clock[1]


def assert_refused(capsys, arguments, *words):
    assert main(["train", "progress=false", *arguments]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    for word in words:
        assert word in err


def test_a_run_is_not_overwritten(finished, capsys):
    assert_refused(capsys, [*TINY, f"out={finished}"], f"resume={finished}")


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("stepz=5", ("stepz", "steps")),
        ("algorithm=a3c", ("a3c", "sac", "ppo")),
        ("architecture=C", ("A, B",)),
        ("variant=flat", ("hierarchical",)),
        ("device=gpu9", ("device", "cpu")),
        ("steps=0", ("steps", "between 1 and 1000000000")),
        ("num_envs=-4", ("num_envs",)),
        ("threads=0", ("threads",)),
        ("compile=maybe", ("auto, on, off",)),
        ("epsilon_deg=0", ("epsilon_deg",)),
        ("epsilon_deg=nan", ("epsilon_deg",)),
        ("curriculum=[]", ("curriculum",)),
        ("curriculum=[{epsilon_low_deg:9,epsilon_high_deg:3}]", ("curriculum[0].epsilon_high_deg", "at least 9")),
        ("replay.capacity=10", ("replay.capacity",)),
        ("replay.hindsight.ratio=1.5", ("replay.hindsight.ratio", "between 0 and 1")),
        ("replay.hindsight.strategy=past", ("none, final, future, episode",)),
        ("algorithm.gamma=0", ("algorithm.gamma",)),
        ("algorithm.learning_rate=nan", ("algorithm.learning_rate",)),
        ("algorithm.batch_size=0", ("algorithm.batch_size",)),
        ("algorithm.env_steps_per_gradient_step=0", ("algorithm.env_steps_per_gradient_step",)),
        ("algorithm.mixture_components=0", ("algorithm.mixture_components",)),
        ("algorithm.layout=raw", ("algorithm.layout", "relative")),
        ("resume=nowhere", ("nowhere",)),
        ("centralised.motion=flat", ("centralised.motion", "variant=centralised")),
        ("decentralised.pass_reward=-1", ("decentralised.pass_reward", "variant=decentralised")),
        ("workers=3", ("workers", "collector=multiprocess or ray")),
        ("seed=100000000000000000000", ("seed",)),
    ],
)
def test_bad_input_is_one_line_and_exit_2(capsys, tmp_path, argument, words):
    assert_refused(capsys, [*TINY, f"out={tmp_path / 'run'}", argument], *words)
    assert not (tmp_path / "run").exists()


def test_a_file_in_place_of_the_folder_is_refused(capsys, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert_refused(capsys, [*TINY, f"out={tmp_path / 'file'}"], "file")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x03\x04 half a zip"])
def test_a_corrupt_checkpoint_is_refused(capsys, tmp_path, content):
    (tmp_path / "checkpoint.pt").write_bytes(content)
    assert_refused(capsys, [f"resume={tmp_path}"], "checkpoint", str(tmp_path))


def test_an_empty_folder_cannot_be_resumed(capsys, tmp_path):
    assert_refused(capsys, [f"resume={tmp_path}"], "checkpoint not found")


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_every_algorithm_validates_with_its_defaults(name):
    config = compose(SCHEMA, [f"algorithm={name}"], groups={"algorithm": ALGORITHMS})
    config.validate()
    assert config.algorithm.name == name


def test_a_resumed_run_keeps_its_settings(capsys, tmp_path):
    folder = tmp_path / "run"
    assert main(["train", *TINY, f"out={folder}"]) == 0
    capsys.readouterr()
    assert_refused(capsys, [f"resume={folder}", "architecture=A"], "task.architecture", "'A'")
    assert_refused(capsys, [f"resume={folder}", "seed=9"], "seed")
