"""Serial ports: which there are, and one that is open.

An open one cannot hang: every wait has an end, every failure is a :class:`PortLost`, every byte is in the log.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import serial
from serial.tools import list_ports

from marl_handover.hardware.clock import Clock
from marl_handover.hardware.errors import FlushFailed, PortLost, PortNotFound, WrongState
from marl_handover.hardware.settings import BoardConfig, TimeoutConfig

BITS_PER_BYTE = 10
CANCEL = b"\x1b"
"""Escape: a board drops what it was sent of the present line, so that a fresh start is not glued to an old fragment."""

WAIT_SLICE_S = 0.004
"""Nobody who waits for an answer is out of reach for longer."""

_SCHEMES = "marl_handover.hardware.emulator"
_FAILURES = (serial.SerialException, OSError, FlushFailed)
"""Of a port that was pulled out: pyserial lets ``in_waiting`` raise a bare OSError, and flushing termios's own error, which is none."""

if _SCHEMES not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append(_SCHEMES)  # so that every port of this package may be ssc32emu://name


class Logged(NamedTuple):
    """Bytes that went over a wire. ``direction``: ``>`` to the board, ``<`` from it, ``x`` held back by a dry run."""

    t_s: float
    direction: str
    data: bytes


class LineRecord(NamedTuple):
    """A line and when it was handed over; ``written`` is False in a dry run."""

    board: str
    t_s: float
    data: bytes
    written: bool


class Wire:
    """One open port.

    Args:
        port: a device path or a pyserial URL.
        baud: bits per second.
        timeouts: limits of waiting.
        clock: whose time the log is in.
        log: where every byte is noted; it outlives the port.

    Raises:
        PortNotFound: it cannot be opened: it is not there, somebody else has it, or the user may not.
    """

    def __init__(self, port: str, baud: int, timeouts: TimeoutConfig, clock: Clock, log: deque[Logged]) -> None:
        self.port, self._timeouts, self._clock, self.log = port, timeouts, clock, log
        # Two locks: a stop from another thread must not wait for an answer.
        self._asking, self._sending = threading.RLock(), threading.RLock()
        self._free_s, self._cut = 0.0, False
        try:
            self._serial: Any = serial.serial_for_url(
                port, baudrate=baud, timeout=timeouts.reply_s, write_timeout=timeouts.write_s, exclusive=True
            )
        except (*_FAILURES, ValueError) as error:
            text = " ".join(str(error).split())
            reason = f"it cannot be opened ({text})"
            if "ermission denied" in text:
                reason += "; run: sudo usermod -aG dialout $USER, and log in again"
            raise PortNotFound(port, reason, [found.path for found in list_serial_ports()]) from error
        # A pty has no such mode, other systems neither; without it an answer takes FTDI's 16 ms.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            self._serial.set_low_latency_mode(True)

    @property
    def baud(self) -> int:
        """Bits per second."""
        return int(self._serial.baudrate)

    def set_baud(self, baud: int) -> None:
        """Change the rate of the open port."""
        with self._guarded("changing its rate"):
            self._serial.baudrate = baud

    def write(self, data: bytes) -> float:
        """Send; the time at which it was handed over.

        After a write that was cut short, by a signal or a full buffer, the board is first told to drop the fragment: glued to one, a line
        may well be another move.
        """
        with self._sending, self._guarded("writing"):
            now_s = self._clock.now_s()
            data, self._cut = (CANCEL + data if self._cut else data), True
            self._serial.write(data)
            self._cut = False
            self._free_s = max(now_s, self._free_s) + len(data) * BITS_PER_BYTE / self.baud
            self.log.append(Logged(now_s, ">", data))
            return now_s

    def note_held_back(self, data: bytes) -> float:
        """Log what a dry run does not send."""
        now_s = self._clock.now_s()
        self.log.append(Logged(now_s, "x", data))
        return now_s

    def backlog_s(self) -> float:
        """How long what was written is still on its way."""
        return max(0.0, self._free_s - self._clock.now_s())

    def ask(
        self, question: bytes, size: int, *, until: bytes = b"", timeout_s: float | None = None, on_wait: Callable[[], object] | None = None
    ) -> bytes:
        """Send a question and read what comes back: up to ``size`` bytes, up to the first ``until``, or whatever there is at the timeout.

        What had come in before is thrown away: it answers nothing that was asked now. While the answer is waited for, ``on_wait`` is called
        every :data:`WAIT_SLICE_S`; what it raises ends the waiting.
        """
        with self._asking, self._guarded("reading"):
            self._serial.reset_input_buffer()
            end_s = self._clock.now_s() + self.backlog_s() + (self._timeouts.reply_s if timeout_s is None else timeout_s)
            self.write(question)
            reply = bytearray()
            while len(reply) < size and not (until and reply.endswith(until)):
                left_s = end_s - self._clock.now_s()
                if left_s <= 0:
                    break
                self._serial.timeout = left_s if on_wait is None else min(left_s, WAIT_SLICE_S)
                reply += self._serial.read(1 if until else size - len(reply))
                if on_wait is not None:
                    on_wait()
            if reply:
                self.log.append(Logged(self._clock.now_s(), "<", bytes(reply)))
            return bytes(reply)

    def drain(self, quiet_s: float, on_wait: Callable[[], object] | None = None) -> None:
        """Throw away what comes in, until nothing has for ``quiet_s``, or a second has passed. ``on_wait``: as of :meth:`ask`."""
        with self._asking, self._guarded("reading"):
            self._serial.timeout = quiet_s if on_wait is None else min(quiet_s, WAIT_SLICE_S)
            now_s = self._clock.now_s()
            end_s, quiet_since_s = now_s + 1.0, now_s
            while now_s < end_s and now_s - quiet_since_s < quiet_s:
                heard = self._serial.read(256)
                now_s = self._clock.now_s()
                quiet_since_s = now_s if heard else quiet_since_s
                if on_wait is not None:
                    on_wait()

    def close(self) -> None:
        """Let the port go, whatever state it is in."""
        with contextlib.suppress(*_FAILURES):
            self._serial.close()

    @contextlib.contextmanager
    def _guarded(self, what: str) -> Iterator[None]:
        try:
            yield
        except _FAILURES as error:
            raise PortLost(self.port, what, " ".join(str(error).split())) from error


