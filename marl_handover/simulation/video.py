"""Videos of a simulation: MP4 or GIF, written beside the file and moved there when whole."""

from __future__ import annotations

import math
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import imageio.v2 as imageio

from marl_handover.config import require_between
from marl_handover.errors import InvalidSetting, MissingFile
from marl_handover.simulation.camera import Pixels

FORMATS = (".mp4", ".gif")


def require_video(name: str, path: Path | str) -> Path:
    """``path`` as a :class:`Path`; raises :class:`InvalidSetting` for another format or a folder, :class:`MissingFile` without a folder."""
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise InvalidSetting(name, str(path), f"a file that ends in {' or '.join(FORMATS)}")
    if not path.parent.is_dir():
        raise MissingFile("folder", path.parent, "make it first")
    if path.is_dir():
        raise InvalidSetting(name, str(path), "a file, not a folder")
    return path


class Video:
    """A context manager that takes frames; the file appears when the block ends without an error."""

    def __init__(self, path: Path | str, fps: float, name: str = "video") -> None:
        self.path = require_video(name, path)
        require_between("fps", fps, 1, 50)
        self._temporary = self.path.with_name(f".{self.path.stem}.part{self.path.suffix.lower()}")
        options: dict[str, Any] = (
            {"fps": fps, "macro_block_size": 2} if self.path.suffix.lower() == ".mp4" else {"duration": 1000 / fps, "loop": 0}
        )
        self._writer = imageio.get_writer(self._temporary, **options)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._writer.close()
            if kind is None:
                self._temporary.replace(self.path)
        finally:
            self._temporary.unlink(missing_ok=True)

    def add(self, frame: Pixels) -> None:
        """Append one frame, RGB (height, width, 3)."""
        self._writer.append_data(frame)


class FrameClock:
    """Says at which of many calls, ``step_s`` apart, a frame of ``fps`` a second is due."""

    def __init__(self, fps: float, step_s: float) -> None:
        self._per_step, self._calls = fps * step_s, 0

    def due(self) -> int:
        """How many frames fall on this call: 0, 1 or more."""
        self._calls += 1
        return math.floor(self._calls * self._per_step + 1e-9) - math.floor((self._calls - 1) * self._per_step + 1e-9)
