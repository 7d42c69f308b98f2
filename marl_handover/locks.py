"""One process at a time works in a folder.

The system releases a lock when the process that holds it ends, however it ends. Between machines it holds on NFS, where Linux turns it into
a lock of the server; a share mounted with ``nolock`` or ``local_lock=flock`` keeps each machine's locks to itself, and there two machines
must be given different folders.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from filelock import FileLock, Timeout

from marl_handover.errors import HandoverError, WorkFailed

RUN_LOCK = ".lock"
"""In a run directory, locked by whoever trains there."""


class LockUnavailable(WorkFailed):
    """A file system on which no lock can be had."""

    def __init__(self, path: Path, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or error
        super().__init__(f"{path} cannot be locked ({reason}); choose an out= on a file system that has locks")
        self.path = path


class FolderBusy(HandoverError):
    """Another process writes into a run directory."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder} is in use: another training writes into it; wait for its end, or choose another out=")
        self.folder = folder


@contextmanager
def held(folder: Path, wait_s: float = 0.0) -> Iterator[bool]:
    """Lock a folder for the block: False if somebody else has it.

    Args:
        folder: need not exist, and may be deleted meanwhile: the locked file is ``<folder>.lock``, which stays.
        wait_s: how long to wait for it.

    Raises:
        LockUnavailable: the file cannot be written, or its file system has no locks.
    """
    lock = FileLock(folder.with_name(f"{folder.name}.lock"))
    mine = _taken(lock, wait_s)
    try:
        yield mine
    finally:
        lock.release()


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Be the only one who writes into a run directory, which is made if it is not there; within one thread, blocks may be nested.

    Raises:
        FolderBusy: another process or thread has it.
        LockUnavailable: as of :func:`held`.
    """
    lock = FileLock(folder.absolute() / RUN_LOCK, is_singleton=True)
    if not _taken(lock):
        raise FolderBusy(folder)
    try:
        yield
    finally:
        lock.release()


def new_folder(path: Path) -> Path:
    """Make a folder that did not exist: ``path``, or if others were faster ``path-2``, ``path-3``, …; its path."""
    for number in count(1):
        folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
        try:
            folder.mkdir(parents=True)
            break
        except FileExistsError:
            continue
    return folder


def _taken(lock: FileLock, wait_s: float = 0.0) -> bool:
    path = Path(lock.lock_file)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=wait_s)
    except Timeout:
        return False
    except (OSError, NotImplementedError) as error:
        raise LockUnavailable(path, error) from error
    return True
