"""``marl-handover stop``: latched for every session until cleared."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from marl_handover.cli import main
from marl_handover.commands.stop_now import at_once
from marl_handover.hardware import session_registry, settings
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.session_registry import SessionRegistry


@pytest.fixture
def own_session_registry(tmp_path, monkeypatch):
    """A session registry that no other test's session is in."""
    for module in (session_registry, settings):
        monkeypatch.setattr(module, "user_path", lambda suffix: tmp_path / f"user{suffix}")
    return SessionRegistry()


def test_stop_is_latched_and_cleared(own_session_registry, tmp_path, capsys):
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


def test_every_session_has_to_obey(own_session_registry, tmp_path, capsys):
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


def test_plain_stop_reaches_sessions_with_stop_files_of_their_own(own_session_registry, tmp_path, capsys):
    lab = StopLatch(tmp_path / "lab" / "stop")
    (tmp_path / "lab").mkdir()
    obeying(lab, 0.0)
    assert main(["stop", "wait_s=20"]) == 0
    assert lab.is_set()
    assert (tmp_path / "user.stop").exists()
    assert f"process {os.getpid()} has stopped its arms" in capsys.readouterr().out
    lab.leave()


def test_a_session_that_was_killed_is_not_waited_for(own_session_registry, tmp_path, capsys):
    own_session_registry.folder.mkdir(mode=0o700)
    (own_session_registry.folder / "4194305-0.json").write_text('{"pid": 4194305, "stop_file": "/tmp/x"}')  # above the kernel's largest pid
    (own_session_registry.folder / "rubbish.json").write_text("{")
    assert main(["stop", f"hardware.stop_file={tmp_path / 'stop'}"]) == 0
    assert main(["stop"]) == 0
    assert not list(own_session_registry.folder.iterdir())


def test_a_stop_file_that_cannot_be_written_is_told_with_what_to_do(own_session_registry, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["stop", f"hardware.stop_file={tmp_path / 'file' / 'stop'}"]) == 1
    assert "CUT THE POWER" in capsys.readouterr().err


@pytest.mark.parametrize(("key", "word"), [("wait_s=-1", "wait_s"), ("hardware.stop_file=here", "absolute")])
def test_bad_keys_are_refused(own_session_registry, tmp_path, capsys, key, word):
    assert main(["stop", key]) == 2
    assert word in capsys.readouterr().err


MEASURED = """
import resource, sys
from marl_handover.hardware import estop
put = estop._put
def noted(path, text):
    put(path, text)
    used = resource.getrusage(resource.RUSAGE_SELF)
    heavy = {"numpy", "hydra", "omegaconf", "numba", "gymnasium", "torch", "scipy", "tqdm", "importlib.metadata"} & set(sys.modules)
    print("latched after", used.ru_utime + used.ru_stime, *sorted(heavy))
estop._put = noted
from marl_handover.cli import main
sys.exit(main(["stop", *sys.argv[1:]]))
"""


def test_the_stop_is_latched_before_anything_heavy_is_imported(tmp_path):
    """Processor time from the very start of Python; a busy computer does not count against it."""
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, f"hardware.stop_file={tmp_path / 'stop'}", "wait_s=0"], capture_output=True, text=True, check=True
    )
    words = done.stdout.splitlines()[0].split()
    assert words[:2] == ["latched", "after"]
    assert words[3:] == []
    assert float(words[2]) <= 0.12


@pytest.mark.parametrize(
    "arguments",
    [
        ["clear=true"],
        ["--help"],
        ["now"],
        ["resaon=x"],
        ["hardware=lynxmotion"],
        ["wait_s=-1"],
        ["reason='x'"],
        ["reason=a\nb"],
        ["clear=no"],
    ],
)
def test_what_has_to_be_read_first_is_not_latched_at_once(own_session_registry, tmp_path, arguments):
    assert at_once(arguments) is None
    assert not (tmp_path / "user.stop").exists()


