"""Cameras by their settings: a UVC device, a RealSense, a video, a folder of pictures, a rendered picture."""

from __future__ import annotations

import contextlib
import glob
import importlib
import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile, install_line
from marl_handover.files import read_bounded
from marl_handover.perception.calibration import Pixels
from marl_handover.perception.camera import Camera, Clock, EndOfFrames, Frame, LiveCamera, NoCamera, RenderedCamera, Reopening
from marl_handover.perception.overlay import decoded
from marl_handover.perception.settings import CameraConfig
from marl_handover.wording import counted

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
