"""The registry of sessions that can move arms: who has to obey a stop, and who has.

One folder for each user, at a place that no environment variable and no working directory changes, with a file for each session. An entry
whose process is gone counts for nothing, so a session that was killed need not sign off. Everybody may read the folder, so that whoever
stops the arms learns of other users' sessions too; only its user may write to it.

This module imports little: a stop must not wait for numpy.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from marl_handover.errors import CorruptFile, MissingFile, WorkFailed
from marl_handover.files import write_whole
from marl_handover.parsing import read_json

_COUNT = itertools.count()
_ENTRY_BYTES = 16_000
"""A path of 4,096 characters fits, however it is written."""

_MOST = 1000
"""No user has more sessions; what is beyond was put there to keep somebody busy."""


def user_path(suffix: str) -> Path:
    """A path of this user's, the same in every session of every shell."""
    shared = Path("/tmp") if os.path.isdir("/tmp") else Path(tempfile.gettempdir())
    return shared / f"marl-handover-{os.getuid()}{suffix}"


class RegistryUnusable(WorkFailed):
    """The folder of the registry cannot be used."""

    def __init__(self, folder: Path, why: str) -> None:
        super().__init__(f"sessions cannot sign up in {folder} ({why}), so a stop could not tell whether they obeyed; put that right first")
        self.folder = folder


class SessionRecord(NamedTuple):
    """A session that runs: its process, the stop file it looks at, and whether it has stopped since that was latched last.

    ``owner`` is the other user whose it is; empty: it is this user's. One that cannot be looked into has no ``stop_file``.
    """

    pid: int
    stop_file: Path | None
    obeyed: bool
    entry: Path
    owner: str = ""


class SessionRegistry:
    """The registry in ``folder``; that of this user unless given."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or user_path(".sessions")

    def register(self, stop_file: Path) -> Path:
        """Put this session down. Returns its entry, for :meth:`obeyed` and :meth:`leave`.

        Raises:
            RegistryUnusable: the folder belongs to somebody else, or cannot be written.
        """
        about = {"pid": os.getpid(), "started": _started(os.getpid()), "stop_file": str(stop_file.absolute())}
        try:
            self.folder.mkdir(mode=0o755, parents=True, exist_ok=True)
            if not self._own():
                raise RegistryUnusable(self.folder, "it is not a folder, or belongs to somebody else")
            self.folder.chmod(0o755)
            entry = self.folder / f"{os.getpid()}-{next(_COUNT)}.json"
            _receipt(entry).unlink(missing_ok=True)
            write_whole(entry, json.dumps(about))
            entry.chmod(0o644)
        except OSError as error:
            raise RegistryUnusable(self.folder, error.strerror or str(error)) from error
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

    def registered(self, stop_file: Path | None = None) -> list[SessionRecord]:
        """This user's sessions, all or those that look at ``stop_file``. Entries of processes that are gone are taken off."""
        found: list[SessionRecord] = []
        if not self._own():  # somebody else's has nothing to say, and nobody could sign up in it
            return found
        for entry in sorted(self.folder.glob("*.json"))[:_MOST]:
            session = _read(entry)
            if session is None:
                self.leave(entry)
            elif stop_file is None or session.stop_file == stop_file.absolute():
                found.append(session)
        return found

    def others(self) -> list[SessionRecord]:
        """Sessions of other users of this computer. Of a folder that cannot be read, its user's first process that may be one counts."""
        found: list[SessionRecord] = []
        for folder in sorted(self.folder.parent.glob("marl-handover-*.sessions")):
            uid = _folder_of(folder)
            if uid is None or uid == os.getuid() or folder.name != f"marl-handover-{uid}.sessions":
                continue
            try:
                with os.scandir(folder) as listed:
                    names = [entry.name for entry in itertools.islice(listed, _MOST) if entry.name.endswith(".json")]
            except OSError:
                pid = next(_processes(uid), 0)
                found += [SessionRecord(pid, None, False, folder, user_name(uid))] if pid else []
                continue
            sessions = (_read(folder / name, uid) for name in sorted(names))
            found += [session._replace(owner=user_name(uid)) for session in sessions if session is not None]
        return found

    def clear_receipts(self, stop_file: Path) -> None:
        """A new stop: what was obeyed before is no answer to it."""
        for session in self.registered(stop_file):
            _receipt(session.entry).unlink(missing_ok=True)

    def _own(self) -> bool:
        return _folder_of(self.folder) == os.getuid()


def user_name(uid: int) -> str:
    """A user by name, or by number if there is no name."""
    try:
        import pwd

        return pwd.getpwuid(uid).pw_name
    except (ImportError, KeyError):  # a system without such a list
        return f"user {uid}"


def suspended(pid: int) -> bool:
    """Whether a process is held by a signal or a debugger, as far as can be known: it does nothing before it is let go on."""
    return _stat(pid)[:1] in (["T"], ["t"])


def _receipt(entry: Path) -> Path:
    return entry.with_suffix(".obeyed")


def _folder_of(path: Path) -> int | None:
    """Whose folder it is; None: there is none, or it is something else."""
    try:
        about = os.lstat(path)
    except OSError:
        return None
    return about.st_uid if stat.S_ISDIR(about.st_mode) else None


def _read(entry: Path, uid: int | None = None) -> SessionRecord | None:
    """A session that runs; None: it is over, or this is no entry. Another user's counts only if its process is theirs."""
    try:
        about = read_json(entry, "entry of a session", _ENTRY_BYTES)
        pid, stop_file, started = int(about["pid"]), Path(str(about["stop_file"])), str(about.get("started", ""))
        alive = pid > 0 and _alive(pid, started) and (uid is None or _owner(pid) in (uid, None))
        return SessionRecord(pid, stop_file, _receipt(entry).exists(), entry) if alive else None
    except (OSError, ValueError, KeyError, TypeError, OverflowError, MissingFile, CorruptFile):
        return None


def _alive(pid: int, started: str) -> bool:
    """Whether a process runs, and is the one that had this number at first."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    now = _stat(pid)
    return not now or (now[0] not in "ZX" and (not started or _start(now) in (started, "")))


def _started(pid: int) -> str:
    """When a process began, in the kernel's own count; empty if that cannot be known."""
    return _start(_stat(pid))


def _start(fields: list[str]) -> str:
    return fields[19] if len(fields) > 19 else ""


def _stat(pid: int) -> list[str]:
    """Fields of ``/proc/PID/stat`` from the state on; none where there is no such thing."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    except OSError:
        return []


def _owner(pid: int) -> int | None:
    """Whose process it is, None if that is not shown."""
    try:
        return os.stat(f"/proc/{pid}").st_uid
    except OSError:
        return None


def _processes(uid: int) -> Iterator[int]:
    """Processes of a user that may be a session: those that are called by this package's name, then those of any Python."""
    with contextlib.suppress(OSError):
        own = [int(name) for name in os.listdir("/proc") if name.isdecimal() and _owner(int(name)) == uid]
        called = {pid: _command(pid) for pid in own}
        for word in (b"marl", b"python"):
            yield from (pid for pid in own if word in called[pid])


def _command(pid: int) -> bytes:
    """How a process was called; nothing of one that is over."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""
