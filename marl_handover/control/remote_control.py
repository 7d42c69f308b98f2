"""What people at a page may tell a session: pause, go on, another goal. Nothing here makes an arm move.

A :class:`ControlFolder` reads commands in one thread and leaves them in the :class:`CommandQueue`, where the session's own thread finds
them when it is about to begin a transfer.
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.files import read_bounded
from marl_handover.parsing import parse_json

_REQUEST = re.compile(r"control-\d+-\d+\.json")

MAX_AGE_S = 2.0
"""A command older than this is refused: whoever gave it saw another situation."""

_POLL_S = 0.02
_LARGEST_BYTES = 4096
_LARGEST = 1e12
"""No number in a command is larger; infinity is, and what is not a number is not smaller."""

_RESPONSES = 100


class SessionCommand(StrEnum):
    """What may be asked."""

    START = "start"
    PAUSE = "pause"
    RESUME = "resume"
    GOAL = "goal"


class Response(NamedTuple):
    """What came of a command: its number, what it was, the goal (3,) it gave, and why it was refused (None: it was not)."""

    number: int
    command: str
    goal: list[float] | None
    refused: str | None


class CommandQueue:
    """What was asked for and not done yet. Set by one thread, read by the session's.

    Args:
        paused: whether the session has to be started by somebody.
    """

    def __init__(self, paused: bool = False) -> None:
        self._go = threading.Event()
        self._responses: deque[Response] = deque(maxlen=_RESPONSES)
        self.goal: Floats | None = None
        """Where the block is to go (3,), if somebody has said so."""
        if not paused:
            self._go.set()

    @property
    def paused(self) -> bool:
        """Whether no transfer is to begin."""
        return not self._go.is_set()

    def take(self, response: Response) -> None:
        """Take note of a command and, unless it was refused, of what it asks."""
        self._responses.append(response)
        if response.refused is not None:
            return
        if response.command == SessionCommand.PAUSE:
            self._go.clear()
        elif response.command == SessionCommand.GOAL:
            self.goal = np.array(response.goal, float)
        else:
            self._go.set()

    def responses(self) -> list[Response]:
        """What was taken note of since the last call."""
        return [self._responses.popleft() for _ in range(len(self._responses))]

    def wait(self, obey: Callable[[], None]) -> None:
        """Wait for as long as the session is paused; ``obey`` is called all the while, and may raise. There is no other limit."""
        while not self._go.wait(_POLL_S):
            obey()


def control_name(number: int) -> str:
    """The file for a command of this process: of its own, so that none is replaced by a later one. By their names they are in order."""
    return f"control-{number:016d}-{os.getpid()}.json"


class ControlFolder:
    """Takes commands from a folder that others lay them into, a file each. What was read is removed.

    Args:
        folder: where they lie.
        session: only commands to the session of this name are taken.
        unreachable: says of a goal (3,) why it cannot be, or None.
    """

    def __init__(self, folder: Path, session: str, unreachable: Callable[[Floats], str | None]) -> None:
        self._folder, self._session, self._unreachable = folder, session, unreachable
        self._began_s = time.time()
        self._kept: set[str] = set()
        self._number = -1

    def poll(self) -> Response | None:
        """The answer to the first command that is new; None if there is none. Whatever the folder holds, this does not raise."""
        try:
            names = [name for name in os.listdir(self._folder) if _REQUEST.fullmatch(name) and name not in self._kept]
        except OSError:
            return None
        if not names:
            return None
        path = self._folder / min(names)
        response = self._read(path)
        with contextlib.suppress(OSError):
            path.unlink()
            return response
        self._kept.add(path.name)
        return response

    def _read(self, path: Path) -> Response | None:
        try:
            content = parse_json(read_bounded(path, _LARGEST_BYTES, "control file", own=True), finite=False)
        except MissingFile:
            return None
        except (CorruptFile, ValueError) as error:
            return Response(-1, "", None, f"it cannot be read: {error}"[:300])
        return self._judged(content)

    def _judged(self, content: Any) -> Response:
        fields = content if isinstance(content, dict) else {}
        command, goal = fields.get("command"), fields.get("goal")
        number = given if type(given := fields.get("number")) is int else -1
        response = Response(number, str(command)[:20], None, None)
        if number < 0 or command not in list(SessionCommand):
            return response._replace(refused=f"a command needs a number, and to be one of: {', '.join(SessionCommand)}")
        if fields.get("session") != self._session:
            return response._replace(refused="it was meant for another session")
        if number <= self._number:
            return response._replace(refused="a later command was seen already")
        self._number = number
        if (late := self._late(fields.get("time"))) is not None:
            return response._replace(refused=late)
        if command != SessionCommand.GOAL:
            return response
        if not _is_pose(goal):
            return response._replace(refused="a goal is x_mm, y_mm, theta_rad")
        pose = np.array(goal, float)
        return response._replace(goal=pose.tolist(), refused=self._unreachable(pose))

    def _late(self, given_s: Any) -> str | None:
        """Why a command given at ``given_s`` (s since 1970) is not for now."""
        if not _is_number(given_s):
            return "it does not say when it was given"
        if given_s < self._began_s:
            return "it is older than this session"
        age_s = time.time() - given_s
        if abs(age_s) > MAX_AGE_S:
            return f"it is {age_s:.1f} s old, more than {MAX_AGE_S:g} s" if age_s > 0 else "it comes from the future: compare the clocks"
        return None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _LARGEST


def _is_pose(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(_is_number(item) for item in value)
