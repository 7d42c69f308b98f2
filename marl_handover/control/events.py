"""What happens in a session, by name, and the log it is kept in: JSON Lines, each written out at once.

Every line has ``t_s`` (the session's clock), ``event`` (a value of :class:`Event`) and that event's own fields, which docs/hardware.md
lists. Lengths are in mm, angles in rad. A trace can be drawn from the log alone: ``state`` lines carry the joints of all arms while one
moves, ``seen`` lines the block and the goal.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.errors import CannotWrite, counted
from marl_handover.files import GrowingFile


class Event(StrEnum):
    """What a line of the log is about. Comments: the reaction."""

    SESSION = "session"
    EPISODE = "episode"
    GOAL = "goal"
    SEEN = "seen"
    STATE = "state"
    MOTION = "motion"
    TRANSFER = "transfer"
    ENDED = "ended"
    ARMED = "armed"
    CONTROL = "control"  # somebody at a page asked for something; done, unless it was refused
    PAUSED = "paused"  # no transfer begins until somebody goes on
    RESUMED = "resumed"
    # What goes wrong.
    FAILED_GRASP = "failed_grasp"  # look again, decide again
    DROPPED = "dropped"  # the same, from where the block lies now
    BLOCK_MOVED = "block_moved"  # somebody moved it: decide from where it is
    GOAL_CHANGED = "goal_changed"  # a transfer that is going on is finished; then decide for the new goal
    BLOCK_OUTSIDE = "block_outside"  # no arm reaches it: wait, for as long as there is patience, until somebody puts it back
    MARKER_HIDDEN = "marker_hidden"  # arms hold; wait until it is seen again; in vain after a transfer, and again: the episode ends
    CAMERA_FROZEN = "camera_frozen"  # arms hold; wait for new pictures
    SERIAL_LOST = "serial_lost"  # reconnect, read back where the arms are held, go on with the motion
    CONTROLLER_RESET = "controller_reset"  # nothing moves until somebody has put the arms into the parked pose; then arm, look, decide
    BAD_REPLY = "bad_reply"  # arms hold; the motion goes on from there
    HOST_LATE = "host_late"  # the same
    GATE_REFUSED = "gate_refused"  # the command is not sent; the arm goes home, or stays for somebody to help
    PULSE_MISMATCH = "pulse_mismatch"  # a board does not do what it is told: every channel is stopped, the session ends
    ARM_STALLED = "arm_stalled"  # one arm does nothing, time and again: the episode ends
    STOPPED = "stopped"  # the latched stop: every channel is stopped, the session ends
    RECOVERED = "recovered"  # what was wrong is over


NOTES = frozenset(
    (
        Event.SESSION,
        Event.EPISODE,
        Event.GOAL,
        Event.SEEN,
        Event.STATE,
        Event.MOTION,
        Event.TRANSFER,
        Event.ENDED,
        Event.ARMED,
        Event.CONTROL,
        Event.PAUSED,
        Event.RESUMED,
        Event.RECOVERED,
    )
)
"""The events of every good session."""

FAULTS = frozenset(Event) - NOTES
"""The events that tell of something wrong or unforeseen."""


class EventLog:
    """Writes events to a file as they come, and counts them.

    A file that has no room any more ends with its last whole line. That interrupts nothing: :meth:`require_written` tells of it.

    Args:
        clock: gives ``t_s``.
        path: of the file; empty: only counted.
        listener: is shown each line as well.

    Raises:
        CannotWrite: the file cannot be opened.
    """

    def __init__(self, clock: Callable[[], float], path: str = "", listener: Callable[[dict[str, Any]], None] | None = None) -> None:
        self._clock, self._listener = clock, listener
        self.counts: Counter[Event] = Counter()
        self._file = GrowingFile(Path(path), fresh=True) if path else None
        self._failure: CannotWrite | None = None

    @property
    def verbose(self) -> bool:
        """Whether anybody reads more than the counts."""
        return self._file is not None or self._listener is not None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def add(self, event: Event, **fields: Any) -> None:
        """Note ``event``; fields are numbers, texts, None, arrays, or lists and mappings of them."""
        self.counts[event] += 1
        if not self.verbose:
            return
        row = {"t_s": round(self._clock(), 4), "event": str(event), **{name: _plain(value) for name, value in fields.items()}}
        self._write(row)
        if self._listener is not None:
            self._listener(row)

    def _write(self, row: dict[str, Any]) -> None:
        if self._file is None or self._failure is not None:
            return
        try:
            self._file.write(json.dumps(row, allow_nan=False) + "\n")
        except CannotWrite as failure:  # arms may be moving: nothing of that is to stop here
            self._failure = failure

    def require_written(self) -> None:
        """Raise the :class:`CannotWrite` of a line that is missing. To be called where arms are parked."""
        if self._failure is not None:
            raise self._failure

    def show(self, listener: Callable[[dict[str, Any]], None]) -> None:
        """Show ``listener`` each line from now on, in place of whoever was shown them before."""
        self._listener = listener

    def close(self) -> None:
        """Close the file; again is fine."""
        if self._file is not None:
            self._file.close()


def _plain(value: Any) -> Any:
    """``value`` as JSON has it, numbers to 0.1 um and 6e-6 degrees; what is not finite is null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return round(float(value), 7) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value if value is None or isinstance(value, int) else str(value)


