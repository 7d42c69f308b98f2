"""One controller board over its wire: handshake, queries that are checked, moves that are safe to send."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from math import ceil, inf
from typing import NamedTuple, TypeVar

from marl_handover.hardware import protocol
from marl_handover.hardware.clock import Clock
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
from marl_handover.hardware.settings import BoardConfig, StreamConfig, TimeoutConfig
from marl_handover.hardware.transport import Logged, Wire, choose_port

T = TypeVar("T")

QUIET_S = 0.02
"""A line on which nothing came for so long is taken to be silent: above a board's slowest pause between bytes, and FTDI's latency."""

MOVED_US = 100
"""A pulse may change by this much between two readings while a move goes on."""


class LineRecord(NamedTuple):
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
        self.firmware: protocol.Firmware | None = None
        self._timeouts, self._clock = timeouts, clock
        self._log: deque[Logged] = deque(maxlen=log_entries)
        self._wire: Wire | None = None
        self._known: set[int] = set()
        self._expected, self._attend = ExpectedPulses(), on_wait

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
            self._expected.hold(channel, PulseRange(pulse, pulse + protocol.READING_US))

    def referenced(self, channels: Iterable[int]) -> bool:
        """Whether the first move of all these channels is done."""
        return self._known.issuperset(channels)

    def first_move(self, pulses_us: Mapping[int, int], time_ms: int | None) -> LineRecord:
        """Send channels to where they are known to stand. The board ignores ``time_ms`` for channels without a pulse, and jumps."""
        sent = self._send_move(pulses_us, time_ms, {})
        self._known.update(pulses_us)
        return sent

    def move(self, pulses_us: Mapping[int, int], time_ms: int, speeds_us_s: Mapping[int, int] | None = None) -> LineRecord:
        """Move channels together, each at most at its speed; a :class:`NoReference` if any of them was never moved."""
        unknown = [channel for channel in pulses_us if channel not in self._known]
        if unknown:
            raise NoReference(self.name, unknown)
        return self._send_move(pulses_us, time_ms, speeds_us_s or {})

    def stop(self, channels: Iterable[int]) -> LineRecord:
        """Stop channels where they are. Written even in a dry run."""
        listed = list(channels)
        data = protocol.stop(listed)
        written_s = self.wire.write(data)
        self._expected.stop(listed, written_s, self._clock.now_s() + self.wire.backlog_s())
        return LineRecord(self.name, written_s, data, True)

    def torque_off(self, channels: Iterable[int]) -> LineRecord:
        """No more pulses: arms sink, but for a dry run. The next move is a first one."""
        listed = list(channels)
        self._known.difference_update(listed)
        self._expected.forget(listed)
        return self._send(protocol.encode_line([protocol.Level(channel, False) for channel in listed]))

    def _pulses_once(self, listed: list[int]) -> dict[int, int | None]:
        answer = self._asked(protocol.query_pulses(listed), len(listed), lambda reply: protocol.parse_pulses(reply, len(listed)))
        return dict(zip(listed, answer, strict=True))

    def _astray(self, found: Mapping[int, int | None], taken_s: tuple[float, float], tolerance_us: float) -> PulseMismatch | None:
        """The first reading, taken between two times, that cannot be what its channel was sent."""
        for channel, pulse in found.items():
            span = self._expected.span(channel, *taken_s)
            if span is None or pulse is None:
                continue
            if not span.lower - protocol.READING_US - tolerance_us <= pulse <= span.upper + tolerance_us:
                return PulseMismatch(self.name, channel, pulse, span, tolerance_us)
        return None

    def _forget(self) -> None:
        """Every channel counts as never moved."""
        self._known.clear()
        self._expected.forget()

    def _send_move(self, pulses_us: Mapping[int, int], time_ms: int | None, speeds_us_s: Mapping[int, int]) -> LineRecord:
        sent = self._send(protocol.group_move(pulses_us, time_ms, speeds_us_s))
        if sent.written:
            heard_s = self._clock.now_s() + self.wire.backlog_s()
            self._expected.move(pulses_us, (time_ms or 0) / 1000, speeds_us_s, sent.t_s, heard_s)
        return sent

    def _send(self, line: bytes) -> LineRecord:
        if self.dry_run:
            return LineRecord(self.name, self.wire.note_held_back(line), line, False)
        return LineRecord(self.name, self.wire.write(line), line, True)

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


def _version(wire: Wire, on_wait: Callable[[], object] | None = None) -> tuple[protocol.Firmware | None, bytes]:
    """What a board says that it is, None if that is no SSC-32, and the answer itself."""
    # An old fragment would glue itself to the question; a board that is just starting may miss the first one.
    reply = wire.ask(protocol.CANCEL + protocol.VERSION, protocol.MAX_VERSION_BYTES, until=protocol.CR, on_wait=on_wait)
    try:
        firmware = protocol.parse_version(reply)
    except BadReply:
        return None, reply
    wire.drain(QUIET_S, on_wait)  # some say more on a second line
    return firmware, reply


def _same(before: int | None, now: int | None) -> bool:
    """Whether two readings of a pulse agree: both none, or a frame of the fastest move apart at most."""
    if before is None or now is None:
        return before is now
    return abs(before - now) <= MOVED_US


FRAME_S = 0.02
"""Boards change their pulses at this interval, and move in whole ones."""

LATE_S = 0.03
"""A board begins a move at most so long after its line came in: one frame, and half of one for the computer's own delays."""

SETTLED_S = 0.08
"""A board is done with a move so long after its time is over, at the latest; its line's own way included."""

_RAMPS = 16
"""More moves than fit on a line while a board may be late."""


