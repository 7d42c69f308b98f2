"""Pictures from whatever takes them, behind one small interface: the newest one, with its time, or a clear error.

UVC devices, RealSense, videos, folders of pictures, rendered pictures: :func:`open_camera` opens each by its settings.
"""

from __future__ import annotations

import contextlib
import glob
import importlib
import itertools
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import cv2
import numpy as np

from marl_handover.errors import CorruptFile, HandoverError, InvalidSetting, MissingFile, WorkFailed, counted, install_line
from marl_handover.files import read_bounded
from marl_handover.perception.calibration import Pixels
from marl_handover.perception.overlay import decoded
from marl_handover.perception.settings import CameraConfig

Clock = Callable[[], float]

_JOIN_S = 2.0
_PAUSE_S = 0.005


class NoCamera(HandoverError):
    """A camera that was named is not there, or gives other pictures than were asked for; the message says what to do."""


class StaleFrame(WorkFailed):
    """No picture is young enough."""

    def __init__(self, name: str, age_s: float, max_age_s: float) -> None:
        super().__init__(f"{name}: the newest picture is {age_s:.2f} s old, {max_age_s:g} s is allowed; is the camera unplugged or frozen?")
        self.name, self.age_s, self.max_age_s = name, age_s, max_age_s


class EndOfFrames(WorkFailed):
    """A file or a folder has no more pictures."""


class Frame(NamedTuple):
    """A picture: BGR (height, width, 3), when it was taken by the camera's clock [s], and its number, which counts up."""

    image: Pixels
    t_s: float
    number: int


class Camera(ABC):
    """A source of pictures. A context manager: ``with open_camera(...) as camera: frame = camera.read()``."""

    name = "camera"

    @abstractmethod
    def read(self, max_age_s: float | None = None, wait_s: float | None = None) -> Frame:
        """The newest picture that was not read before; waits for it if need be, for ``wait_s`` (None: as the settings have it).

        Raises:
            StaleFrame: there is none that is at most ``max_age_s`` old (None: as the settings have it).
            EndOfFrames: there will be none any more.
        """

    def newest(self) -> Frame | None:
        """The newest picture there is, for who only watches; it still counts as unread. None: pictures are taken when they are read."""
        return None

    def close(self) -> None:  # noqa: B027 - a source without a device has nothing to let go
        """Let the device go; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class RenderedCamera(Camera):
    """Pictures from a function: a twin's. It gives pixels, taken now, or a whole :class:`Frame`, whose age then counts."""

    name = "rendered camera"

    def __init__(self, picture: Callable[[], Pixels | Frame], max_age_s: float, clock: Clock = time.monotonic) -> None:
        self._picture, self._max_age_s, self._clock, self._number = picture, max_age_s, clock, 0

    def read(self, max_age_s: float | None = None, wait_s: float | None = None) -> Frame:
        """See :meth:`Camera.read`; there is nothing to wait for."""
        limit = self._max_age_s if max_age_s is None else max_age_s
        began_s = self._clock()
        taken = self._picture()
        self._number += 1
        if not isinstance(taken, Frame):
            return Frame(taken, began_s, self._number)
        age_s = self._clock() - taken.t_s
        if age_s > limit:
            raise StaleFrame(self.name, age_s, limit)
        return taken


class Device(Protocol):
    """What a live camera is read through, always from one thread."""

    name: str

    def grab(self) -> Pixels | None:
        """Wait for the next picture, not for ever; None if none came."""

    def stop(self) -> None:
        """Let the device go."""


class Reopening:
    """A device that is opened anew whenever it has given nothing for a while: a cable that was pulled out comes back.

    Args:
        opened: opens it.
        after_s: how long it may give nothing, and how long to leave between two attempts.
        clock: in s.

    Raises:
        NoCamera: it is not there in the beginning.
    """

    def __init__(self, opened: Callable[[], Device], after_s: float, clock: Clock = time.monotonic) -> None:
        self._opened, self._after_s, self._clock = opened, after_s, clock
        self._device: Device | None = opened()
        self.name = self._device.name
        self._good_s, self._stopped = clock(), False

    def grab(self) -> Pixels | None:
        """The next picture; None if none came."""
        image = None if self._device is None else self._device.grab()
        now_s = self._clock()
        if image is not None:
            self._good_s = now_s
        elif now_s - self._good_s > self._after_s and not self._stopped:
            self._reopen()
        return image

    def stop(self) -> None:
        """Let the device go."""
        self._stopped = True
        if self._device is not None:
            self._device.stop()

    def _reopen(self) -> None:
        if self._device is not None:
            self._device.stop()
            self._device = None
        with contextlib.suppress(NoCamera):
            self._device = self._opened()
        if self._stopped and self._device is not None:  # somebody stopped it while it was being opened
            self._device.stop()
        self._good_s = self._clock()


