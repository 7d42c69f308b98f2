"""The controller: lines in, replies out, and what each of its 32 channels puts out every 20 ms.

Where the board's behaviour is not documented the choice is said here: a move's length is rounded up to whole frames; a move sent while
another runs starts from what is put out now, in the next frame; a channel let go (``P0``, ``L``, ``H``) forgets its position.
"""

from __future__ import annotations

import math
import random
import re
from typing import NamedTuple

from marl_handover.hardware.protocol import CHANNELS, CR, ESC, OFFSET_US, PULSE_US, READING_US, parse_version

FRAME_S = 0.02

_SPACE = b" \t\n"
_MOVES = re.compile(r"((?:#\d+P\d+(?:S\d+)?)+)(?:T(\d+))?")
_MOVE = re.compile(r"#(\d+)P(\d+)(?:S(\d+))?")
_OFFSETS = re.compile(r"(?:#\d+PO[+-]?\d+)+")
_LEVELS = re.compile(r"(?:#\d+[HL])+")
_REGISTER = re.compile(r"R(\d+)(?:=(-?\d+))?")
_PULSE_QUERY = re.compile(r"(?:QP\d+)+")
_INPUTS = re.compile(r"(?:[A-F]L?){1,8}")
_ANALOG = re.compile(r"(?:V[A-H]){1,8}")
_STOP = re.compile(r"STOP(\d+)")
_DIGITS = 5
_MAX_BUFFER = 512
_FAST_S, _SLOW_S, _DEFAULTS_S = 100e-6, 0.3, 1.1
_REGISTERS = {0: 0b10, 1: 600, 2: 70, 4: 960}
_STARTUP, _DELAY, _OFFSETS_ON, _PULSES_ON, _DISABLED = (1 << bit for bit in (0, 1, 2, 3, 15))


class Reply(NamedTuple):
    """Bytes, and how long after the line's end the board begins to think of sending them."""

    delay_s: float
    data: bytes


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


