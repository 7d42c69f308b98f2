"""The latched stop: a file that any process can put there, and a running session looks at every few milliseconds."""

from __future__ import annotations

import contextlib
import json
import os
import time
from pathlib import Path

from marl_handover.files import temporary_of
from marl_handover.hardware.roll import Roll
from marl_handover.parsing import parse_object


class StopLatch:
    """A stop that stays until it is cleared by hand.

    Its presence is what counts, not what it holds; a folder that cannot be looked into counts as a stop.

    Args:
        path: of the file; every session and ``marl-handover stop`` have to name the same.
        roll: where sessions sign up; that of this user unless given.
    """

    def __init__(self, path: Path | str, roll: Roll | None = None) -> None:
        self.path, self.roll = Path(path), roll or Roll()
        self._receipt = self.path.with_name(self.path.name + ".obeyed")
        self._here = ""
        self._entry: Path | None = None

    def join(self) -> None:
        """From now on whoever latches this stop waits for this session to obey. Raises :class:`~marl_handover.hardware.roll.NoRoll`."""
        if self._entry is None:
            self._entry = self.roll.sign(self.path)

    def leave(self) -> None:
        """This session cannot move anything any more."""
        if self._entry is not None:
            self.roll.leave(self._entry)
            self._entry = None

    def latch(self, reason: str) -> None:
        """Stop this session and every other one with the same file. Works in this process even if the file cannot be written."""
        self._here = reason or "stop"
        self._forget_receipts()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_of(self.path)  # not fsynced: that may take longer than a stop has
        temporary.write_text(json.dumps({"reason": self._here, "pid": os.getpid(), "time": time.time()}), encoding="utf-8")
        temporary.replace(self.path)

    def is_set(self) -> bool:
        """Whether to stop. A few microseconds."""
        if self._here:
            return True
        try:
            os.stat(self.path)
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return True

    def reason(self) -> str:
        """Why; empty if there is no stop."""
        if self._here or not self.is_set():
            return self._here
        try:
            return str(parse_object(self.path.read_text(encoding="utf-8"))["reason"])
        except (OSError, ValueError, KeyError, TypeError):
            return "stop file present"

    def obeyed(self) -> None:
        """Leave a receipt: this session has sent its stops. Failing to leave one must not keep anybody from stopping."""
        with contextlib.suppress(OSError):
            self._receipt.write_text(str(os.getpid()), encoding="utf-8")
        if self._entry is not None:
            self.roll.obeyed(self._entry)

    def obeyed_by(self) -> int | None:
        """A process that has stopped since the latch was set; None if none has, or one that runs has not yet: then cut the power."""
        if not all(session.obeyed for session in self.roll.signed(self.path)):
            return None
        try:
            return int(self._receipt.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def clear(self) -> None:
        """Allow motion again. Nothing moves by itself."""
        self._here = ""
        self.path.unlink(missing_ok=True)
        self._forget_receipts()

    def _forget_receipts(self) -> None:
        """What was obeyed before is no answer to a new stop."""
        with contextlib.suppress(OSError):
            self._receipt.unlink(missing_ok=True)
            self.roll.summon(self.path)
