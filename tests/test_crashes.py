"""Processes that are killed and disks that are full, at random moments: nothing is corrupt, all goes on, and the file is named."""

from __future__ import annotations

import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml

from marl_handover.commands.train import resumed
from marl_handover.learning.checkpoint import load_checkpoint
from marl_handover.learning.recorder import COLUMNS
from marl_handover.report.traces import read_trace
from marl_handover.viewer.trace_file import read_trace as read_log

TRAIN = [
    *("train", "preset=smoke", "progress=false", "compile=off", "num_envs=16", "evaluation_interval=128", "checkpoint_interval=64"),
    *("evaluation_episodes=10", "algorithm.learning_starts=64", "algorithm.env_steps_per_gradient_step=32", "algorithm.batch_size=32"),
]
FORKS = """
import json, os, resource, sys
import marl_handover.learning.trainer, marl_handover.commands.train, marl_handover.commands.evaluate
from marl_handover.cli import main
for line in sys.stdin:
    arguments, room, said = json.loads(line)
    pid = os.fork()
    if pid == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        if room:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
        sys.exit(main(arguments))
    print(pid, flush=True)
    print(os.waitpid(pid, 0)[1], flush=True)
"""


class Commands:
    """Command lines, each in a process of its own that need not import anything any more."""

    def __init__(self, folder):
        self.said = folder / "said"
        self._forks = subprocess.Popen([sys.executable, "-c", FORKS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def start(self, arguments, room_bytes=0):
        """The process; with ``room_bytes`` no file that it writes can be larger."""
        self._forks.stdin.write(json.dumps([[str(argument) for argument in arguments], room_bytes, str(self.said)]) + "\n")
        self._forks.stdin.flush()
        return int(self._forks.stdout.readline())

    def status(self):
        """How the process that was started last ended."""
        return os.waitstatus_to_exitcode(int(self._forks.stdout.readline()))

    def run(self, arguments, room_bytes=0):
        """Exit status, and what was said."""
        self.start(arguments, room_bytes)
        return self.status(), self.said.read_text()

    def close(self):
        self._forks.stdin.close()
        self._forks.wait(60)


@pytest.fixture(scope="module")
def commands(tmp_path_factory):
    made = Commands(tmp_path_factory.mktemp("commands"))
    yield made
    made.close()


def temporaries(folder):
    return [path.name for path in folder.rglob("*") if ".tmp" in path.name]


def steps_of(folder):
    with (folder / "metrics.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert all(None not in row and list(row) == list(COLUMNS) and None not in row.values() for row in rows)
    return [int(row["step"]) for row in rows]


def replaced(path, pid, times):
    """Wait until a process has put so many new files in the place of ``path``; how long the last took."""
    inode = path.stat().st_ino if path.exists() else 0
    began = time.monotonic()
    lasted = 0.0
    while times:
        assert Path(f"/proc/{pid}").exists()
        if path.exists() and (now := path.stat().st_ino) != inode:
            inode, times = now, times - 1
            began, lasted = time.monotonic(), time.monotonic() - began
        time.sleep(0.001)
    return lasted


def trained_and_killed(commands, folder, moments, draw):
    """Train, be killed, resume, be killed, ... The step of the last checkpoint after each time."""
    found, between_s = [0], 0.1
    for moment in range(moments):
        pid = commands.start([*TRAIN, "steps=1000000", f"out={folder}"] if moment == 0 else ["train", f"resume={folder}", "progress=false"])
        replaced(folder / "config.yaml", pid, 1)
        if count := draw.randrange(4):
            between_s = replaced(folder / "checkpoint.pt", pid, count)
        time.sleep(draw.uniform(0.0, between_s))  # sooner or later in what lies between two checkpoints
        os.kill(pid, signal.SIGKILL)
        assert commands.status() == -signal.SIGKILL
        assert len(temporaries(folder)) <= 1, "those of earlier kills are gone"
        assert yaml.safe_load((folder / "config.yaml").read_text())["steps"] == 1_000_000
        found.append(load_checkpoint(folder)["counters"]["step"] if (folder / "checkpoint.pt").exists() else 0)
        assert found[-1] >= found[-2] + 64 * count
        if moment:
            assert sorted(set(steps := steps_of(folder))) == steps
    return found


@pytest.mark.parametrize("moments", [2, pytest.param(40, marks=pytest.mark.slow)])
def test_a_training_killed_at_random_moments_goes_on_from_its_last_checkpoint(commands, tmp_path, moments):
    found = trained_and_killed(commands, tmp_path / "run", moments, random.Random(moments))
    print(f"killed {moments} times, checkpoints at steps {found}")
    trainer = resumed(tmp_path / "run")
    assert trainer.counters.step == found[-1]
    trainer._advance()
    trainer.collector.close()


def assert_named(status, said, folder):
    """Exit 1, and one line that names a file of the folder."""
    assert status == 1, said
    assert said.count("\n") == 1, said
    assert str(folder) in said
    assert "cannot be written: File too large" in said or "ffmpeg ended" in said
    assert temporaries(folder) == []


@pytest.mark.parametrize("moments", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_a_training_without_room_says_so_and_goes_on_when_there_is_some(commands, tmp_path, moments):
    folder, draw = tmp_path / "run", random.Random(moments)
    begin = [*TRAIN, f"out={folder}", "steps=128"]
    assert commands.run(begin) == (0, commands.said.read_text())
    size, step = (folder / "checkpoint.pt").stat().st_size, 128
    for _ in range(moments):
        step += 128
        longer(folder, step)
        before = (folder / "checkpoint.pt").read_bytes()
        room = draw.randrange(len((folder / "config.yaml").read_bytes()) + 100, size - 1000)
        assert_named(*commands.run(["train", f"resume={folder}", "progress=false"], room), folder)
        assert (folder / "checkpoint.pt").read_bytes() == before
        status, said = commands.run(["train", f"resume={folder}", "progress=false"])
        assert (status, said.count("\n")) == (0, 1), said
        assert load_checkpoint(folder)["counters"]["step"] == step
        assert steps_of(folder) == list(range(128, step + 1, 128))


def longer(folder, steps):
    """Change how long a run is to be, as nobody else may."""
    state = torch.load(folder / "checkpoint.pt", weights_only=True)
    config = yaml.safe_load(state["config"])
    state["config"] = yaml.safe_dump({**config, "steps": steps})
    torch.save(state, folder / "checkpoint.pt")


def starved(commands, command, path, moments, read):
    """A command that writes ``path``, with room for it and, at random moments, without."""
    draw = random.Random(moments)
    assert commands.run(command)[0] == 0, commands.said.read_text()
    whole = path.read_bytes()
    read(path)
    for _ in range(moments):
        assert_named(*commands.run(command, draw.randrange(3000, len(whole) - 100)), path.parent)
        assert path.read_bytes() == whole, "the old one stays"


@pytest.mark.parametrize("moments", [3, pytest.param(10, marks=pytest.mark.slow)])
def test_an_evaluation_without_room(commands, tmp_path, moments):
    path = tmp_path / "trace.jsonl"
    command = ["evaluate", "policy=exact", "episodes=60", "progress=false", f"trace={path}"]
    starved(commands, command, path, moments, read_trace)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_a_film_without_room(commands, tmp_path, suffix):
    path = tmp_path / f"film.{suffix}"
    command = ["simulate", "policy=exact", "seed=5", "size=[160,120]", "captions=false", "progress=false", f"video={path}"]
    starved(commands, command, path, 10, lambda path: None)


@pytest.mark.slow
def test_a_session_without_room_for_its_log_ends_with_whole_lines(commands, tmp_path, twin_calibration):
    path = tmp_path / "log.jsonl"
    command = ["run", "hardware=twin", f"calibration={twin_calibration}", f"hardware.stop_file={tmp_path / 'stop'}", f"log={path}"]
    command += ["start=[-60,20,40]", "goal=[50,25,76]", "policy=exact"]
    draw = random.Random(1)
    assert commands.run(command)[0] == 0, commands.said.read_text()
    whole = path.stat().st_size
    read_log(path)
    for _ in range(10):
        status, said = commands.run(command, draw.randrange(3000, whole - 100))
        assert_named(status, said, tmp_path)
        content = path.read_bytes()
        assert content.endswith(b"\n")
        assert [json.loads(line) for line in content.splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("what", ["sheets", "camera", "servos"])
def test_a_calibration_without_room_leaves_the_old_one(commands, tmp_path, twin_calibration, what):
    folder = Path(shutil.copytree(twin_calibration, tmp_path / "calibration"))
    command = [
        "calibrate",
        "hardware=twin",
        f"calibration={folder}",
        f"what={what}",
        "postures=24",
        f"hardware.stop_file={tmp_path / 'stop'}",
    ]
    if what == "sheets":
        assert commands.run(command)[0] == 0
    before = {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    # Sizes of what is written last: the camera's file, the first arm's, the smallest sheet.
    least, most = {"sheets": (3000, 20_000), "camera": (400, 850), "servos": (400, 1750)}[what]
    draw = random.Random(what)
    for room in (draw.randrange(least, most) for _ in range(10)):
        assert_named(*commands.run(command, room), folder)
        now = {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        assert {name: now.get(name) for name in before} == before
