"""The latched stop: a file that any process can put there, and a running session looks at every few milliseconds."""

from __future__ import annotations

import contextlib
import json
import os
import time
from pathlib import Path


class StopLatch:
    """A stop that stays until it is cleared by hand.

    Its presence is what counts, not what it holds; a folder that cannot be looked into counts as a stop.

    Args:
        path: of the file; every session and ``marl-handover stop`` have to name the same.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._receipt = self.path.with_name(self.path.name + ".obeyed")
        self._here = ""

    def latch(self, reason: str) -> None:
        """Stop this session and every other one with the same file. Works in this process even if the file cannot be written."""
        self._here = reason or "stop"
        self._receipt.unlink(missing_ok=True)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.path.with_name(f"{self.path.name}.{os.getpid()}.tmp")
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
            return str(json.loads(self.path.read_text(encoding="utf-8"))["reason"])
        except (OSError, ValueError, KeyError, TypeError):
            return "stop file present"

    def obeyed(self) -> None:
        """Leave a receipt: this session has sent its stops. Failing to leave one must not keep anybody from stopping."""
        with contextlib.suppress(OSError):
            self._receipt.write_text(str(os.getpid()), encoding="utf-8")

    def obeyed_by(self) -> int | None:
        """The process that has stopped since the latch was set, or None: nobody has, so cut the power."""
        try:
            return int(self._receipt.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def clear(self) -> None:
        """Allow motion again. Nothing moves by itself."""
        self._here = ""
        self.path.unlink(missing_ok=True)
        self._receipt.unlink(missing_ok=True)
