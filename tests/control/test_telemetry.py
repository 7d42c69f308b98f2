"""A session that shows itself: real twin sessions in processes of their own, and all that may happen to whoever watches them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest

from marl_handover.cli import main
from marl_handover.control.events import SessionDigest
from marl_handover.control.remote_control import control_name
from marl_handover.control.telemetry import Publisher
from marl_handover.control.telemetry_reader import EVENTS_FILE, STATE_FILE, TelemetryReader
from marl_handover.errors import InvalidSetting

PATIENCE_S = 120.0
VIEWER = """
import sys, threading
from marl_handover.control.telemetry_reader import TelemetryReader
from marl_handover.viewer.live import LivePage
from marl_handover.viewer.server import keep_updating, open_server
with open_server(0, "live") as server:
    page = LivePage(server, None, TelemetryReader(sys.argv[1]))
    print("up", flush=True)
    keep_updating(lambda dt_s: page.update(), 20.0, threading.Event())
"""


SLEEPER = """
import sys, time
from marl_handover.control.telemetry import Publisher
with Publisher(sys.argv[1]):
    time.sleep(600)
"""


@pytest.fixture
def cell(twin_calibration, tmp_path):
    """A folder to publish in, its feed, and ``run(...)``, which starts a session in a process of its own."""
    processes = []

    def start(*command):
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
        processes.append(process)
        return process

    folder, log = tmp_path / "live", tmp_path / "log.jsonl"
    usual = ["hardware=twin", f"calibration={twin_calibration}", f"hardware.stop_file={tmp_path / 'stop'}", "policy=exact"]
    cell = SimpleNamespace(folder=folder, log=log, usual=usual, feed=TelemetryReader(folder), start=start)
    cell.run = lambda *more: start(sys.executable, "-m", "marl_handover.cli", "run", *usual, f"publish={folder}", f"log={log}", *more)
    yield cell
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


def until(condition, process=None):
    """Wait until ``condition()`` holds; what it gave."""
    end_s = time.monotonic() + PATIENCE_S
    while not (result := condition()):
        assert time.monotonic() < end_s, "it never came"
        assert process is None or process.poll() is None, process.communicate()[0]
        time.sleep(0.01)
    return result


def doing(cell, *words):
    def check():
        state = cell.feed.read().state
        return state is not None and state["doing"] in words and state

    return check


def rows(path):
    return [json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines()]


def where(kinds, wanted):
    return [index for index, kind in enumerate(kinds) if kind == wanted]


def without_wall_times(path):
    return [{key: value for key, value in row.items() if key != "planning_ms"} for row in rows(path)]


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["exact", "random"])  # random draws lots: whoever asks it changes what it says next
def test_killed_viewers_a_lost_folder_and_forged_commands_change_nothing(cell, tmp_path, policy):
    cell.usual[cell.usual.index("policy=exact")] = f"policy={policy}"
    alone = tmp_path / "alone.jsonl"
    ended = main(["run", *cell.usual, "seed=3", f"log={alone}"])
    viewer = cell.start(sys.executable, "-c", VIEWER, str(cell.folder))
    assert viewer.stdout.readline() == "up\n"
    session = cell.run("seed=3")
    state = until(doing(cell, "moving"), session)
    viewer.kill()
    for number, command in enumerate(("pause", "goal", "start", "pause"), 1):
        forged = {"session": state["session"], "number": number, "time": time.time(), "command": command, "goal": [0.0, 0.0, 0.0]}
        (cell.folder / control_name(number)).write_text(json.dumps(forged))
        time.sleep(0.1)
    shutil.rmtree(cell.folder)
    cell.folder.write_text("a file where the folder was")
    time.sleep(0.3)
    cell.folder.unlink()
    output, _ = session.communicate(timeout=PATIENCE_S)
    assert session.returncode == ended, output
    assert policy == "random" or "1 of 1 at the goal" in output
    assert without_wall_times(cell.log) == without_wall_times(alone), "to the last bit of what was seen, decided and sent"
    final = cell.feed.read()
    assert (final.state["doing"], final.state["over"], final.problem) == ("ended", True, "")
    assert final.state["failures"]["count"] > 0, "what could not be written is counted and said"
    assert final.state["control"] is None
    assert final.state["totals"]["episodes"] == 1


@pytest.mark.slow
def test_a_session_that_may_be_steered_waits_obeys_fresh_commands_only_and_stops(cell):
    session = cell.run("episodes=50", "view_control=true", "paused=true")
    state = until(doing(cell, "paused"), session)
    old = {"session": state["session"], "number": 1, "time": time.time() - 10, "command": "start", "goal": None}
    (cell.folder / control_name(1)).write_text(json.dumps(old))
    until(lambda: cell.feed.read().state["control"], session)
    state = cell.feed.read().state
    assert "s old" in state["control"]["refused"] or "older than" in state["control"]["refused"]
    assert (state["doing"], state["driver"]) == ("paused", "not connected"), "nothing was even connected"
    cell.feed.ask("start")
    until(doing(cell, "moving"), session)
    cell.feed.ask("pause")
    paused = until(doing(cell, "paused"), session)
    assert paused["totals"]["transfers"] >= 1, "the transfer that went on was finished"
    goal = [60.0, 20.0, 1.0]
    cell.feed.ask("goal", [900.0, 0.0, 0.0])
    until(lambda: "reaches" in str(cell.feed.read().state["control"]["refused"]), session)
    cell.feed.ask("goal", goal)
    until(lambda: cell.feed.read().state["goal"] == goal, session)
    assert cell.feed.read().state["doing"] == "paused"
    cell.feed.ask("resume")
    until(doing(cell, "moving"), session)
    until(lambda: cell.feed.read().state["phase"] == "transfer", session)
    cell.feed.stop("from a page")
    output, _ = session.communicate(timeout=PATIENCE_S)
    assert session.returncode == 1
    assert "stopped: from a page" in output
    assert cell.feed.latch().obeyed_by() == session.pid
    final = cell.feed.read().state
    assert (final["doing"], final["text"], final["over"]) == ("stopped", "from a page", True)
    log = rows(cell.log)
    kinds = [row["event"] for row in log]
    assert kinds[-1] == "stopped", "nothing was sent after the stop"
    assert kinds.index("paused") < kinds.index("armed"), "no servo was told anything before somebody pressed start"
    for first, last in zip(where(kinds, "paused"), where(kinds, "resumed"), strict=True):
        assert not {"motion", "state", "transfer"} & set(kinds[first:last])
    asked = [(row["command"], row["refused"] is None) for row in log if row["event"] == "control"]
    assert asked == [("start", False), ("start", True), ("pause", True), ("goal", False), ("goal", True), ("resume", True)]
    assert next(row for row in log if row["event"] == "goal_changed")["goal"] == goal
    published = [row["event"] for row in rows(cell.folder / EVENTS_FILE)]
    assert published == [kind for kind in kinds if kind != "state"]
    digest = SessionDigest()
    for row in log:
        digest.take(row)
    assert digest.moved == kinds.count("transfer")
    assert digest.stopped == "from a page"


def test_a_stop_ends_a_pause_before_anything_was_sent(cell, empty_session_registry):
    def stop():
        until(doing(cell, "paused"))
        cell.feed.stop("enough")

    page = threading.Thread(target=stop)
    page.start()
    arguments = [*cell.usual, f"publish={cell.folder}", f"log={cell.log}", "view_control=true", "paused=true"]
    assert main(["run", *arguments]) == 1
    page.join()
    assert (cell.feed.read().state["doing"], cell.feed.read().state["text"]) == ("stopped", "enough")
    assert [row["event"] for row in rows(cell.log)] == ["session", "episode", "paused", "stopped"]


@pytest.mark.slow
def test_how_a_session_broke_off_is_told_and_its_folder_is_its_own(cell, tmp_path):
    session = cell.start(sys.executable, "-c", SLEEPER, str(cell.folder))
    until(lambda: cell.feed.read().live, session)
    with pytest.raises(InvalidSetting, match=f"process {session.pid} publishes there"), Publisher(str(cell.folder)):
        pass
    session.send_signal(signal.SIGINT)
    session.wait(PATIENCE_S)
    told = cell.feed.read().state
    assert (told["doing"], told["text"], told["over"]) == ("stopped", "Ctrl-C in the session's terminal", True)
    session = cell.start(sys.executable, "-c", SLEEPER, str(cell.folder))
    until(lambda: cell.feed.read().live, session)
    session.kill()
    session.wait(PATIENCE_S)
    assert f"process {session.pid} is gone" in cell.feed.read().problem


@pytest.mark.parametrize(
    ("settings", "word"),
    [({"view_control": True}, "publish"), ({"paused": True}, "view_control"), ({"folder": "FILE"}, "can be written")],
)
def test_settings_that_mean_nothing_are_refused(tmp_path, settings, word):
    (tmp_path / "file").write_text("")
    folder = str(tmp_path / "file" / "live") if settings.pop("folder", "") else ""
    with pytest.raises(InvalidSetting, match=word), Publisher(folder, **settings):
        pass


def test_real_time_is_for_the_twin_only(capsys):
    assert main(["run", "hardware=lynxmotion", "real_time=true", "camera.path=/dev/null/cam"]) == 2
    assert "real_time" in capsys.readouterr().err


def test_a_folder_is_for_its_owner_and_starts_anew(tmp_path):
    folder = tmp_path / "new" / "live"
    with Publisher(str(folder)):
        assert folder.stat().st_mode & 0o077 == 0
    state = json.loads((folder / STATE_FILE).read_text())
    assert (state["doing"], state["over"]) == ("ended", True)
    with pytest.raises(RuntimeError, match="boom"), Publisher(str(folder)):
        raise RuntimeError("boom")
    assert TelemetryReader(folder).read().state["text"] == "boom"
