"""Moves that the driver is asked for with anything at all, at any moment."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.errors import HandoverError
from marl_handover.hardware.connection import State
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.errors import BadCommand, BoardReset
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason


def turned(driver, degrees, arm=0):
    q = driver.joints_rad()[arm].copy()
    q[0] += math.radians(degrees)
    return JointCommand(arm, q, driver.gripper_mm(arm))


def lines(rig):
    return [line for device in rig.cell.devices.values() for _, line in device.lines if b"#" in line]


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize(
    ("arm", "duration", "made"),
    [
        (1.0, 0.06, None),
        (True, 0.06, None),
        ("left", 0.06, None),
        (None, 0.06, None),
        (2, 0.06, None),
        (-1, 0.06, None),
        (0, "0.06", None),
        (0, None, None),
        (0, True, None),
        (0, math.nan, None),
        (0, 0.06, "now"),
    ],
)
def test_what_is_no_command_is_refused_by_name(armed, one_board, enabled, arm, duration, made):
    one_board.gate.enabled = enabled
    rig = armed(one_board)
    before = lines(rig)
    with pytest.raises(CommandRejected) as caught:
        rig.driver.move([JointCommand(arm, rig.driver.parked_rad, 12.0)], duration, made)
    assert caught.value.reason in (Reason.SHAPE, Reason.DURATION)
    assert lines(rig) == before
    assert rig.driver.state is State.ARMED


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize(
    ("joints", "fingers", "speed"),
    [
        ([math.nan, 0, 0, 0, 0], 12.0, 30.0),
        ([0, 0, 0, 0], 12.0, 30.0),
        ("parked", 12.0, 30.0),
        (None, 12.0, 30.0),
        ("park", math.inf, 30.0),
        ("park", 12.0, 0.0),
        ("park", 12.0, -30.0),
        ("park", 12.0, math.nan),
        ("park", 12.0, "fast"),
        ("park", 12.0, None),
    ],
)
def test_nor_is_an_arm_driven_to_what_is_no_place(armed, one_board, enabled, joints, fingers, speed):
    one_board.gate.enabled = enabled
    rig = armed(one_board)
    before = lines(rig)
    with pytest.raises((CommandRejected, BadCommand)):
        rig.driver.drive(0, rig.driver.parked_rad if joints == "park" else joints, fingers, speed)
    assert lines(rig) == before
    with pytest.raises(HandoverError):
        rig.driver.drive(1.0, rig.driver.parked_rad, 12.0, 30.0)


def test_numbers_of_numpy_are_numbers(armed):
    rig = armed()
    rig.driver.move([JointCommand(np.int64(0), rig.driver.parked_rad, np.float64(12.0))], np.float64(0.06))
    rig.driver.drive(np.int64(1), list(rig.driver.parked_rad), 12.0, np.float64(30.0))


def test_driving_ends_exactly_where_it_was_asked_to(armed):
    rig = armed()
    q = rig.driver.parked_rad + np.array([0.1, -0.2, 0.05, 0.03, 1 / 3])
    sent = rig.driver.drive(0, q, 7.1, 40.0)
    np.testing.assert_array_equal(rig.driver.joints_rad()[0], q)
    assert rig.driver.gripper_mm(0) == 7.1
    assert len(sent.lines) * rig.config.stream.period_s == pytest.approx(sent.duration_s)


@pytest.mark.parametrize(("browned", "moving"), [("west", 1), ("east", 0), ("west", 0)])
def test_one_board_that_forgot_stops_both_arms(armed, two_boards, browned, moving):
    """The arm whose board was reset sags into the way of the other."""
    rig = armed(two_boards)
    rig.cell.devices[browned].add_faults([make_fault("brownout", rig.clock.now_s() + 0.1)])
    rig.driver.wait(0.5)
    before = lines(rig)
    with pytest.raises(BoardReset, match=browned):
        rig.driver.move([turned(rig.driver, 1.0, moving)], 0.06)
    assert lines(rig) == before
    assert rig.driver.state is State.CONFIGURED


@pytest.mark.parametrize("offset", range(12))
def test_moves_back_to_back_wait_for_the_line_and_end(armed, one_board, offset):
    one_board.stream.check_reset = False
    rig = armed(one_board)
    rig.clock.sleep_s(0.013 * offset)
    inner, left = rig.clock.sleep_s, iter(range(1000))

    def sleep_s(duration_s):
        next(left)  # ends an endless loop
        inner(duration_s)

    rig.clock.sleep_s = sleep_s
    began_s = rig.clock.now_s()
    for _ in range(3):
        assert rig.driver.boards.backlog_s(rig.driver.boards.by_name) < 0.02
        rig.driver.move([turned(rig.driver, 0.0)], 0.06)
    assert rig.clock.now_s() > began_s
