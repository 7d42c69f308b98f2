"""One call at a time works in a task's folder.

The lock is ``flock`` on a file beside the folder, which the system releases when the process that holds it ends, however it ends. Between
machines it holds on NFS, where Linux turns it into a lock of the server; a share mounted with ``nolock`` or ``local_lock=flock`` keeps
each machine's locks to itself, and there two machines must be given different rows.
"""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from marl_handover.errors import WorkFailed

POLL_S = 0.1


class LockUnavailable(WorkFailed):
    """A file system on which no lock can be had."""

    def __init__(self, path: Path, error: OSError) -> None:
        super().__init__(f"{path} cannot be locked ({error.strerror or error}); choose an out= on a file system that has locks")
        self.path = path


@contextmanager
def held(folder: Path, wait_s: float = 0.0) -> Iterator[bool]:
    """Lock a folder for the block: False if somebody else has it.

    Args:
        folder: need not exist, and may be deleted meanwhile: the locked file is ``<folder>.lock``, which stays.
        wait_s: how long to wait for it.

    Raises:
        LockUnavailable: the file cannot be written, or its file system has no locks.
    """
    path = folder.with_name(f"{folder.name}.lock")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = path.open("a")
    except OSError as error:
        raise LockUnavailable(path, error) from error
    with stream:
        try:
            deadline = time.monotonic() + wait_s
            while not (mine := _locked(stream)) and time.monotonic() < deadline:
                time.sleep(POLL_S)
        except OSError as error:
            raise LockUnavailable(path, error) from error
        yield mine


def _locked(stream: IO[str]) -> bool:
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):  # the second is what NFS may say
        return False
    return True
