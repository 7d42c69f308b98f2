"""Reading a session's folder: whatever is in there, or is not, it is said and nothing is raised."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.control.remote_control import ControlFolder
from marl_handover.control.telemetry_reader import (
    EVENTS_FILE,
    FORMAT,
    PICTURE_FILE,
    SILENT_S,
    STATE_FILE,
    VERSION,
    NotSteerable,
    TelemetryReader,
)
from marl_handover.errors import InvalidSetting
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.session_registry import SessionRegistry
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.perception.overlay import jpeg

pytestmark = pytest.mark.usefixtures("empty_session_registry")


def state(**fields):
    usual = {
        "format": FORMAT,
        "version": VERSION,
        "session": "abc",
        "pid": os.getpid(),
        "host": os.uname().nodename,
        "time": time.time(),
        "over": False,
        "view_control": False,
        "doing": "moving",
        "text": "",
    }
    return usual | fields


def put(folder, content):
    (folder / STATE_FILE).write_text(content if isinstance(content, str) else json.dumps(content))


def test_a_session_that_goes_on_is_live(tmp_path):
    put(tmp_path, state())
    reading = TelemetryReader(tmp_path).read()
    assert reading.live
    assert reading.problem == ""
    assert reading.state["doing"] == "moving"


def test_nothing_there_is_said(tmp_path):
    reading = TelemetryReader(tmp_path / "nowhere").read()
    assert (reading.state, reading.live) == (None, False)
    assert "no session yet" in reading.problem


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("{", "cannot be read"),
        ("", "cannot be read"),
        ("[1, 2]", "no session wrote it"),
        (json.dumps({"format": "else"}), "no session wrote it"),
        (state(version=99), "version 99"),
        (state(pid="1"), "its pid"),
        (state(time=None), "its time"),
        (state(pid=-1), "its pid"),
        (state(pid=0), "its pid"),
        (state(pid=True), "its pid"),
        (state(time=True), "its time"),
        (state(time=float("nan")), "cannot be read"),
        (state(time=10**400), "cannot be read"),
        (json.dumps(state(time=0)).replace('"time": 0', '"time": 1e400'), "cannot be read"),
        (state(block={"pose": [float("inf"), 0, 0]}), "cannot be read"),
        (state(stop_file=["a"]), "its stop_file"),
        (state(stop_file="a\0b"), "its stop_file"),
    ],
)
def test_a_damaged_state_is_said_and_the_last_good_one_kept(tmp_path, content, word):
    put(tmp_path, content)
    fresh = TelemetryReader(tmp_path).read()
    assert fresh.state is None
    assert word in fresh.problem
    feed = TelemetryReader(tmp_path)
    put(tmp_path, state(doing="looking"))
    feed.read()
    put(tmp_path, content)
    kept = feed.read()
    assert kept.state["doing"] == "looking"
    assert word in kept.problem


@given(content=st.binary(max_size=300))
def test_whatever_bytes_are_in_the_files_nothing_is_raised(tmp_path_factory, content):
    folder = tmp_path_factory.getbasetemp()
    for name in (STATE_FILE, EVENTS_FILE, PICTURE_FILE):
        (folder / name).write_bytes(content)
    feed = TelemetryReader(folder)
    assert not feed.read().live
    assert feed.picture() is None
    assert all("event" in row for row in feed.events())


def test_silence_and_an_emptied_folder_are_said(tmp_path):
    put(tmp_path, state(time=time.time() - SILENT_S - 5))
    feed = TelemetryReader(tmp_path)
    reading = feed.read()
    assert not reading.live
    assert "no news for 7 s" in reading.problem
    (tmp_path / STATE_FILE).unlink()
    assert "emptied or taken away" in feed.read().problem
    put(tmp_path, state(time=time.time() + SILENT_S + 60))
    reading = feed.read()
    assert not reading.live
    assert "compare the clocks" in reading.problem


def test_an_event_with_a_number_that_is_none_is_a_damaged_line(tmp_path):
    (tmp_path / EVENTS_FILE).write_text('{"t_s": NaN, "event": "a"}\n{"t_s": 1e999, "event": "b"}\n{"t_s": 1, "event": "c"}\n')
    assert [row["event"] for row in TelemetryReader(tmp_path).events()] == ["a damaged line", "a damaged line", "c"]


def test_a_process_that_died_is_said(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    put(tmp_path, state(pid=process.pid))
    reading = TelemetryReader(tmp_path).read()
    assert not reading.live
    assert f"process {process.pid} is gone" in reading.problem
    put(tmp_path, state(pid=process.pid, host="another-computer"))
    assert TelemetryReader(tmp_path).read().live, "processes of another computer cannot be asked about"
    put(tmp_path, state(pid=process.pid, over=True))
    assert TelemetryReader(tmp_path).read().problem == "", "a session that ended may be gone"


def test_events_come_once_whole_and_again_with_another_session(tmp_path):
    path = tmp_path / EVENTS_FILE
    put(tmp_path, state())
    feed = TelemetryReader(tmp_path)
    feed.read()
    assert feed.events() == []
    path.write_text('{"event": "a"}\n{"event": "b"}\n{"eve')
    assert [row["event"] for row in feed.events()] == ["a", "b"]
    with path.open("a") as stream:
        stream.write('nt": "c"}\nnonsense\n')
    assert [row["event"] for row in feed.events()] == ["c", "a damaged line"]
    assert feed.events() == []
    path.write_text('{"event": "d"}\n')
    assert [row["event"] for row in feed.events()] == ["d"], "a file that became shorter is another one"
    put(tmp_path, state(session="next"))
    feed.read()
    assert [row["event"] for row in feed.events()] == ["d"]


def test_of_a_long_log_the_end_is_read(tmp_path):
    put(tmp_path, state())
    (tmp_path / EVENTS_FILE).write_text("".join(f'{{"event": "{number:06d}"}}\n' for number in range(20_000)))
    feed = TelemetryReader(tmp_path)
    feed.read()
    rows = feed.events()
    assert rows[-1]["event"] == "019999"
    numbers = [int(row["event"]) for row in rows]
    assert numbers == list(range(numbers[0], 20_000)), "no line is cut"


def test_a_picture_is_given_once(tmp_path):
    image = np.zeros((36, 64, 3), np.uint8)
    image[..., 2] = 250  # BGR: red
    (tmp_path / PICTURE_FILE).write_bytes(jpeg(image))
    feed = TelemetryReader(tmp_path)
    seen = feed.picture()
    assert seen.shape == (36, 64, 3)
    assert seen[..., 0].min() > 200
    assert seen[..., 2].max() < 50
    assert feed.picture() is None


def test_a_session_is_asked_only_if_it_takes_wishes(tmp_path):
    feed = TelemetryReader(tmp_path)
    with pytest.raises(NotSteerable, match="no session yet"):
        feed.ask("pause")
    put(tmp_path, state())
    with pytest.raises(NotSteerable, match="view_control"):
        feed.ask("pause")
    assert [path.name for path in tmp_path.iterdir()] == [STATE_FILE]
    put(tmp_path, state(view_control=True))
    with pytest.raises(InvalidSetting, match="start, pause"):
        feed.ask("park")
    control = ControlFolder(tmp_path, "abc", lambda goal: None)
    for command, goal in (("pause", None), ("goal", [1.0, 2.0, 3.0])):
        number = feed.ask(command, goal)
        assert control.poll() == (number, command, goal, None)
    asked = [("goal", [1.0, 2.0, 3.0]), ("start", None)]
    numbers = [feed.ask(*wish) for wish in asked]
    taken = [control.poll() for _ in asked]
    assert [answer.command for answer in taken] == ["goal", "start"], "none has replaced another"
    assert [answer.number for answer in taken] == numbers
    put(tmp_path, state(view_control=True, over=True))
    with pytest.raises(NotSteerable, match="over"):
        feed.ask("pause")


def test_stop_goes_through_the_latch_that_the_session_names(tmp_path):
    stop = tmp_path / "stop"
    put(tmp_path, state(stop_file=str(stop)))
    feed = TelemetryReader(tmp_path)
    assert str(stop) in feed.stop("page")
    assert StopLatch(stop).reason() == "page"
    assert TelemetryReader(tmp_path / "nowhere").latch().path == StopLatch(HardwareConfig().stop_path()).path


def test_a_latch_that_cannot_be_written_interrupts_the_session(tmp_path):
    code = "import time\ntry:\n    print('up', flush=True)\n    time.sleep(60)\nexcept KeyboardInterrupt:\n    print('halted')"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "up\n"
    (tmp_path / "file").write_text("")
    put(tmp_path, state(pid=process.pid, stop_file=str(tmp_path / "file" / "stop")))
    feed = TelemetryReader(tmp_path)
    assert "CUT THE POWER" in feed.stop("page"), "a process that has not signed up as a session is none"
    SessionRegistry().folder.mkdir(exist_ok=True)
    signed = SessionRegistry().folder / f"{process.pid}-0.json"
    signed.write_text(json.dumps({"pid": process.pid, "stop_file": str(tmp_path / "file" / "stop")}))
    assert f"interrupted process {process.pid}" in feed.stop("page")
    assert process.communicate(timeout=30)[0] == "halted\n"
    assert "CUT THE POWER" in feed.stop("page"), "nobody is left to be interrupted"


@pytest.mark.parametrize("where", [{"host": "another-computer"}, {"pid": 1}, {"pid": -1}])
def test_nobody_is_interrupted_who_is_not_surely_the_session(tmp_path, monkeypatch, where):
    signals = []
    monkeypatch.setattr("marl_handover.control.telemetry_reader.os.kill", lambda pid, number: signals.append(number) if number else None)
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("marl_handover.control.telemetry_reader.HardwareConfig.stop_path", lambda _: tmp_path / "file" / "stop")
    put(tmp_path, state(stop_file=str(tmp_path / "file" / "stop")) | where)
    assert "CUT THE POWER" in TelemetryReader(tmp_path).stop("page")
    assert signals == []


def test_stop_replaces_no_file_that_is_no_stop_file(tmp_path):
    mine = tmp_path / "thesis.tex"
    mine.write_text("years of work")
    put(tmp_path, state(stop_file=str(mine)))
    assert "is no stop file" in (said := TelemetryReader(tmp_path).stop("page"))
    assert "CUT THE POWER" in said
    assert mine.read_text() == "years of work"
    os.mkfifo(tmp_path / "fifo")
    put(tmp_path, state(stop_file=str(tmp_path / "fifo")))
    assert "is no stop file" in TelemetryReader(tmp_path).stop("page"), "and a FIFO is not waited for"
    put(tmp_path, state(stop_file=str(tmp_path / "stop")))
    for reason in ("first", "second"):
        assert "stop latched" in TelemetryReader(tmp_path).stop(reason)
        assert StopLatch(tmp_path / "stop").reason() == reason


def test_a_stop_reaches_what_a_session_signed_up_with_and_what_its_folder_says(tmp_path):
    """A session that has not connected yet has not signed up, while another one of the same process may have."""
    entry = SessionRegistry().register(tmp_path / "signed")
    put(tmp_path, state(stop_file=str(tmp_path / "told")))
    assert TelemetryReader(tmp_path).stop("page") == f"stop latched in {tmp_path / 'signed'} and {tmp_path / 'told'}"
    assert StopLatch(tmp_path / "signed").reason() == StopLatch(tmp_path / "told").reason() == "page"
    SessionRegistry.leave(entry)


def test_of_several_sessions_of_a_process_only_the_one_that_is_shown_is_stopped(tmp_path):
    entries = [SessionRegistry().register(tmp_path / name) for name in ("other", "shown", "third")]
    put(tmp_path, state(stop_file=str(tmp_path / "shown")))
    feed = TelemetryReader(tmp_path)
    assert feed.stop("page") == f"stop latched in {tmp_path / 'shown'}"
    assert feed.latch().path == tmp_path / "shown"
    assert not (tmp_path / "other").exists()
    assert not (tmp_path / "third").exists()
    for entry in entries:
        SessionRegistry.leave(entry)


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")
def test_a_strangers_folder_and_his_files_in_ones_own_are_not_believed(tmp_path, monkeypatch):
    monkeypatch.setattr("marl_handover.control.telemetry_reader.HardwareConfig.stop_path", lambda _: tmp_path / "default")
    put(tmp_path, state(stop_file=str(tmp_path / "stop")))
    (tmp_path / PICTURE_FILE).write_bytes(jpeg(np.zeros((36, 64, 3), np.uint8)))
    (tmp_path / EVENTS_FILE).write_text('{"event": "a"}\n')
    for name in (STATE_FILE, PICTURE_FILE, EVENTS_FILE, ""):
        os.chown(tmp_path / name, 12345, 12345)
        feed = TelemetryReader(tmp_path)
        assert (feed.read().state is None) == (name in (STATE_FILE, ""))
        assert (feed.picture() is None) == (name == PICTURE_FILE)
        assert (feed.events() == []) == (name == EVENTS_FILE)
        if name in (STATE_FILE, ""):
            assert "another user (12345)" in feed.read().problem
        feed.stop("page")
        assert (tmp_path / "stop").exists() == (name not in (STATE_FILE, ""))
        (tmp_path / "stop").unlink(missing_ok=True)
        os.chown(tmp_path / name, 0, 0)


@pytest.mark.parametrize("name", [STATE_FILE, PICTURE_FILE, EVENTS_FILE])
@pytest.mark.parametrize("kind", ["fifo", "folder", "link", "large"])
def test_what_is_no_small_file_of_its_own_is_not_read_nor_waited_for(tmp_path, name, kind):
    put(tmp_path, state())
    (tmp_path / name).unlink(missing_ok=True)
    if kind == "fifo":
        os.mkfifo(tmp_path / name)
    elif kind == "folder":
        (tmp_path / name).mkdir()
    elif kind == "link":
        (tmp_path / name).symlink_to("/proc/self/environ")
    else:
        with (tmp_path / name).open("wb") as stream:
            stream.truncate(10**13)
    feed = TelemetryReader(tmp_path)
    assert (feed.read().state is None) == (name == STATE_FILE)
    assert feed.picture() is None
    assert feed.events() == [] or kind == "large"
