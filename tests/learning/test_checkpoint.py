"""Checkpoints and resuming: a continued run is the run it would have been."""

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

import pytest
import torch

from marl_handover.commands.train import resumed
from marl_handover.errors import CheckpointMismatch, CorruptFile, MissingFile
from marl_handover.files import remove_temporaries, temporary_of
from marl_handover.learning.checkpoint import FILE, load_checkpoint, save_checkpoint
from marl_handover.learning.recorder import COLUMNS, Recorder
from marl_handover.learning.trainer import Trainer

SLOW = pytest.mark.slow


def weights(trainer):
    return {
        f"{name}.{key}": value
        for name, part in trainer.algorithm.modules().items()
        if isinstance(part, torch.nn.Module)
        for key, value in part.state_dict().items()
        if isinstance(value, torch.Tensor)
    }


def assert_same_weights(one, other):
    one, other = weights(one), weights(other)
    assert one.keys() == other.keys()
    for name, value in one.items():
        torch.testing.assert_close(other[name], value, rtol=0, atol=0, msg=name)


class Killed(Exception):
    pass


def killed_after(config, folder, monkeypatch):
    """Train until the first checkpoint, then 100 steps more, and die there."""
    trainer = Trainer(config, folder)
    report = trainer._report

    def watched(recorder):
        report(recorder)
        if trainer.counters.step >= config.checkpoint_interval + 100:
            raise Killed

    monkeypatch.setattr(trainer, "_report", watched)
    with pytest.raises(Killed):
        trainer.run()


@pytest.mark.parametrize(
    ("algorithm", "architecture"),
    [("sac", "B"), ("td3", "B"), ("ppo", "B"), pytest.param("flat_sac", "B", marks=SLOW), pytest.param("sac", "A", marks=SLOW)],
)
def test_a_resumed_run_is_the_uninterrupted_run(small, table, tmp_path, monkeypatch, algorithm, architecture):
    """In one go, and as a checkpoint with 100 steps lost and done again: the same weights, counters and table."""
    overrides = (f"task.architecture={architecture}", "steps=640", "evaluation_interval=128", "checkpoint_interval=320")
    whole = Trainer(small(algorithm, *overrides), tmp_path / "whole")
    whole.run()
    killed_after(small(algorithm, *overrides), tmp_path / "killed", monkeypatch)
    assert [int(row["step"]) for row in table(tmp_path / "killed")] == [128, 256, 384]
    continued = resumed(tmp_path / "killed")
    assert continued.counters.step == 320
    continued.run()
    assert_same_weights(whole, continued)
    mine, theirs = (vars(trainer.counters) for trainer in (continued, whole))
    assert {**mine, "wall_s": 0} == {**theirs, "wall_s": 0}
    assert mine["gradient_step"] > 0
    assert table(tmp_path / "killed") == table(tmp_path / "whole")


def test_checkpoint_is_plain_data(small, tmp_path):
    Trainer(small("sac", "steps=512"), tmp_path).run()
    state = torch.load(tmp_path / FILE, weights_only=True)

    def plain(value):
        if isinstance(value, dict):
            return all(isinstance(key, (str, int)) and plain(part) for key, part in value.items())
        if isinstance(value, (list, tuple)):
            return all(map(plain, value))
        return value is None or isinstance(value, (torch.Tensor, str, int, float, bool))

    assert plain(state)
    assert state["counters"]["step"] == 512
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["step"] == 512
    assert 0 <= summary["validation"]["success_rate"] <= 1


@pytest.fixture
def started(small, tmp_path):
    """A run directory with a checkpoint of step 0."""
    folder = tmp_path / "run"
    folder.mkdir()
    Trainer(small("sac"), folder).save()
    return folder


def test_missing_run_and_missing_checkpoint(tmp_path):
    with pytest.raises(MissingFile, match="run directory"):
        load_checkpoint(tmp_path / "nowhere")
    with pytest.raises(MissingFile, match="checkpoint"):
        load_checkpoint(tmp_path)
    with pytest.raises(MissingFile, match="nowhere"):
        resumed(tmp_path / "nowhere")


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9, 0.9999])
def test_truncated_checkpoint_is_corrupt(started, kept):
    content = (started / FILE).read_bytes()
    (started / FILE).write_bytes(content[: int(kept * len(content))])
    with pytest.raises(CorruptFile, match="checkpoint"):
        load_checkpoint(started)


@pytest.mark.parametrize("content", [b"not a checkpoint at all", b"\x80\x04."])
def test_garbage_is_corrupt(started, content):
    (started / FILE).write_bytes(content)
    with pytest.raises(CorruptFile):
        resumed(started)


@pytest.mark.parametrize("value", [[1, 2], {"weights": 3}, torch.zeros(2)])
def test_another_programs_file_is_corrupt(started, value):
    torch.save(value, started / FILE)
    with pytest.raises(CorruptFile, match="no marl_handover state"):
        load_checkpoint(started)


