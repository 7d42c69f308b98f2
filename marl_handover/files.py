"""Writing files so that nothing is ever half written."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path


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
