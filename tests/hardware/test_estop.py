"""A stop that another process can set, and who has to obey it."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from marl_handover.errors import InvalidSetting
from marl_handover.hardware import estop
from marl_handover.hardware.estop import NotCleared, PrivateStop, StopLatch
from marl_handover.hardware.session_registry import RegistryUnusable, SessionRegistry
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
    code = f"from marl_handover.hardware.estop import StopLatch; StopLatch({str(tmp_path / 'stop')!r}).latch('typed stop')"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    assert latch.reason() == "typed stop"


def test_when_in_doubt_it_is_a_stop(tmp_path):
    (tmp_path / "stop").write_text("rubbish")
    assert StopLatch(tmp_path / "stop").is_set()
    assert StopLatch(tmp_path / "stop").reason() == "stop file present"
    assert StopLatch(tmp_path / "stop" / "below").is_set(), "a folder that cannot be looked into"
    assert StopLatch("x" * 5000).is_set()


def test_a_stop_says_whether_everybody_obeyed(tmp_path):
    registry = SessionRegistry(tmp_path / "sessions")
    button, one, two = (StopLatch(tmp_path / "stop", registry) for _ in range(3))
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


def test_a_session_is_in_the_registry_of_its_own_stop_file_only(tmp_path):
    registry = SessionRegistry(tmp_path / "sessions")
    latch = StopLatch(tmp_path / "stop", registry)
    latch.join()
    latch.join()
    assert [(it.pid, it.stop_file, it.obeyed) for it in registry.registered()] == [(os.getpid(), tmp_path / "stop", False)]
    assert registry.registered(tmp_path / "other") == []
    latch.leave()
    assert registry.registered() == []
    assert list(registry.folder.iterdir()) == []


def test_the_roll_of_a_process_that_was_killed_is_empty(tmp_path):
    folder = tmp_path / "sessions"
    code = f"""
import os, signal
from pathlib import Path
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.session_registry import SessionRegistry
latch = StopLatch("/tmp/nothing", SessionRegistry(Path({str(folder)!r})))
latch.join()
assert len(latch.registry.registered()) == 1
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == -9
    assert len(list(folder.iterdir())) == 1
    assert SessionRegistry(folder).registered() == []


def test_nothing_runs_without_a_roll(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RegistryUnusable, match="cannot sign up"):
        StopLatch(tmp_path / "stop", SessionRegistry(tmp_path / "file")).join()


def test_a_driver_is_in_the_registry_as_long_as_it_holds_its_ports(rig):
    made = rig()
    names = [entry.entry for entry in made.latch.registry.registered(made.latch.path)]
    assert names == []
    made.driver.connect()
    assert [entry.pid for entry in made.latch.registry.registered(made.latch.path)] == [os.getpid()]
    made.driver.disconnect()
    assert made.latch.registry.registered(made.latch.path) == []


def test_every_session_of_a_user_looks_at_the_same_file(monkeypatch, tmp_path):
    before = HardwareConfig().stop_path()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert HardwareConfig().stop_path() == before
    assert HardwareConfig(stop_file="/srv/stop").stop_path() == "/srv/stop"
    assert HardwareConfig(name="twin").stop_path() != before, "the twin's is another"
    with pytest.raises(InvalidSetting, match="absolute"):
        HardwareConfig(stop_file="mine").validate()


def test_what_somebody_else_put_there_stops_and_is_not_read(tmp_path, monkeypatch):
    """In /tmp anybody may: a FIFO would be waited for, a large file read, escape codes carried out by a terminal."""
    latch, uid = StopLatch(tmp_path / "stop"), os.getuid()
    os.mkfifo(latch.path)
    assert latch.is_set()
    assert latch.reason() == "stop file present"
    latch.path.unlink()
    latch.path.write_text(json.dumps({"reason": "x" * 100_000}))
    assert latch.reason() == "stop file present"
    latch.path.write_text("[" * 50_000)
    assert latch.reason() == "stop file present"
    (tmp_path / "real").write_text('{"reason": "mine"}')
    latch.path.unlink()
    latch.path.symlink_to(tmp_path / "real")
    assert latch.reason() == "stop file present"
    latch.path.unlink()
    latch.path.symlink_to(tmp_path / "nowhere")
    assert latch.is_set(), "whatever it leads to"
    latch.path.unlink()
    latch.path.write_text('{"reason": "theirs"}')
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    monkeypatch.setattr(os, "geteuid", lambda: uid + 1)
    assert latch.reason().startswith("stop file present, put there by ")


@pytest.mark.parametrize("reason", ["\x1b[2J\x1b]0;owned\x07", "two\nlines", "\u202egnihton", "x" * 5000, "\x9b31m"])
def test_no_reason_does_anything_to_a_terminal(tmp_path, reason):
    latch = StopLatch(tmp_path / "stop")
    latch.path.write_text(json.dumps({"reason": reason}))
    assert latch.reason().isprintable()
    assert len(latch.reason()) <= 200
    latch.latch(reason)
    assert latch.reason().isprintable()
    assert StopLatch(latch.path).reason() == latch.reason()