STARTING, LOOKING, DECIDING, MOVING, PAUSED, BETWEEN = "starting", "looking", "deciding", "moving", "paused", "between episodes"
"""What a session that goes on may be doing, besides waiting for something that is wrong to pass."""

_WAITING = {
    Event.MARKER_HIDDEN: "waiting: the marker is hidden",
    Event.CAMERA_FROZEN: "waiting: the camera gives no new picture",
    Event.BLOCK_OUTSIDE: "waiting: no arm reaches the block",
    Event.SERIAL_LOST: "waiting: the serial port is lost",
    Event.CONTROLLER_RESET: "waiting: the controller was reset; the arms have to be put into the parked pose",
}
_DOING = {
    Event.ARMED: LOOKING,
    Event.SEEN: DECIDING,
    Event.TRANSFER: DECIDING,
    Event.GOAL_CHANGED: DECIDING,
    Event.RESUMED: DECIDING,
    Event.RECOVERED: LOOKING,
    Event.MOTION: MOVING,
    Event.STATE: MOVING,
    Event.PAUSED: PAUSED,
    Event.ENDED: BETWEEN,
}
_IN_MOTION = frozenset(
    (Event.MOTION, Event.SERIAL_LOST, Event.BAD_REPLY, Event.HOST_LATE, Event.GATE_REFUSED, Event.BLOCK_MOVED, Event.RECOVERED)
)
"""Events that may come while an arm moves, or is about to; after any other none does."""


class SessionDigest:
    """Takes the rows of an :class:`~marl_handover.control.events.EventLog` one by one. Poses in mm and rad, as lists.

    ``labels`` are what rows call the arms.

    Attributes:
        doing: one of the words above.
        text: about the last thing that went wrong in this episode, or how the last one ended.
        arm, phases: of the motion that goes on: index, and [name, begin, end] of each phase in s; -1 and none without one.
        begun: whether that motion's first command was sent.
        pose, goal: of the block and of where it is to go (3,), as far as they are known.
        previous_arm: index of the arm that moved the block last, -1 for none.
        episode: number of the present episode, from 0; -1 before the first.
        transfers: of the present episode.
        ended, solved, moved: episodes, solved ones and transfers so far.
        faults: how often each fault came.
        stalled: arms that do nothing.
        stopped: why, once the stop was obeyed.
    """

    def __init__(self, labels: Sequence[str] = ARM_LETTERS) -> None:
        self._labels = tuple(labels)
        self.doing, self.text = STARTING, ""
        self.arm, self.begun = -1, False
        self.phases: list[tuple[str, float, float]] = []
        self.pose: list[float] | None = None
        self.goal: list[float] | None = None
        self.previous_arm = self.episode = -1
        self.transfers = self.ended = self.solved = self.moved = 0
        self.faults: Counter[str] = Counter()
        self.stalled: set[int] = set()
        self.stopped = ""

    def take(self, row: dict[str, Any]) -> None:
        """Take in a row."""
        event = Event(row["event"])
        if event in FAULTS:
            self.faults[event] += 1
            self.text = _told(event, row, self._labels)
        self.doing = _WAITING.get(event) or _DOING.get(event) or self.doing
        if event is Event.STATE:
            self.begun = self.arm >= 0
        elif event not in _IN_MOTION:
            self.arm, self.phases, self.begun = -1, [], False
        handler = getattr(self, f"_{event}", None)
        if handler is not None:
            handler(row)

    def phase(self, reached_s: float) -> str:
        """Name of the present motion's phase ``reached_s`` into it; empty without one."""
        if not self.begun:
            return ""
        return next((name for name, _, end_s in self.phases if reached_s < end_s), self.phases[-1][0] if self.phases else "")

    def _episode(self, row: dict[str, Any]) -> None:
        self.episode += 1
        self.transfers, self.previous_arm, self.text = 0, -1, ""
        self.pose = self.goal = None
        self.stalled = set()
        self.doing = LOOKING if self.episode else STARTING

    def _goal(self, row: dict[str, Any]) -> None:
        self.goal = row["goal"]

    _goal_changed = _goal

    def _seen(self, row: dict[str, Any]) -> None:
        self.pose = row["pose"]

    def _motion(self, row: dict[str, Any]) -> None:
        self.arm, self.phases, self.begun = row["arm"], row["phases"], False

    def _transfer(self, row: dict[str, Any]) -> None:
        self.transfers += 1
        self.moved += 1
        self.pose = row["next_state"]
        arm = self._labels.index(row["arm"])
        if row["refusal"] is None:
            self.previous_arm = arm
            self.stalled.discard(arm)

    def _arm_stalled(self, row: dict[str, Any]) -> None:
        self.stalled.add(row["arm"])

    def _ended(self, row: dict[str, Any]) -> None:
        self.ended += 1
        self.solved += row["ended"] == "success"
        self.text = f"episode {self.episode} ended: {row['ended']} after {counted(row['transfers'], 'transfer')}"

    def _recovered(self, row: dict[str, Any]) -> None:
        self.text = f"{row['what'].replace('_', ' ')} is over"

    def _stopped(self, row: dict[str, Any]) -> None:
        self.stopped = row["reason"]


def _told(event: Event, row: dict[str, Any], labels: Sequence[str]) -> str:
    """A fault in a line."""
    arm = f", arm {labels[row['arm']]}" if "arm" in row else ""
    detail = row.get("text") or row.get("reason") or ""
    return f"{str(event).replace('_', ' ')}{arm}{': ' if detail else ''}{detail}"