class Board:
    """One SSC-32 or SSC-32U. Times ``t_s`` are the caller's and never go back.

    Args:
        firmware: the text that ``VER`` answers; it decides what the board knows.
        seed: of its analog noise.
    """

    def __init__(self, firmware: str = "SSC32-V2.50USB", seed: int = 0) -> None:
        self.firmware = parse_version(firmware.encode("ascii", "replace"))
        self.registers = dict(_REGISTERS)
        self.startup = ""
        self.inputs = dict.fromkeys("ABCDEF", False)
        self.volts = dict.fromkeys("ABCDEFGH", 0.0)
        self.stuck = False
        """Whether ``Q`` answers "moving" for ever, as some boards do at times."""
        self.ignored, self.guessed = 0.0, 0.0
        """The share of moves that are not carried out, and of pulses that are told at random."""
        self.told: list[int] | None = None
        """What ``QP`` tells of each channel, whatever it puts out; None: the truth."""
        self._random = random.Random(seed)
        self.power_up(0.0)

    def power_up(self, t_s: float) -> None:
        """Forget everything but the registers and the startup string."""
        self.on_since_s = t_s
        self.channels = [Channel() for _ in range(CHANNELS)]
        self._buffer = bytearray()
        self._moving_until, self._warm, self._was_low = 0, set[str](), set[str]()
        flags = self.registers[0]
        self.baud = 10 * self.registers[4] if self.registers[4] != _REGISTERS[4] else 0
        """The rate that register 4 asks for, or 0: as the button or the jumpers say."""
        if flags & _DISABLED:
            return
        for number, channel in enumerate(self.channels):
            if flags & _OFFSETS_ON:
                channel.offset_us = self.registers.get(32 + number, 0)
            pulse = self.registers.get(64 + number, 0)
            if flags & _PULSES_ON and pulse:
                channel.go(_clamped(pulse), 0, 1)
        if flags & _STARTUP:
            for line in self.startup.split(";"):
                self._execute(line, t_s)

    @property
    def delays_s(self) -> tuple[float, float]:
        """Before a reply, and between its bytes."""
        if not self.registers[0] & _DELAY:
            return 0.0, 0.0
        return 1e-6 * self.registers[1], 1e-6 * self.registers[2]

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

    def receive(self, data: bytes, t_s: float) -> list[Reply]:
        """Take bytes, the last of which came in at ``t_s``; the replies of the lines that ended."""
        replies: list[Reply] = []
        for part in re.split(rb"(?<=\r)", data):
            ended = part.endswith(CR)
            kept = part[:-1] if ended else part
            if ESC in kept:
                self._buffer.clear()
                kept = kept[kept.rindex(ESC) + 1 :]
            self._buffer += kept[: max(0, _MAX_BUFFER - len(self._buffer))]
            if ended:
                text = bytes(self._buffer).decode("latin-1")
                self._buffer.clear()
                replies += self._execute(text, t_s)
        return replies

    def _execute(self, line: str, t_s: float) -> list[Reply]:
        """Carry out one line. What is not understood is dropped in silence."""
        if line[:5].upper() == "SSCAT":
            self.startup = (self.startup + line[5:].strip())[:100]
            return []
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
        elif match := re.fullmatch(r"#([0-3]):(\d{1,3})", text):
            for bit in range(8):
                self.channels[8 * int(match[1]) + bit].let_go(bool(int(match[2]) >> bit & 1))
        elif (match := _STOP.fullmatch(text)) and self.firmware.has_stop:
            if _is_channel(match[1]):
                self.channels[int(match[1])].hold(frame)
        elif text.startswith("SSDEL"):
            self.startup = self.startup[: -int(text[5:])] if text[5:].isdecimal() and int(text[5:]) else self.startup
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
            if _is_channel(number) and OFFSET_US[0] <= int(offset) <= OFFSET_US[1]:
                self.channels[int(number)].offset_us = int(offset)

    def _answer(self, text: str, frame: int) -> list[Reply]:
        """Replies to queries."""
        if text == "Q":
            # About the last move's time, not about the servos: a stop changes nothing.
            return [Reply(_FAST_S, b"+" if self.stuck or frame < self._moving_until else b".")]
        if _PULSE_QUERY.fullmatch(text):
            numbers = re.findall(r"\d+", text)
            return [Reply(_FAST_S, bytes(self._tens(int(n), frame) for n in numbers))] if all(map(_is_channel, numbers)) else []
        if text == "VER":
            return [Reply(_FAST_S, self.firmware.text.encode() + CR)]
        if _ANALOG.fullmatch(text):
            return [Reply(_FAST_S, bytes(self._converted(name) for name in text[1::2]))]
        if _INPUTS.fullmatch(text):
            return [Reply(_FAST_S, b"".join(self._digital(name) for name in re.findall(r"[A-F]L?", text)))]
        if text == "RDFLT":
            self.registers = dict(_REGISTERS)
            return [Reply(_DEFAULTS_S, b"OK\r")]
        if text == "SS":
            return [Reply(_SLOW_S, f'"{self.startup}"\r'.encode("latin-1"))]
        if match := _REGISTER.fullmatch(text):
            number = int(match[1][:_DIGITS])
            if match[2] is None:
                return [Reply(_FAST_S, f"{self.registers.get(number, 0)}\r".encode())]
            if number < 256 and len(match[2]) <= _DIGITS + 1:
                self.registers[number] = int(match[2])
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

    def _digital(self, name: str) -> bytes:
        """A pin's level; with L low also if it was low at any time since it was last asked for like that."""
        high = self.inputs[name[0]]
        if len(name) == 2:
            high = high and name[0] not in self._was_low
            self._was_low.discard(name[0])
        return b"1" if high else b"0"

    def set_input(self, name: str, high: bool) -> None:
        """Put a level on a pin."""
        self.inputs[name] = high
        if not high:
            self._was_low.add(name)

    def _converted(self, name: str) -> int:
        if name not in self._warm:
            self._warm.add(name)
            return self._random.randrange(256)  # the first conversion of a pin is of no use
        return min(255, int(self.volts[name] * 256 / 5))


def _is_channel(number: str) -> bool:
    return len(number) <= 2 and int(number) < CHANNELS


def _clamped(pulse_us: int) -> int:
    return min(max(pulse_us, PULSE_US[0]), PULSE_US[1])
