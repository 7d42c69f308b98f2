"""The controller: lines in, replies out, and what each of its 32 channels puts out every 20 ms.

Where the board's behaviour is not documented the choice is said here: a move's length is rounded up to whole frames; a move sent while
another runs starts from what is put out now, in the next frame; a channel let go (``P0``, ``L``, ``H``) forgets its position.
"""

from __future__ import annotations

import math
import random
import re
from dataclasses import dataclass

from marl_handover.hardware.settings import CHANNELS, PULSE_US, READING_US
from marl_handover.hardware.ssc32 import CR, parse_version
from marl_handover.hardware.transport import CANCEL

FRAME_S = 0.02

_SPACE = b" \t\n"
_MOVES = re.compile(r"((?:#\d+P\d+(?:S\d+)?)+)(?:T(\d+))?")
_MOVE = re.compile(r"#(\d+)P(\d+)(?:S(\d+))?")
_OFFSETS = re.compile(r"(?:#\d+PO[+-]?\d+)+")
_LEVELS = re.compile(r"(?:#\d+[HL])+")
_PULSE_QUERY = re.compile(r"(?:QP\d+)+")
_STOP = re.compile(r"STOP(\d+)")
_DIGITS = 5
_MAX_BUFFER = 512
_OFFSET_US = (-100, 100)


class Channel:
    """One output: off, or on the way from one pulse to another."""

    def __init__(self) -> None:
        self.known, self.offset_us, self.high = False, 0, False
        self._start, self._target, self._from, self._frames = 0.0, 0.0, 0, 1

    def commanded(self, frame: int) -> float:
        """The pulse in us at a frame, without the offset; 0 when off."""
        if not self.known:
            return 0.0
        return self._start + (self._target - self._start) * min(max(frame - self._from, 0) / self._frames, 1.0)

    def output(self, frame: int) -> float:
        """The pulse that the servo gets; 0 for none."""
        return min(max(self.commanded(frame) + self.offset_us, PULSE_US[0]), PULSE_US[1]) if self.known else 0.0

    def go(self, target_us: float, frame: int, frames: int) -> None:
        """Begin a move. Without a known position it is a jump, whatever was asked."""
        self._start = self.commanded(frame) if self.known else target_us
        self._frames = frames if self.known else 1
        self._target, self._from, self.known = target_us, frame, True

    def hold(self, frame: int) -> None:
        """Stay at what is put out now."""
        self._start = self._target = self.commanded(frame)

    def let_go(self, high: bool = False) -> None:
        """No more pulses."""
        self.known, self.high = False, high