class LiveCamera(Camera):
    """A device whose pictures come by themselves.

    A thread takes them off as they come: drivers queue some, and a reader that comes once in a while would get old ones.

    Args:
        device: what to read.
        warm_up_s: throw pictures away this long.
        max_age_s: what :meth:`read` allows by default.
        timeout_s: how long to wait for a picture.
        clock: in s.

    Raises:
        NoCamera: no picture came within ``warm_up_s + timeout_s``.
    """

    def __init__(self, device: Device, warm_up_s: float, max_age_s: float, timeout_s: float, clock: Clock = time.monotonic) -> None:
        self.name = device.name
        self._device, self._max_age_s, self._timeout_s, self._clock = device, max_age_s, timeout_s, clock
        self._news = threading.Condition()
        self._newest: Frame | None = None
        self._read = self._number = 0
        self._opened_s, self._ended = clock(), False
        self._thread = threading.Thread(target=self._take_off, name=f"frames of {device.name}", daemon=True)
        self._thread.start()
        try:
            self._warm_up(warm_up_s)
        except BaseException:
            self.close()
            raise

    def read(self, max_age_s: float | None = None, wait_s: float | None = None) -> Frame:
        """See :meth:`Camera.read`."""
        limit = self._max_age_s if max_age_s is None else max_age_s
        with self._news:
            self._news.wait_for(lambda: self._fresh(limit), timeout=self._timeout_s if wait_s is None else wait_s)
            if not self._fresh(limit):
                newest_s = self._opened_s if self._newest is None else self._newest.t_s
                raise StaleFrame(self.name, self._clock() - newest_s, limit)
            assert self._newest is not None
            self._read = self._newest.number
            return self._newest

    def newest(self) -> Frame | None:
        """See :meth:`Camera.newest`."""
        return self._newest

    def close(self) -> None:
        """Stop the thread and let the device go; a second call does nothing."""
        if self._ended:
            return
        self._ended = True
        self._thread.join(_JOIN_S)
        self._device.stop()

    def _fresh(self, limit: float) -> bool:
        return self._newest is not None and self._newest.number > self._read and self._clock() - self._newest.t_s <= limit

    def _take_off(self) -> None:
        while not self._ended:
            image = self._device.grab()
            if image is None:
                time.sleep(_PAUSE_S)  # an unplugged device answers at once
                continue
            with self._news:
                self._number += 1
                self._newest = Frame(image, self._clock(), self._number)
                self._news.notify_all()

    def _warm_up(self, seconds: float) -> None:
        with self._news:
            if not self._news.wait_for(lambda: self._newest is not None, timeout=seconds + self._timeout_s):
                raise NoCamera(
                    f"{self.name} gives no pictures; is another program using it, or is it on a USB port too slow for this size?"
                )
        time.sleep(seconds)
        with self._news:
            self._read = self._number


PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
BY_ID = "/dev/v4l/by-id/*"
INSTALL_REALSENSE = f"{install_line('realsense')} (and, on Debian or Ubuntu, apt install libusb-1.0-0)"

_MS = 1000
_PICTURE_BYTES = 100_000_000
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF")


def open_camera(config: CameraConfig, picture: Callable[[], Pixels | Frame] | None = None, clock: Clock = time.monotonic) -> Camera:
    """The camera of ``config``, warmed up.

    Args:
        config: source, size, patience.
        picture: for camera.source=rendered, what gives its pictures.
        clock: in s; frames carry its time.

    Raises:
        InvalidSetting, UnknownChoice: a setting is out of its limits, or ``picture`` is missing.
        NoCamera, MissingFile, CorruptFile: the device, file or folder is not there or gives no pictures of the size asked for.
    """
    config.validate()
    if config.source == "rendered":
        if picture is None:
            raise InvalidSetting("camera.source", config.source, "another one here: nothing renders its pictures")
        return RenderedCamera(picture, config.max_age_s, clock)
    if config.source == "video":
        return Recording(_video(Path(config.path)), clock)
    if config.source == "folder":
        return Recording(_folder(Path(config.path), config.frames_per_s), clock)
    device = Reopening(lambda: UvcDevice(config) if config.source == "uvc" else RealSenseDevice(config), config.timeout_s)
    return LiveCamera(device, config.warm_up_s, config.max_age_s, config.timeout_s, clock)


def cameras_found() -> tuple[str, ...]:
    """Paths of video devices on this machine: by name where the system has those, which stay the same when cameras are replugged."""
    return tuple(sorted(glob.glob(BY_ID)) or sorted(glob.glob("/dev/video*")))


