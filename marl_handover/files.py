"""Writing files so that nothing is ever half written."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path


def write_whole(path: Path, text: str) -> None:
    """Write a file so that a reader sees the old one or the new one, never half of it."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with temporary.open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def keep(path: Path) -> Path | None:
    """Copy a file that is about to be replaced, beside it and under a name that no other has; its path, None if there is no file."""
    if not path.exists():
        return None
    stamp = time.strftime("%Y%m%d-%H%M%S")
    names = [path.with_name(f"{path.name}.{stamp}{suffix}.bak") for suffix in ("", *(f".{n}" for n in range(1, 1000)))]
    kept = next(name for name in names if not name.exists())
    shutil.copy2(path, kept)
    return kept
