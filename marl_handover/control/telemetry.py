"""Showing a session to whoever looks into a folder: a state file, the newest picture, the events.

    with Publisher("runs/live") as publisher, make_loop(...) as loop:
        publisher.attach(loop)
        session = Session(loop, about, publisher.desk)

A thread of its own does all the writing, from what the session's thread leaves in passing: a few attributes and a queue. Nothing that
happens to the folder or to its readers reaches the session. Files are replaced as a whole, so that a reader never sees half of one.
"""

from __future__ import annotations

import json
import math
import os
import threading
import time
import uuid
from collections import deque
from collections.abc import Iterable
from contextlib import closing
from copy import deepcopy
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.control.events import Event, SessionDigest
from marl_handover.control.remote_control import CommandQueue, ControlFolder
from marl_handover.control.telemetry_reader import EVENTS_FILE, FORMAT, PICTURE_FILE, STATE_FILE, VERSION, TelemetryReader, require_own
from marl_handover.control.transfers import Placement, rollout
from marl_handover.errors import HandoverError, InvalidSetting
from marl_handover.files import GrowingFile, write_whole
from marl_handover.hardware.errors import Stopped
from marl_handover.motion.trajectory import LOADED_PHASES
from marl_handover.palette import FAINT, PAPER, YELLOW
from marl_handover.perception.camera import Frame
from marl_handover.perception.overlay import Mark, annotated, jpeg
from marl_handover.perception.tracker import Believed, Seen

if TYPE_CHECKING:
    from marl_handover.control.closed_loop import ClosedLoop
    from marl_handover.control.hardware_backend import HardwareBackend

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
        self.command_queue = CommandQueue(paused)
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
        self._session_state: SessionState | None = None
        self._control: ControlFolder | None = None
        self._number = self._pictures = self._picture_frame = 0
        self._response: dict[str, Any] | None = None
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
        from marl_handover.control.hardware_backend import HardwareBackend

        backend, cell = loop.backend, loop.rules.cell
        if self.folder is None or not isinstance(backend, HardwareBackend):
            return

        def unreachable(goal: NDArray[np.float64]) -> str | None:
            return None if cell.reaches(goal[:2]).any() else "no arm reaches that goal"

        if self._fixed["view_control"]:
            self._control = ControlFolder(self.folder, str(self._fixed["session"]), unreachable)
        self._session_state = SessionState(loop, backend, self.command_queue)
        backend.log.show(self._take_row)
        backend.workcell.pose_monitor.shown = self._take_picture

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
            other = TelemetryReader(folder).read()
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
        response = None if self._control is None else self._control.poll()
        if response is not None:
            self.command_queue.take(response)
            self._response = response._asdict()

    def _write_events(self, folder: Path) -> None:
        rows = [self._rows.popleft() for _ in range(len(self._rows))]
        if self._session_state is not None:
            self._session_state.take(rows)
        lines = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows if row["event"] != Event.STATE)
        if lines:
            with closing(GrowingFile(folder / EVENTS_FILE)) as file:
                file.write(lines)

    def _write_picture(self, folder: Path, last: bool) -> None:
        now_s, session_state = time.monotonic(), self._session_state
        if session_state is None or self._frame is None or (now_s < self._picture_s + PICTURE_S and not last):
            return
        frame, seen = self._frame
        if (newest := session_state.backend.workcell.camera.newest()) is not None and newest.number > frame.number:
            frame = newest
        if frame.number == self._picture_frame:
            return
        self._picture_s, self._picture_frame, self._pictured_s = now_s, frame.number, frame.t_s
        workcell = session_state.backend.workcell
        picture = annotated(frame.image, workcell.pose_monitor.tracker.detector.calibration, session_state.marks(frame, seen))
        _replace(folder / PICTURE_FILE, jpeg(picture))
        self._pictures += 1

    def _write_state(self, folder: Path, last: bool) -> None:
        now_s = time.monotonic()
        shown = {**self._fixed, "picture": self._pictures, "control": self._response}
        shown["failures"] = {"count": self.failures, "last": self.last_failure}
        seen = None if self._frame is None else self._frame[1]
        moment: dict[str, Any] = {}
        if self._session_state is not None:
            shown |= self._session_state.state(seen)
            moment = self._session_state.moment(self._pictured_s)
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


_JOINT_DIGITS, _SEEN_DIGITS = 4, 3


