"""The wire in bad moments: a write that is cut short, a reader that waits, a cable that is out."""

from __future__ import annotations

import threading
import time

import pytest

from marl_handover.hardware.clock import RealClock, VirtualClock
from marl_handover.hardware.emulator.board import EmulatedBoard
from marl_handover.hardware.emulator.device import EmulatedDevice, make_fault
from marl_handover.hardware.emulator.protocol_ssc32emu import mount
from marl_handover.hardware.emulator.pty import PtyEmulator
from marl_handover.hardware.errors import PortLost
from marl_handover.hardware.settings import BoardConfig, TimeoutConfig
from marl_handover.hardware.ssc32 import Ssc32


def made():
    clock, device = VirtualClock(), EmulatedDevice(EmulatedBoard())
    clock.until(1.0)
    board = Ssc32("main", BoardConfig(mount("alone", device, clock)), TimeoutConfig(), clock)
    board.connect()
    board.first_move({0: 1500, 1: 1500}, None)
    clock.sleep_s(0.1)
    return board, device, clock


@pytest.mark.parametrize("kept", range(1, 18))
def test_a_line_is_not_glued_to_one_that_was_cut_short(kept):
    board, device, clock = made()
    port = board.wire._serial
    inner = port.write

    def cut(data):
        port.write = inner
        inner(data[:kept])
        raise KeyboardInterrupt

    port.write = cut
    with pytest.raises(KeyboardInterrupt):
        board.move({0: 1547, 1: 1521}, 60)
    board.move({0: 1510}, 60)
    clock.sleep_s(0.2)
    assert device.outputs_us(clock.now_s())[:2] == [1510.0, 1500.0]


@pytest.mark.parametrize("call", ["reset_input_buffer", "reset_output_buffer"])
def test_flushing_a_port_without_cable_fails_as_a_real_one_does(call):
    board, device, clock = made()
    device.add_faults([make_fault("unplug", clock.now_s() + 0.1)])
    clock.sleep_s(0.2)
    with pytest.raises(Exception, match="Input/output error") as caught:
        getattr(board.wire._serial, call)()
    assert not isinstance(caught.value, OSError)
    with pytest.raises(PortLost):
        board.wire.ask(b"Q\r", 1)


def test_a_stop_does_not_wait_for_an_answer(tmp_path):
    """A board without power never answers; the reader waits for as long as it was told to."""
    clock, device = RealClock(), EmulatedDevice(EmulatedBoard())
    emulator = PtyEmulator(device, tmp_path / "port")
    ended = threading.Event()
    threads = [threading.Thread(target=emulator.serve, args=(ended.is_set,))]
    threads[0].start()
    try:
        board = Ssc32("main", BoardConfig(str(tmp_path / "port")), TimeoutConfig(reply_s=60.0), clock)
        time.sleep(0.5)
        board.connect()
        device.add_faults([make_fault("silent", emulator.now_s())])

        def ask():
            with pytest.raises(PortLost):
                board.wire.ask(b"Q\r", 1)

        threads.append(threading.Thread(target=ask))
        threads[1].start()
        while board.log[-1].data != b"Q\r":
            time.sleep(0.001)
        board.stop([0])
        assert threads[1].is_alive(), "the stop went out while the other thread was still waiting"
        device.add_faults([make_fault("unplug", emulator.now_s())])
        threads[1].join(30.0)
        assert not threads[1].is_alive()
    finally:
        ended.set()
        threads[0].join()
        emulator.close()
