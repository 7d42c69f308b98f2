"""Showing a session to whoever looks into a folder: a state file, the newest picture, the events.

    with Publisher("runs/live") as publisher, make_loop(...) as loop:
        publisher.attach(loop)
        session = Session(loop, about, publisher.desk)

A thread of its own does all the writing, from what the session's thread leaves in passing: a few attributes and a queue. Nothing that
happens to the folder or to its readers reaches the session. Files are replaced as a whole, so that a reader never sees half of one.
"""

from __future__ import annotations

import json
import os
import threading
import time
import uuid
from collections import deque
from contextlib import closing
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import InvalidSetting
from marl_handover.files import GrowingFile, write_whole
from marl_handover.hardware.errors import Stopped
from marl_handover.perception.camera import Frame
from marl_handover.perception.overlay import annotated, jpeg
from marl_handover.perception.tracker import Seen
from marl_handover.runtime.events import Event
from marl_handover.runtime.feed import EVENTS_FILE, FORMAT, PICTURE_FILE, STATE_FILE, VERSION, Feed, require_own
from marl_handover.runtime.steering import ControlFolder, Desk

if TYPE_CHECKING:
    from marl_handover.runtime.loop import ClosedLoop
    from marl_handover.runtime.portrait import Portrait

PERIOD_S = 0.04
"""Between two state files, in wall time."""

PICTURE_S = 0.2
"""Between two pictures."""

_UNCHANGED_S = 0.25
_JOIN_S = 1.0
_ROWS = 10_000