class DeviceOptions(TypedDict, total=False):
    """What every device on a wire takes by name; see :class:`WiredDevice`."""

    log_entries: int
    dry_run: bool
    on_wait: Callable[[], object]


class WiredDevice:
    """What is reached over a wire, open or not.

    Args:
        name: of the board or bus in the settings.
        config: its port and rate.
        timeouts: limits of waiting.
        clock: time.
        log_entries: length of the byte log.
        dry_run: write questions and stops only.
        on_wait: is called time and again while an answer is waited for; it may raise.
    """

    def __init__(
        self,
        name: str,
        config: BoardConfig,
        timeouts: TimeoutConfig,
        clock: Clock,
        *,
        log_entries: int = 20_000,
        dry_run: bool = False,
        on_wait: Callable[[], object] = lambda: None,
    ) -> None:
        self.name, self.config, self.dry_run = name, config, dry_run
        self._timeouts, self._clock, self._attend = timeouts, clock, on_wait
        self._log: deque[Logged] = deque(maxlen=log_entries)
        self._wire: Wire | None = None

    @property
    def wire(self) -> Wire:
        """The open port. Raises :class:`WrongState` if there is none."""
        if self._wire is None:
            raise WrongState(f"use {self.name}", "not connected", "connected")
        return self._wire

    @property
    def log(self) -> list[Logged]:
        """Every byte with its time, as far back as the log goes, whatever became of the port meanwhile."""
        return list(self._log)

    def close(self) -> None:
        """Let the port go; servos keep what they do. Again is fine."""
        if self._wire is not None:
            self._wire.close()
        self._wire = None

    def _send(self, data: bytes) -> LineRecord:
        """Write what makes servos move or let go; a dry run only notes it."""
        if self.dry_run:
            return LineRecord(self.name, self.wire.note_held_back(data), data, False)
        return LineRecord(self.name, self.wire.write(data), data, True)

    def _opened(self) -> Wire:
        """A wire to the port of the settings, or to the only likely one. Raises :class:`PortNotFound`."""
        return Wire(choose_port(self.config.port), self.config.baud, self._timeouts, self._clock, self._log)


FTDI = (0x0403, 0x6001)
"""Vendor and product of the USB chip on an SSC-32U, and in most cables of an SSC-32."""

WCH = 0x1A86
"""Vendor of the USB chips on the adapters that are sold for bus servos."""

_BY_ID = Path("/dev/serial/by-id")
_USB_SERIAL = Path("/sys/bus/usb-serial/devices")


class PortInfo(NamedTuple):
    """A port: the name to use, what it says about itself, and whether its USB chip is of a kind that boards have, or adapters of buses."""

    path: str
    description: str
    likely: bool
    bus: bool = False


def list_serial_ports() -> list[PortInfo]:
    """All ports, likely ones first; nothing is opened."""
    stable = {str(link.resolve()): str(link) for link in sorted(_BY_ID.glob("*"))} if _BY_ID.is_dir() else {}
    found = [
        PortInfo(
            stable.get(str(Path(port.device).resolve()), port.device),
            port.description or "",
            (port.vid, port.pid) == FTDI,
            port.vid == WCH,
        )
        for port in list_ports.comports()
    ]
    return sorted(found, key=lambda port: (not port.likely, port.path))


def choose_port(port: str) -> str:
    """``port`` itself if it is set, else the one port that is likely a board's. Raises :class:`PortNotFound`."""
    if port:
        return port
    ports = list_serial_ports()
    likely = [found.path for found in ports if found.likely]
    if len(likely) != 1:
        reason = "none looks like a controller board" if not likely else "more than one could be the board"
        raise PortNotFound("", reason, [found.path for found in ports])
    return likely[0]


def latency_ms(path: str) -> int | None:
    """How long a USB serial chip keeps bytes back before it hands them over; None where the system does not say."""
    try:
        return int((_USB_SERIAL / Path(path).resolve().name / "latency_timer").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