class EmulatedBoard:
    """One SSC-32 or SSC-32U. Times ``t_s`` are the caller's and never go back.

    Args:
        firmware: the text that ``VER`` answers; it decides what the board knows.
        seed: of what faults change at random.
    """

    def __init__(self, firmware: str = "SSC32-V2.50USB", seed: int = 0) -> None:
        self.firmware = parse_version(firmware.encode("ascii", "replace"))
        self.stuck = False
        """Whether ``Q`` answers "moving" for ever, as some boards do at times."""
        self.ignored, self.guessed = 0.0, 0.0
        """The share of moves that are not carried out, and of pulses that are told at random."""
        self.told: list[int] | None = None
        """What ``QP`` tells of each channel, whatever it puts out; None: the truth."""
        self._random = random.Random(seed)
        self.power_up(0.0)

    def power_up(self, t_s: float) -> None:
        """Forget everything."""
        self.on_since_s = t_s
        self.channels = [Channel() for _ in range(CHANNELS)]
        self._buffer = bytearray()
        self._moving_until = 0

    def frame(self, t_s: float) -> int:
        """Number of the frame that is put out at a time."""
        return max(0, math.floor((t_s - self.on_since_s) / FRAME_S + 1e-9))

    def freeze_told(self, t_s: float) -> None:
        """From now on ``QP`` tells what it would now."""
        self.told = None
        self.told = [self._tens(number, self.frame(t_s)) for number in range(CHANNELS)]

    def outputs_us(self, t_s: float) -> list[float]:
        """What the servos get, channel by channel; 0: no pulse."""
        frame = self.frame(t_s)
        return [channel.output(frame) for channel in self.channels]

    def receive(self, data: bytes, t_s: float) -> list[bytes]:
        """Take bytes, the last of which came in at ``t_s``; the replies of the lines that ended."""
        replies: list[bytes] = []
        for part in re.split(rb"(?<=\r)", data):
            ended = part.endswith(CR)
            kept = part[:-1] if ended else part
            if CANCEL in kept:
                self._buffer.clear()
                kept = kept[kept.rindex(CANCEL) + 1 :]
            self._buffer += kept[: max(0, _MAX_BUFFER - len(self._buffer))]
            if ended:
                text = bytes(self._buffer).decode("latin-1")
                self._buffer.clear()
                replies += self._execute(text, t_s)
        return replies

    def _execute(self, line: str, t_s: float) -> list[bytes]:
        """Carry out one line. What is not understood is dropped in silence."""
        text = line.translate({code: None for code in _SPACE}).upper()
        frame = self.frame(t_s)
        if match := _MOVES.fullmatch(text):
            self._move(match[1], match[2], frame)
        elif _OFFSETS.fullmatch(text):
            self._shift(text)
        elif _LEVELS.fullmatch(text):
            for number, level in re.findall(r"#(\d+)([HL])", text):
                if _is_channel(number):
                    self.channels[int(number)].let_go(level == "H")
        elif (match := _STOP.fullmatch(text)) and self.firmware.has_stop:
            if _is_channel(match[1]):
                self.channels[int(match[1])].hold(frame)
        else:
            return self._answer(text, frame)
        return []

    def _move(self, moves: str, time_ms: str | None, frame: int) -> None:
        """A move or group move: everything that has a position begins and ends together."""
        if self.ignored and self._random.random() < self.ignored:
            return
        wanted: dict[int, tuple[int, int]] = {}
        for number, pulse, speed in _MOVE.findall(moves):
            if not _is_channel(number) or len(pulse) > _DIGITS or len(speed) > _DIGITS:
                return
            wanted[int(number)] = int(pulse), int(speed or 0)
        duration_s = int(time_ms[:_DIGITS]) / 1000 if time_ms else 0.0
        for number, (pulse, speed) in wanted.items():
            if self.channels[number].known and pulse and speed:
                duration_s = max(duration_s, abs(_clamped(pulse) - self.channels[number].commanded(frame)) / speed)
        frames = max(1, math.ceil(duration_s / FRAME_S - 1e-9))
        for number, (pulse, _) in wanted.items():
            if pulse:
                self.channels[number].go(_clamped(pulse), frame, frames)
            else:
                self.channels[number].let_go()
        self._moving_until = frame + frames

    def _shift(self, text: str) -> None:
        for number, offset in re.findall(r"#(\d+)PO([+-]?\d{1,3})(?=#|$)", text):
            if _is_channel(number) and _OFFSET_US[0] <= int(offset) <= _OFFSET_US[1]:
                self.channels[int(number)].offset_us = int(offset)

    def _answer(self, text: str, frame: int) -> list[bytes]:
        """Replies to queries."""
        if text == "Q":
            # About the last move's time, not about the servos: a stop changes nothing.
            return [b"+" if self.stuck or frame < self._moving_until else b"."]
        if _PULSE_QUERY.fullmatch(text):
            numbers = re.findall(r"\d+", text)
            return [bytes(self._tens(int(n), frame) for n in numbers)] if all(map(_is_channel, numbers)) else []
        if text == "VER":
            return [self.firmware.text.encode() + CR]
        return []

    def _tens(self, number: int, frame: int) -> int:
        """A pulse as ``QP`` says it. Firmware before 2.00 forgot to take the offset out."""
        if self.guessed and self._random.random() < self.guessed:
            return self._random.randint(PULSE_US[0] // READING_US, PULSE_US[1] // READING_US)
        if self.told is not None:
            return self.told[number]
        channel = self.channels[number]
        pulse = channel.commanded(frame)
        return int((pulse + channel.offset_us * (self.firmware.number < (2, 0))) / 10 + 1e-9) if pulse else 0


def _is_channel(number: str) -> bool:
    return len(number) <= 2 and int(number) < CHANNELS


def _clamped(pulse_us: int) -> int:
    return min(max(pulse_us, PULSE_US[0]), PULSE_US[1])


@dataclass(frozen=True)
class ServoTruth:
    """What a servo is really like. Positions ``p`` are rad for a joint, mm for a gripper.

    ``pulse = zero_us + slope_us * p``; ``low`` and ``high`` are the end stops, ``speed`` per second.
    """

    zero_us: float
    slope_us: float
    low: float
    high: float
    speed: float
    dead_band_us: float = 8.0
    lag_s: float = 0.03
    settle_sd_us: float = 0.0


class Servo:
    """A servo that stands at ``position`` (rad or mm) when it is first powered."""

    def __init__(self, truth: ServoTruth, position: float, seed: int = 0) -> None:
        self.truth = truth
        self._random = random.Random(seed)
        self._pulse_us, self._moved, self._error_us = 0.0, False, 0.0
        self.jammed = False
        """Something holds it: it pushes and does not move."""
        self.put(position)

    @property
    def position(self) -> float:
        """Where it truly is."""
        return (self._at_us - self.truth.zero_us) / self.truth.slope_us

    @property
    def pushing(self) -> bool:
        """Whether it strains against an end stop or an obstacle; hobby servos burn out like that."""
        stuck = self.jammed or not self._low_us < self._at_us < self._high_us
        return stuck and self._pulse_us > 0 and abs(self._pulse_us - self._at_us) > 2 * self.truth.dead_band_us

    def put(self, position: float) -> None:
        """Turn it by hand."""
        truth = self.truth
        self._low_us, self._high_us = sorted((truth.zero_us + truth.slope_us * truth.low, truth.zero_us + truth.slope_us * truth.high))
        self._at_us = min(max(truth.zero_us + truth.slope_us * position, self._low_us), self._high_us)

    def step(self, pulse_us: float, duration_s: float) -> None:
        """Follow a pulse for a while; 0 is none, and it stays where it is."""
        truth = self.truth
        if pulse_us != self._pulse_us:
            self._pulse_us, self._moved = pulse_us, True
        elif self._moved:
            self._moved, self._error_us = False, self._random.gauss(0.0, truth.settle_sd_us)
        if pulse_us <= 0.0 or self.jammed:
            return
        gap = pulse_us + self._error_us - self._at_us
        beyond = abs(gap) - truth.dead_band_us / 2
        if beyond > 0.0:
            fastest = truth.speed * abs(truth.slope_us) * duration_s
            self._at_us += math.copysign(min(fastest, beyond * -math.expm1(-duration_s / truth.lag_s)), gap)
            self._at_us = min(max(self._at_us, self._low_us), self._high_us)
