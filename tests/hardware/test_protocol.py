"""Bytes as the user guide writes them, worked out by hand, and what must never become bytes."""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.hardware import ssc32 as protocol
from marl_handover.hardware.errors import BadCommand, BadReply, DuplicateChannel, LineTooLong, MixedCommands
from marl_handover.hardware.ssc32 import Level, Move

channels = st.integers(0, 31)
pulses = st.integers(500, 2500)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (protocol.group_move({5: 1600}, 1000), b"#5P1600T1000\r"),
        (protocol.group_move({5: 1600}, None, {5: 750}), b"#5P1600S750\r"),
        (protocol.group_move({5: 1600, 10: 750}, 2500), b"#5P1600#10P750T2500\r"),
        (protocol.group_move({5: 1600, 17: 750}, 2500, {17: 500}), b"#5P1600#17P750S500T2500\r"),
        (protocol.encode_line([Level(3, True), Level(4, False)]), b"#3H#4L\r"),
        (protocol.stop([0, 31]), b"\x1bSTOP0\rSTOP31\r"),
        (protocol.query_pulses([5]), b"QP5\r"),
        (protocol.query_pulses([0, 16]), b"QP0QP16\r"),
        (protocol.QUERY, b"Q\r"),
        (protocol.VERSION, b"VER\r"),
    ],
)
def test_lines_are_the_guides(line, expected):
    assert line == expected


def test_bytes_of_a_move_one_by_one():
    # '#' 23, '0' 30, 'P' 50, "1500" 31 35 30 30, 'T' 54, "20" 32 30, CR 0D
    assert protocol.group_move({0: 1500}, 20).hex(" ") == "23 30 50 31 35 30 30 54 32 30 0d"


@pytest.mark.parametrize("pulse", [499, 2501, 0, -1, 1500.0, 1500.5, math.nan, math.inf, True, "1500", None, np.float64(1500)])
def test_a_pulse_that_is_no_whole_number_in_range_is_refused(pulse):
    with pytest.raises(BadCommand, match="pulse_us.*500 to 2500"):
        protocol.group_move({0: pulse}, 100)


def test_whole_numbers_of_numpy_are_whole_numbers():
    assert protocol.group_move({np.int64(3): np.int16(1500)}, np.int32(40)) == b"#3P1500T40\r"


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: protocol.group_move({32: 1500}), "channel"),
        (lambda: protocol.group_move({-1: 1500}), "channel"),
        (lambda: protocol.group_move({0: 1500}, 0), "time_ms"),
        (lambda: protocol.group_move({0: 1500}, 65536), "time_ms"),
        (lambda: protocol.group_move({0: 1500}, math.nan), "time_ms"),
        (lambda: protocol.group_move({0: 1500}, 100, {0: 0}), "speed_us_s"),
        (lambda: protocol.encode_line([Level(0, True)], 100), "time_ms"),
        (lambda: protocol.encode_line([]), "commands"),
        (lambda: protocol.encode_line(["#0P1500"]), "commands"),
        (lambda: protocol.query_pulses([]), "channels"),
    ],
)
def test_limits_are_named(call, name):
    with pytest.raises(BadCommand) as caught:
        call()
    assert caught.value.name == name


def test_duplicates_mixtures_and_long_lines_are_refused():
    with pytest.raises(DuplicateChannel):
        protocol.encode_line([Move(1, 1500), Move(1, 1600)])
    with pytest.raises(DuplicateChannel):
        protocol.stop([1, 2, 1])
    with pytest.raises(MixedCommands, match="Level.*Move"):
        protocol.encode_line([Move(1, 1500), Level(2, True)])
    every = {channel: 1500 for channel in range(32)}
    assert len(protocol.group_move(every, 65535)) <= protocol.MAX_LINE_BYTES
    with pytest.raises(LineTooLong):
        protocol.group_move(every, 65535, dict.fromkeys(every, 60000))


def test_replies():
    assert protocol.parse_moving(b"+")
    assert not protocol.parse_moving(b".")
    assert protocol.parse_pulses(b"\x96\x00\xfa", 3) == (1500, None, 2500)
    assert protocol.parse_version(b"SSC32-V2.50USB\r") == protocol.Firmware("SSC32-V2.50USB", (2, 50), "USB")


@pytest.mark.parametrize(("firmware", "stops"), [("SSC32-V1.06XE", False), ("SSC32-V2.00XE", False), ("SSC32-V2.01XE_BETA1", True)])
def test_firmware_before_2_01_has_no_stop(firmware, stops):
    assert protocol.parse_version(firmware.encode() + b"\r").has_stop is stops


@pytest.mark.parametrize(
    "call",
    [
        lambda: protocol.parse_moving(b""),
        lambda: protocol.parse_moving(b"*5Q6\r"),
        lambda: protocol.parse_moving(b"\x96"),
        lambda: protocol.parse_pulses(b"\x96", 2),
        lambda: protocol.parse_pulses(b"+", 1),
        lambda: protocol.parse_pulses(b".", 1),
        lambda: protocol.parse_pulses(b"\r", 1),
        lambda: protocol.parse_version(b"LSS-V2.50\r"),
        lambda: protocol.parse_version(b""),
    ],
)
def test_what_cannot_be_the_answer_is_refused(call):
    with pytest.raises(BadReply):
        call()


@given(st.dictionaries(channels, st.tuples(pulses, st.none() | st.integers(1, 65535)), min_size=1, max_size=12), st.integers(1, 65535))
def test_every_line_reads_back_as_what_was_meant(moves, time_ms):
    line = protocol.encode_line([Move(channel, pulse, speed) for channel, (pulse, speed) in moves.items()], time_ms)
    assert line.isascii()
    assert line.count(b"\r") == 1
    body, _, time_text = line[:-1].decode().partition("T")
    read = {}
    for item in body.split("#")[1:]:
        channel, _, rest = item.partition("P")
        pulse, _, speed = rest.partition("S")
        read[int(channel)] = int(pulse), int(speed) if speed else None
    assert read == moves
    assert int(time_text) == time_ms


@given(st.binary(max_size=80), st.integers(1, 8))
def test_parsers_answer_or_refuse_whatever_comes(reply, count):
    for parse in (
        protocol.parse_moving,
        protocol.parse_version,
        lambda data: protocol.parse_pulses(data, count),
    ):
        with suppress(BadReply):
            parse(reply)
