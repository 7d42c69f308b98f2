"""The first move: what is checked and asked before it, how it is made, and how it ends when somebody steps in."""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal

import numpy as np
import pytest

from marl_handover.config import MotionConfig
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.capsules import ground_clearance_mm
from marl_handover.hardware.clearance import FAR_MM, arm_shapes, between_mm, still
from marl_handover.hardware.connection import State
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.errors import BoardReset, HalfHeld, NotConfirmed, Stopped, WrongState
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason


def moves(rig):
    return [line for device in rig.cell.devices.values() for _, line in device.lines if b"#" in line and b"P" in line]


def again(rig, confirm=lambda text: True, **keywords):
    """Another session on the same boards, configured."""
    rig.driver.disconnect()
    rig.driver = ArmDriver(rig.config, rig.driver.model, clock=rig.clock, latch=rig.latch, confirm=confirm, **keywords)
    rig.driver.connect()
    rig.driver.configure()
    return rig.driver


def sampled(rig, channel, board="main"):
    """The pulse of a channel in every frame from now on."""
    found = []

    def look():
        found.append(rig.cell.devices[board].outputs_us(rig.clock.now_s())[channel])
        rig.clock.at(rig.clock.now_s() + 0.02, look)

    rig.clock.at(rig.clock.now_s() + 0.001, look)
    return found


def away(rig, degrees=60.0):
    """Turn the left arm's base."""
    q = rig.driver.parked_rad.copy()
    q[0] += math.radians(degrees)
    rig.driver.drive(0, q, 12.0, 60.0)


@pytest.mark.parametrize(
    ("parked_deg", "limits", "reason"),
    [
        ([0.0, 140.0, -115.0, 70.0, 0.0], [500, 2000], Reason.PULSE_LIMIT),
        ([0.0, 165.0, -115.0, 70.0, 0.0], None, Reason.JOINT_LIMIT),
        ([0.0, 15.0, -109.0, 80.0, 0.0], None, Reason.TABLE),
        ([0.0, 65.8, -126.8, 61.0, 0.0], None, Reason.OTHER_ARM),
    ],
)
def test_a_parked_pose_that_is_not_allowed_is_never_sent(rig, model, one_board, parked_deg, limits, reason):
    asked = []
    if limits:
        one_board.arms["left"].pulse_limits_us[1] = limits
    made = rig(one_board)
    motion = MotionConfig()
    motion.parked_deg = parked_deg
    driver = ArmDriver(one_board, model, motion, clock=made.clock, latch=made.latch, confirm=lambda text: asked.append(text) or True)
    made.driver = driver
    driver.connect()
    driver.configure()
    with pytest.raises(CommandRejected) as caught:
        driver.arm()
    assert caught.value.reason is reason
    assert driver.state is State.CONFIGURED
    assert np.isnan(driver.joints_rad()).all()
    assert not asked
    assert not moves(made)


@pytest.mark.parametrize("speed_deg_s", [2000.0, 91.0, 0.0, math.nan])
def test_parking_has_a_greatest_speed(one_board, speed_deg_s):
    one_board.park_deg_s = speed_deg_s
    with pytest.raises(InvalidSetting, match="park_deg_s"):
        one_board.validate()


def put(rig, joints):
    """Boards hold both arms at ``joints`` (2, 5), wherever they were before; another session, configured, that finds them so."""
    for name, pulses in rig.driver.wiring.pulses([JointCommand(arm, joints[arm], 12.0) for arm in range(2)]).items():
        rig.driver.boards.by_name[name].move(pulses, 100)
    rig.clock.sleep_s(3.0)
    return again(rig)


def jam(rig, arm, jammed):
    """Whether no servo of an arm moves from now on; nobody is told."""
    for servo in rig.cell.servos(arm):
        servo.jammed = jammed


