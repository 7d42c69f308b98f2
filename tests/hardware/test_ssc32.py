"""One board over its wire: finding it, not believing everything it says, and losing it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.errors import HandoverError
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.emulator.board import EmulatedBoard
from marl_handover.hardware.emulator.device import EmulatedDevice, parse_faults
from marl_handover.hardware.emulator.protocol_ssc32emu import mount
from marl_handover.hardware.errors import (
    BadReply,
    BoardReset,
    BoardSilent,
    NoReference,
    PortLost,
    PortNotFound,
    UnsuitableFirmware,
    WrongState,
)
from marl_handover.hardware.settings import BoardConfig, TimeoutConfig
from marl_handover.hardware.ssc32 import Ssc32


def made(faults="", firmware="SSC32-V2.50USB", baud=115200, board=None, dry_run=False, **config):
    clock = VirtualClock()
    device = EmulatedDevice(board or EmulatedBoard(firmware), baud=baud)
    device.add_faults(parse_faults(faults))
    settings = BoardConfig(mount("alone", device, clock), **config)
    return Ssc32("main", settings, TimeoutConfig(), clock, dry_run=dry_run, log_entries=1000), device, clock


@pytest.mark.parametrize("baud", [2400, 9600, 38400, 115200])
def test_a_board_is_found_at_any_of_its_rates(baud):
    board, _, clock = made(baud=baud)
    assert board.connect().text == "SSC32-V2.50USB"
    assert board.wire.baud == baud
    assert clock.now_s() < 2.0
    assert board.pulses([3]) == {3: None}


def test_without_the_scan_another_rate_is_silence_or_noise():
    board, _, _ = made(baud=9600, scan=False)
    with pytest.raises((BoardSilent, UnsuitableFirmware), match="115200|rate"):
        board.connect()
    assert not board.connected


def test_a_port_that_opens_but_is_silent_says_where_to_look():
    board, _, clock = made("silent")
    with pytest.raises(BoardSilent, match="controller's own supply") as caught:
        board.connect()
    assert caught.value.bauds == (115200, 38400, 9600, 2400)
    assert clock.now_s() < 3.0
    with pytest.raises(WrongState):
        _ = board.wire
    with pytest.raises(PortNotFound, match="no emulated board"):
        Ssc32("main", BoardConfig("ssc32emu://nowhere"), TimeoutConfig(), clock).connect()


def test_a_port_in_use_is_not_taken():
    board, _, clock = made()
    board.connect()
    with pytest.raises(PortNotFound, match="exclusively"):
        Ssc32("main", board.config, TimeoutConfig(), clock).connect()
    board.close()
    board.close()
    Ssc32("main", board.config, TimeoutConfig(), clock).connect()


def test_firmware_without_stop_is_refused():
    board, _, _ = made(firmware="SSC32-V1.06XE")
    with pytest.raises(UnsuitableFirmware, match="V2.01"):
        board.connect()


class Liar(EmulatedBoard):
    """A board that answers what it is told to."""

    def __init__(self, replies):
        self.replies, self.said = replies, 0
        super().__init__()

    def receive(self, data, t_s):
        if not data.endswith(b"\r"):
            return []
        reply = next(self.replies, b"")
        self.said += len(reply)
        return [reply]


def test_other_boards_are_refused():
    board, _, _ = made(board=Liar(iter([b"*VER2.06M\r"] * 50)))
    with pytest.raises(UnsuitableFirmware, match="2.06M"):
        board.connect()


def test_moves_need_a_first_one():
    board, device, clock = made()
    board.connect()
    with pytest.raises(NoReference, match="channels 1"):
        board.move({1: 1600}, 100)
    board.first_move({1: 1500}, None)
    sent = board.move({1: 1600}, 100, {1: 2000})
    assert (sent.data, sent.written) == (b"#1P1600S2000T100\r", True)
    clock.sleep_s(0.2)
    assert board.pulses([1]) == {1: 1600}
    assert not board.moving()
    assert device.lines[-1][1] == b"Q\r"


def test_a_reset_is_noticed_and_every_channel_is_a_first_one_again():
    board, _, clock = made("brownout@1")
    board.connect()
    board.first_move({1: 1500, 2: 1500}, None)
    clock.until(0.9)
    board.require_pulses([1, 2])
    clock.until(2.0)
    with pytest.raises(BoardReset, match="supply"):
        board.require_pulses([2])
    assert not board.referenced([1])
    with pytest.raises(NoReference):
        board.move({1: 1500}, 100)


def test_letting_go():
    board, device, clock = made()
    board.connect()
    board.first_move({1: 1500, 2: 1500}, None)
    clock.sleep_s(0.1)
    board.torque_off([1])
    clock.sleep_s(0.1)
    assert device.outputs_us(clock.now_s())[1:3] == [0.0, 1500.0]
    assert not board.referenced([1])


@pytest.mark.parametrize("fault", ["drop@1:0.08", "corrupt@1:0.08=1", "late@1:0.05=0.12"])
def test_a_bad_reply_is_asked_again(fault):
    board, _, clock = made(fault)
    board.connect()
    board.first_move({0: 1500, 1: 2000}, None)
    clock.until(1.01)
    assert board.pulses([0, 1]) == {0: 1500, 1: 2000}


def test_pulses_that_come_out_different_every_time_are_not_believed():
    board, _, clock = made("corrupt@1=1")
    board.connect()
    board.first_move(dict.fromkeys(range(8), 1500), None)
    clock.until(1.01)
    with pytest.raises((BadReply, PortLost)):
        board.pulses(range(8))


@pytest.mark.parametrize(
    ("said", "believed"),
    [
        ([b"\x96", b"\xc8", b"\xc8"], 2000),
        ([b"\x96", b"\x00", b"\x00"], None),
        ([b"\x00", b"\x96", b"\x97"], 1510),
        ([b"\x96", b"\xc8", b"\x96", b"\xc8"], BadReply),
        ([b"\x00", b"\x96", b"\x00", b"\x96"], BadReply),
    ],
)
def test_a_pulse_is_believed_when_it_was_said_twice(said, believed):
    board, _, _ = made(board=Liar(iter([b"SSC32-V2.50USB\r", *said])))
    board.connect()
    if believed is BadReply:
        with pytest.raises(BadReply, match="twice"):
            board.pulses([0])
    else:
        assert board.pulses([0]) == {0: believed}


def test_a_late_reply_is_not_taken_for_the_next_one():
    board, _, clock = made("late@1:0.05=0.15")
    board.connect()
    board.first_move({0: 1500, 1: 2000}, None)
    clock.until(1.01)
    assert board.pulses([0]) == {0: 1500}
    assert board.pulses([1]) == {1: 2000}


def test_replies_that_stay_bad_are_named():
    board, _, clock = made("drop@1")
    board.connect()
    clock.until(1.5)
    with pytest.raises((BadReply, PortLost)):
        board.pulses([0])
    assert clock.now_s() < 4.0


def test_stuck_moving_is_only_what_it_says():
    board, _, clock = made("stuck@1")
    board.connect()
    board.first_move({0: 1500}, None)
    clock.until(2.0)
    assert board.moving()
    assert board.pulses([0]) == {0: 1500}


def test_a_lost_cable():
    board, _, clock = made("unplug@1")
    board.connect()
    board.first_move({0: 1500}, None)
    clock.until(1.5)
    for call in (board.moving, lambda: board.pulses([0]), lambda: board.stop([0]), lambda: board.move({0: 1600}, 100)):
        with pytest.raises(PortLost, match="cable"):
            call()
    board.close()


def test_a_dry_run_writes_questions_and_stops_only():
    board, device, clock = made(dry_run=True)
    board.connect()
    sent = board.first_move({0: 1500}, None)
    assert (sent.data, sent.written) == (b"#0P1500\r", False)
    board.move({0: 1600}, 100)
    board.stop([0])
    assert not board.torque_off([0]).written
    clock.sleep_s(0.1)
    assert device.outputs_us(clock.now_s())[0] == 0.0
    assert [line for _, line in device.lines] == [b"\x1bVER\r", b"\x1bSTOP0\r"]
    assert [entry.data for entry in board.log if entry.direction == "x"] == [b"#0P1500\r", b"#0P1600T100\r", b"#0L\r"]


def test_the_log_has_every_byte_and_an_end():
    board, _, _ = made()
    board.connect()
    for _ in range(2000):
        board.moving()
    assert len(board.log) == 1000
    assert {(entry.direction, entry.data) for entry in board.log} == {(">", b"Q\r"), ("<", b".")}
    times = [entry.t_s for entry in board.log]
    assert times == sorted(times)


def fuzz(replies):
    """Talk to a board that answers anything: every call ends, in time, with an answer or a named error. Number of bytes it said."""
    liar = Liar(iter(replies))
    board, _, clock = made(board=liar)
    for call in (
        board.connect,
        board.moving,
        lambda: board.pulses([0, 5]),
        lambda: board.require_pulses([1]),
    ):
        began_s = clock.now_s()
        try:
            result = call()
        except HandoverError:
            result = None
        assert clock.now_s() - began_s < 15.0
        if isinstance(result, dict):
            assert all(pulse is None or 500 <= pulse <= 2500 for pulse in result.values())
    assert not board.referenced([0])
    assert len(board.log) <= 1000
    board.close()
    return liar.said


@given(st.lists(st.binary(max_size=300), max_size=30))
def test_whatever_the_board_answers_nothing_hangs(replies):
    fuzz(replies)


@given(
    st.lists(st.one_of(st.binary(max_size=6), st.sampled_from([b"SSC32-V2.50USB\r", b".", b"+", b"\x96", b"\0", b"\x96\x96"])), max_size=30)
)
def test_nor_when_some_of_it_is_right(replies):
    fuzz([b"SSC32-V2.50USB\r", *replies])


def test_a_million_random_bytes():
    import random

    source, left = random.Random(0), 1_000_000
    while left > 0:
        left -= fuzz([b"SSC32-V2.50USB\r", *(source.randbytes(source.randrange(400)) for _ in range(60))])


@pytest.mark.parametrize(
    "said", [b"SSC32-V2.50USB rev.2\r", b"SSC32-V2.50USB\rbuilt 2014\r", b"  SSC32-V2.03XE \r", b"\nSSC32-V2.50USB \r"]
)
def test_words_around_the_version_are_understood_after_a_damaged_answer_too(said):
    """What the handshake takes for a board is what it is recognised by later."""
    board, _, _ = made(board=Liar(iter([said, b"\x01", said, b"\x96", b"\x96"])))
    assert board.connect().number >= (2, 3)
    assert board.pulses([0]) == {0: 1500}


def test_another_board_at_the_same_port_is_not_taken_for_the_first():
    board, _, _ = made(board=Liar(iter([b"SSC32-V2.50USB\r", b"\x01", *[b"SSC32-V2.03XE\r"] * 9])))
    board.connect()
    with pytest.raises(PortLost, match="no longer answers"):
        board.pulses([0])
