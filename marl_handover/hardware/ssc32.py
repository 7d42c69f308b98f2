"""SSC-32 and SSC-32U servo controllers: their language, and one board over its wire, with checked queries and moves that are safe to send.

Lines are ASCII and end in CR. Moves are never acknowledged, bad lines are dropped in silence, and a pulse beyond its limits is clamped, so
everything is checked here before it is sent. Source: Lynxmotion's SSC-32U user guide (pages 24-39) and what users measured, as collected in
the design notes. ``T`` is in milliseconds (the guide says microseconds once; its examples say otherwise).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, TypeVar, Unpack

from marl_handover.hardware.clock import Clock
from marl_handover.hardware.errors import (
    BadCommand,
    BadReply,
    BoardReset,
    BoardSilent,
    DuplicateChannel,
    LineTooLong,
    MixedCommands,
    NoReference,
    PortLost,
    PulseMismatch,
    UnsuitableFirmware,
)
from marl_handover.hardware.expected_pulses import ExpectedPulses, PulseRange
from marl_handover.hardware.settings import (
    BAUDS,
    CHANNELS,
    PULSE_US,
    READING_US,
    SPEED_US_S,
    TIME_MS,
    BoardConfig,
    StreamConfig,
    TimeoutConfig,
)
from marl_handover.hardware.transport import BITS_PER_BYTE, CANCEL, DeviceOptions, LineRecord, Wire, WiredDevice

MAX_LINE_BYTES = 256
"""No buffer size is published; this fits positions of all 32 channels with a time, and no driver in use sends longer lines."""

CR = b"\r"
QUERY = b"Q\r"
VERSION = b"VER\r"

MAX_VERSION_BYTES = 64
_FIRMWARE = re.compile(r"SSC32-V(\d+)\.(\d+)(\w*)")


@dataclass(frozen=True)
class Move:
    """Go to ``pulse_us``, not faster than ``speed_us_s`` if that is given."""

    channel: int
    pulse_us: int
    speed_us_s: int | None = None


@dataclass(frozen=True)
class Level:
    """Stop the pulses of a channel and hold its pin high or low. Low is how a servo is let go limp."""

    channel: int
    high: bool


BoardCommand = Move | Level


@dataclass(frozen=True)
class Firmware:
    """What ``VER`` said. ``number`` orders firmwares: (2, 50) for V2.50."""

    text: str
    number: tuple[int, int]
    suffix: str

    @property
    def has_stop(self) -> bool:
        """Whether ``STOP`` exists: from V2.01 on."""
        return self.number >= (2, 1)


def encode_line(commands: Sequence[BoardCommand], time_ms: int | None = None) -> bytes:
    """One line for commands of one type; ``time_ms`` goes with moves only. Moves in one line begin and end together.

    Raises:
        BadCommand: a value is out of its limits, or no whole number.
        DuplicateChannel, MixedCommands, LineTooLong: as they say.
    """
    kinds = {type(command) for command in commands}
    if not commands or not kinds <= {Move, Level}:
        raise BadCommand("commands", [type(command).__name__ for command in commands], "at least one Move or Level")
    if len(kinds) > 1:
        raise MixedCommands(kind.__name__ for kind in kinds)
    _require_distinct(command.channel for command in commands)
    text = "".join(_encoded(command) for command in commands)
    if time_ms is not None:
        if kinds != {Move}:
            raise BadCommand("time_ms", time_ms, "left out but for moves")
        text += f"T{_whole('time_ms', time_ms, *TIME_MS)}"
    return _line(text)


def group_move(pulses_us: Mapping[int, int], time_ms: int | None = None, speeds_us_s: Mapping[int, int] | None = None) -> bytes:
    """The line that takes channels to pulses; shorthand for :func:`encode_line` of :class:`Move`."""
    speeds = speeds_us_s or {}
    return encode_line([Move(channel, pulse, speeds.get(channel)) for channel, pulse in pulses_us.items()], time_ms)


def stop(channels: Iterable[int]) -> bytes:
    """Lines that stop channels where their moves are now: one short line a channel, so that the first acts while the rest is on its way.

    A fragment of a move that was cut short is dropped first: glued to it, the first stop would not be understood. (Ending the fragment's
    line instead would carry it out.) ``Q`` goes on saying "moving" until the original time is over.
    """
    listed = list(channels)
    _require_distinct(listed)
    return CANCEL + b"".join(_line(f"STOP{_channel(channel)}") for channel in listed)


def query_pulses(channels: Sequence[int]) -> bytes:
    """Ask what channels are sent now; :func:`parse_pulses` reads the reply of one byte a channel."""
    if not channels:
        raise BadCommand("channels", list(channels), "at least one")
    return _line("".join(f"QP{_channel(channel)}" for channel in channels))


def parse_moving(reply: bytes) -> bool:
    """Whether the last move goes on, from the one byte that answers ``Q``."""
    if reply not in (b".", b"+"):
        raise BadReply("Q", reply, "'.' or '+'")
    return reply == b"+"


def parse_pulses(reply: bytes, count: int) -> tuple[int | None, ...]:
    """Pulses in us, to 10 us, of ``count`` channels; None where the board sends none and so knows no position."""
    if len(reply) != count or any(byte != 0 and not 50 <= byte <= 250 for byte in reply):
        raise BadReply("QP", reply, f"{count} bytes, each 0 or 50 to 250")
    return tuple(10 * byte or None for byte in reply)


def parse_version(reply: bytes) -> Firmware:
    """What answers ``VER``. Raises :class:`BadReply` for anything that is no SSC-32's."""
    text = reply.decode("ascii", "replace").strip()
    match = _FIRMWARE.search(text)
    if match is None or len(reply) > MAX_VERSION_BYTES:
        raise BadReply("VER", reply, "SSC32-V and a number: other boards answer in another style")
    return Firmware(match[0], (int(match[1]), int(match[2])), match[3])


