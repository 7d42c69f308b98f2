"""What a board's channels should put out by now, reckoned from the lines that it was sent."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from math import ceil, inf
from typing import NamedTuple

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
