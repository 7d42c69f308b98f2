"""Bars and words on what takes long: moving on a terminal, a line now and then in a file."""

from __future__ import annotations

import contextlib
import os
import pty
import subprocess
import sys
import time

import pytest

from marl_handover import progress

TERMINAL = """
import time
from marl_handover import progress
progress.QUIET_S = 0.1
with progress.Bar(total=50, unit="step") as bar:
    for step in range(50):
        bar.update()
        time.sleep(0.01)
    progress.say("a line")
with progress.working("compiling what is slow"):
    time.sleep(0.8)
with progress.working("nothing to tell"):
    pass
"""


@pytest.fixture
def log(capsys):
    """``log()``: what was written to stderr, which is no terminal."""
    return lambda: capsys.readouterr().err


def test_in_a_file_a_bar_is_a_line_at_the_start_and_one_at_the_end(log):
    with progress.Bar(total=100_000, unit="step") as bar:
        for step in range(100_000):
            bar.set_postfix(step=step, refresh=False)
            bar.update()
            if step % 10_000 == 0:
                bar.refresh()
    written = log()
    assert "\r" not in written
    first, last = written.splitlines()
    assert "0/100000" in first
    assert "100000/100000" in last


def test_in_a_file_lines_come_at_their_times(log, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with progress.Bar(total=1000, unit="step") as bar:
        for _ in range(500):
            now[0] += 1.0
            bar.update()
            bar.refresh()
    lines = log().splitlines()
    assert 500 / progress.LOG_S <= len(lines) <= 500 / progress.LOG_S + 2
    assert "500/1000" in lines[-1], "how far it came is told, also if that is not the end"


def test_a_bar_that_is_not_to_be_shown_writes_nothing(log):
    with progress.Bar(total=3, shown=False) as bar:
        bar.update(3)
        bar.refresh()
    assert log() == ""


def test_lines_and_bars_do_not_mix_in_a_file(log):
    with progress.Bar(total=3, leave=False) as bar:
        bar.update()
        progress.say("a line")
        bar.update(2)
    assert [line.split("|")[0].strip() for line in log().splitlines()] == ["0%", "a line", "100%"]


def test_what_takes_long_is_told_once_in_a_file_and_what_does_not_is_not(log, monkeypatch):
    monkeypatch.setattr(progress, "QUIET_S", 0.05)
    with progress.working("compiling what is slow"):
        time.sleep(0.5)
    monkeypatch.setattr(progress, "QUIET_S", 60.0)
    with progress.working("nothing to tell"):
        pass
    assert log() == "compiling what is slow ...\n"


def test_on_a_terminal_bars_move_also_if_it_has_no_size():
    """As of a pseudo-terminal that nobody gave one."""
    control, terminal = pty.openpty()
    with subprocess.Popen([sys.executable, "-c", TERMINAL], stderr=terminal, stdout=terminal) as process:
        os.close(terminal)
        shown = b""
        with contextlib.suppress(OSError):  # which ends it
            while piece := os.read(control, 65536):
                shown += piece
    os.close(control)
    assert process.returncode == 0
    text = shown.decode()
    assert text.count("step/s") > 3
    assert "50/50" in text
    assert "a line" in text
    assert text.count("compiling what is slow") >= 2, "with the time it has taken so far"
    assert "nothing to tell" not in text