def test_code_in_a_checkpoint_is_not_run(started, tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    torch.save({"format": 1, "config": Evil()}, started / FILE)
    with pytest.raises(CorruptFile):
        load_checkpoint(started)
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize("missing", ["config", "counters", "algorithm", "replay", "random"])
def test_a_checkpoint_without_one_of_its_parts_is_corrupt(started, missing):
    state = load_checkpoint(started)
    del state[missing]
    torch.save(state, started / FILE)
    with pytest.raises(CorruptFile):
        resumed(started)


def test_another_format_and_another_architecture_do_not_match(small, started):
    with pytest.raises(CheckpointMismatch, match="architecture = 'B', but 'A'"):
        Trainer(small("sac", "task.architecture=A"), started).restore()
    torch.save({**load_checkpoint(started), "format": 99}, started / FILE)
    with pytest.raises(CheckpointMismatch, match="format = 99"):
        load_checkpoint(started)


def test_a_temporary_file_of_a_killed_process_is_harmless(started):
    state = load_checkpoint(started)
    before = state["config"]
    left = [temporary_of(started / FILE), started / f"{FILE}.tmp", started / "config.yaml.123.tmp"]  # the last two are of version 0.1
    for path in left:
        path.write_bytes(b"half a checkpo")
    assert load_checkpoint(started)["config"] == before
    save_checkpoint(started, {**state, "config": "new"})
    assert load_checkpoint(started)["config"] == "new"
    remove_temporaries(started)
    assert not any(path.exists() for path in left)


def test_a_save_that_fails_leaves_the_old_checkpoint(started):
    before = (started / FILE).read_bytes()
    with pytest.raises(Exception, match="pickle|local object"):
        save_checkpoint(started, {"config": lambda: None})
    assert (started / FILE).read_bytes() == before


def test_rows_later_than_the_checkpoint_are_dropped(tmp_path):
    recorder = Recorder(tmp_path, 1000, progress=False)
    for step in (100, 200, 300):
        recorder.record({"step": step, "success_rate": 0.5, "wall_s": 1e-7})
    recorder.close()
    with (tmp_path / "metrics.csv").open("a") as stream:
        stream.write("40")  # torn by a kill
    Recorder(tmp_path, 1000, start_step=200, progress=False).close()
    with (tmp_path / "metrics.csv").open(newline="") as stream:
        rows = list(csv.reader(stream))
    assert rows[0] == list(COLUMNS)
    assert [row[0] for row in rows[1:]] == ["100", "200"]
    Recorder(tmp_path, 1000, start_step=0, progress=False).close()
    assert (tmp_path / "metrics.csv").read_text() == ",".join(COLUMNS) + "\n"


@pytest.mark.slow
def test_a_run_killed_five_times_ends_as_an_uninterrupted_one(table, tmp_path):
    """SIGKILL at random moments, each time resumed."""
    program = [sys.executable, "-m", "marl_handover.cli", "train"]
    arguments = ["preset=smoke", "progress=false", "num_envs=16", "checkpoint_interval=128", "evaluation_interval=256", "seed=3"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    assert subprocess.run([*program, *arguments, f"out={tmp_path / 'whole'}"], **quiet, check=False).returncode == 0
    folder = tmp_path / "killed"
    moment = random.Random(5)
    command = [*program, *arguments, f"out={folder}"]
    for number in range(5):
        process = subprocess.Popen(command, **quiet)
        before = (folder / FILE).stat().st_mtime_ns if (folder / FILE).exists() else 0
        limit = time.monotonic() + 120
        while not ((folder / FILE).exists() and (folder / FILE).stat().st_mtime_ns > before):  # it runs and has saved something new
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < limit
            time.sleep(0.01)
        time.sleep(moment.uniform(0, 0.5))
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL, f"run {number} ended before it was killed"
        assert load_checkpoint(folder)["counters"]["step"] < 2048
        assert all(row["success_rate"] for row in table(folder))
        command = [*program, f"resume={folder}", "progress=false"]
    done = subprocess.run(command, **quiet, check=False)
    assert done.returncode == 0, done.stderr
    summaries = [json.loads((path / "summary.json").read_text()) for path in (tmp_path / "whole", folder)]
    for summary in summaries:
        summary.pop("wall_s")
    assert summaries[0] == summaries[1]
    assert table(folder) == table(tmp_path / "whole")
    one, other = (load_checkpoint(path)["algorithm"]["loss"] for path in (tmp_path / "whole", folder))
    assert all(torch.equal(value, other[key]) for key, value in one.items())


@pytest.mark.slow
@pytest.mark.skipif(os.getuid() != 0 or not shutil.which("unshare"), reason="only root takes shared memory away")
def test_a_machine_without_shared_memory_is_told(tmp_path):
    code = "from marl_handover.learning.trainer import NoSharedMemory, require_shared_memory as r\n"
    code += "try: r()\nexcept NoSharedMemory as e: print(e)"
    # A file system in which no semaphore can be made, in a mount namespace of its own.
    command = ["unshare", "-m", "sh", "-c", 'mount --bind /proc /dev/shm || exit 77; exec "$@"', "sh", sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 77:
        pytest.skip("nothing can be mounted here")
    assert "training needs shared memory, and /dev/shm cannot be used" in done.stdout, done.stderr
