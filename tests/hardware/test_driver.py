"""Both arms through pyserial on emulated boards: life cycle, first move, faults."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.hardware.connection import State
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.errors import BadReply, BoardReset, BoardSilent, NotConfirmed, PortLost, PortNotFound, Stopped, WrongState
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason
from marl_handover.hardware.settings import ARMS


def turned(driver, degrees, joint=0, arm=0):
    q = driver.joints_rad()[arm].copy()
    q[joint] += math.radians(degrees)
    return JointCommand(arm, q, driver.gripper_mm(arm))


def outputs(rig):
    return {name: device.outputs_us(rig.clock.now_s()) for name, device in rig.cell.devices.items()}


def test_the_life_of_a_session(rig, wired):
    made = rig(wired)
    driver = made.driver
    assert driver.state is State.DISCONNECTED
    for step in (driver.configure, driver.arm, lambda: driver.safety_filter, lambda: driver.wiring, driver.resume):
        with pytest.raises(WrongState):
            step()
    with driver:
        assert driver.state is State.CONFIGURED
        with pytest.raises(WrongState, match="armed"):
            driver.move([JointCommand(0, driver.parked_rad, 12.0)], 0.06)
        assert np.isnan(driver.joints_rad()).all()
        driver.arm()
        assert driver.state is State.ARMED
        np.testing.assert_array_equal(driver.joints_rad(), [driver.parked_rad] * 2)
        driver.move([turned(driver, 3.0)], 0.06)
    assert driver.state is State.DISCONNECTED
    driver.disconnect()
    driver.disconnect()


def test_what_is_sent_is_returned_and_arrives(armed, wired):
    rig = armed(wired)
    driver, board = rig.driver, wired.arms["right"].board
    command = turned(driver, 10.0, joint=1, arm=1)
    sent = driver.move([command], 0.2)
    assert [line.board for line in sent.lines] == [board]
    assert sent.lines[0].data == driver.boards.by_name[board].log[-1].data
    np.testing.assert_allclose(sent.joints_rad[1], command.joints_rad, atol=math.radians(0.06))
    assert driver.joints_rad()[1, 1] < command.joints_rad[1]
    driver.wait(0.5)
    np.testing.assert_array_equal(driver.joints_rad()[1], command.joints_rad)
    channel = wired.arms["right"].channels[1]
    nominal = wired.nominal["shoulder"]
    assert outputs(rig)[board][channel] == round(nominal.zero_us + nominal.us_per_deg * math.degrees(command.joints_rad[1]))
    assert rig.cell.joints_rad(rig.clock.now_s())[1, 1] == pytest.approx(command.joints_rad[1], abs=math.radians(8.0))


def test_both_arms_in_one_command(armed, wired):
    rig = armed(wired)
    sent = rig.driver.move([turned(rig.driver, 5.0, arm=0), turned(rig.driver, -5.0, arm=1)], 0.1)
    assert len(sent.lines) == len(wired.used_boards())
    assert set(sent.joints_rad) == {0, 1}
    rig.driver.wait(0.3)
    np.testing.assert_allclose(np.degrees(rig.driver.joints_rad()[:, 0]), [5.0, -5.0])


def test_the_first_move_is_the_parked_pose_after_somebody_said_yes(rig):
    asked = []
    made = rig(confirm=lambda text: asked.append(text) or True)
    with made.driver as driver:
        before = made.device.servos[1].position
        sent = driver.arm()
        assert "full speed" in asked[0]
        assert before == pytest.approx(driver.parked_rad[1])
        np.testing.assert_allclose(list(sent.joints_rad.values()), [driver.parked_rad] * 2, atol=math.radians(0.06))
        moves = [line for _, line in made.device.lines if line.startswith(b"#")]
        assert [line.startswith(b"#0P1500#1P2162#2P1790#3P2165#5P1500#4P") for line in moves] == [True]


@pytest.mark.parametrize("setup", [{"confirm": None}, {"confirm": lambda text: False}])
def test_without_a_yes_nothing_moves(rig, setup):
    made = rig(**setup)
    with made.driver as driver:
        with pytest.raises(NotConfirmed):
            driver.arm()
        made.clock.sleep_s(1.0)
        assert not any(outputs(made)["main"])
        with pytest.raises(WrongState):
            driver.move([JointCommand(0, driver.parked_rad, 12.0)], 0.06)


def test_the_settings_may_refuse_first_moves(rig, one_board):
    one_board.first_move = "refuse"
    with rig(one_board).driver as driver, pytest.raises(NotConfirmed):
        driver.arm()


def test_boards_that_hold_are_driven_to_the_parked_pose_slowly(armed):
    rig = armed()
    q = rig.driver.parked_rad.copy()
    q[0] += 0.9
    rig.driver.drive(0, q, 12.0, 60.0)
    rig.driver.disconnect()
    asked = []
    second = ArmDriver(rig.config, rig.driver.model, clock=rig.clock, latch=rig.latch, confirm=lambda text: asked.append(text) or True)
    with second:
        began_s = rig.clock.now_s()
        sent = second.arm()
        assert "hold the arms" in asked[0]
        assert sent.duration_s == pytest.approx(math.degrees(0.9) / rig.config.park_deg_s, rel=0.05)
        assert rig.clock.now_s() - began_s > sent.duration_s
        np.testing.assert_array_equal(second.joints_rad(), [second.parked_rad] * 2)


def test_it_does_not_park_through_the_other_arm(armed, model):
    rig = armed()
    driver = rig.driver
    q = np.asarray(model.arm.ik([200.0, 0.0, 60.0])[0])
    driver.safety_filter.refer(0, q, 12.0)
    driver.safety_filter.refer(1, q, 12.0)
    with pytest.raises(CommandRejected) as caught:
        driver.safety_filter.check_room(dict.fromkeys((0, 1), driver.parked_rad), 0.0)
    assert caught.value.reason is Reason.OTHER_ARM


def test_a_brown_out_is_noticed_before_the_next_move(armed, wired):
    rig = armed(wired)
    rig.device.add_faults([make_fault("brownout", rig.clock.now_s() + 0.1)])
    rig.driver.wait(0.5)
    lines = len(rig.device.lines)
    with pytest.raises(BoardReset, match="supply"):
        rig.driver.move([turned(rig.driver, 2.0)], 0.06)
    assert rig.driver.state is State.CONFIGURED
    assert not any(b"P1" in line and line.startswith(b"#") for _, line in list(rig.device.lines)[lines:])
    with pytest.raises(WrongState):
        rig.driver.move([JointCommand(0, rig.driver.parked_rad, 12.0)], 0.06)
    rig.driver.arm()
    rig.driver.move([turned(rig.driver, 2.0)], 0.06)


def test_a_cable_that_comes_out_and_back(armed):
    rig = armed()
    now_s = rig.clock.now_s()
    rig.device.add_faults([make_fault("unplug", now_s + 0.1, 1.0)])
    rig.driver.wait(0.2)
    with pytest.raises(PortLost):
        rig.driver.move([turned(rig.driver, 2.0)], 0.06)
    assert rig.driver.state is State.LOST
    with pytest.raises(WrongState):
        rig.driver.move([JointCommand(0, rig.driver.parked_rad, 12.0)], 0.06)
    assert not rig.driver.halt(), "the board was not reached, and nobody is told it was"
    rig.driver.reconnect()
    assert 1.1 <= rig.clock.now_s() - now_s < 2.0
    assert rig.driver.state is State.CONFIGURED
    rig.driver.arm()
    rig.driver.move([turned(rig.driver, 2.0)], 0.06)


def test_a_cable_that_stays_out(armed):
    rig = armed()
    rig.device.add_faults([make_fault("unplug", rig.clock.now_s() + 0.1)])
    rig.driver.wait(0.2)
    began_s = rig.clock.now_s()
    with pytest.raises(PortNotFound):
        rig.driver.reconnect()
    assert rig.config.timeouts.reconnect_s <= rig.clock.now_s() - began_s < rig.config.timeouts.reconnect_s + 1.0


@pytest.mark.parametrize("fault", ["drop", "silent", "late", "corrupt"])
def test_a_board_that_answers_no_more_ends_in_a_named_error(armed, fault):
    rig = armed()
    rig.device.add_faults([make_fault(fault, rig.clock.now_s() + 0.1, amount=1.0)])
    rig.driver.wait(0.2)

    def go_on():
        for _ in range(100):  # a damaged byte may look like a pulse now and then
            rig.driver.move([turned(rig.driver, 0.0)], 0.06)
            rig.driver.wait(0.06)

    with pytest.raises((BadReply, PortLost, BoardReset)):
        go_on()
    assert rig.driver.state in (State.LOST, State.ARMED, State.CONFIGURED)


def test_stuck_moving_and_jams_disturb_nobody_here(armed):
    """Q is not used for moves; and servos tell nobody that they do not move: that is for the camera to see."""
    rig = armed()
    rig.device.add_faults([make_fault("stuck", 0.0), make_fault("jam", 0.0, amount=0)])
    rig.driver.wait(0.1)
    before = rig.cell.joints_rad(rig.clock.now_s())[0, 0]
    rig.driver.drive(0, turned(rig.driver, 30.0).joints_rad, 12.0, 60.0)
    assert rig.cell.joints_rad(rig.clock.now_s())[0, 0] == before
    assert rig.cell.servos(0)[0].pushing


def test_without_power_it_does_not_connect(rig):
    made = rig(faults="silent@0")
    with pytest.raises(BoardSilent), made.driver:
        pass
    assert made.driver.state is State.DISCONNECTED


def test_if_the_second_board_is_missing_the_first_is_let_go(rig, two_boards):
    made = rig(two_boards)
    made.cell.devices["east"].add_faults([make_fault("unplug", 0.0)])
    with pytest.raises(PortNotFound):
        made.driver.connect()
    assert not any(board.connected for board in made.driver.boards.by_name.values())


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_exception_stops_the_arms_where_they_are(rig, wired, error):
    made = rig(wired)

    def interrupted():
        with made.driver as driver:
            driver.arm()
            driver.move([turned(driver, 18.0)], 1.0)
            driver.wait(0.5)
            raise error

    with pytest.raises(error):
        interrupted()
    made.clock.sleep_s(0.04)
    held = outputs(made)
    for name, device in made.cell.devices.items():
        stops = {line for _, line in device.lines if b"STOP" in line}
        assert len(stops) == sum(wired.arms[arm].board == name for arm in ARMS) * 6
    made.clock.sleep_s(2.0)
    assert outputs(made) == held
    assert made.driver.state is State.DISCONNECTED


@pytest.mark.parametrize(("policy", "expected"), [("hold", "held"), ("limp", "off"), ("park", "parked")])
def test_on_leaving_the_settings_say_what_becomes_of_the_arms(rig, one_board, policy, expected):
    one_board.on_disconnect = policy
    made = rig(one_board)
    with made.driver as driver:
        driver.arm()
        driver.move([turned(driver, 9.0)], 0.2)
        driver.wait(0.3)
    made.clock.sleep_s(0.3)
    pulse = outputs(made)["main"][0]
    assert {"held": pulse == 1585.0, "off": pulse == 0.0, "parked": pulse == 1500.0}[expected]


def test_letting_go_and_arming_again(armed):
    rig = armed()
    rig.driver.torque_off()
    rig.clock.sleep_s(0.1)
    assert not any(outputs(rig)["main"])
    with pytest.raises(WrongState):
        rig.driver.move([JointCommand(0, rig.driver.parked_rad, 12.0)], 0.06)
    rig.driver.arm()


def test_a_stop_needs_to_be_cleared_and_resumed(armed):
    rig = armed()
    rig.driver.move([turned(rig.driver, 18.0)], 1.0)
    rig.driver.wait(0.5)
    rig.driver.stop("button")
    for call in (lambda: rig.driver.move([turned(rig.driver, 1.0)], 0.06), rig.driver.resume, lambda: rig.driver.wait(0.1)):
        with pytest.raises(Stopped, match="button"):
            call()
    rig.latch.clear()
    with pytest.raises(Stopped):
        rig.driver.move([turned(rig.driver, 1.0)], 0.06)
    rig.driver.resume()
    assert 5.0 < math.degrees(rig.driver.joints_rad()[0, 0]) < 13.0
    rig.driver.move([turned(rig.driver, 1.0)], 0.06)


def test_a_dry_run_does_all_but_the_last_write(armed):
    rig = armed(dry_run=True)
    sent = rig.driver.move([turned(rig.driver, 5.0)], 0.06)
    assert sent.lines[0].data.startswith(b"#0P1547S")
    assert not sent.lines[0].written
    with pytest.raises(CommandRejected):
        rig.driver.move([turned(rig.driver, 50.0)], 0.06)
    rig.driver.wait(0.1)
    assert math.degrees(rig.driver.joints_rad()[0, 0]) == pytest.approx(5.0)
    assert not any(outputs(rig)["main"])
    assert not any(line.startswith(b"#") for _, line in rig.device.lines)