@pytest.mark.parametrize("arguments", [["now"], ["resaon=x"], ["wait_s=never"], ["reason=x", "hardware.gate=1"]])
def test_what_cannot_be_read_is_refused_and_latches_nothing(own_session_registry, tmp_path, capsys, arguments):
    assert main(["stop", *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "user.stop").exists()


@pytest.mark.parametrize(
    "arguments", [[], ["reason=arm hits = table"], ["reason='quoted'"], ["debug=false", "clear=false"], ["hardware=lynxmotion"]]
)
def test_both_ways_to_the_latch_do_the_same(own_session_registry, tmp_path, capsys, arguments):
    obeying(latch := StopLatch(tmp_path / "lab.stop"), 0.0)
    assert main(["stop", "wait_s=20", *arguments]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[:2] == [f"stop latched in {tmp_path / 'user.stop'}", f"stop latched in {tmp_path / 'lab.stop'}"]
    assert told[2:] == [f"process {os.getpid()} has stopped its arms", "allow motion again: marl-handover stop clear=true"]
    wanted = next((a.partition("=")[2].strip("'") for a in arguments if a.startswith("reason=")), "marl-handover stop")
    assert StopLatch(tmp_path / "user.stop").reason() == wanted
    latch.leave()


def test_clearing_clears_the_twins_stop_too(own_session_registry, tmp_path, capsys):
    twins = StopLatch(settings.HardwareConfig(name="twin").stop_path())
    obeying(twins, 0.0)
    assert main(["stop", "wait_s=20"]) == 0
    twins.leave()
    assert twins.is_set()
    assert main(["stop", "clear=true"]) == 0
    assert list(tmp_path.glob("*.stop")) == []
    assert main(["stop"]) == 0
    assert not twins.is_set(), "no twin runs, so none is stopped"


def test_a_stop_file_of_somebody_else_is_named_when_it_cannot_be_cleared(own_session_registry, tmp_path, capsys):
    (tmp_path / "user.stop").mkdir()
    assert main(["stop", "clear=true"]) == 1
    assert "whoever put it there, or root" in capsys.readouterr().err
    assert main(["stop"]) == 0, "latched by what is there"


SESSION = """
import sys, time
from pathlib import Path
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.session_registry import SessionRegistry
latch = StopLatch(sys.argv[1], SessionRegistry(Path(sys.argv[2])))
latch.join()
print("on", flush=True)
end_s = time.monotonic() + 60
while not latch.is_set() and time.monotonic() < end_s:
    time.sleep(0.002)
latch.obeyed()
print("stopped", latch.reason(), flush=True)
time.sleep(60)
"""


def test_a_session_that_is_suspended_is_named_and_stops_once_it_goes_on(own_session_registry, tmp_path, capsys):
    path = tmp_path / "stop"
    process = subprocess.Popen([sys.executable, "-c", SESSION, path, own_session_registry.folder], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "on\n"
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        assert main(["stop", f"hardware.stop_file={path}", "wait_s=0.1", "reason=frozen"]) == 1
        told = capsys.readouterr().err
        assert f"process {process.pid} did not answer within 0.1 s (it is suspended" in told
        assert "CUT THE POWER" in told
        process.send_signal(signal.SIGCONT)
        assert process.stdout.readline() == "stopped frozen\n"
        assert main(["stop", f"hardware.stop_file={path}", "wait_s=0"]) == 1, "a new stop wants a new answer"
    finally:
        process.kill()
        process.communicate()


ELSEWHERE = 12345
AS_SOMEBODY = """
import contextlib, io, os, sys
from pathlib import Path
from marl_handover import cli
from marl_handover.hardware import estop, session_registry, settings
base = Path(sys.argv[1])
for module in (session_registry, settings, estop):
    module.user_path = lambda suffix: base / f"marl-handover-{os.getuid()}{suffix}"
with contextlib.redirect_stdout(io.StringIO()):
    cli.main(["stop", "--help"])  # imports what this user may read and the other may not
os.setgroups([])
os.setgid(int(sys.argv[2]))
os.setuid(int(sys.argv[2]))
sys.exit(cli.main(["stop", *sys.argv[3:]]))
"""


@pytest.fixture
def somebody():
    """Another user with a process and a session registry; ``stop(*arguments, uid=...)`` as a third user, who may read it or not."""
    if os.getuid() != 0:
        pytest.skip("needs root, to be other users")
    base = Path(tempfile.mkdtemp(prefix="marl-test-"))  # pytest's own folders are closed to others
    base.chmod(0o1777)
    process = subprocess.Popen(["python-that-sleeps", "60"], executable=shutil.which("sleep"), user=ELSEWHERE)
    folder = base / f"marl-handover-{ELSEWHERE}.sessions"
    folder.mkdir()
    entry = folder / f"{process.pid}-0.json"
    entry.write_text(json.dumps({"pid": process.pid, "stop_file": str(base / "theirs.stop")}))
    for path in (folder, entry):
        os.chown(path, ELSEWHERE, ELSEWHERE)

    def stop(*arguments, uid=ELSEWHERE + 1):
        command = [sys.executable, "-c", AS_SOMEBODY, base, str(uid), "wait_s=0", *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    yield SimpleNamespace(process=process, folder=folder, entry=entry, base=base, stop=stop)
    process.kill()
    process.wait()
    shutil.rmtree(base)


def test_a_session_of_another_user_is_no_success(somebody):
    done = somebody.stop()
    assert done.returncode == 1
    assert f"process {somebody.process.pid} of user {ELSEWHERE} runs a session" in done.stderr
    assert "CUT THE POWER" in done.stderr
    assert "no session runs" not in done.stdout
    assert (somebody.base / f"marl-handover-{ELSEWHERE + 1}.stop").exists(), "whoever typed it is stopped all the same"
    assert not (somebody.base / "theirs.stop").exists()


def test_a_roll_that_cannot_be_read_is_told_as_long_as_its_user_has_a_process(somebody):
    somebody.folder.chmod(0o700)
    done = somebody.stop()
    assert done.returncode == 1
    assert f"user {ELSEWHERE} may be running a session" in done.stderr
    somebody.process.kill()
    somebody.process.wait()
    done = somebody.stop()
    assert (done.returncode, done.stderr) == (0, "")
    assert "no session runs" in done.stdout


def test_what_another_user_says_is_believed_only_of_their_own_processes(somebody):
    somebody.entry.write_text(json.dumps({"pid": os.getpid(), "stop_file": "/x"}))
    os.mkfifo(somebody.folder / "0-0.json")
    (somebody.folder / "1-0.json").write_text("[" * 10_000)
    done = somebody.stop()
    assert (done.returncode, done.stderr) == (0, "")


def test_a_stop_file_that_users_share_stops_sessions_of_all(somebody):
    shared = somebody.base / "theirs.stop"
    done = somebody.stop(f"hardware.stop_file={shared}")
    assert done.returncode == 1
    assert f"process {somebody.process.pid} of user {ELSEWHERE} did not answer" in done.stderr
    assert shared.exists()
