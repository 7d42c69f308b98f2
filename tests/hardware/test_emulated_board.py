"""The emulated controller against the user guide and what users measured."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.hardware import ssc32 as protocol
from marl_handover.hardware.emulator.board import FRAME_S, EmulatedBoard


def said(board, line, t_s):
    return b"".join(reply for reply in board.receive(line, t_s))


@pytest.fixture
def board():
    """Channels 0 and 1 stand at 1500 and 1000 us since 0.1 s."""
    board = EmulatedBoard()
    board.receive(b"#0P1500\r#1P1000\r", 0.1)
    return board


def pulse(board, channel, t_s):
    return board.outputs_us(t_s)[channel]


def test_nothing_happens_before_the_cr_and_escape_cancels():
    board = EmulatedBoard()
    assert said(board, b"VE", 0.0) == b""
    assert said(board, b"R\r", 0.0) == b"SSC32-V2.50USB\r"
    board.receive(b"#0P1500", 0.1)
    assert pulse(board, 0, 1.0) == 0.0
    board.receive(b"\x1b#1P1600\r", 1.1)
    assert pulse(board, 0, 2.0) == 0.0
    assert pulse(board, 1, 2.0) == 1600.0


def test_case_and_blanks_do_not_count():
    board = EmulatedBoard()
    board.receive(b" #\t3 p 12 00\n\r", 0.0)
    assert pulse(board, 3, 1.0) == 1200.0
    assert said(board, b"q p 3\r", 1.0) == bytes([120])


@pytest.mark.parametrize(
    "line",
    [b"#0P\r", b"#32P1500\r", b"P1500\r", b"#0P1500#1PO5\r", b"#0P15x0\r", b"#0P-5\r", b"hello\r", b"\r", b"#0P1500T\r", b"\xff\xfe\r",
     b"#99999999999P1500\r", b"#0P99999999\r"],
)  # fmt: skip
def test_bad_lines_are_dropped_in_silence(board, line):
    before = board.outputs_us(1.0)
    assert said(board, line, 1.0) == b""
    assert board.outputs_us(2.0) == before


def test_the_first_move_of_a_channel_is_a_jump_and_later_ones_are_not():
    board = EmulatedBoard()
    board.receive(b"#0P1000S100T5000\r", 0.0)
    assert pulse(board, 0, FRAME_S) == 1000.0
    board.receive(b"#0P2000T1000\r", 1.0)
    assert pulse(board, 0, 1.5) == pytest.approx(1500.0)
    assert pulse(board, 0, 2.0) == 2000.0


def test_a_group_begins_and_ends_together_and_no_servo_is_faster_than_its_speed(board):
    # 500 us at 250 us/s take 2 s, longer than T = 1 s, for both channels.
    board.receive(b"#0P2000S250#1P1100T1000\r", 1.0)
    assert pulse(board, 0, 2.0) == pytest.approx(1750.0)
    assert pulse(board, 1, 2.0) == pytest.approx(1050.0)
    assert pulse(board, 0, 2.98) < 2000.0
    assert (pulse(board, 0, 3.0), pulse(board, 1, 3.0)) == (2000.0, 1100.0)


def test_pulses_change_every_20_ms_only(board):
    board.receive(b"#0P2500T1000\r", 1.0)
    values = {pulse(board, 0, 1.2 + share * FRAME_S) for share in (0.0, 0.3, 0.6, 0.9)}
    assert values == {1700.0}
    assert pulse(board, 0, 1.22) == pytest.approx(1720.0)


def test_a_new_move_begins_where_the_old_one_is(board):
    board.receive(b"#0P2500T1000\r", 1.0)
    board.receive(b"#0P1500T100\r", 1.5)
    assert pulse(board, 0, 1.5) == pytest.approx(2000.0)
    assert pulse(board, 0, 1.55) == pytest.approx(1800.0)  # two frames of five
    assert pulse(board, 0, 1.6) == pytest.approx(1500.0)


@pytest.mark.parametrize(("told", "put_out"), [(1, 500), (499, 500), (500, 500), (2500, 2500), (2501, 2500), (3000, 2500), (0, 0)])
def test_pulses_are_clamped_and_zero_lets_go(board, told, put_out):
    board.receive(f"#0P{told}\r".encode(), 1.0)
    assert pulse(board, 0, 1.1) == put_out


def test_stop_holds_one_channel_and_q_stays_at_moving(board):
    board.receive(b"#0P2500#1P2000T1000\r", 1.0)
    board.receive(b"STOP0\r", 1.5)
    assert pulse(board, 0, 5.0) == pytest.approx(2000.0)
    board.receive(b"STOP 1\r", 1.6)
    assert pulse(board, 1, 5.0) == pytest.approx(1600.0)
    assert said(board, b"Q\r", 1.9) == b"+"
    assert said(board, b"Q\r", 2.01) == b"."


def test_old_firmware_has_no_stop_and_counts_the_offset_in_qp():
    board = EmulatedBoard("SSC32-V1.06XE")
    board.receive(b"#0P1500\r", 0.0)
    board.receive(b"#0PO-100\r", 0.1)
    assert said(board, b"QP0\r", 0.2) == bytes([140])
    board.receive(b"#0P2500T1000\r", 1.0)
    board.receive(b"STOP0\r", 1.5)
    assert pulse(board, 0, 2.5) == 2400.0


def test_qp_is_raw_truncated_and_zero_without_a_pulse(board):
    board.receive(b"#0P1509\r", 1.0)
    assert said(board, b"QP0QP1QP7\r", 1.1) == bytes([150, 100, 0])
    board.receive(b"#0PO50\r", 1.2)
    assert pulse(board, 0, 1.3) == 1559.0
    assert said(board, b"QP0\r", 1.3) == bytes([150])


@pytest.mark.parametrize("line", [b"#0L\r", b"#0H\r", b"#0P0\r"])
def test_a_channel_that_was_let_go_has_its_first_move_before_it_again(board, line):
    board.receive(line, 1.0)
    assert said(board, b"QP0\r", 1.1) == b"\0"
    board.receive(b"#0P2000T5000\r", 1.2)
    assert pulse(board, 0, 1.22) == 2000.0


def test_power_up_forgets_all():
    board = EmulatedBoard()
    board.receive(b"#0P2000\r", 0.1)
    board.power_up(5.0)
    assert said(board, b"QP0QP1\r", 5.1) == bytes([0, 0])


@given(st.lists(st.tuples(st.binary(max_size=40), st.floats(0.0, 0.5)), max_size=12))
def test_whatever_is_sent_pulses_stay_within_limits(pieces):
    board, now_s = EmulatedBoard(), 0.0
    for data, pause_s in pieces:
        now_s += pause_s
        board.receive(data + b"\r", now_s)
        assert all(value == 0.0 or 500.0 <= value <= 2500.0 for value in board.outputs_us(now_s))


@given(st.dictionaries(st.integers(0, 31), st.integers(500, 2500), min_size=1, max_size=6), st.integers(1, 3000))
def test_the_board_understands_what_the_protocol_writes(moves, time_ms):
    board = EmulatedBoard()
    board.receive(protocol.group_move(dict.fromkeys(moves, 1500)), 0.0)
    board.receive(protocol.group_move(moves, time_ms), 1.0)
    reply = said(board, protocol.query_pulses(list(moves)), 1.0 + time_ms / 1000 + FRAME_S)
    assert protocol.parse_pulses(reply, len(moves)) == tuple(pulse // 10 * 10 for pulse in moves.values())
