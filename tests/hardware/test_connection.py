"""Stopping, resuming and letting go: what must not come in between, and what must not be left out."""

from __future__ import annotations

import math
import threading

import pytest

from marl_handover.hardware.connection import State
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.errors import BoardReset, PortLost, Stopped, TooSlow
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason


def turned(driver, degrees, arm=0):
    q = driver.joints_rad()[arm].copy()
    q[0] += math.radians(degrees)
    return JointCommand(arm, q, driver.gripper_mm(arm))


def last_words(driver):
    """The lines written last, newest first, but for questions."""
    lines = [entry.data for board in driver.boards.by_name.values() for entry in board.log if entry.direction == ">"]
    return [line for line in reversed(lines) if b"QP" not in line]


class LatchThatLetsAnotherThreadHalt(StopLatch):
    """A latch that is not set; whoever looks at it for the ``number``-th time gives another thread the chance to halt the driver."""

    driver, left = None, 0

    def is_set(self):
        self.left -= 1
        if self.left == 0:
            self.thread = threading.Thread(target=self.driver.halt)
            self.thread.start()
            self.thread.join(0.2)
        return super().is_set()


@pytest.mark.parametrize("look", range(1, 6))
def test_no_move_is_written_after_another_threads_halt(armed, look):
    rig = armed()
    driver = rig.driver
    latch = LatchThatLetsAnotherThreadHalt(rig.latch.path)
    rig.latch.leave()
    latch.join()
    latch.driver, latch.left, driver.latch = driver, look, latch
    try:
        driver.move([turned(driver, 5.0)], 0.3)
        driver.wait(0.1)
    except Stopped:
        pass
    latch.thread.join()
    assert driver.state is State.STOPPED
    assert b"STOP" in last_words(driver)[0]
    with pytest.raises(Stopped):
        driver.move([turned(driver, 1.0)], 0.06)


def test_no_move_is_written_after_a_halt_while_the_board_is_asked(armed):
    rig = armed()
    rig.clock.at(rig.clock.now_s() + 0.0005, rig.driver.halt)
    with pytest.raises(Stopped):
        rig.driver.move([turned(rig.driver, 18.0)], 0.3)
    assert b"STOP" in last_words(rig.driver)[0]


def test_a_stop_is_not_glued_to_a_move_that_was_cut_short(armed):
    rig = armed()
    rig.driver.move([turned(rig.driver, 18.0)], 1.0)
    rig.driver.wait(0.3)
    rig.driver.boards.by_name["main"].wire.write(b"#0P1547#1P21")
    rig.driver.stop("button")
    rig.clock.sleep_s(0.04)
    held = rig.device.outputs_us(rig.clock.now_s())
    rig.clock.sleep_s(1.0)
    assert rig.device.outputs_us(rig.clock.now_s()) == held


def test_resuming_needs_a_pulse_on_every_channel(armed):
    rig = armed()
    rig.driver.boards.by_name["main"].torque_off([1])
    rig.driver.stop("x")
    rig.latch.clear()
    with pytest.raises(BoardReset) as caught:
        rig.driver.resume()
    assert caught.value.channels == (1,)
    assert rig.driver.state is State.CONFIGURED


def test_resuming_needs_arms_within_their_limits(armed):
    rig = armed()
    q = rig.driver.parked_rad.copy()
    q[2] = math.radians(-20.0)
    rig.driver.boards.by_name["main"].move(rig.driver.wiring.pulses([JointCommand(0, q, 12.0)])["main"], 100)
    rig.clock.sleep_s(0.2)
    rig.driver.stop("x")
    rig.latch.clear()
    with pytest.raises(CommandRejected) as caught:
        rig.driver.resume()
    assert caught.value.reason is Reason.JOINT_LIMIT
    assert rig.driver.state is State.STOPPED


def test_resuming_at_a_joint_limit(armed, model):
    """A reading is 10 us wide, and part of what it stands for is beyond the limit: that is no reason to refuse."""
    rig = armed()
    q = rig.driver.parked_rad.copy()
    q[0] = model.arm.upper_rad[0]
    rig.driver.drive(0, q, 12.0, 60.0)
    rig.driver.wait(0.5)
    rig.driver.stop("x")
    rig.latch.clear()
    rig.driver.resume()
    assert rig.driver.joints_rad()[0, 0] == pytest.approx(q[0], abs=math.radians(1.1))
    rig.driver.move([turned(rig.driver, -1.0)], 0.06)


def test_halting_while_resuming_wins(armed):
    rig = armed()
    rig.driver.stop("x")
    rig.latch.clear()
    rig.clock.at(rig.clock.now_s() + 0.002, rig.driver.halt)
    with pytest.raises(Stopped, match="meanwhile"):
        rig.driver.resume()
    assert rig.driver.state is State.STOPPED
    rig.driver.resume()


def test_a_lost_board_does_not_spare_the_other_from_letting_go(armed, two_boards):
    rig = armed(two_boards)
    rig.cell.devices["west"].add_faults([make_fault("unplug", rig.clock.now_s() + 0.01)])
    rig.clock.sleep_s(0.1)
    with pytest.raises(PortLost):
        rig.driver.torque_off()
    rig.clock.sleep_s(0.1)
    assert not any(rig.cell.devices["east"].outputs_us(rig.clock.now_s()))
    assert rig.driver.state is State.LOST
    assert rig.driver.safety_filter.held(0, rig.clock.now_s()) is None


@pytest.mark.parametrize("baud", [38400, 9600, 2400])
def test_a_board_too_slow_to_stop_in_time_is_refused(rig, baud):
    made = rig()
    made.device.baud = baud
    with pytest.raises(TooSlow, match=f"{baud} baud.*40 ms.*115200"):
        made.driver.connect()
    assert not any(board.connected for board in made.driver.boards.by_name.values())
    assert made.driver.state is State.DISCONNECTED


def test_a_stop_arrives_within_what_was_reckoned(armed, wired):
    """At its worst moment: just after the longest line, and a look."""
    rig = armed(wired)
    rig.driver.move([turned(rig.driver, 1.0, arm) for arm in (0, 1)], 0.06)
    rig.clock.sleep_s(wired.stream.poll_s)
    began_s = rig.clock.now_s() - wired.stream.poll_s
    rig.driver.halt()
    rig.clock.sleep_s(0.2)
    for name, device in rig.cell.devices.items():
        device.advance(rig.clock.now_s())
        last_s = max(t_s for t_s, line in device.lines if b"STOP" in line)
        assert last_s - began_s <= rig.driver.boards.stop_s(name) < 0.04


def test_the_log_goes_on_after_a_reconnection(armed):
    rig = armed()
    rig.device.add_faults([make_fault("unplug", rig.clock.now_s() + 0.1, 0.5)])
    rig.driver.wait(0.2)
    before = rig.driver.boards.by_name["main"].log
    with pytest.raises(PortLost):
        rig.driver.move([turned(rig.driver, 1.0)], 0.06)
    rig.driver.reconnect()
    board = rig.driver.boards.by_name["main"]
    assert board.log[: len(before)] == before
    assert len(board.log) > len(before)
    rig.driver.close()
    assert board.log[: len(before)] == before


def test_a_dry_run_lets_nothing_fall(armed):
    rig = armed()
    rig.driver.disconnect()
    rig.config.on_disconnect = "limp"
    with type(rig.driver)(
        rig.config, rig.driver.model, clock=rig.clock, latch=rig.latch, confirm=lambda text: True, dry_run=True
    ) as second:
        second.arm()
    rig.clock.sleep_s(0.1)
    assert sum(map(bool, rig.device.outputs_us(rig.clock.now_s()))) == 12