def _encoded(command: BoardCommand) -> str:
    head = f"#{_channel(command.channel)}"
    if isinstance(command, Move):
        speed = "" if command.speed_us_s is None else f"S{_whole('speed_us_s', command.speed_us_s, *SPEED_US_S)}"
        return f"{head}P{_whole('pulse_us', command.pulse_us, *PULSE_US)}{speed}"
    return head + ("H" if command.high else "L")


def _channel(channel: Any) -> int:
    return _whole("channel", channel, 0, CHANNELS - 1)


def _whole(name: str, value: Any, low: int, high: int) -> int:
    """``value`` as an int. NaN, text, truth values and fractions are refused: a number that had to be guessed at would move an arm."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
        raise BadCommand(name, value, f"a whole number, {low} to {high}")
    return int(value)


def _require_distinct(channels: Iterable[int]) -> None:
    seen: set[int] = set()
    for channel in channels:
        if channel in seen:
            raise DuplicateChannel(channel)
        seen.add(channel)


def _line(text: str) -> bytes:
    line = text.encode("ascii") + CR
    if len(line) > MAX_LINE_BYTES:
        raise LineTooLong(len(line), MAX_LINE_BYTES)
    return line


T = TypeVar("T")

QUIET_S = 0.02
"""A line on which nothing came for so long is taken to be silent: above a board's slowest pause between bytes, and FTDI's latency."""

MOVED_US = 100
"""A pulse may change by this much between two readings while a move goes on."""


class Ssc32(WiredDevice):
    """A board by the name it has in the settings. For its arguments see the base class."""

    has_encoders = False
    """Where a servo stands that has no pulse, nobody knows: its first move is a jump."""

    def __init__(self, name: str, config: BoardConfig, timeouts: TimeoutConfig, clock: Clock, **options: Unpack[DeviceOptions]) -> None:
        super().__init__(name, config, timeouts, clock, **options)
        self.firmware: Firmware | None = None
        self._known: set[int] = set()
        self._expected = ExpectedPulses()

    @property
    def connected(self) -> bool:
        """Whether a board has answered and the port is still open."""
        return self._wire is not None and self.firmware is not None

    def connect(self) -> Firmware:
        """Open the port and find the board on it, trying other rates if allowed; every channel counts as never moved.

        Raises:
            PortNotFound: there is no port, or it is in use.
            BoardSilent: nothing answers; most often the controller's own supply is off.
            UnsuitableFirmware: it is no SSC-32, or one without ``STOP``.
        """
        self.close()
        wire = self._opened()
        try:
            self.firmware = self._handshake(wire)
        except BaseException:
            wire.close()
            raise
        self._wire = wire
        return self.firmware

    def close(self) -> None:
        """Let the port go; the servos keep their last pulse. Again is fine."""
        super().close()
        self.firmware = None
        self._forget()

    def pulses(self, channels: Iterable[int]) -> dict[int, int | None]:
        """What the board puts out, in us to 10 us; None for channels without a pulse, whose position it does not know.

        Asked until two answers in a row agree, for a damaged byte may well look like a pulse. Raises :class:`BadReply` if they never do.
        """
        listed, before = list(channels), None
        for _ in range(2 + self._timeouts.retries):
            now = self._pulses_once(listed)
            if before is not None and all(_same(before[channel], now[channel]) for channel in listed):
                return now
            before = now
        raise BadReply("QP", repr(before).encode(), "the same pulses twice")

    def correct(self) -> None:
        """Nothing: nobody tells what is missing."""

    def marks(self, channels: Iterable[int]) -> tuple[int, ...]:
        """None: hobby servos keep nothing."""
        return ()

    def limp(self, channels: Iterable[int]) -> list[int]:
        """None: of a servo that does not hold nobody knows where it stands, and :meth:`pulses` says so."""
        return []

    def moving(self) -> bool:
        """Whether the last move's time is not over. It says nothing of servos that were stopped, and some boards get stuck on True."""
        return self._asked(QUERY, 1, parse_moving)

    def require_pulses(self, channels: Iterable[int], tolerance_us: float = StreamConfig.pulse_tolerance_us) -> None:
        """Ask whether channels put out what they were sent by now.

        A damaged byte may well look like a pulse: a bad answer is asked for again before it is believed. Nothing is asked in a dry run.

        Raises:
            BoardReset: channels have no pulse: a first move is then due again.
            PulseMismatch: one has another pulse than it was sent, by more than ``tolerance_us``, or another at each question.
            BadReply: the answers are none.
        """
        listed = list(channels)
        if self.dry_run:
            return
        before: dict[int, int | None] | None = None
        for _ in range(2 + self._timeouts.retries):
            asked_s = self._clock.now_s()
            now = self._pulses_once(listed)
            astray = self._astray(now, (asked_s, self._clock.now_s()), tolerance_us)
            if None not in now.values() and astray is None:
                return
            agreed = before is not None and all(_same(before[channel], now[channel]) for channel in listed)
            silent = [channel for channel in listed if now[channel] is None]
            if agreed and silent:
                self._forget()
                raise BoardReset(self.name, silent)
            if agreed and astray is not None:
                raise astray
            before = now
        raise astray or BadReply("QP", repr(before).encode(), "the same pulses twice")

    def note_readback(self, pulses_us: Mapping[int, int]) -> None:
        """Take readings of channels that stand still for what they put out, whatever they were sent before."""
        for channel, pulse in pulses_us.items():
            self._expected.hold(channel, PulseRange(pulse, pulse + READING_US))

    def referenced(self, channels: Iterable[int]) -> bool:
        """Whether the first move of all these channels is done."""
        return self._known.issuperset(channels)

    def first_move(self, pulses_us: Mapping[int, int], time_ms: int | None) -> LineRecord:
        """Send channels to where they are known to stand. The board ignores ``time_ms`` for channels without a pulse, and jumps."""
        sent = self._send_move(pulses_us, time_ms, {})
        self._known.update(pulses_us)
        return sent

    def move(
        self,
        pulses_us: Mapping[int, int],
        time_ms: int,
        speeds_us_s: Mapping[int, int] | None = None,
        aims_us: Mapping[int, int] | None = None,
    ) -> LineRecord:
        """Move channels together, each at most at its speed; a :class:`NoReference` if any of them was never moved.

        ``aims_us`` are for servos that brake for their goal, and not used.
        """
        unknown = [channel for channel in pulses_us if channel not in self._known]
        if unknown:
            raise NoReference(self.name, unknown)
        return self._send_move(pulses_us, time_ms, speeds_us_s or {})

    def stop(self, channels: Iterable[int]) -> LineRecord:
        """Stop channels where they are. Written even in a dry run."""
        listed = list(channels)
        data = stop(listed)
        written_s = self.wire.write(data)
        self._expected.stop(listed, written_s, self._clock.now_s() + self.wire.backlog_s())
        return LineRecord(self.name, written_s, data, True)

    def stop_s(self, channels: Sequence[int]) -> float:
        """How long a stop is on the wire at worst: it waits for the longest line."""
        longest = group_move(dict.fromkeys(channels, PULSE_US[1]), TIME_MS[1], dict.fromkeys(channels, SPEED_US_S[1]))
        return (len(longest) + len(stop(channels))) * BITS_PER_BYTE / self.wire.baud

    def torque_off(self, channels: Iterable[int]) -> LineRecord:
        """No more pulses: arms sink, but for a dry run. The next move is a first one."""
        listed = list(channels)
        self._known.difference_update(listed)
        self._expected.forget(listed)
        return self._send(encode_line([Level(channel, False) for channel in listed]))

    def _pulses_once(self, listed: list[int]) -> dict[int, int | None]:
        answer = self._asked(query_pulses(listed), len(listed), lambda reply: parse_pulses(reply, len(listed)))
        return dict(zip(listed, answer, strict=True))

    def _astray(self, found: Mapping[int, int | None], taken_s: tuple[float, float], tolerance_us: float) -> PulseMismatch | None:
        """The first reading, taken between two times, that cannot be what its channel was sent."""
        for channel, pulse in found.items():
            span = self._expected.span(channel, *taken_s)
            if span is None or pulse is None:
                continue
            if not span.lower - READING_US - tolerance_us <= pulse <= span.upper + tolerance_us:
                return PulseMismatch(self.name, channel, pulse, span, tolerance_us)
        return None

    def _forget(self) -> None:
        """Every channel counts as never moved."""
        self._known.clear()
        self._expected.forget()

    def _send_move(self, pulses_us: Mapping[int, int], time_ms: int | None, speeds_us_s: Mapping[int, int]) -> LineRecord:
        sent = self._send(group_move(pulses_us, time_ms, speeds_us_s))
        if sent.written:
            heard_s = self._clock.now_s() + self.wire.backlog_s()
            self._expected.move(pulses_us, (time_ms or 0) / 1000, speeds_us_s, sent.t_s, heard_s)
        return sent

    def _handshake(self, wire: Wire) -> Firmware:
        """The firmware; the wire is left at the rate at which it answered."""
        bauds = [self.config.baud]
        if self.config.scan:
            bauds += [baud for baud in BAUDS if baud != self.config.baud]
        odd = b""
        for baud in bauds:
            wire.set_baud(baud)
            for _ in range(1 + self._timeouts.retries):
                firmware, reply = _version(wire)
                if firmware is None:
                    odd = reply or odd
                    continue
                if not firmware.has_stop:
                    raise UnsuitableFirmware(wire.port, firmware.text, "it has no STOP; V2.01 or later is needed")
                return firmware
        if odd.strip():
            raise UnsuitableFirmware(wire.port, odd.decode("ascii", "replace").strip(), "no SSC-32 answers like that, or at another rate")
        raise BoardSilent(wire.port, bauds)

    def _asked(self, question: bytes, size: int, parse: Callable[[bytes], T], until: bytes = b"") -> T:
        """A checked answer. After a bad one the line is made quiet and the board asked who it is, so that nothing late is taken for it."""
        for attempt in range(1 + self._timeouts.retries):
            reply = self.wire.ask(question, size, until=until, on_wait=self._attend)
            try:
                return parse(reply)
            except BadReply:
                if attempt == self._timeouts.retries:
                    raise
                self._resynchronise()
        raise AssertionError("unreachable")

    def _resynchronise(self) -> None:
        """Make sure that what comes next answers what is asked next. Raises :class:`PortLost` if the board does not come back."""
        for _ in range(1 + self._timeouts.retries):
            self.wire.drain(QUIET_S, self._attend)
            if self.firmware is not None and _version(self.wire, self._attend)[0] == self.firmware:
                return
        raise PortLost(self.wire.port, "asking the board", "it no longer answers")


def _version(wire: Wire, on_wait: Callable[[], object] | None = None) -> tuple[Firmware | None, bytes]:
    """What a board says that it is, None if that is no SSC-32, and the answer itself."""
    # An old fragment would glue itself to the question; a board that is just starting may miss the first one.
    reply = wire.ask(CANCEL + VERSION, MAX_VERSION_BYTES, until=CR, on_wait=on_wait)
    try:
        firmware = parse_version(reply)
    except BadReply:
        return None, reply
    wire.drain(QUIET_S, on_wait)  # some say more on a second line
    return firmware, reply


def _same(before: int | None, now: int | None) -> bool:
    """Whether two readings of a pulse agree: both none, or a frame of the fastest move apart at most."""
    if before is None or now is None:
        return before is now
    return abs(before - now) <= MOVED_US
