"""An emulated device behind a real serial port: a pseudo-terminal whose path is a symlink that outlives unplugging."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import tty
from collections.abc import Callable, Sequence
from pathlib import Path

from marl_handover.errors import InvalidSetting
from marl_handover.files import temporary_of
from marl_handover.hardware.clock import Clock, RealClock
from marl_handover.hardware.emulator.device import SerialDevice

_RATES = {getattr(termios, f"B{baud}"): baud for baud in (2400, 9600, 38400, 57600, 115200, 500000, 1000000)}
IDLE_S = 0.02
"""So long a turn waits at most for something to do."""


class PtyEmulator:
    """Serves one device. A pty takes any rate and paces nothing: the device does, at the rate the other side has set.

    Args:
        device: what is plugged in. Its clock begins at 0 when this is made.
        link: path of the symlink; it is gone while the cable is out, and points to a new pty once it is back.
        clock: real time.

    Raises:
        InvalidSetting: something else than a symlink is in the place of ``link``, or it cannot be written.
    """

    def __init__(self, device: SerialDevice, link: Path | str, clock: Clock | None = None) -> None:
        self.device, self.link = device, Path(link)
        self._clock: Clock = clock or RealClock()
        self._zero_s = self._clock.now_s()
        self._master, self._slave = -1, -1
        if self.link.exists() and not self.link.is_symlink():
            raise InvalidSetting("link", str(link), "a path at which there is nothing, or a symlink")
        self.device.advance(0.0)
        self._follow_plug()

    def now_s(self) -> float:
        """Time on the device's clock."""
        return self._clock.now_s() - self._zero_s

    def serve(self, until: Callable[[], bool]) -> None:
        """Pass bytes on until ``until`` says True; it is asked at least every 20 ms."""
        while not until():
            turn([self])

    def wait_s(self) -> float:
        """How long nothing is to be done, 20 ms at most, unless bytes come in."""
        next_s = self.device.next_event_s()
        return IDLE_S if next_s is None else min(IDLE_S, max(0.0, next_s - self.now_s()))

    def fileno(self) -> int:
        """Of the master's side; -1 while the cable is out."""
        return self._master

    def pass_on(self, ready: bool) -> None:
        """Take what has come in, if bytes are ``ready``, and hand over what has come back."""
        data = os.read(self._master, 4096) if ready else b""
        if data:
            self.device.host_baud = _RATES.get(termios.tcgetattr(self._slave)[5], 0) or self.device.baud
            self.device.write(data, self.now_s())
        self.device.advance(self.now_s())
        self._follow_plug()
        reply = self.device.read(self.now_s())
        if reply and self._master >= 0:
            with contextlib.suppress(BlockingIOError):  # nobody reads: a real port's buffer runs over, too
                os.write(self._master, reply)

    def close(self) -> None:
        """Take the port away. Again is fine."""
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        if self._master >= 0:
            self.link.unlink(missing_ok=True)
        self._master, self._slave = -1, -1

    def _follow_plug(self) -> None:
        """Make the port be there or not, as the device says."""
        if self.device.plugged and self._master < 0:
            self._open()
        elif not self.device.plugged and self._master >= 0:
            self.close()

    def _open(self) -> None:
        # The slave stays open here too: without any reader a master's reads fail until somebody opens it again.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        temporary = temporary_of(self.link)
        try:
            self.link.parent.mkdir(parents=True, exist_ok=True)
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(os.ttyname(self._slave))
            temporary.replace(self.link)
        except OSError as error:
            self.close()
            raise InvalidSetting("link", str(self.link), f"a path that can be written ({error.strerror or error})") from error


def turn(emulators: Sequence[PtyEmulator]) -> None:
    """Wait for the next thing to do at any of them, 20 ms at most, and do it."""
    ready, _, _ = select.select([each for each in emulators if each.fileno() >= 0], [], [], min(each.wait_s() for each in emulators))
    for each in emulators:
        each.pass_on(each in ready)
