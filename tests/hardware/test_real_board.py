"""A real controller: what no emulator can say. Channel 31 has to be free; nothing else is sent a pulse.

MARL_HANDOVER_PORT=/dev/serial/by-id/usb-FTDI_FT232R python -m pytest -m hardware tests/hardware/test_real_board.py
"""

from __future__ import annotations

import os
import time

import pytest

from marl_handover.hardware.clock import RealClock
from marl_handover.hardware.settings import BoardConfig, TimeoutConfig
from marl_handover.hardware.ssc32 import Ssc32

pytestmark = pytest.mark.hardware
FREE = 31
STEP_US = 10  # of a pulse that is read back


@pytest.fixture
def board():
    port = os.environ.get("MARL_HANDOVER_PORT", "")
    if not port:
        pytest.skip("MARL_HANDOVER_PORT names no port")
    board = Ssc32("real", BoardConfig(port), TimeoutConfig(), RealClock())
    board.connect()
    yield board
    board.torque_off([FREE])
    board.close()


def test_it_can_stop_and_is_fast_enough(board):
    assert board.firmware.has_stop
    assert board.wire.baud == 115200


def test_it_answers_every_time(board):
    for _ in range(200):
        assert board.pulses([FREE]).keys() == {FREE}


def test_a_channel_that_was_let_go_has_no_pulse_and_one_that_was_moved_has(board):
    board.torque_off([FREE])
    time.sleep(0.05)
    assert board.pulses([FREE]) == {FREE: None}
    board.first_move({FREE: 1500}, None)
    time.sleep(0.05)
    assert board.pulses([FREE]) == {FREE: 1500}


@pytest.mark.parametrize("after_s", [0.2, 0.5, 1.1])
def test_a_stop_acts_within_40_ms(board, after_s):
    board.first_move({FREE: 1000}, None)
    time.sleep(0.1)
    board.move({FREE: 2000}, 2000)  # 500 us a second
    time.sleep(after_s)
    before = board.pulses([FREE])[FREE]
    board.stop([FREE])
    time.sleep(0.04)
    held = board.pulses([FREE])[FREE]
    assert before - STEP_US <= held <= before + 0.04 * 500 + 2 * STEP_US
    time.sleep(0.5)
    assert board.pulses([FREE]) == {FREE: held}