def nearest_mm(rig, shapes, bases):
    """What is filled with the arms' true distance in every frame from now on."""
    found = []

    def look():
        q = rig.cell.joints_rad(rig.clock.now_s())
        found.append(between_mm(still(q[0]), still(q[1]), True, shapes, shapes, *bases, FAR_MM))
        rig.clock.at(rig.clock.now_s() + 0.02, look)

    rig.clock.at(rig.clock.now_s() + 0.001, look)
    return found


@pytest.mark.parametrize(
    "start_deg",
    [
        [[13.0, 85.0, -111.0, -12.0, 0.0], [-13.0, 96.0, -112.0, 16.0, 0.0]],  # the right one stuck: 26 mm into it
        [[-18.0, 108.0, -128.0, 24.0, 0.0], [14.0, 58.0, -115.0, 48.0, 0.0]],  # the left one stuck: 18 mm
    ],
)
def test_held_arms_that_clear_each_other_only_if_both_move_are_not_driven(armed, start_deg):
    """Both go home at once, and no moment brings them together; but a servo that is stuck tells nobody."""
    rig = armed()
    driver = put(rig, np.radians(start_deg))
    before = rig.device.outputs_us(rig.clock.now_s())
    with pytest.raises(CommandRejected) as caught:
        driver.arm()
    assert caught.value.reason is Reason.OTHER_ARM
    rig.clock.sleep_s(1.0)
    assert np.abs(np.subtract(rig.device.outputs_us(rig.clock.now_s()), before)).max() <= 5.0, "sent where they are held, and nowhere else"


def check_stuck(armed, seed, count):
    """Held anywhere at all, one arm stuck: where arming is not refused the other one reaches its parked pose without touching it."""
    random, rig = np.random.default_rng(seed), armed()
    model, arms = rig.driver.model, 0
    shapes, bases = arm_shapes(model), [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]
    while arms < count:
        joints = random.uniform(model.arm.lower_rad + 0.05, model.arm.upper_rad - 0.05, (2, 5))
        apart = between_mm(still(joints[0]), still(joints[1]), True, shapes, shapes, *bases, FAR_MM)
        if not 15.0 < apart < 60.0 or ground_clearance_mm(model.arm, joints).min() < 3.0:
            continue
        driver, stuck = put(rig, joints), arms % 2
        jam(rig, stuck, True)
        found = nearest_mm(rig, shapes, bases)
        with contextlib.suppress(CommandRejected):
            driver.arm()
            arms += 1
            assert np.degrees(np.abs(rig.cell.joints_rad(rig.clock.now_s())[1 - stuck] - driver.parked_rad)).max() < 8.0
            assert min(found) > 0.0
        jam(rig, stuck, False)


def test_a_stuck_arm_is_not_run_into(armed):
    check_stuck(armed, 0, 3)


@pytest.mark.slow
def test_a_stuck_arm_is_not_run_into_from_two_hundred_places(armed):
    check_stuck(armed, 1, 200)


def test_held_fingers_open_no_faster_than_the_gate_allows(armed):
    rig = armed()
    rig.driver.drive(0, rig.driver.parked_rad, 2.0, 30.0)
    driver = again(rig)
    gripper = rig.config.arms["left"].gripper
    pulses = sampled(rig, gripper.channel)
    driver.arm()
    speeds = np.abs(np.diff(pulses)) / abs(gripper.open_us - gripper.closed_us) * gripper.open_mm / 0.02
    assert 0 < speeds.max() <= rig.config.gate.finger_mm_s * 1.02
    assert driver.gripper_mm(0) == driver.motion.finger_travel_mm


def test_held_arms_are_driven_in_short_moves_at_the_parking_speed(armed):
    rig = armed()
    away(rig)
    driver = again(rig)
    pulses = sampled(rig, 0)
    seen = len(moves(rig))
    sent = driver.arm()
    speeds = np.abs(np.diff(pulses)) / 9.5 / 0.02
    assert 25.0 < np.median(speeds[speeds > 1.0]) < 35.0
    assert speeds.max() < 45.0, "whole microseconds, and half a reading at the beginning"
    times = {int(line[line.rindex(b"T") + 1 :]) for line in moves(rig)[seen:]}
    assert times == {200, 60}, "where they are held, and then a period at a time"
    assert sent.duration_s == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("joint", [0, 4])