class Recording(Camera):
    """Recorded pictures, one after the other, in the time of the recording."""

    name = "recording"

    def __init__(self, pictures: Iterator[tuple[float, Pixels]], clock: Clock) -> None:
        self._pictures, self._opened_s, self._number = pictures, clock(), 0

    def read(self, max_age_s: float | None = None, wait_s: float | None = None) -> Frame:
        """The next picture; it is never too old."""
        following = next(self._pictures, None)
        if following is None:
            raise EndOfFrames(f"the recording ends after {counted(self._number, 'picture')}")
        self._number += 1
        return Frame(following[1], self._opened_s + following[0], self._number)


def _video(path: Path) -> Iterator[tuple[float, Pixels]]:
    """Times and pictures of a video file."""
    if not path.is_file():
        raise MissingFile("video", path)
    capture = cv2.VideoCapture(str(path))
    rate, first = capture.get(cv2.CAP_PROP_FPS), capture.read()[1]
    if first is None or not rate > 0:
        raise CorruptFile("video", path, "it holds no pictures that can be decoded")
    return _decoded(capture, first, rate)


def _decoded(capture: Any, image: Any, rate: float) -> Iterator[tuple[float, Pixels]]:
    """Times and pictures from ``image`` on."""
    for number in itertools.count():
        if image is None:
            break
        yield number / rate, np.asarray(image, dtype=np.uint8)
        image = capture.read()[1]
    capture.release()


def _folder(path: Path, frames_per_s: float) -> Iterator[tuple[float, Pixels]]:
    """Times and pictures of a folder, in the order of their names."""
    if not path.is_dir():
        raise MissingFile("folder of pictures", path)
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in PICTURES)
    if not files:
        raise MissingFile("pictures", path, f"the folder must hold files that end in {', '.join(PICTURES)}")

    def pictures() -> Iterator[tuple[float, Pixels]]:
        for number, file in enumerate(files):
            yield number / frames_per_s, decoded(read_bounded(file, _PICTURE_BYTES, "picture"), file, _FORMATS)

    return pictures()


class UvcDevice:
    """A standard USB camera through Video4Linux; also the colour half of a RealSense without its library."""

    def __init__(self, config: CameraConfig) -> None:
        self.name = config.path
        if not os.path.exists(config.path):
            found = ", ".join(cameras_found()) or "none on this machine"
            raise NoCamera(f"camera {config.path} is not there; found: {found}")
        capture = cv2.VideoCapture(os.path.realpath(config.path), cv2.CAP_V4L2)
        if not capture.isOpened():
            raise NoCamera(f"camera {config.path} cannot be opened; is it a camera, is another program using it, are you in group video?")
        wanted = (config.width_px, config.height_px)
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, wanted[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted[1])
        capture.set(cv2.CAP_PROP_FPS, config.frames_per_s)
        got = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if got != wanted:
            capture.release()
            raise NoCamera(
                f"camera {config.path} gives {got[0]}x{got[1]} px in {config.fourcc}, not {wanted[0]}x{wanted[1]}; try camera.fourcc=MJPG"
            )
        self._capture = capture

    def grab(self) -> Pixels | None:
        """The next picture; None if the device is gone."""
        there, image = self._capture.read()
        return np.asarray(image, dtype=np.uint8) if there else None

    def stop(self) -> None:
        """Release the device."""
        self._capture.release()


class RealSenseDevice:
    """The colour stream of an Intel RealSense; ``camera.path`` is its serial number, or empty for the only one."""

    def __init__(self, config: CameraConfig) -> None:
        self.name = f"RealSense {config.path}".strip()
        rs = _realsense()
        settings, self._timeout_ms = rs.config(), round(config.timeout_s * _MS)
        if config.path:
            settings.enable_device(config.path)
        settings.enable_stream(rs.stream.color, config.width_px, config.height_px, rs.format.bgr8, round(config.frames_per_s))
        self._pipeline = rs.pipeline()
        try:
            self._pipeline.start(settings)
        except RuntimeError as error:
            raise NoCamera(f"{self.name} cannot be started: {error}; on USB 2 a D435 gives 1280x720 at 6 frames/s only") from error

    def grab(self) -> Pixels | None:
        """The next picture; None if the device is gone."""
        try:
            colour = self._pipeline.wait_for_frames(self._timeout_ms).get_color_frame()
        except RuntimeError:
            return None
        # A copy: the buffer is the library's, which has only a few of them.
        return np.array(colour.get_data(), dtype=np.uint8) if colour else None

    def stop(self) -> None:
        """Stop the stream; that of a device that is gone has stopped."""
        with contextlib.suppress(RuntimeError):
            self._pipeline.stop()


def _realsense() -> Any:
    """The library. Without the system's libusb its import fails with OSError or ImportError, as the platform has it."""
    try:
        return importlib.import_module("pyrealsense2")
    except (ImportError, OSError) as error:
        raise NoCamera(f"camera.source = 'realsense' cannot be used: {error}; {INSTALL_REALSENSE}") from error