def test_pipes_in_the_way_are_neither_waited_for_nor_written_to(tmp_path):
    latch = StopLatch(tmp_path / "stop")
    for name in ("stop", "stop.obeyed"):
        os.mkfifo(tmp_path / name)
    latch.obeyed()
    assert latch.obeyed_by() == os.getpid()
    (tmp_path / "stop.obeyed").unlink()
    os.mkfifo(tmp_path / "stop.obeyed")
    assert latch.obeyed_by() is None
    latch.latch("now")
    assert StopLatch(latch.path).is_set()
    assert latch.path.is_fifo()
    latch.clear()
    victim = tmp_path / "victim"
    victim.write_text("mine")
    latch.path.symlink_to(victim)
    latch.latch("again")
    assert victim.read_text() == "mine"
    latch.clear()
    assert not latch.is_set()
    assert victim.exists()


@pytest.mark.parametrize("path", ["/dev/null", "/dev/full", "/", "/dev"])
def test_devices_and_folders_are_left_alone(path):
    before = os.lstat(path)
    latch = StopLatch(path)
    latch.latch("now")
    latch.obeyed()
    with pytest.raises(NotCleared):
        latch.clear()
    assert os.lstat(path).st_ino == before.st_ino
    Path(f"{path}.obeyed").unlink(missing_ok=True)


def test_a_stop_that_cannot_be_replaced_is_latched_all_the_same(tmp_path):
    latch = StopLatch(tmp_path / "stop")
    latch.path.mkdir()
    (latch.path / "full").write_text("")
    latch.latch("now")
    assert StopLatch(latch.path).is_set()
    with pytest.raises(NotCleared, match="whoever put it there, or root"):
        latch.clear()
    assert latch.is_set()


def test_a_roll_that_somebody_else_laid_out_is_not_used(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "sessions").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RegistryUnusable, match="not a folder"):
        SessionRegistry(tmp_path / "sessions").register(tmp_path / "stop")
    registry = SessionRegistry(tmp_path / "theirs")
    registry.folder.mkdir()
    os.mkfifo(registry.folder / "1-0.json")
    uid = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    assert registry.registered() == []
    with pytest.raises(RegistryUnusable, match="somebody else"):
        registry.register(tmp_path / "stop")


@pytest.mark.parametrize(
    "entry", ['{"pid": 0, "stop_file": "/x"}', '{"pid": -1, "stop_file": "/x"}', '{"pid": 1e400}', "[" * 9999, "[]", "7", "x" * 20_000]
)
def test_entries_that_are_none_count_for_nothing(tmp_path, entry):
    registry = SessionRegistry(tmp_path / "sessions")
    registry.folder.mkdir()
    (registry.folder / "1-0.json").write_text(entry)
    assert registry.registered() == []


def test_another_process_with_the_number_of_one_that_was_killed_is_not_taken_for_it(tmp_path):
    registry = SessionRegistry(tmp_path / "sessions")
    entry = registry.register(tmp_path / "stop")
    about = json.loads(entry.read_text())
    entry.write_text(json.dumps(about | {"started": "1"}))
    assert registry.registered() == []


def test_a_process_that_is_over_but_not_yet_buried_is_not_waited_for(tmp_path):
    registry = SessionRegistry(tmp_path / "sessions")
    registry.folder.mkdir()
    process = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    (registry.folder / "1-0.json").write_text(json.dumps({"pid": process.pid, "stop_file": "/x"}))
    assert registry.registered() == []
    process.wait()


def test_sessions_of_others_are_seen(tmp_path, monkeypatch):
    """As whoever has another number sees this user's."""
    uid = os.getuid()
    registry = SessionRegistry(tmp_path / f"marl-handover-{uid}.sessions")
    registry.register(tmp_path / "stop")
    assert stat.S_IMODE(registry.folder.stat().st_mode) == 0o755
    (tmp_path / f"marl-handover-{uid + 7}.sessions").mkdir()  # not of whom it says
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    other = SessionRegistry(tmp_path / f"marl-handover-{uid + 1}.sessions")
    assert [(it.pid, it.stop_file) for it in other.others()] == [(os.getpid(), tmp_path / "stop")]
    assert other.others()[0].owner

    scan = os.scandir

    def closed(folder):
        if folder == registry.folder:
            raise PermissionError(13, "closed")
        return scan(folder)

    monkeypatch.setattr(os, "scandir", closed)
    (unknown,) = other.others()
    assert unknown.stop_file is None
    assert unknown.pid > 0


def test_a_private_stop_concerns_nobody_else(tmp_path, monkeypatch):
    monkeypatch.setattr(estop, "user_path", lambda suffix: tmp_path / f"user{suffix}")
    one, two = PrivateStop(), PrivateStop()
    one.join()
    assert not one.is_set()
    one.latch("enough")
    assert one.reason() == "enough"
    assert not two.is_set()
    StopLatch(two.path).latch("a page that shows it")
    assert two.is_set()
    two.obeyed()
    for stop in (one, two):
        stop.leave()
    assert list(tmp_path.iterdir()) == []
