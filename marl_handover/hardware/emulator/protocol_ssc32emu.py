"""The pyserial URL scheme ``ssc32emu://name``: a mounted :class:`SerialDevice` as a serial port inside the process.

pyserial finds this module by its name, in a package of ``serial.protocol_handler_packages``. Reads and writes fail as those of a real port
whose cable comes out: a read and a write with ``SerialException``, ``in_waiting`` with a bare ``OSError``, flushing with ``termios.error``,
which is neither, and ``is_open`` stays True.
"""

from __future__ import annotations

import errno
import os
from weakref import WeakKeyDictionary

from serial import PortNotOpenError, SerialException, SerialTimeoutException
from serial.serialutil import SerialBase

from marl_handover.hardware.clock import Clock
from marl_handover.hardware.emulator.device import BITS_PER_BYTE, SerialDevice
from marl_handover.hardware.errors import FlushFailed

SCHEME = "ssc32emu://"
BUFFER_BYTES = 4096
"""What the operating system takes before a write has to wait."""

_mounted: dict[str, tuple[SerialDevice, Clock]] = {}
_in_use: WeakKeyDictionary[SerialDevice, Serial] = WeakKeyDictionary()


def mount(name: str, device: SerialDevice, clock: Clock) -> str:
    """Make ``device`` the one behind ``ssc32emu://name``; the URL. A device that was there before is replaced."""
    _mounted[name] = device, clock
    return SCHEME + name


def unmount(name: str) -> None:
    """Take it away; ports that are open keep their device."""
    _mounted.pop(name, None)


class Serial(SerialBase):
    """An open port to a mounted device."""

    is_open: bool

    def open(self) -> None:
        """Raises :class:`SerialException` if there is no such device, it is not plugged in, or it is held exclusively."""
        if self.is_open:
            raise SerialException("Port is already open.")
        name = str(self._port)[len(SCHEME) :].rstrip("/")
        if name not in _mounted:
            raise SerialException(errno.ENOENT, f"could not open port {self._port}: no emulated board of that name is mounted")
        device, self._clock = _mounted[name]
        device.advance(self._clock.now_s())
        if not device.plugged:
            raise SerialException(errno.ENOENT, f"could not open port {self._port}: no such device")
        if self._exclusive and _in_use.get(device) not in (None, self):
            raise SerialException(errno.EAGAIN, f"could not exclusively lock port {self._port}: resource temporarily unavailable")
        self._device, self.is_open = device, True
        self._unplugged_before = device.unplugged
        if self._exclusive:
            _in_use[device] = self
        self._reconfigure_port()
        self.reset_input_buffer()

    def close(self) -> None:
        """Let the port go; again is fine."""
        if self.is_open:
            self.is_open = False
            if _in_use.get(self._device) is self:
                del _in_use[self._device]

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read."""
        now_s = self._now_s()
        if self._gone():
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return self._device.waiting(now_s)

    @property
    def out_waiting(self) -> int:
        """Bytes that are still on their way to the board."""
        left_s = self._device.sending_until_s() - self._now_s()
        return max(0, round(left_s * self._baudrate / BITS_PER_BYTE))

    def read(self, size: int = 1) -> bytes:
        """Up to ``size`` bytes, until the timeout."""
        end_s = None if self._timeout is None else self._now_s() + self._timeout
        data = bytearray()
        while len(data) < size:
            now_s = self._now_s()
            if self._gone():
                raise SerialException("device reports readiness to read but returned no data (device disconnected?)")
            data += self._device.read(now_s, size - len(data))
            if len(data) == size or (end_s is not None and now_s >= end_s):
                break
            next_s = self._device.next_event_s(size - len(data))
            wait_s = 0.01 if next_s is None else max(next_s - now_s, 1e-6)
            self._clock.sleep_s(wait_s if end_s is None else min(wait_s, end_s - now_s))
        return bytes(data)

    def write(self, data: bytes) -> int:
        """Send; waits only while the buffer is full, up to the write timeout."""
        end_s = None if self._write_timeout is None else self._now_s() + self._write_timeout
        while self.out_waiting + len(data) > BUFFER_BYTES and self.out_waiting:
            if end_s is not None and self._now_s() >= end_s:
                raise SerialTimeoutException("Write timeout")
            self._clock.sleep_s(0.001)
        now_s = self._now_s()
        if self._gone():
            raise SerialException(f"write failed: [Errno {errno.EIO}] {os.strerror(errno.EIO)}")
        self._device.write(bytes(data), now_s)
        return len(data)

    def flush(self) -> None:
        """Wait until everything has left."""
        self._clock.sleep_s(max(0.0, self._device.sending_until_s() - self._now_s()))

    def reset_input_buffer(self) -> None:
        """Throw away what was not read."""
        self._now_s()
        self._require_cable()
        self._device.forget_input()

    def reset_output_buffer(self) -> None:
        """Nothing to do: what was written is on the wire."""
        self._now_s()
        self._require_cable()

    def _now_s(self) -> float:
        if not self.is_open:
            raise PortNotOpenError()
        return self._clock.now_s()

    def _require_cable(self) -> None:
        """Raise ``termios.error``, as flushing a port does whose cable came out."""
        if self._gone():
            raise FlushFailed(errno.EIO, os.strerror(errno.EIO))

    def _gone(self) -> bool:
        """Whether the cable came out since the port was opened; a cable that is back needs a fresh open."""
        self._device.advance(self._clock.now_s())
        return self._device.unplugged > self._unplugged_before

    def _reconfigure_port(self) -> None:
        if self.is_open:
            self._device.host_baud = self._baudrate

    def _update_dtr_state(self) -> None:
        """The board does not look at it."""

    def _update_rts_state(self) -> None:
        """The board does not look at it."""
