"""Reading what a :class:`~marl_handover.control.telemetry.Publisher` writes, and asking for things, from another process."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marl_handover.control.remote_control import SessionCommand, control_name
from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile, WorkFailed
from marl_handover.files import open_bounded, read_bounded, write_whole
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.session_registry import SessionRecord, SessionRegistry
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.parsing import parse_json
from marl_handover.perception.calibration import Pixels
from marl_handover.perception.overlay import decoded

STATE_FILE, PICTURE_FILE, EVENTS_FILE = "state.json", "picture.jpg", "events.jsonl"
FORMAT, VERSION = "marl-handover live", 1

SILENT_S = 2.0
"""No news for longer than this is said."""

_TAIL_BYTES = 65536
_STATE_BYTES, _PICTURE_BYTES, _EVENTS_BYTES, _LATCH_BYTES = 1_000_000, 8_000_000, 10**12, 100_000
_LARGEST = 1e15
"""No number in a folder is larger; infinity is, and what is not a number is not smaller."""


class NotSteerable(WorkFailed):
    """A session was asked for something that it does not take from a page."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"the session cannot be asked: {reason}")


class Reading(NamedTuple):
    """What the folder says.

    ``state``: the newest one there was, also from before something went wrong; None: never any. ``live``: whether the session goes on and
    is heard of. ``problem``: what is wrong, for people; empty if nothing is. ``age_s``: of the state.
    """

    state: dict[str, Any] | None
    live: bool
    problem: str
    age_s: float


