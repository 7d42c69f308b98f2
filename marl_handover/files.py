"""Reading files of bounded size, and writing them so that nothing is ever half written."""

from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from marl_handover.errors import CorruptFile, MissingFile

MEGABYTE = 1_000_000
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


@contextmanager
def open_bounded(path: Path, limit_bytes: int, what: str, own: bool = False) -> Iterator[BinaryIO]:
    """A file opened for reading, once it is known to be a regular file of at most ``limit_bytes``; nothing else is waited for or read.

    Args:
        path: of the file.
        limit_bytes: its largest size.
        what: what it should be, for errors: "policy file", say.
        own: it must belong to this process's user, and be no symbolic link: for folders that others may write to.

    Raises:
        MissingFile: there is no such file.
        CorruptFile: it is no regular file, too large, another user's, or cannot be opened.
    """
    # Without O_NONBLOCK, opening a FIFO waits for somebody who writes to it.
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (os.O_NOFOLLOW if own else 0)
    try:
        descriptor = os.open(path, flags)
    except FileNotFoundError as error:
        raise MissingFile(what, path) from error
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        link = own and path.is_symlink()
        raise CorruptFile(what, path, "it is a symbolic link" if link else getattr(error, "strerror", None) or str(error)) from error
    try:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            raise CorruptFile(what, path, f"it is {KINDS.get(stat.S_IFMT(about.st_mode), 'something else')}, not a regular file")
        if own and about.st_uid != os.geteuid():
            raise CorruptFile(what, path, f"it belongs to another user ({about.st_uid})")
        if about.st_size > limit_bytes:
            raise _too_large(what, path, about.st_size, limit_bytes)
        with os.fdopen(descriptor, "rb", closefd=False) as stream:
            yield stream
    finally:
        os.close(descriptor)


def read_bounded(path: Path, limit_bytes: int, what: str, own: bool = False) -> bytes:
    """What a regular file of at most ``limit_bytes`` holds. Arguments and errors as of :func:`open_bounded`."""
    with open_bounded(path, limit_bytes, what, own) as stream:
        try:
            content = stream.read(limit_bytes + 1)
        except OSError as error:
            raise CorruptFile(what, path, error.strerror or str(error)) from error
    if len(content) > limit_bytes:  # it grew meanwhile, or is of those in /proc that say they are empty
        raise _too_large(what, path, len(content), limit_bytes)
    return content


def _too_large(what: str, path: Path, size_bytes: int, limit_bytes: int) -> CorruptFile:
    return CorruptFile(what, path, f"it has {size_bytes} bytes, more than the {limit_bytes} that it may have")


def write_whole(path: Path, text: str) -> None:
    """Write a file so that a reader sees the old one or the new one, never half of it; of two writers, the later one's."""
    temporary = temporary_of(path)
    try:
        with temporary.open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def temporary_of(path: Path) -> Path:
    """Where this process writes what is to become ``path``: another one at the same time has a name of its own."""
    return path.with_name(f"{path.name}.{os.getpid()}.tmp")


def keep(path: Path) -> Path | None:
    """Copy a file that is about to be replaced, beside it and under a name that no other has; its path, None if there is no file."""
    if not path.exists():
        return None
    stamp = time.strftime("%Y%m%d-%H%M%S")
    names = [path.with_name(f"{path.name}.{stamp}{suffix}.bak") for suffix in ("", *(f".{n}" for n in range(1, 1000)))]
    kept = next(name for name in names if not name.exists())
    shutil.copy2(path, kept)
    return kept
