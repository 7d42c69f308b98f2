"""A stop that another process can set, and who has to obey it."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from marl_handover.errors import InvalidSetting
from marl_handover.hardware.latch import StopLatch
from marl_handover.hardware.roll import NoRoll, Roll
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


def test_a_stop_says_whether_everybody_obeyed(tmp_path):
    roll = Roll(tmp_path / "roll")
    button, one, two = (StopLatch(tmp_path / "stop", roll) for _ in range(3))
    one.join()
    two.join()
    button.latch("now")
    assert button.obeyed_by() is None
    one.obeyed()
    assert button.obeyed_by() is None, "the other one still moves"
    two.obeyed()
    assert button.obeyed_by() == os.getpid()
    two.leave()
    assert button.obeyed_by() == os.getpid()
    button.latch("again")
    assert button.obeyed_by() is None, "an old receipt is no receipt"


def test_a_session_is_on_the_roll_of_its_own_stop_file_only(tmp_path):
    roll = Roll(tmp_path / "roll")
    latch = StopLatch(tmp_path / "stop", roll)
    latch.join()
    latch.join()
    assert [(it.pid, it.stop_file, it.obeyed) for it in roll.signed()] == [(os.getpid(), tmp_path / "stop", False)]
    assert roll.signed(tmp_path / "other") == []
    latch.leave()
    assert roll.signed() == []
    assert list(roll.folder.iterdir()) == []


def test_the_roll_of_a_process_that_was_killed_is_empty(tmp_path):
    folder = tmp_path / "roll"
    code = f"""
import os, signal
from pathlib import Path
from marl_handover.hardware.latch import StopLatch
from marl_handover.hardware.roll import Roll
latch = StopLatch("/tmp/nothing", Roll(Path({str(folder)!r})))
latch.join()
assert len(latch.roll.signed()) == 1
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == -9
    assert len(list(folder.iterdir())) == 1
    assert Roll(folder).signed() == []


def test_nothing_runs_without_a_roll(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(NoRoll, match="cannot sign up"):
        StopLatch(tmp_path / "stop", Roll(tmp_path / "file")).join()


def test_a_driver_is_on_the_roll_as_long_as_it_holds_its_ports(rig):
    made = rig()
    names = [entry.entry for entry in made.latch.roll.signed(made.latch.path)]
    assert names == []
    made.driver.connect()
    assert [entry.pid for entry in made.latch.roll.signed(made.latch.path)] == [os.getpid()]
    made.driver.disconnect()
    assert made.latch.roll.signed(made.latch.path) == []


def test_every_session_of_a_user_looks_at_the_same_file(monkeypatch, tmp_path):
    before = HardwareConfig().stop_path()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert HardwareConfig().stop_path() == before
    assert HardwareConfig(stop_file="/srv/stop").stop_path() == "/srv/stop"
    with pytest.raises(InvalidSetting, match="absolute"):
        HardwareConfig(stop_file="mine").validate()
