"""The driver against a real serial port, in real time, once; and the command that serves one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from marl_handover.errors import InvalidSetting
from marl_handover.hardware.clock import RealClock
from marl_handover.hardware.connection import State
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.emulator.board import EmulatedBoard
from marl_handover.hardware.emulator.device import EmulatedCell, EmulatedDevice, make_fault
from marl_handover.hardware.emulator.pty import PtyEmulator
from marl_handover.hardware.errors import PortLost, Stopped
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.safety_filter import JointCommand
from marl_handover.hardware.settings import BoardConfig, HardwareConfig, TimeoutConfig
from marl_handover.hardware.ssc32 import Ssc32


@pytest.fixture
def served():
    """``served(device, link)``: a pty emulator, turned by a thread until the test ends."""
    ended, threads, emulators = threading.Event(), [], []

    def make(device, link):
        emulators.append(PtyEmulator(device, link))
        threads.append(threading.Thread(target=emulators[-1].serve, args=(ended.is_set,)))
        threads[-1].start()
        return emulators[-1]

    yield make
    ended.set()
    for thread in threads:
        thread.join(timeout=10)
    for emulator in emulators:
        emulator.close()
        emulator.close()
        assert not emulator.link.is_symlink()


def go_on(driver, q):
    for _ in range(100):
        driver.move([JointCommand(0, q, 12.0)], 0.06)
        time.sleep(0.02)


def test_the_driver_on_a_real_port(served, model, tmp_path):
    link = tmp_path / "port"
    config = HardwareConfig(boards={"main": BoardConfig(str(link))})
    config.timeouts.reply_s = 1.0  # a busy machine
    config.stream.settle_s = 0.05
    cell = EmulatedCell(config, model.arm, np.radians([0.0, 140.0, -115.0, 70.0, 0.0]))
    device = cell.devices["main"]
    emulator = served(device, link)
    latch = StopLatch(tmp_path / "stop")
    with ArmDriver(config, model, latch=latch, confirm=lambda text: True) as driver:
        driver.arm()
        q = driver.parked_rad.copy()
        q[0] += 0.2
        driver.move([JointCommand(0, q, 12.0)], 0.3)
        driver.wait(0.5)
        pulses = driver.boards.pulses()["main"]
        assert pulses[0] == 1600
        device.add_faults([make_fault("unplug", emulator.now_s(), 0.5)])
        with pytest.raises(PortLost):
            go_on(driver, q)
        assert driver.state is State.LOST
        driver.reconnect()
        assert link.is_symlink()
        driver.arm()
        StopLatch(latch.path).latch("other process")
        with pytest.raises(Stopped):
            driver.move([JointCommand(0, q, 12.0)], 0.06)
        assert driver.state is State.STOPPED
    assert driver.state is State.DISCONNECTED


def test_a_cable_that_came_out_in_a_pause(served, model, tmp_path):
    """The first thing to fail then is flushing what came in, and not a read or a write."""
    link = tmp_path / "port"
    config = HardwareConfig(boards={"main": BoardConfig(str(link))})
    config.timeouts.reply_s = 1.0
    config.stream.settle_s = 0.05
    device = EmulatedCell(config, model.arm, np.radians([0.0, 140.0, -115.0, 70.0, 0.0])).devices["main"]
    emulator = served(device, link)
    with ArmDriver(config, model, latch=StopLatch(tmp_path / "stop"), confirm=lambda text: True) as driver:
        driver.arm()
        device.add_faults([make_fault("unplug", emulator.now_s())])
        while link.is_symlink():
            time.sleep(0.01)
        with pytest.raises(PortLost):
            driver.move([JointCommand(0, driver.parked_rad, 12.0)], 0.06)
        assert driver.state is State.LOST
        assert not driver.halt()


def test_a_pty_is_paced_and_its_rate_counts(served, tmp_path):
    served(EmulatedDevice(EmulatedBoard(), baud=9600), tmp_path / "port")
    board = Ssc32("main", BoardConfig(str(tmp_path / "port"), baud=115200), TimeoutConfig(), RealClock())
    board.connect()
    assert board.wire.baud == 9600
    assert board.pulses([0]) == {0: None}
    board.close()


def test_a_link_does_not_take_the_place_of_a_file(tmp_path):
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(InvalidSetting, match="symlink"):
        PtyEmulator(EmulatedDevice(EmulatedBoard()), tmp_path / "notes")
    assert (tmp_path / "notes").read_text() == "mine"


def test_the_command_serves_until_it_is_interrupted(tmp_path):
    link = tmp_path / "ssc32"
    arguments = [sys.executable, "-m", "marl_handover.cli", "emulate", f"link={link}", "firmware=SSC32-V2.04GP", "lines=true"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}) as process:
        try:
            assert "SSC32-V2.04GP" in process.stdout.readline()
            board = Ssc32("main", BoardConfig(str(link)), TimeoutConfig(reply_s=1.0), RealClock())
            assert board.connect().number == (2, 4)
            board.first_move({3: 1234}, None)
            assert board.pulses([3]) == {3: 1230}
            board.close()
            process.send_signal(signal.SIGINT)
            rest = process.stdout.read()
            assert process.wait(timeout=30) == 0
        finally:
            process.kill()
    assert "#3P1234" in rest
    assert not link.is_symlink()


def test_the_command_serves_every_board_of_three_arms(tmp_path):
    """The first board at the link, the second beside it; each has the channels of its own arms and knows nothing of the other's."""
    link = tmp_path / "ssc32"
    arguments = [sys.executable, "-m", "marl_handover.cli", "emulate", "hardware=triangle", f"link={link}"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}) as process:
        try:
            assert f"at {link}," in process.stdout.readline()
            assert f"at {link}_second," in process.stdout.readline()
            boards = [Ssc32(name, BoardConfig(f"{link}{name}"), TimeoutConfig(reply_s=1.0), RealClock()) for name in ("", "_second")]
            for number, board in enumerate(boards):
                board.connect()
                board.first_move({4: 1300 + 100 * number}, None)
            assert [board.pulses([4]) for board in boards] == [{4: 1300}, {4: 1400}]
            for board in boards:
                board.close()
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=30) == 0
        finally:
            process.kill()
    assert not link.is_symlink()
    assert not (tmp_path / "ssc32_second").is_symlink()
