"""A study's journal survives full disks and killed processes."""

from __future__ import annotations

import json
import logging
import os
import resource
import signal
import subprocess
import sys

import pytest

from marl_handover.errors import CannotWrite, CorruptFile, HandoverError
from marl_handover.experiments.tune_storage import Journal, open_storage, open_study


def tell(study, values):
    for value in values:
        trial = study.ask()
        study.tell(trial, value)


def values(path):
    return [trial.value for trial in open_study(str(path), "s").get_trials() if trial.value is not None]


@pytest.mark.parametrize("lost", [1, 2, 20, 60])
def test_a_journal_that_was_cut_off_goes_on_from_its_last_whole_line(tmp_path, caplog, lost):
    path = tmp_path / "study.journal"
    tell(open_study(str(path), "s"), [1.0, 2.0])
    content = path.read_bytes()
    path.write_bytes(content[:-lost])
    with caplog.at_level(logging.WARNING):
        study = open_study(str(path), "s")
    assert "cut off" in caplog.text
    tell(study, [3.0])
    assert values(path) == [1.0, 3.0]
    assert all(json.loads(line) for line in path.read_bytes().splitlines())


def test_one_that_is_open_meanwhile_appends_to_whole_lines_too(tmp_path):
    path = tmp_path / "study.journal"
    study = open_study(str(path), "s")
    tell(study, [1.0])
    with path.open("ab") as stream:  # another process was killed here
        stream.write(b'{"op_code": 4, "wor')
    journal = Journal(path)
    assert path.read_bytes().endswith(b"\n")
    with path.open("ab") as stream:
        stream.write(b'{"op_code": 4, "wor')
    journal.append_logs([])
    assert path.read_bytes().endswith(b"\n")
    assert values(path) == [1.0]


def test_a_full_disk_leaves_whole_lines_and_is_told(tmp_path):
    path = tmp_path / "study.journal"
    study = open_study(str(path), "s")
    tell(study, [1.0])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 30, before[1]))
    try:
        with pytest.raises(CannotWrite, match="study.journal cannot be written"):
            tell(study, [2.0])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    tell(study, [3.0])
    assert values(path) == [1.0, 3.0]


def test_a_writer_that_is_killed_at_any_moment_leaves_a_study(tmp_path):
    path = tmp_path / "study.journal"
    code = (
        "import sys; from marl_handover.experiments.tune_storage import open_study\n"
        "study = open_study(sys.argv[1], 's'); print('up', flush=True)\n"
        "while True: study.tell(study.ask(), 1.0)"
    )
    writer = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE)
    writer.stdout.readline()
    while path.stat().st_size < 20_000:
        assert writer.poll() is None
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    (tmp_path / "study.journal.lock").unlink(missing_ok=True)  # Optuna waits 30 s before it takes a dead one's
    assert len(values(path)) > 10


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "study.journal")
    with pytest.raises(CorruptFile, match="no regular file"):
        open_study(str(tmp_path / "study.journal"), "s")


@pytest.mark.parametrize(
    "content", ['{"episode": 0}\n', "years of work", '{"op_code":9}\n', '{"op_code":0}\n', '{"op_code":4,"worker_id":"a"}\n']
)
def test_a_file_that_is_no_journal_is_named_and_left_as_it_is(tmp_path, content):
    path = tmp_path / "trace.jsonl"
    path.write_text(content)
    with pytest.raises(HandoverError, match=r"trace\.jsonl"):
        open_storage(str(path))
    assert path.read_text() == content
