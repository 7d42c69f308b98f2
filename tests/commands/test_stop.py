"""``marl-handover stop``: latched for every session until cleared."""

from __future__ import annotations

import os
import threading
import time

import pytest

from marl_handover.cli import main
from marl_handover.hardware import roll as rolls
from marl_handover.hardware import settings
from marl_handover.hardware.latch import StopLatch
from marl_handover.hardware.roll import Roll


@pytest.fixture
def own_roll(tmp_path, monkeypatch):
    """A roll that no other test's session signs."""
    for module in (rolls, settings):
        monkeypatch.setattr(module, "user_path", lambda suffix: tmp_path / f"user{suffix}")
    return Roll()


def test_stop_is_latched_and_cleared(own_roll, tmp_path, capsys):
    path = tmp_path / "stop"
    assert main(["stop", f"hardware.stop_file={path}", "reason=smoke", "wait_s=0"]) == 0
    assert "no session runs; if arms move, CUT THE POWER" in capsys.readouterr().out
    latch = StopLatch(path)
    assert latch.is_set()
    assert latch.reason() == "smoke"
    assert main(["stop", f"hardware.stop_file={path}", "clear=true"]) == 0
    assert not latch.is_set()


def obeying(latch, after_s):
    """A session that looks at its latch and then says that it has stopped."""

    def obey():
        while not latch.is_set():
            time.sleep(0.002)
        time.sleep(after_s)
        latch.obeyed()

    latch.join()
    thread = threading.Thread(target=obey, daemon=True)
    thread.start()
    return thread


def test_every_session_has_to_obey(own_roll, tmp_path, capsys):
    path = tmp_path / "stop"
    quick, slow = StopLatch(path), StopLatch(path)
    obeying(quick, 0.0)
    slow.join()
    assert main(["stop", f"hardware.stop_file={path}", "wait_s=0.3"]) == 1
    told = capsys.readouterr()
    assert f"process {os.getpid()} has stopped its arms" in told.out
    assert f"process {os.getpid()} did not answer within 0.3 s" in told.err
    assert "CUT THE POWER" in told.err
    assert slow.obeyed_by() is None, "one of two is not enough"
    slow.leave()
    assert main(["stop", f"hardware.stop_file={path}", "clear=true"]) == 0
    again = obeying(quick, 0.1)
    assert main(["stop", f"hardware.stop_file={path}", "wait_s=20"]) == 0
    again.join()
    assert "CUT" not in capsys.readouterr().out


def test_plain_stop_reaches_sessions_with_stop_files_of_their_own(own_roll, tmp_path, capsys):
    lab = StopLatch(tmp_path / "lab" / "stop")
    (tmp_path / "lab").mkdir()
    obeying(lab, 0.0)
    assert main(["stop", "wait_s=20"]) == 0
    assert lab.is_set()
    assert (tmp_path / "user.stop").exists()
    assert f"process {os.getpid()} has stopped its arms" in capsys.readouterr().out
    lab.leave()


def test_a_session_that_was_killed_is_not_waited_for(own_roll, tmp_path, capsys):
    own_roll.folder.mkdir(mode=0o700)
    (own_roll.folder / "4194305-0.json").write_text('{"pid": 4194305, "stop_file": "/tmp/x"}')  # above the kernel's largest pid
    (own_roll.folder / "rubbish.json").write_text("{")
    assert main(["stop", f"hardware.stop_file={tmp_path / 'stop'}"]) == 0
    assert main(["stop"]) == 0
    assert not list(own_roll.folder.iterdir())


def test_a_stop_file_that_cannot_be_written_is_told_with_what_to_do(own_roll, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["stop", f"hardware.stop_file={tmp_path / 'file' / 'stop'}"]) == 1
    assert "CUT THE POWER" in capsys.readouterr().err


@pytest.mark.parametrize(("key", "word"), [("wait_s=-1", "wait_s"), ("hardware.stop_file=here", "absolute")])
def test_bad_keys_are_refused(own_roll, tmp_path, capsys, key, word):
    assert main(["stop", key]) == 2
    assert word in capsys.readouterr().err