class PulseRange(NamedTuple):
    """Everything from ``lower`` to ``upper``, in us."""

    lower: float
    upper: float

    def joined(self, other: PulseRange) -> PulseRange:
        """The smallest span that holds both."""
        return PulseRange(min(self.lower, other.lower), max(self.upper, other.upper))


class _Ramp(NamedTuple):
    """Straight from one pulse to another; there before and after. It began ``doubt_us`` beside ``start_us`` at most."""

    start_us: float
    end_us: float
    begin_s: float
    end_s: float
    doubt_us: float = 0.0

    def at(self, t_s: float) -> float:
        """The pulse at a time."""
        return self.end_us + self._left(t_s) * (self.start_us - self.end_us)

    def doubt(self, t_s: float) -> float:
        """How far beside it the channel may be at a time, in us."""
        return self._left(t_s) * self.doubt_us

    def speed_us_s(self, t_s: float) -> float:
        """Change of the pulse at a time."""
        return (self.end_us - self.start_us) / (self.end_s - self.begin_s) if self.begin_s <= t_s < self.end_s else 0.0

    def _left(self, t_s: float) -> float:
        """The share that is still to go."""
        if self.end_s == inf:
            return 1.0
        return 0.0 if t_s >= self.end_s or self.end_s <= self.begin_s else min((self.end_s - t_s) / (self.end_s - self.begin_s), 1.0)


class _Channel:
    """One channel as one board would move it: its last ways, each of which cuts off the one before."""

    def __init__(self, pulse_us: float, doubt_us: float = 0.0) -> None:
        self._ramps = deque([_Ramp(pulse_us, pulse_us, -inf, inf, doubt_us)], maxlen=_RAMPS)

    def at(self, t_s: float) -> float:
        """The pulse at a time."""
        return self._ramp(t_s).at(t_s)

    def distance(self, pulse_us: float, t_s: float) -> float:
        """How far it may have to a pulse at a time, at most."""
        way = self._ramp(t_s)
        return abs(pulse_us - way.at(t_s)) + way.doubt(t_s)

    def go(self, pulse_us: float, begin_s: float, duration_s: float) -> None:
        """Turn to another pulse. Where it turned is known to a frame: one of the old speed for one of the new."""
        before = self._ramp(begin_s)
        way = _Ramp(before.at(begin_s), pulse_us, begin_s, begin_s + duration_s)
        doubt_us, old_us_s = before.doubt(begin_s), before.speed_us_s(begin_s)
        if old_us_s:
            doubt_us += FRAME_S * abs(old_us_s - way.speed_us_s(begin_s))
        self._ramps.append(way._replace(doubt_us=doubt_us))

    def range(self, from_s: float, to_s: float) -> PulseRange:
        """Everything that it may pass between two times."""
        turns = (t_s for way in self._ramps for t_s in (way.begin_s, way.end_s) if from_s < t_s < to_s)
        passed = [(self.at(t_s), self._ramp(t_s).doubt(t_s)) for t_s in (from_s, to_s, *turns)]
        return PulseRange(min(pulse - doubt for pulse, doubt in passed), max(pulse + doubt for pulse, doubt in passed))

    def _ramp(self, t_s: float) -> _Ramp:
        return next((way for way in reversed(self._ramps) if t_s >= way.begin_s), self._ramps[0])


class ExpectedPulses:
    """The channels of one board. Times are those of the caller's clock.

    When a board acts is known to some frames only. So each channel is reckoned twice: as a board would move it that is as early as can
    be, and as one that is as late; what it puts out lies between.
    """

    def __init__(self) -> None:
        self._channels: dict[int, tuple[_Channel, _Channel]] = {}

    def move(
        self, pulses_us: Mapping[int, int], duration_s: float, speeds_us_s: Mapping[int, int], written_s: float, heard_s: float
    ) -> None:
        """Channels were sent to ``pulses_us`` together, each at most at its speed: written at one time, at the board at another.

        One of which nothing is known jumps there.
        """
        for channel, pulse in pulses_us.items():
            self._channels.setdefault(channel, (_Channel(pulse), _Channel(pulse)))
        for late, begin_s in enumerate((written_s - FRAME_S, heard_s + LATE_S)):
            courses = {channel: self._channels[channel][late] for channel in pulses_us}
            ways_s = (courses[channel].distance(pulses_us[channel], begin_s) / speed for channel, speed in speeds_us_s.items())
            longest_s = max((duration_s, *ways_s))
            for channel, pulse in pulses_us.items():
                courses[channel].go(float(pulse), begin_s, FRAME_S * ceil(longest_s / FRAME_S) if late else longest_s)

    def stop(self, channels: Iterable[int], written_s: float, heard_s: float) -> None:
        """Channels were told to stay where they are."""
        for channel in channels:
            if (span := self.span(channel, written_s, heard_s + LATE_S)) is not None:
                self.hold(channel, span)

    def hold(self, channel: int, span: PulseRange) -> None:
        """A channel note_readback still somewhere in ``span``."""
        middle_us, doubt_us = (span.lower + span.upper) / 2, (span.upper - span.lower) / 2
        self._channels[channel] = _Channel(middle_us, doubt_us), _Channel(middle_us, doubt_us)

    def forget(self, channels: Iterable[int] | None = None) -> None:
        """Nothing is known of these channels any more; of none, without any."""
        for channel in list(self._channels if channels is None else channels):
            self._channels.pop(channel, None)

    def span(self, channel: int, from_s: float, to_s: float) -> PulseRange | None:
        """What a channel may put out between two times; None for one that was told nothing."""
        if channel not in self._channels:
            return None
        early, late = self._channels[channel]
        # A move that was cut off in its first frame may have been carried out for all of that frame, or not at all.
        return early.range(from_s - LATE_S, to_s).joined(late.range(from_s, to_s + LATE_S))
