"""Pictures from whatever takes them, behind one small interface: the newest one, with its time, or a clear error."""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import NamedTuple, Protocol, Self

from marl_handover.errors import HandoverError, WorkFailed
from marl_handover.perception.calibration import Pixels

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
