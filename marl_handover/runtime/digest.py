"""Where a session stands, put together from its events as they come."""

from __future__ import annotations

from collections import Counter
from typing import Any

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.runtime.events import FAULTS, Event
from marl_handover.wording import counted

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


class Digest:
    """Takes the rows of an :class:`~marl_handover.runtime.events.EventLog` one by one. Poses in mm and rad, as lists.

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

    def __init__(self) -> None:
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
            self.text = _told(event, row)
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

    def _goal_changed(self, row: dict[str, Any]) -> None:
        self.goal = row["goal"]

    def _seen(self, row: dict[str, Any]) -> None:
        self.pose = row["pose"]

    def _motion(self, row: dict[str, Any]) -> None:
        self.arm, self.phases, self.begun = row["arm"], row["phases"], False

    def _transfer(self, row: dict[str, Any]) -> None:
        self.transfers += 1
        self.moved += 1
        self.pose = row["next_state"]
        arm = ARM_LETTERS.index(row["arm"])
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


def _told(event: Event, row: dict[str, Any]) -> str:
    """A fault in a line."""
    arm = f", arm {ARM_LETTERS[row['arm']]}" if "arm" in row else ""
    detail = row.get("text") or row.get("reason") or ""
    return f"{str(event).replace('_', ' ')}{arm}{': ' if detail else ''}{detail}"
