"""``marl-handover stop``: latched for every session until cleared."""

from __future__ import annotations

import os

from marl_handover.cli import main
from marl_handover.hardware.latch import StopLatch


def test_stop_is_latched_and_cleared(tmp_path, capsys):
    path = tmp_path / "stop"
    assert main(["stop", f"hardware.stop_file={path}", "reason=smoke", "wait_s=0"]) == 0
    assert "CUT THE POWER" in capsys.readouterr().out
    latch = StopLatch(path)
    assert latch.is_set()
    assert latch.reason() == "smoke"
    assert main(["stop", f"hardware.stop_file={path}", "clear=true"]) == 0
    assert not latch.is_set()


def test_a_session_that_obeys_is_named(tmp_path, capsys, monkeypatch):
    path = tmp_path / "stop"
    latch = StopLatch.latch

    def obeyed_at_once(self, reason):
        latch(self, reason)
        self.obeyed()

    monkeypatch.setattr(StopLatch, "latch", obeyed_at_once)
    assert main(["stop", f"hardware.stop_file={path}"]) == 0
    assert f"process {os.getpid()} has stopped its arms" in capsys.readouterr().out


def test_a_wait_below_zero_is_refused(tmp_path, capsys):
    assert main(["stop", f"hardware.stop_file={tmp_path / 'stop'}", "wait_s=-1"]) == 2
    assert "wait_s" in capsys.readouterr().err
    assert not (tmp_path / "stop").exists()