class Publisher:
    """Shows a session in a folder, and takes wishes from it if that is allowed. A context manager; it should outlive the loop.

    Args:
        folder: where; made if it is missing. Empty: nothing is shown.
        view_control: whether requests that are laid into it are obeyed.
        paused: whether nothing moves before somebody says so.
        log_path: of the session's own log, to be named to readers.

    Raises:
        InvalidSetting: the folder cannot be used, or another session is using it; ``paused`` without anybody who could start.
    """

    def __init__(self, folder: str, *, view_control: bool = False, paused: bool = False, log_path: str = "") -> None:
        if view_control and not folder:
            raise InvalidSetting("view_control", view_control, "false without publish=FOLDER")
        if paused and not view_control:
            raise InvalidSetting("paused", paused, "false without view_control=true: nobody could start the session")
        self.folder = Path(folder).absolute() if folder else None
        self.desk = Desk(paused)
        self.failures, self.last_failure = 0, ""
        """How often something could not be written, and why it could not the last time."""
        self._fixed = {
            "format": FORMAT,
            "version": VERSION,
            "session": uuid.uuid4().hex,
            "pid": os.getpid(),
            "host": os.uname().nodename,
            "view_control": view_control,
            "log": str(Path(log_path).absolute()) if log_path else "",
            "events": EVENTS_FILE,
        }
        self._rows: deque[dict[str, Any]] = deque(maxlen=_ROWS)
        self._frame: tuple[Frame, Seen] | None = None
        self._lively_s = time.monotonic()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._portrait: Portrait | None = None
        self._control: ControlFolder | None = None
        self._number = self._pictures = self._picture_frame = 0
        self._answer: dict[str, Any] | None = None
        self._picture_s = self._written_s = -1e9
        self._pictured_s: float | None = None
        self._written: dict[str, Any] = {}
        self._end: tuple[str, str] | None = None

    def __enter__(self) -> Self:
        if self.folder is not None:
            self._prepare(self.folder)
            self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Write how it ended; wait for that no longer than a second."""
        self._end = _ending(error)
        self._over.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)

    def attach(self, loop: ClosedLoop) -> None:
        """Show what ``loop``, around a :class:`HardwareBackend`, does from now on."""
        # Imported here, with what a loop needs, so that a session is seen to start while that takes its time.
        from marl_handover.runtime.hardware_backend import HardwareBackend
        from marl_handover.runtime.portrait import Portrait

        backend, cell = loop.backend, loop.rules.cell
        if self.folder is None or not isinstance(backend, HardwareBackend):
            return

        def unreachable(goal: NDArray[np.float64]) -> str | None:
            return None if cell.reaches(goal[:2]).any() else "no arm reaches that goal"

        if self._fixed["view_control"]:
            self._control = ControlFolder(self.folder, str(self._fixed["session"]), unreachable)
        self._portrait = Portrait(loop, backend, self.desk)
        backend.log.show(self._take_row)
        backend.lab.watcher.shown = self._take_picture

    def _take_row(self, row: dict[str, Any]) -> None:
        """In the session's thread."""
        self._lively_s = time.monotonic()
        self._rows.append(row)

    def _take_picture(self, frame: Frame, seen: Seen) -> None:
        """In the session's thread."""
        self._lively_s = time.monotonic()
        self._frame = (frame, seen)

    def _prepare(self, folder: Path) -> None:
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            require_own(folder)
            other = Feed(folder).read()
            if other.live and other.state is not None and other.state["pid"] != os.getpid():
                raise InvalidSetting("publish", str(folder), f"a folder of its own; process {other.state['pid']} publishes there")
            for name in (STATE_FILE, PICTURE_FILE, EVENTS_FILE):
                (folder / name).unlink(missing_ok=True)
            _replace(folder / EVENTS_FILE, "")
        except OSError as error:
            raise InvalidSetting("publish", str(folder), f"a folder that can be written ({error.strerror or error})") from error

    def _run(self) -> None:
        while not self._over.wait(PERIOD_S):
            self._publish()
        self._publish(last=True)

    def _publish(self, last: bool = False) -> None:
        """One round. Whatever goes wrong is counted: this thread has to go on, and nobody else is to hear of it."""
        folder = self.folder
        assert folder is not None
        parts = (
            lambda: folder.mkdir(mode=0o700, exist_ok=True),  # somebody may have thrown it away
            self._take_wishes,
            lambda: self._write_events(folder),
            lambda: self._write_picture(folder, last),
            lambda: self._write_state(folder, last),
        )
        for part in parts:
            try:
                part()
            except Exception as error:
                self.failures += 1
                self.last_failure = f"{type(error).__name__}: {error}"

    def _take_wishes(self) -> None:
        answer = None if self._control is None else self._control.poll()
        if answer is not None:
            self.desk.take(answer)
            self._answer = answer._asdict()

    def _write_events(self, folder: Path) -> None:
        rows = [self._rows.popleft() for _ in range(len(self._rows))]
        if self._portrait is not None:
            self._portrait.take(rows)
        lines = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows if row["event"] != Event.STATE)
        if lines:
            with closing(GrowingFile(folder / EVENTS_FILE)) as file:
                file.write(lines)

    def _write_picture(self, folder: Path, last: bool) -> None:
        now_s, portrait = time.monotonic(), self._portrait
        if portrait is None or self._frame is None or (now_s < self._picture_s + PICTURE_S and not last):
            return
        frame, seen = self._frame
        if (newest := portrait.backend.lab.camera.newest()) is not None and newest.number > frame.number:
            frame = newest
        if frame.number == self._picture_frame:
            return
        self._picture_s, self._picture_frame, self._pictured_s = now_s, frame.number, frame.t_s
        lab = portrait.backend.lab
        picture = annotated(frame.image, lab.watcher.tracker.detector.calibration, portrait.marks(frame, seen))
        _replace(folder / PICTURE_FILE, jpeg(picture))
        self._pictures += 1

    def _write_state(self, folder: Path, last: bool) -> None:
        now_s = time.monotonic()
        shown = {**self._fixed, "picture": self._pictures, "control": self._answer}
        shown["failures"] = {"count": self.failures, "last": self.last_failure}
        seen = None if self._frame is None else self._frame[1]
        moment: dict[str, Any] = {}
        if self._portrait is not None:
            shown |= self._portrait.state(seen)
            moment = self._portrait.moment(self._pictured_s)
        else:
            shown |= {"doing": "starting", "text": ""}
        if last and self._end is not None:
            shown["doing"], shown["text"] = self._end
        if shown == self._written and now_s < self._written_s + _UNCHANGED_S and not last:
            return
        self._number += 1
        about = {"number": self._number, "time": time.time(), "quiet_s": round(now_s - self._lively_s, 2), "over": last}
        _replace(folder / STATE_FILE, json.dumps({**shown, **moment, **about}, allow_nan=False))
        self._written, self._written_s = shown, now_s


def _ending(error: BaseException | None) -> tuple[str, str]:
    """How a session ended, in a word and in a text."""
    if error is None:
        return "ended", ""
    if isinstance(error, Stopped):
        return "stopped", error.reason
    if isinstance(error, KeyboardInterrupt):
        return "stopped", "Ctrl-C in the session's terminal"
    return "failed", str(error) or type(error).__name__


def _replace(path: Path, content: str | bytes) -> None:
    """Write a file as a whole. Not flushed to the disk, as files are that have to outlive a loss of power: these tell of now."""
    write_whole(path, content, durable=False)