class TelemetryReader:
    """A folder that a session publishes in. Nothing that is in there, or not, makes reading raise.

    Args:
        folder: it may come later, and go.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._state: dict[str, Any] | None = None
        self._picture: tuple[int, int] | None = None
        self._events_of, self._offset = "", 0
        self._number, self._asking = 0, threading.Lock()

    def read(self) -> Reading:
        """The newest state."""
        trouble = ""
        try:
            require_own(self.folder)
            content = read_bounded(self.folder / STATE_FILE, _STATE_BYTES, "state file", own=True)
            self._state = _checked(_loaded(content), self.folder / STATE_FILE)
        except (FileNotFoundError, MissingFile):
            trouble = f"{self.folder} holds no session yet" if self._state is None else f"{self.folder} was emptied or taken away"
        except (OSError, ValueError, CorruptFile) as error:
            trouble = str(error) if isinstance(error, CorruptFile) else f"the state file cannot be read: {error}"
        state = self._state
        if state is None:
            return Reading(None, False, trouble, 0.0)
        since_s = time.time() - state["time"]
        age_s = max(since_s, 0.0)
        if state["over"]:
            return Reading(state, False, "", age_s)
        if _gone(state):
            return Reading(
                state, False, f"process {state['pid']} is gone: the session broke off, its arms hold where they were sent", age_s
            )
        if age_s > SILENT_S:
            return Reading(state, False, f"no news for {age_s:.0f} s{'; ' if trouble else ''}{trouble}", age_s)
        if since_s < -SILENT_S:
            return Reading(state, False, f"the state is from {-since_s:.0f} s in the future: compare the clocks", age_s)
        return Reading(state, True, trouble, age_s)

    def picture(self) -> Pixels | None:
        """The newest picture, RGB (height, width, 3); None if there is none that was not given already, or it cannot be read."""
        path = self.folder / PICTURE_FILE
        try:
            found = path.stat()
            mark = (found.st_mtime_ns, found.st_ino)
            if mark == self._picture:
                return None
            image = np.ascontiguousarray(decoded(read_bounded(path, _PICTURE_BYTES, "picture", own=True), path)[..., ::-1])
        except (OSError, CorruptFile, MissingFile):
            return None
        self._picture = mark
        return image

    def events(self) -> list[dict[str, Any]]:
        """The events that came since the last call, oldest first; of a long log, the end. A line that is none says so."""
        session = "" if self._state is None else str(self._state["session"])
        path = self.folder / EVENTS_FILE
        try:
            with open_bounded(path, _EVENTS_BYTES, "events", own=True) as stream:
                size = os.fstat(stream.fileno()).st_size
                if session != self._events_of or size < self._offset:
                    self._events_of, self._offset = session, max(0, size - _TAIL_BYTES)
                stream.seek(self._offset)
                content = stream.read(_TAIL_BYTES)
        except (OSError, CorruptFile, MissingFile):
            return []
        whole = content[: content.rfind(b"\n") + 1] or (content if len(content) == _TAIL_BYTES else b"")
        inside = self._offset > 0 and self._offset == size - _TAIL_BYTES
        self._offset += len(whole)
        return [_row(line) for line in whole.splitlines()[1 if inside else 0 :] if line.strip()]

    def ask(self, command: str, goal: list[float] | None = None) -> int:
        """Ask the session to start, pause, resume, or take another ``goal`` (x_mm, y_mm, theta_rad); the number of the request.

        The state's ``control`` tells what came of it.

        Raises:
            NotSteerable: there is no session, or it takes nothing from pages, or the folder cannot be written.
            InvalidSetting: there is no such command.
        """
        if command not in list(SessionCommand):
            raise InvalidSetting("command", command, f"one of: {', '.join(SessionCommand)}")
        reading = self.read()
        if reading.state is None or not reading.live:
            raise NotSteerable(reading.problem or "it is over")
        if not reading.state["view_control"]:
            raise NotSteerable("it was started without view_control=true; it can only be stopped")
        with self._asking:
            number = self._number = max(self._number + 1, time.time_ns() // 1_000_000)
        asked = {"session": reading.state["session"], "number": number, "time": time.time(), "command": command, "goal": goal}
        try:
            write_whole(self.folder / control_name(number), json.dumps(asked))
        except OSError as error:
            raise NotSteerable(f"{error.strerror or error}") from error
        return number

    def latch(self) -> StopLatch:
        """The stop of this session; before any state was read, the usual one. What the session signed up with is believed first."""
        return StopLatch(str(self._stop_files()[0]))

    def _stop_files(self) -> list[Path]:
        """The stop files that this session may look at, the likeliest first.

        A process can hold several sessions, and one that has not connected yet has not signed up: its state alone names its file then.
        """
        signed = [session.stop_file for session in self._signed() if session.stop_file is not None]
        told = Path(str((self._state or {}).get("stop_file") or HardwareConfig().stop_path()))
        return [told] if told in signed else [*signed, told]

    def _signed(self) -> list[SessionRecord]:
        """The sessions of the state's process as they are on this user's registry."""
        state = self._state
        if state is None or not _here(state):
            return []
        return [session for session in SessionRegistry().registered() if session.pid == state["pid"]]

    def stop(self, reason: str) -> str:
        """Latch the stop: allowed whatever ``view_control`` says. What was done, for people.

        A file that is no stop file is not replaced, whatever the state says. If the latch cannot be written, the session's process is
        interrupted, which stops every channel too; but only one that has signed up on this computer.
        """
        reading, latched, failed = self.read(), [], ""
        for path in self._stop_files():
            trouble = _not_a_latch(path)
            if not trouble:
                try:
                    StopLatch(path).latch(reason)
                    latched.append(str(path))
                except OSError as error:
                    trouble = f"the stop file {path} cannot be written ({error.strerror or error})"
            failed = failed or trouble
        if latched and not failed:
            return f"stop latched in {' and '.join(latched)}"
        signed = self._signed()
        if reading.live and signed:
            with contextlib.suppress(OSError, OverflowError):
                os.kill(signed[0].pid, signal.SIGINT)
                return f"{failed}; interrupted process {signed[0].pid} instead"
        return f"stop latched in {' and '.join(latched)}; {failed}" if latched else f"{failed}: CUT THE POWER"


def require_own(folder: Path) -> None:
    """See that a session's folder belongs to this user: others could write anything into theirs.

    Raises:
        CorruptFile: it does not.
        FileNotFoundError: it is not there.
    """
    owner = os.stat(folder).st_uid
    if owner != os.geteuid():
        raise CorruptFile("session folder", folder, f"it belongs to another user ({owner}); look into it as that user")


def _not_a_latch(path: Path) -> str:
    """What is wrong with the place of a stop file; empty if there is none yet, one without a word, or one that a newer one may replace."""
    try:
        content = _loaded(read_bounded(path, _LATCH_BYTES, "stop file") or b'{"reason": ""}')
    except MissingFile:
        return ""
    except (CorruptFile, ValueError, RecursionError):
        content = None
    return "" if isinstance(content, dict) and "reason" in content else f"{path} is no stop file, and was not replaced by one"


def _checked(content: Any, path: Path) -> dict[str, Any]:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CorruptFile("state file", path, "no session wrote it")
    if content.get("version") != VERSION:
        raise CorruptFile("state file", path, f"it has version {content.get('version')}, this package reads {VERSION}")
    kinds = {"session": str, "pid": int, "time": int | float, "over": bool, "view_control": bool, "doing": str, "text": str}
    for name, kind in kinds.items():
        value = content.get(name)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise CorruptFile("state file", path, f"its {name} is {value!r}")
    if content["pid"] < 1:  # others mean groups of processes
        raise CorruptFile("state file", path, f"its pid is {content['pid']}")
    stop_file = content.get("stop_file", "")
    if not isinstance(stop_file, str) or "\0" in stop_file or not (stop_file == "" or os.path.isabs(stop_file)):
        raise CorruptFile("state file", path, f"its stop_file is {stop_file!r}")
    return content


def _loaded(content: bytes) -> Any:
    """JSON without numbers that nobody can reckon with. Raises ValueError."""
    return parse_json(content, largest=_LARGEST)


def _here(state: dict[str, Any]) -> bool:
    """Whether the session's process is one of this computer."""
    return bool(state.get("host") == os.uname().nodename)


def _gone(state: dict[str, Any]) -> bool:
    """Whether the session's process is known not to run any more."""
    if not _here(state):
        return False
    try:
        os.kill(state["pid"], 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False


def _row(line: bytes) -> dict[str, Any]:
    try:
        row = _loaded(line)
    except ValueError:
        row = None
    return row if isinstance(row, dict) and "event" in row else {"t_s": None, "event": "a damaged line"}
