"""The roll of sessions that can move arms: who has to obey a stop, and who has.

One folder for each user, at a place that no environment variable and no working directory changes, with a file for each session. An entry
whose process is gone counts for nothing, so a session that was killed need not sign off.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import tempfile
from pathlib import Path
from typing import NamedTuple

from marl_handover.errors import WorkFailed
from marl_handover.files import write_whole
from marl_handover.parsing import parse_object

_COUNT = itertools.count()


def user_path(suffix: str) -> Path:
    """A path of this user's, the same in every session of every shell."""
    shared = Path("/tmp") if os.path.isdir("/tmp") else Path(tempfile.gettempdir())
    return shared / f"marl-handover-{os.getuid()}{suffix}"


class NoRoll(WorkFailed):
    """The folder of the roll cannot be used."""

    def __init__(self, folder: Path, why: str) -> None:
        super().__init__(f"sessions cannot sign up in {folder} ({why}), so a stop could not tell whether they obeyed; put that right first")
        self.folder = folder


class Signed(NamedTuple):
    """A session that runs: its process, the stop file it looks at, and whether it has stopped since that was latched last."""

    pid: int
    stop_file: Path
    obeyed: bool
    entry: Path


class Roll:
    """The roll in ``folder``; that of this user unless given."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or user_path(".sessions")

    def sign(self, stop_file: Path) -> Path:
        """Put this session down. Returns its entry, for :meth:`obeyed` and :meth:`leave`.

        Raises:
            NoRoll: the folder belongs to somebody else, or cannot be written.
        """
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if self.folder.stat().st_uid != os.getuid():
                raise NoRoll(self.folder, "it belongs to somebody else")
            entry = self.folder / f"{os.getpid()}-{next(_COUNT)}.json"
            _receipt(entry).unlink(missing_ok=True)
            write_whole(entry, json.dumps({"pid": os.getpid(), "stop_file": str(stop_file.absolute())}))
        except OSError as error:
            raise NoRoll(self.folder, error.strerror or str(error)) from error
        return entry

    @staticmethod
    def obeyed(entry: Path) -> None:
        """This session has sent its stops. Failing to say so must not keep anybody from stopping."""
        with contextlib.suppress(OSError):
            _receipt(entry).touch()

    @staticmethod
    def leave(entry: Path) -> None:
        """This session is over."""
        with contextlib.suppress(OSError):
            entry.unlink(missing_ok=True)
            _receipt(entry).unlink(missing_ok=True)

    def signed(self, stop_file: Path | None = None) -> list[Signed]:
        """The sessions that run, all or those that look at ``stop_file``. Entries of processes that are gone are taken off."""
        found = []
        for entry in sorted(self.folder.glob("*.json")):
            session = _read(entry)
            if session is None or not _alive(session.pid):
                self.leave(entry)
            elif stop_file is None or session.stop_file == stop_file.absolute():
                found.append(session)
        return found

    def summon(self, stop_file: Path) -> None:
        """A new stop: what was obeyed before is no answer to it."""
        for session in self.signed(stop_file):
            _receipt(session.entry).unlink(missing_ok=True)


def _receipt(entry: Path) -> Path:
    return entry.with_suffix(".obeyed")


def _read(entry: Path) -> Signed | None:
    """None: it was taken off meanwhile, or is no entry."""
    try:
        about = parse_object(entry.read_text(encoding="utf-8"))
        return Signed(int(about["pid"]), Path(about["stop_file"]), _receipt(entry).exists(), entry)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
