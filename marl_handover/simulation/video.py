"""Videos of a simulation: MP4 or GIF, written whole or not at all."""

from __future__ import annotations

import errno
import io
import math
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import imageio.v2 as imageio
import numpy as np
from imageio_ffmpeg import get_ffmpeg_exe

from marl_handover.config import require_between
from marl_handover.errors import InvalidSetting, MissingFile, MissingProgram
from marl_handover.files import replacing
from marl_handover.simulation.camera import Pixels

FORMATS = (".mp4", ".gif")
Add = Callable[[Pixels], None]

_QUALITY = 25  # x264's constant rate factor, less is better
_SEEKABLE = ("-g", "2", "-bf", "0", "-preset", "veryfast")
"""Every second picture whole, none that waits for a later one."""
_ENDING_S = 600.0


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
    """A context manager that takes frames; the file appears when the block ends without an error.

    Args:
        path: of the file; its suffix says the format.
        fps: frames a second.
        name: of the setting, for errors.
        seekable: whether any picture of an MP4 is to be found without decoding many before it; the file is larger.

    Raises:
        CannotWrite: there is no room for the file, or the encoder failed.
        MissingProgram: there is no ffmpeg, which writes MP4.
    """

    def __init__(self, path: Path | str, fps: float, name: str = "video", seekable: bool = False) -> None:
        self.path, self._fps, self._seekable = require_video(name, path), fps, seekable
        require_between("fps", fps, 1, 50)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        suffix = self.path.suffix.lower()
        temporary = self._stack.enter_context(replacing(self.path, suffix))
        film = _mp4(temporary, self._fps, self._seekable) if suffix == ".mp4" else _gif(temporary, self._fps)
        self.add = self._stack.enter_context(film)
        """Append one frame, RGB (height, width, 3)."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stack.__exit__(kind, error, trace)


@contextmanager
def _gif(path: Path, fps: float) -> Iterator[Add]:
    buffer = io.BytesIO()  # imageio would go on writing to a disk that is full
    writer = imageio.get_writer(buffer, format="GIF", mode="I", duration=1000 / fps, loop=0)
    with writer:
        yield writer.append_data
    path.write_bytes(buffer.getbuffer())


@contextmanager
def _mp4(path: Path, fps: float, seekable: bool) -> Iterator[Add]:
    """Frames for ffmpeg, which is started with the first one, and whose end is looked at: a film that it gave up is no film."""
    process: subprocess.Popen[bytes] | None = None
    with tempfile.TemporaryFile() as said:

        def add(frame: Pixels) -> None:
            """Hand a frame to ffmpeg."""
            nonlocal process
            process = process or _ffmpeg(path, fps, frame.shape, said, seekable)
            assert process.stdin is not None
            try:
                process.stdin.write(np.ascontiguousarray(frame, np.uint8).data)
            except BrokenPipeError:
                raise _encoder_error(process, said) from None

        try:
            yield add
            if process is not None:
                process.communicate(timeout=_ENDING_S)
                if process.returncode:
                    raise _encoder_error(process, said)
        finally:
            if process is not None:
                process.kill()
                process.wait()


def _ffmpeg(path: Path, fps: float, shape: tuple[int, ...], said: BinaryIO, seekable: bool) -> subprocess.Popen[bytes]:
    try:
        program = get_ffmpeg_exe()
    except RuntimeError as error:
        raise MissingProgram("a video that ends in .mp4", "ffmpeg", "install it, set IMAGEIO_FFMPEG_EXE, or ask for .gif") from error
    frames = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{shape[1]}x{shape[0]}", "-r", f"{fps:g}", "-i", "-"]
    film = [
        "-an",
        "-vcodec",
        "libx264",
        "-pix_fmt",
        "yuv420p",
        "-crf",
        str(_QUALITY),
        *(_SEEKABLE if seekable else ()),
        str(path.absolute()),
    ]
    # In a session of its own: Ctrl-C in the terminal is for us, who then end it.
    command = [program, "-y", "-loglevel", "error", *frames, *film]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said, start_new_session=True)


def _encoder_error(process: subprocess.Popen[bytes], said: BinaryIO) -> OSError:
    status = process.wait(_ENDING_S)
    said.seek(0)
    words = said.read(10_000).decode(errors="replace")
    if os.strerror(errno.ENOSPC) in words:
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    last = (words.strip().splitlines() or ["it said nothing"])[-1][:200]
    return OSError(errno.EIO, f"ffmpeg ended with {status}: {last}")


class FrameClock:
    """Says at which of many calls, ``step_s`` apart, a frame of ``fps`` a second is due."""

    def __init__(self, fps: float, step_s: float) -> None:
        self._per_step, self._calls = fps * step_s, 0

    def due(self) -> int:
        """How many frames fall on this call: 0, 1 or more."""
        self._calls += 1
        return math.floor(self._calls * self._per_step + 1e-9) - math.floor((self._calls - 1) * self._per_step + 1e-9)
