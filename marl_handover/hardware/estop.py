"""The latched stop: a file that any process can put there, and a running session looks at every few milliseconds.

What counts is that something is there, whoever put it there. It is read only after the arms were stopped, and only if it is a small file
of one's own: in ``/tmp`` others may put theirs. This module imports little: a stop must not wait for numpy.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import stat
import time
from pathlib import Path

from marl_handover.errors import CorruptFile, MissingFile, WorkFailed
from marl_handover.files import read_bounded, temporary_of
from marl_handover.hardware.session_registry import SessionRegistry, user_name, user_path
from marl_handover.parsing import parse_object

_LARGEST_BYTES = 64_000
_LONGEST = 200


class NotCleared(WorkFailed):
    """A stop that cannot be taken away by this user."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"the stop {path} stays: {why}; whoever put it there, or root, can remove it")
        self.path = path


class StopLatch:
    """A stop that stays until it is cleared by hand.

    Its presence is what counts, not what it holds; a folder that cannot be looked into counts as a stop.

    Args:
        path: of the file; every session and ``marl-handover stop`` have to name the same.
        registry: where sessions sign up; that of this user unless given.
    """

    def __init__(self, path: Path | str, registry: SessionRegistry | None = None) -> None:
        self.path, self.registry = Path(path), registry or SessionRegistry()
        self._receipt = Path(f"{self.path}.obeyed")
        self._here = ""
        self._entry: Path | None = None

    def join(self) -> None:
        """From now on whoever latches this stop waits for this session. Raises :class:`RegistryUnusable`."""
        if self._entry is None:
            self._entry = self.registry.register(self.path)

    def leave(self) -> None:
        """This session cannot move anything any more."""
        if self._entry is not None:
            self.registry.leave(self._entry)
            self._entry = None

    def latch(self, reason: str) -> None:
        """Stop this session and every other one with the same file. Works in this process even if the file cannot be written.

        Raises OSError if it cannot be written, unless something else is there already: that stops as well, and a device or a pipe stays.
        """
        self._here = plain(reason) or "stop"
        self._forget_receipts()
        if self._kind() not in (0, stat.S_IFREG):
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            _put(self.path, json.dumps({"reason": self._here, "pid": os.getpid(), "time": time.time()}))
        except OSError:
            if not os.path.lexists(self.path):
                raise

    def is_set(self) -> bool:
        """Whether to stop. A few microseconds."""
        if self._here:
            return True
        try:
            os.lstat(self.path)
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return True

    def reason(self) -> str:
        """Why, in printable characters; empty if there is no stop."""
        if self._here or not self.is_set():
            return self._here
        try:
            return plain(str(parse_object(read_bounded(self.path, _LARGEST_BYTES, "stop file", own=True))["reason"]))
        except (ValueError, KeyError, MissingFile, CorruptFile):
            return f"stop file present{self._whose()}"

    def obeyed(self) -> None:
        """Leave a receipt: this session has sent its stops. Failing to leave one must not keep anybody from stopping."""
        with contextlib.suppress(OSError):
            _put(self._receipt, str(os.getpid()))
        if self._entry is not None:
            self.registry.obeyed(self._entry)

    def obeyed_by(self) -> int | None:
        """A process that has stopped since the latch was set; None if none has, or one that runs has not yet: then cut the power."""
        if not all(session.obeyed for session in self.registry.registered(self.path)):
            return None
        try:
            return int(read_bounded(self._receipt, _LARGEST_BYTES, "receipt", own=True))
        except (ValueError, MissingFile, CorruptFile):
            return None

    def clear(self) -> None:
        """Allow motion again. Nothing moves by itself. Raises :class:`NotCleared` if this user cannot take the stop away."""
        if self._kind() in (stat.S_IFCHR, stat.S_IFBLK):
            raise NotCleared(self.path, "it is a device")
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            raise NotCleared(self.path, f"{error.strerror or error}{self._whose()}") from error
        self._here = ""
        self._forget_receipts()

    def _kind(self) -> int:
        """What lies in the file's place, as ``stat`` names kinds; 0: nothing that can be seen."""
        try:
            return stat.S_IFMT(os.lstat(self.path).st_mode)
        except OSError:
            return 0

    def _whose(self) -> str:
        """Words on whose the stop file is, if it is somebody else's."""
        try:
            uid = os.lstat(self.path).st_uid
        except OSError:
            return ""
        return "" if uid == os.getuid() else f", put there by {user_name(uid)}"

    def _forget_receipts(self) -> None:
        """What was obeyed before is no answer to a new stop."""
        with contextlib.suppress(OSError):
            self._receipt.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.registry.clear_receipts(self.path)


class PrivateStop(StopLatch):
    """The stop of one simulated session: not registered, and not set by ``marl-handover stop``. It and real arms never stop each other.

    Its file has a name that nobody else has; whoever is told it, as a page that shows the session, stops this session alone.
    """

    def __init__(self) -> None:
        super().__init__(user_path(f".{os.getpid()}-{secrets.token_hex(8)}.stop"))

    def join(self) -> None:
        """Nobody waits for this session."""

    def leave(self) -> None:
        """This session is over, and its stop with it."""
        for path in (self.path, self._receipt):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def plain(text: str) -> str:
    """At most 200 characters of ``text`` in one line that no terminal takes for commands."""
    shown = "".join(character if character.isprintable() else " " for character in text[: _LONGEST + 1])
    return shown if len(shown) <= _LONGEST else f"{shown[: _LONGEST - 1]}…"


def _put(path: Path, text: str) -> None:
    """Write a file as a whole, where others may write too: whatever is there is replaced, and never written to or waited for.

    Not fsynced: that may take longer than a stop has. Raises OSError.
    """
    temporary = temporary_of(path)
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
            stream.write(text)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
