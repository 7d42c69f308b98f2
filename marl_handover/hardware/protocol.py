"""The language of SSC-32 and SSC-32U servo controllers: bytes in, bytes out, no port and no clock.

Lines are ASCII and end in CR. Moves are never acknowledged, bad lines are dropped in silence, and a pulse beyond its limits is clamped, so
everything is checked here before it is sent. Source: Lynxmotion's SSC-32U user guide (pages 24-39) and what users measured, as collected in
the design notes. ``T`` is in milliseconds (the guide says microseconds once; its examples say otherwise).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any

from marl_handover.hardware.errors import BadCommand, BadReply, DuplicateChannel, LineTooLong, MixedCommands

CHANNELS = 32
PULSE_US = (500, 2500)
READING_US = 10
"""A pulse as boards tell it stands for any from itself to less than this above."""

SPEED_US_S = (1, 65535)
TIME_MS = (1, 65535)
BAUDS = (115200, 38400, 9600, 2400)
"""Rates of the boards' jumpers or button; 9600 is what an SSC-32U comes with, 115200 is what stopping in time needs."""

MAX_LINE_BYTES = 256
"""No buffer size is published; this fits positions of all 32 channels with a time, and no driver in use sends longer lines."""

CR, ESC = b"\r", b"\x1b"
QUERY = b"Q\r"
VERSION = b"VER\r"
CANCEL = ESC
"""Drops what was sent of the present line, so that a fresh start is not glued to an old fragment."""

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