class SessionState:
    """Puts the state together.

    Args:
        loop: the session's.
        backend: the loop's.
        command_queue: where wishes lie.
    """

    def __init__(self, loop: ClosedLoop, backend: HardwareBackend, command_queue: CommandQueue) -> None:
        self.digest, self.backend, self._desk = SessionDigest(loop.rules.cell.labels), backend, command_queue
        self._policy, self._whole = deepcopy(loop.policy), loop.rules.cell
        """Of its own: asking the session's would change what one that draws lots does next."""
        self._reach_slack_mm = loop.settings.reach_slack_mm
        self._about: dict[str, Any] = {"architecture": loop.rules.config.architecture}
        self._armed = False
        self._planned_for: Any = None
        self._plan: list[Placement] = []

    def take(self, rows: Iterable[dict[str, Any]]) -> None:
        """Take in events."""
        for row in rows:
            if row["event"] == "session":
                self._about |= {name: value for name, value in row.items() if name not in ("t_s", "event")}
            self._armed = self._armed or row["event"] == "armed"
            if row["event"] == "motion":
                self._roll_out()
            self.digest.take(row)

    def state(self, seen: Seen | None) -> dict[str, Any]:
        """What does not change while nothing happens; ``seen``: the newest sighting."""
        digest, driver = self.digest, self.backend.workcell.driver
        phase = digest.phase(self.backend.player.reached_s)
        self._roll_out()
        return {
            **self._about,
            "doing": "stopped" if digest.stopped else digest.doing,
            "text": digest.stopped or digest.text,
            "pausing": self._desk.paused,
            "driver": str(driver.state),
            "armed": self._armed,
            "arms": self._arms(phase),
            "phase": phase,
            "block": _block(digest.pose, seen),
            "goal": None if (goal := self.goal()) is None else goal.tolist(),
            "camera": {"seen": seen is not None, "frozen": seen is not None and seen.frozen},
            "plan": [{"pose": step.pose.round(2).tolist(), "arm": step.arm, "final": step.final} for step in self._plan],
            "episode": {"number": digest.episode, "transfers": digest.transfers},
            "totals": {"episodes": digest.ended, "solved": digest.solved, "transfers": digest.moved},
            "faults": {str(event): count for event, count in sorted(digest.faults.items())},
            "latch": {"set": driver.latch.is_set(), "reason": driver.latch.reason()},
            "stop_file": str(driver.latch.path),
        }

    def moment(self, pictured_s: float | None) -> dict[str, Any]:
        """What changes all the time; ``pictured_s``: when the newest picture was taken, by the session's clock."""
        now_s = self.backend.clock.now_s()
        return {"t_s": round(now_s, 3), "picture_s_ago": None if pictured_s is None else round(max(now_s - pictured_s, 0.0), 2)}

    def goal(self) -> Floats | None:
        """Where the block is to go (3,): what was asked for on the page, else what the session goes by."""
        wanted = self._desk.goal
        if wanted is not None:
            return wanted
        return None if self.digest.goal is None else np.array(self.digest.goal, float)

    def marks(self, frame: Frame, seen: Seen) -> list[Mark]:
        """What to draw into a picture: the block as it was seen last, and the goal."""
        block = self.backend.model.cell.config.block
        drawn = []
        if (goal := self.goal()) is not None and np.isfinite(goal).all():
            drawn.append(Mark(goal, block.side_mm, 0.0, PAPER, "goal"))
        if seen.block.pose is not None:
            here = seen.block.seen and seen.number == frame.number
            text = f"block {seen.block.confidence:.2f}" if here else f"block {frame.t_s - seen.t_s + seen.block.age_s:.1f} s ago"
            drawn.append(Mark(seen.block.pose, block.side_mm, block.height_mm, YELLOW if here else FAINT, text))
        return drawn

    def _arms(self, phase: str) -> list[dict[str, Any]]:
        joints = np.round(self.backend.joints_rad(), _JOINT_DIGITS)
        digest, driver, rows = self.digest, self.backend.workcell.driver, []
        for arm, name in enumerate(driver.config.arms):
            known = bool(np.isfinite(joints[arm]).all())
            fingers = driver.gripper_mm(arm)
            rows.append(
                {
                    "name": name,
                    "letter": self._whole.labels[arm],
                    "joints_rad": joints[arm].tolist() if known else None,
                    "gripper_mm": round(fingers, 2) if math.isfinite(fingers) else None,
                    "moving": digest.begun and digest.arm == arm,
                    "holding": digest.arm == arm and phase in LOADED_PHASES,
                    "stalled": arm in digest.stalled,
                }
            )
        return rows

    def _roll_out(self) -> None:
        """What is planned; while an arm moves, what was when it set out."""
        digest, goal = self.digest, self.goal()
        if digest.arm >= 0:
            return
        wanted = (digest.pose, None if goal is None else goal.tolist(), digest.previous_arm)
        if wanted == self._planned_for:
            return
        self._planned_for, self._plan = wanted, []
        if digest.pose is None or goal is None or self._there(digest.pose, goal):
            return
        try:
            start = self._policy.rules.cell.clamp_to_workspace(np.array(digest.pose, float), self._reach_slack_mm)
            self._plan = rollout(self._policy, start, goal, digest.previous_arm, self._whole)
        except HandoverError:
            return  # a policy that has nothing to say of this will say so in the session

    def _there(self, pose: list[float], goal: Floats) -> bool:
        rules = self._policy.rules
        near = math.dist(pose[:2], goal[:2]) <= rules.tolerance_mm
        return near and abs(float(rules.orientation_error(np.float64(pose[2]), np.float64(goal[2])))) <= rules.epsilon_rad


def _block(pose: list[float] | None, seen: Seen | None) -> dict[str, Any]:
    """Where the block was seen last, in a picture or, without one that shows it, by the session."""
    believed: Believed | None = None if seen is None else seen.block
    if believed is None or believed.pose is None:
        return {"pose": pose, "seen": False, "confidence": None, "hidden": False}
    return {
        "pose": [round(float(value), _SEEN_DIGITS) for value in believed.pose],
        "seen": believed.seen,
        "confidence": round(believed.confidence, 3),
        "hidden": believed.hidden,
    }
