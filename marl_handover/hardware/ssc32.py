"""One controller board over its wire: handshake, queries that are checked, moves that are safe to send."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, TypeVar

from marl_handover.hardware import protocol
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.commanded import Commanded, Span
from marl_handover.hardware.errors import (
    BadReply,
    BoardReset,
    BoardSilent,
    NoReference,
    PortLost,
    PulseMismatch,
    UnsuitableFirmware,
    WrongState,
)
from marl_handover.hardware.ports import choose_port
from marl_handover.hardware.settings import BoardConfig, StreamConfig, TimeoutConfig
from marl_handover.hardware.transport import Logged, Wire

T = TypeVar("T")

QUIET_S = 0.02
"""A line on which nothing came for so long is taken to be silent: above a board's slowest pause between bytes, and FTDI's latency."""

MOVED_US = 100
"""A pulse may change by this much between two readings while a move goes on."""


class SentLine(NamedTuple):
    """A line and when it was handed over; ``written`` is False in a dry run."""

    board: str
    t_s: float
    data: bytes
    written: bool


class Ssc32:
    """A board by the name it has in the settings.

    Args:
        name: of the board.
        config: its port and rate.
        timeouts: limits of waiting.
        clock: time.
        log_entries: length of the byte log.
        dry_run: write queries and stops only.
        attend: is called time and again while an answer is waited for; it may raise.
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
        attend: Callable[[], object] = lambda: None,
    ) -> None:
        self.name, self.config, self.dry_run = name, config, dry_run
        self.firmware: protocol.Firmware | None = None
        self._timeouts, self._clock = timeouts, clock
        self._log: deque[Logged] = deque(maxlen=log_entries)
        self._wire: Wire | None = None
        self._known: set[int] = set()
        self._commanded, self._attend = Commanded(), attend

    @property
    def wire(self) -> Wire:
        """The open port. Raises :class:`WrongState` if there is none."""
        if self._wire is None:
            raise WrongState("use the board", "not connected", "connected")
        return self._wire

    @property
    def connected(self) -> bool:
        """Whether a board has answered and the port is still open."""
        return self._wire is not None and self.firmware is not None

    @property
    def log(self) -> list[Logged]:
        """Every byte with its time, as far back as the log goes, whatever became of the port meanwhile."""
        return list(self._log)

    def connect(self) -> protocol.Firmware:
        """Open the port and find the board on it, trying other rates if allowed; every channel counts as never moved.

        Raises:
            PortNotFound: there is no port, or it is in use.
            BoardSilent: nothing answers; most often the controller's own supply is off.
            UnsuitableFirmware: it is no SSC-32, or one without ``STOP``.
        """
        self.close()
        wire = Wire(choose_port(self.config.port), self.config.baud, self._timeouts, self._clock, self._log)
        try:
            self.firmware = self._handshake(wire)
        except BaseException:
            wire.close()
            raise
        self._wire = wire
        return self.firmware

    def close(self) -> None:
        """Let the port go; the servos keep their last pulse. Again is fine."""
        if self._wire is not None:
            self._wire.close()
        self._wire, self.firmware = None, None
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

    def moving(self) -> bool:
        """Whether the last move's time is not over. It says nothing of servos that were stopped, and some boards get stuck on True."""
        return self._asked(protocol.QUERY, 1, protocol.parse_moving)

    def read_register(self, register: int) -> int:
        """A register's value."""
        return self._asked(protocol.read_register(register), 8, protocol.parse_register, until=protocol.CR)

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

    def stands(self, pulses_us: Mapping[int, int]) -> None:
        """Take readings of channels that stand still for what they put out, whatever they were sent before."""
        for channel, pulse in pulses_us.items():
            self._commanded.hold(channel, Span(pulse, pulse + protocol.READING_US))

    def referenced(self, channels: Iterable[int]) -> bool:
        """Whether the first move of all these channels is done."""
        return self._known.issuperset(channels)

    def first_move(self, pulses_us: Mapping[int, int], time_ms: int | None) -> SentLine:
        """Send channels to where they are known to stand. The board ignores ``time_ms`` for channels without a pulse, and jumps."""
        sent = self._send_move(pulses_us, time_ms, {})
        self._known.update(pulses_us)
        return sent

    def move(self, pulses_us: Mapping[int, int], time_ms: int, speeds_us_s: Mapping[int, int] | None = None) -> SentLine:
        """Move channels together, each at most at its speed; a :class:`NoReference` if any of them was never moved."""
        unknown = [channel for channel in pulses_us if channel not in self._known]
        if unknown:
            raise NoReference(self.name, unknown)
        return self._send_move(pulses_us, time_ms, speeds_us_s or {})

    def stop(self, channels: Iterable[int]) -> SentLine:
        """Stop channels where they are. Written even in a dry run."""
        listed = list(channels)
        data = protocol.stop(listed)
        written_s = self.wire.write(data)
        self._commanded.stop(listed, written_s, self._clock.now_s() + self.wire.backlog_s())
        return SentLine(self.name, written_s, data, True)

    def limp(self, channels: Iterable[int]) -> SentLine:
        """No more pulses: arms sink, but for a dry run. The next move is a first one."""
        listed = list(channels)
        self._known.difference_update(listed)
        self._commanded.forget(listed)
        return self._send(protocol.encode_line([protocol.Level(channel, False) for channel in listed]))

    def _pulses_once(self, listed: list[int]) -> dict[int, int | None]:
        answer = self._asked(protocol.query_pulses(listed), len(listed), lambda reply: protocol.parse_pulses(reply, len(listed)))
        return dict(zip(listed, answer, strict=True))

    def _astray(self, found: Mapping[int, int | None], taken_s: tuple[float, float], tolerance_us: float) -> PulseMismatch | None:
        """The first reading, taken between two times, that cannot be what its channel was sent."""
        for channel, pulse in found.items():
            span = self._commanded.span(channel, *taken_s)
            if span is None or pulse is None:
                continue
            if not span.lower - protocol.READING_US - tolerance_us <= pulse <= span.upper + tolerance_us:
                return PulseMismatch(self.name, channel, pulse, span, tolerance_us)
        return None

    def _forget(self) -> None:
        """Every channel counts as never moved."""
        self._known.clear()
        self._commanded.forget()

    def _send_move(self, pulses_us: Mapping[int, int], time_ms: int | None, speeds_us_s: Mapping[int, int]) -> SentLine:
        sent = self._send(protocol.group_move(pulses_us, time_ms, speeds_us_s))
        if sent.written:
            heard_s = self._clock.now_s() + self.wire.backlog_s()
            self._commanded.move(pulses_us, (time_ms or 0) / 1000, speeds_us_s, sent.t_s, heard_s)
        return sent

    def _send(self, line: bytes) -> SentLine:
        if self.dry_run:
            return SentLine(self.name, self.wire.note_held_back(line), line, False)
        return SentLine(self.name, self.wire.write(line), line, True)

    def _handshake(self, wire: Wire) -> protocol.Firmware:
        """The firmware; the wire is left at the rate at which it answered."""
        bauds = [self.config.baud]
        if self.config.scan:
            bauds += [baud for baud in protocol.BAUDS if baud != self.config.baud]
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
            reply = self.wire.ask(question, size, until=until, attend=self._attend)
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


def _version(wire: Wire, attend: Callable[[], object] | None = None) -> tuple[protocol.Firmware | None, bytes]:
    """What a board says that it is, None if that is no SSC-32, and the answer itself."""
    # An old fragment would glue itself to the question; a board that is just starting may miss the first one.
    reply = wire.ask(protocol.CANCEL + protocol.VERSION, protocol.MAX_VERSION_BYTES, until=protocol.CR, attend=attend)
    try:
        firmware = protocol.parse_version(reply)
    except BadReply:
        return None, reply
    wire.drain(QUIET_S, attend)  # some say more on a second line
    return firmware, reply


def _same(before: int | None, now: int | None) -> bool:
    """Whether two readings of a pulse agree: both none, or a frame of the fastest move apart at most."""
    if before is None or now is None:
        return before is now
    return abs(before - now) <= MOVED_US