@pytest.mark.parametrize("end", [-1, 1])
def test_an_arm_held_at_a_limit_is_not_sent_past_it(armed, joint, end):
    """Boards tell pulses to 10 us: the middle of what a reading may mean can lie half a degree beyond."""
    rig = armed()
    model = rig.driver.model.arm
    limits = np.array([model.lower_rad[joint], model.upper_rad[joint]])
    q = rig.driver.parked_rad.copy()
    q[joint] = limits[(end + 1) // 2]
    rig.driver.drive(0, q, 12.0, 60.0)
    again(rig).arm()
    restated = [line for line in moves(rig) if b"S" not in line][-1]
    servo = rig.driver.calibrations[0].maps[joint]
    pulse = int(re.search(rb"#%dP(\d+)" % rig.config.arms["left"].channels[joint], restated)[1])
    beyond_rad = max(0.0, limits[0] - servo.to_rad(float(pulse)), servo.to_rad(float(pulse)) - limits[1])
    assert beyond_rad <= 0.5 / abs(servo.us_per_rad())


def test_a_host_that_dies_while_held_arms_are_driven_leaves_them_holding(armed):
    rig = armed()
    away(rig)
    driver = again(rig)

    def die():
        raise SystemExit

    rig.clock.at(rig.clock.now_s() + 1.0, die)
    with pytest.raises(SystemExit):
        driver.arm()
    rig.clock.sleep_s(rig.config.stream.period_s + 0.04)
    held = rig.device.outputs_us(rig.clock.now_s())
    rig.clock.sleep_s(3.0)
    assert rig.device.outputs_us(rig.clock.now_s()) == held
    assert held[0] > 1600.0
    assert driver.state is State.CONFIGURED


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_arms_on_their_way(armed, number):
    rig = armed()
    away(rig)
    driver = again(rig)
    lines = len(rig.device.lines)
    rig.clock.at(rig.clock.now_s() + 1.0, lambda: os.kill(os.getpid(), number))

    def arming():
        with driver:
            driver.arm()

    with pytest.raises(KeyboardInterrupt):
        arming()
    rig.clock.sleep_s(0.04)
    held = rig.device.outputs_us(rig.clock.now_s())
    assert sum(b"STOP" in line for _, line in list(rig.device.lines)[lines:]) >= 12
    rig.clock.sleep_s(3.0)
    assert rig.device.outputs_us(rig.clock.now_s()) == held
    assert held[0] > 1600.0


def test_a_stop_on_the_way_is_obeyed_and_stays(armed):
    rig = armed()
    away(rig)
    driver = again(rig)
    rig.clock.at(rig.clock.now_s() + 1.0, lambda: StopLatch(rig.latch.path).latch("another process"))
    with pytest.raises(Stopped):
        driver.arm()
    assert driver.state is State.STOPPED
    with pytest.raises(WrongState):
        driver.arm()
    rig.latch.clear()
    driver.resume()
    assert 10.0 < math.degrees(driver.joints_rad()[0, 0]) < 55.0
    driver.park()


def test_halt_from_elsewhere_is_not_armed_over(rig):
    made = rig()
    made.driver.connect()
    made.driver.configure()
    made.clock.at(made.clock.now_s() + 0.1, made.driver.halt)
    with pytest.raises(Stopped):
        made.driver.arm()
    assert made.driver.state is State.STOPPED


def test_boards_that_hold_an_arm_outside_its_limits_are_not_believed(armed):
    """The pose of another cell's settings, say: the way from there is not what it would be taken for."""
    rig = armed()
    q = rig.driver.parked_rad.copy()
    q[2] = math.radians(-20.0)
    pulses = rig.driver.wiring.pulses([JointCommand(0, q, 12.0)])["main"]
    rig.driver.boards.by_name["main"].move(pulses, 2000)
    rig.clock.sleep_s(2.2)
    driver = again(rig)
    seen = len(moves(rig))
    for call in (driver.arm, driver.resync):
        with pytest.raises(CommandRejected, match="elbow, as the board holds it") as caught:
            call()
        assert caught.value.reason is Reason.JOINT_LIMIT
        assert driver.state is State.CONFIGURED
    assert len(moves(rig)) == seen


@pytest.mark.parametrize("answers", [[True, True], [True, False], [False]])
def test_if_one_board_forgot_all_are_let_go_first(armed, two_boards, answers):
    rig = armed(two_boards)
    rig.driver.drive(1, rig.driver.parked_rad + np.array([0.6, 0, 0, 0, 0]), 12.0, 60.0)
    rig.device.add_faults([make_fault("brownout", rig.clock.now_s() + 0.1)])
    rig.clock.sleep_s(0.6)
    asked, held, said = [], [], iter(answers)

    def confirm(text):
        asked.append(text)
        held.append(sum(map(bool, rig.cell.devices["east"].outputs_us(rig.clock.now_s()))))
        return next(said)

    driver = again(rig, confirm)
    seen = len(moves(rig))
    if all(answers):
        driver.arm()
        assert driver.state is State.ARMED
    else:
        with pytest.raises(NotConfirmed):
            driver.arm()
        assert len(moves(rig)) == seen
    assert "let go" in asked[0]
    assert held == [6, 0][: len(answers)], "held until somebody agreed; let go before the jump"
    assert ["full speed" in text for text in asked[1:]] == [True] * (len(answers) - 1)


def test_a_dry_run_lets_nothing_go_and_so_refuses(armed, two_boards):
    rig = armed(two_boards)
    rig.device.add_faults([make_fault("brownout", rig.clock.now_s() + 0.1)])
    rig.clock.sleep_s(0.6)
    driver = again(rig, dry_run=True)
    with pytest.raises(HalfHeld, match="limp"):
        driver.arm()
    assert sum(map(bool, rig.cell.devices["east"].outputs_us(rig.clock.now_s()))) == 6


def test_rejoining_moves_nothing_and_goes_on_from_there(armed):
    rig = armed()
    gripper = rig.config.arms["left"].gripper
    gripper.open_us, gripper.closed_us = 900, 2500  # one channel at the very end of what boards take
    driver = again(rig)
    driver.arm()
    q = driver.parked_rad + np.array([0.3, 0, 0, 0, 0])
    driver.drive(0, q, 0.0, 60.0)
    driver.wait(0.5)
    before = rig.device.outputs_us(rig.clock.now_s())
    assert before[gripper.channel] > 2400
    joined = again(rig, confirm=None)
    joined.resync()
    assert np.abs(np.subtract(rig.device.outputs_us(rig.clock.now_s()), before)).max() <= 5.0
    assert joined.state is State.ARMED
    assert math.degrees(joined.joints_rad()[0, 0]) == pytest.approx(math.degrees(0.3), abs=1.0)
    joined.park()
    with pytest.raises(WrongState):
        joined.resync()


def test_rejoining_a_board_that_forgot_is_refused(rig):
    made = rig()
    made.driver.connect()
    made.driver.configure()
    with pytest.raises(BoardReset):
        made.driver.resync()
    assert made.driver.state is State.CONFIGURED
    assert not moves(made)


def test_the_question_says_that_nobody_has_calibrated(rig):
    asked = []
    made = rig(confirm=lambda text: asked.append(text) or True)
    with made.driver as driver:
        driver.arm()
    assert "NOT CALIBRATED: left and right" in asked[0]
