"""A stop that another process can set."""

from __future__ import annotations

import subprocess
import sys

from marl_handover.hardware.latch import StopLatch
from marl_handover.hardware.settings import HardwareConfig


def test_it_stays_until_it_is_cleared(tmp_path):
    latch, elsewhere = StopLatch(tmp_path / "a" / "stop"), StopLatch(tmp_path / "a" / "stop")
    assert not latch.is_set()
    assert latch.reason() == ""
    elsewhere.latch("button")
    assert latch.is_set()
    assert latch.reason() == "button"
    assert StopLatch(tmp_path / "a" / "stop").is_set(), "for sessions that begin later, too"
    latch.clear()
    assert not latch.is_set()
    elsewhere.clear()
    latch.clear()


def test_another_process_stops_this_one(tmp_path):
    latch = StopLatch(tmp_path / "stop")
    code = f"from marl_handover.hardware.latch import StopLatch; StopLatch({str(tmp_path / 'stop')!r}).latch('typed stop')"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    assert latch.reason() == "typed stop"


def test_when_in_doubt_it_is_a_stop(tmp_path):
    (tmp_path / "stop").write_text("rubbish")
    assert StopLatch(tmp_path / "stop").is_set()
    assert StopLatch(tmp_path / "stop").reason() == "stop file present"
    assert StopLatch(tmp_path / "stop" / "below").is_set(), "a folder that cannot be looked into"
    assert StopLatch("x" * 5000).is_set()


def test_a_stop_says_whether_anybody_obeyed(tmp_path):
    latch = StopLatch(tmp_path / "stop")
    latch.latch("now")
    assert latch.obeyed_by() is None
    StopLatch(tmp_path / "stop").obeyed()
    assert latch.obeyed_by() is not None
    latch.latch("again")
    assert latch.obeyed_by() is None, "an old receipt is no receipt"


def test_every_session_of_a_user_looks_at_the_same_file(monkeypatch, tmp_path):
    before = HardwareConfig().stop_path()
    monkeypatch.chdir(tmp_path)
    assert HardwareConfig().stop_path() == before
    assert HardwareConfig(stop_file="mine").stop_path() == "mine"
