"""The safety filter alone: each limit by itself, and what it says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.geometry.capsules import ground_clearance_mm, self_clearance_mm
from marl_handover.hardware.calibration import nominal_calibration
from marl_handover.hardware.clearance import FAR_MM, arm_shapes, between_mm, still
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason, SafetyFilter
from marl_handover.hardware.settings import ARMS, HardwareConfig
from tests.canonical_arms import PARKED_DEG

PARKED = np.radians(PARKED_DEG)


def made_gate(model, config=None):
    config = config or HardwareConfig()
    gate = SafetyFilter(model, config, [nominal_calibration(config, arm, model.arm) for arm in ARMS])
    for arm in range(2):
        gate.refer(arm, PARKED, 12.0)
    return gate


@pytest.fixture
def gate(model):
    return made_gate(model)


def apart_mm(model, left, right):
    """Distance of the two arms, standing there with open hands."""
    shapes, bases = arm_shapes(model), [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]
    return between_mm(still(left), still(right), True, shapes, shapes, *bases, FAR_MM)


def turned(joint, degrees, fingers=12.0, arm=0, start=PARKED):
    q = start.copy()
    q[joint] += math.radians(degrees)
    return JointCommand(arm, q, fingers)


def refused(gate, command, duration_s=0.06, now_s=1.0, made_s=1.0):
    commands = command if isinstance(command, list) else [command]
    with pytest.raises(CommandRejected) as caught:
        gate.check(commands, duration_s, now_s, made_s)
    rejection = caught.value
    assert str(rejection).startswith(f"safety filter ({rejection.reason}): ")
    assert rejection.limit in str(rejection)
    return rejection


def test_a_small_slow_move_passes(gate):
    gate.check([turned(0, 2.0)], 0.06, 1.0, 0.9)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", range(6))
def test_no_nan_or_infinity_passes_anywhere(gate, bad, place):
    q, fingers = PARKED.copy(), 12.0
    if place < 5:
        q[place] = bad
    else:
        fingers = bad
    assert refused(gate, JointCommand(0, q, fingers)).reason is Reason.NOT_FINITE


@pytest.mark.parametrize(
    "command",
    [
        JointCommand(0, PARKED[:4], 12.0),
        JointCommand(0, PARKED[None], 12.0),
        JointCommand(0, "park", 12.0),
        JointCommand(0, PARKED, None),
        JointCommand(2, PARKED, 12.0),
        [],
        [JointCommand(0, PARKED, 12.0), JointCommand(0, PARKED, 12.0)],
    ],
)
def test_commands_have_a_shape(gate, command):
    assert refused(gate, command).reason is Reason.SHAPE


def test_each_limit_has_its_reason_and_its_numbers(model, gate):
    assert refused(gate, turned(0, 10.0), made_s=0.7).reason is Reason.STALE
    assert refused(gate, turned(0, 10.0), made_s=1.1).reason is Reason.STALE
    assert refused(gate, turned(0, 10.0), made_s=math.nan).reason is Reason.STALE
    for duration_s in (0.0, -1.0, math.nan, 1e9):
        assert refused(gate, turned(0, 1.0), duration_s).reason is Reason.DURATION
    limit = refused(gate, turned(1, 30.0))
    assert (limit.reason, limit.what, limit.arm) == (Reason.JOINT_LIMIT, "shoulder", 0)
    assert limit.value == pytest.approx(170.0)
    assert refused(gate, turned(0, 0.0, fingers=17.0)).reason is Reason.GRIPPER
    assert refused(gate, turned(0, 0.0, fingers=-0.1)).reason is Reason.GRIPPER
    step = refused(gate, turned(0, 25.0), 1.0)
    assert (step.reason, round(step.value, 6)) == (Reason.STEP, 25.0)
    speed = refused(gate, turned(0, 20.0), 0.02)
    assert (speed.reason, round(speed.value)) == (Reason.SPEED, 1000)
    assert refused(gate, turned(0, 0.0, fingers=0.0), 0.06).what == "the speed of fingers"


def test_pulses_have_limits_of_their_own(model):
    config = HardwareConfig()
    config.arms["left"].pulse_limits_us[0] = [1480, 1520]
    rejection = refused(made_gate(model, config), turned(0, 6.0))
    assert (rejection.reason, rejection.value) == (Reason.PULSE_LIMIT, 1557.0)
    made_gate(model, config).check([turned(0, 5.0, arm=1)], 0.06, 1.0, 1.0)


def test_the_table_is_not_touched(model, gate):
    low = np.radians([0.0, 15.0, -109.0, 80.0, 0.0])
    assert ground_clearance_mm(model.arm, low) < 0
    start = low + np.radians([0.0, 12.0, 0.0, 0.0, 0.0])
    gate.refer(0, start, 12.0)
    assert refused(gate, JointCommand(0, low, 12.0), 0.2).reason is Reason.TABLE


def test_what_is_swept_counts_not_only_where_it_ends(model):
    """Both ends are clear of the other arm, the way between is not."""
    config = HardwareConfig()
    config.gate.step_deg = 90.0
    gate = made_gate(model, config)
    other, across = (np.asarray(model.arm.ik([radius, 0.0, 60.0])[0]) for radius in (150.0, 205.0))
    ends = [across + np.radians([side * 40.0, 0, 0, 0, 0]) for side in (-1, 1)]
    gaps = [apart_mm(model, q, other) for q in (*ends, across)]
    assert gaps[2] < 3.0 < min(gaps[:2])
    gate.refer(0, ends[0], 12.0)
    gate.refer(1, other, 12.0)
    assert refused(gate, JointCommand(0, ends[1], 12.0), 1.0).reason is Reason.OTHER_ARM
    gate.check([JointCommand(0, ends[0], 12.0)], 1.0, 1.0, 1.0)


CROSSING = np.radians(
    [
        [[-1.1, 84.0, -131.2, 12.4, -44.6], [18.7, 103.7, -111.7, 21.2, -64.5]],
        [[-18.6, 146.8, -123.4, 7.2, -25.3], [-0.1, 127.3, -143.3, -10.2, -43.0]],
    ]
)
"""Of each arm, where it is and where it is sent. Apart in each of eleven postures of both; within one another in between."""
BESIDE = np.radians(
    [[[-5.53, 95.01, -113.73, 11.04, 0.0], [3.72, 75.03, -131.38, 31.02, 0.0]], [[-4.36, 85.56, -150.89, 71.67, -47.46]] * 2]
)


def on_the_way(model, ways, samples):
    """Distances of the arms in postures that lie evenly between both ends of ``ways`` (2, 2, 5)."""
    return np.array([apart_mm(model, *(ways[:, 0] + share * (ways[:, 1] - ways[:, 0]))) for share in np.linspace(0.0, 1.0, samples)])


@pytest.mark.parametrize(("ways", "looks", "nearest_mm"), [(CROSSING, 11, -12.5), (BESIDE, 11, 2.9)])
def test_arms_do_not_come_too_near_between_two_looks(model, gate, ways, looks, nearest_mm):
    commands = [JointCommand(arm, ways[arm, 1], 12.0) for arm in range(2) if (ways[arm, 0] != ways[arm, 1]).any()]
    for arm in range(2):
        gate.refer(arm, ways[arm, 0], 12.0)
    assert on_the_way(model, ways, looks).min() >= 3.0
    assert on_the_way(model, ways, 301).min() < nearest_mm
    rejection = refused(gate, commands, 0.1)
    assert (rejection.reason, rejection.limit) == (Reason.OTHER_ARM, "at least 3 mm")
    assert rejection.value < 3.0


LEVEL_MM = 45.0
"""The pick height: a hand that is level there holds a block that stands on the table."""


def level(model, radius_mm, height_mm, yaw_deg=0.0):
    turn = math.radians(yaw_deg)
    return np.asarray(model.arm.ik([radius_mm * math.cos(turn), radius_mm * math.sin(turn), height_mm])[0])


@pytest.mark.parametrize("radius_mm", [180.0, 190.0, 225.0])
def test_a_closed_hand_does_not_press_the_block_into_the_table(model, gate, radius_mm):
    """It is taken from the table and set down there; 6 mm below are for aims that take out the backlash of servos, 15 mm are not."""
    above, at, below, deep = (level(model, radius_mm, LEVEL_MM + more_mm) for more_mm in (15.0, 0.0, -5.0, -15.0))
    for start, end in [(at, above), (above, at), (at, below)]:
        gate.refer(0, start, 0.0)
        gate.check([JointCommand(0, end, 0.0)], 1.0, 1.0, 1.0)
    gate.refer(0, at, 0.0)
    rejection = refused(gate, JointCommand(0, deep, 0.0), 1.0)
    assert (rejection.reason, rejection.limit) == (Reason.TABLE, "at least -6 mm")
    assert "block in its closed hand" in str(rejection)
    gate.refer(0, at, 12.0)
    gate.check([JointCommand(0, deep, 12.0)], 1.0, 1.0, 1.0)


def test_a_hand_that_closes_below_or_opens_later_may_hold_it(model, gate):
    """Whether fingers are on the pin at any moment counts; 2.25 mm of each are 1 mm from a pin 2.5 mm thick."""
    at, deep = level(model, 190.0, LEVEL_MM), level(model, 190.0, LEVEL_MM - 15.0)
    for before_mm, after_mm, holds in [(12.0, 0.0, True), (0.0, 12.0, True), (12.0, 2.2, True), (12.0, 2.3, False)]:
        gate.refer(0, at, before_mm)
        if holds:
            assert refused(gate, JointCommand(0, deep, after_mm), 1.0).reason is Reason.TABLE
        else:
            gate.check([JointCommand(0, deep, after_mm)], 1.0, 1.0, 1.0)
    gate.refer(0, at, 0.0)
    gate.accept([JointCommand(0, at, 12.0)], 0.2, 1.0)
    assert refused(gate, JointCommand(0, deep, 12.0), 1.0, 1.08, 1.08).reason is Reason.TABLE, "the board may be late"
    gate.check([JointCommand(0, deep, 12.0)], 1.0, 1.1, 1.1)


@pytest.mark.parametrize(("holder", "heights_mm"), [(0, (90.0, 60.0)), (1, (60.0, 90.0))])
def test_the_held_block_keeps_clear_of_the_other_arm(model, gate, holder, heights_mm):
    """Of a hand that comes over the other one, 40 mm of block on its pin; and of one that comes under the other one and its block."""
    near, away = (level(model, 185.0, heights_mm[0], yaw_deg) for yaw_deg in (0.0, -19.0))
    for arm, q in ((0, away), (1, level(model, 205.0, heights_mm[1], yaw_deg=12.0))):
        gate.refer(arm, q, 12.0)
    gate.check([JointCommand(0, near, 12.0)], 1.0, 1.0, 1.0)
    gate.refer(holder, gate.held(holder, 0.0)[0], 0.0)
    rejection = refused(gate, JointCommand(0, near, gate.held(0, 0.0)[1]), 1.0)
    assert rejection.reason is Reason.OTHER_ARM
    assert "with the block in its closed hand" in str(rejection)


def test_the_held_block_keeps_clear_of_its_own_arm(model, gate):
    tucked, bent = np.radians([[0.0, 120.0, -130.0, -76.0, 0.0], [0.0, 120.0, -130.0, -90.0, 0.0]])
    gate.refer(0, tucked, 12.0)
    gate.check([JointCommand(0, bent, 12.0)], 1.0, 1.0, 1.0)
    gate.refer(0, tucked, 0.0)
    assert refused(gate, JointCommand(0, bent, 0.0), 1.0).reason is Reason.ITSELF


def test_a_closed_hand_stands_parked_and_may_come_from_any_pick(model, gate):
    for radius_mm in (155.0, 190.0, 225.0):
        for yaw_deg in (-60.0, 0.0, 60.0):
            gate.refer(0, level(model, radius_mm, LEVEL_MM, yaw_deg), 0.0)
            gate.check_room({0: PARKED}, 1.0)
    gate.check_stand([JointCommand(arm, PARKED, 0.0) for arm in range(2)])


def test_fingers_that_are_not_named_stay_as_they_are(model, gate):
    gate.refer(0, level(model, 190.0, LEVEL_MM), 0.0)
    deep = level(model, 190.0, LEVEL_MM - 15.0)
    with pytest.raises(CommandRejected, match="block"):
        gate.check_room({0: deep}, 1.0)
    gate.check_room({0: np.append(gate.held(0, 1.0)[0], 12.0)}, 1.0)


def test_an_arm_in_a_move_may_be_anywhere_on_the_rest_of_it(model):
    """The right arm swings away for a second; the left one would be there long before it is gone."""
    config = HardwareConfig()
    config.gate.step_deg = 90.0
    gate = made_gate(model, config)
    reach = np.asarray(model.arm.ik([205.0, 0.0, 60.0])[0])
    beside = reach + np.radians([75.0, 0, 0, 0, 0])
    gate.refer(0, beside, 12.0)
    gate.refer(1, reach, 12.0)
    swing = [JointCommand(1, reach - np.radians([75.0, 0, 0, 0, 0]), 12.0)]
    gate.check(swing, 1.0, 1.0, 1.0)
    gate.accept(swing, 1.0, 1.0)
    assert refused(gate, JointCommand(0, reach, 12.0), 0.4, 1.0).reason is Reason.OTHER_ARM
    assert refused(gate, JointCommand(0, reach, 12.0), 0.4, 1.3, 1.3).reason is Reason.OTHER_ARM
    gate.check([JointCommand(0, reach, 12.0)], 0.4, 2.1, 2.1)


def test_arms_of_one_command_go_together_unless_one_may_be_stuck(model, gate):
    """The right arm makes way for the left one; if it did not, they would meet."""
    reach = level(model, 205.0, 60.0)
    for arm, turn in ((0, 40.0), (1, 0.0)):
        gate.refer(arm, reach + np.radians([turn, 0, 0, 0, 0]), 12.0)
    aims = {0: reach, 1: reach + np.radians([40.0, 0, 0, 0, 0])}
    gate.check_room(aims, 1.0)
    with pytest.raises(CommandRejected) as caught:
        gate.check_room(aims, 1.0, together=False)
    assert caught.value.reason is Reason.OTHER_ARM


def test_boards_may_be_a_little_behind(model):
    """The right arm has just been sent out of the way, by a hand's width; 50 ms later its board has put that out for certain."""
    config = HardwareConfig()
    config.gate.step_deg = 90.0
    gate = made_gate(model, config)
    reach = np.asarray(model.arm.ik([205.0, 0.0, 60.0])[0])
    aside, nearly = (reach - np.radians([degrees, 0, 0, 0, 0]) for degrees in (25.0, 22.5))
    gaps = [apart_mm(model, reach, q) for q in (nearly, aside)]
    assert gaps[0] < config.gate.arm_clearance_mm < gaps[1]
    gate.refer(0, reach + np.radians([0, 35.0, 0, 0, 0]), 12.0)
    gate.refer(1, reach, 12.0)
    gate.accept([JointCommand(1, aside, 12.0)], 0.3, 1.0)
    assert refused(gate, JointCommand(0, reach, 12.0), 0.4, 1.31, 1.31).reason is Reason.OTHER_ARM
    gate.check([JointCommand(0, reach, 12.0)], 0.4, 1.36, 1.36)


def test_so_may_they_be_by_several_short_moves(model, gate):
    """The right arm is sent out of the way in three moves of 20 ms: at the third one's beginning it has not gone yet for certain."""
    reach = np.asarray(model.arm.ik([205.0, 0.0, 60.0])[0])
    gate.limits.step_deg = 90.0
    gate.refer(0, reach + np.radians([0, 35.0, 0, 0, 0]), 12.0)
    gate.refer(1, reach, 12.0)
    for number in range(3):
        gate.accept([JointCommand(1, reach - np.radians([13.5 * (number + 1), 0, 0, 0, 0]), 12.0)], 0.02, 1.0 + 0.02 * number)
    assert refused(gate, JointCommand(0, reach, 12.0), 0.4, 1.065, 1.065).reason is Reason.OTHER_ARM
    gate.check([JointCommand(0, reach, 12.0)], 0.4, 1.1, 1.1)


def test_an_arm_is_kept_from_itself(model, gate):
    Q = np.random.default_rng(0).uniform(model.arm.lower_rad, model.arm.upper_rad, (4000, 5))
    folded = Q[(ground_clearance_mm(model.arm, Q) > 15.0) & (self_clearance_mm(model.arm, Q) < -2.0)]
    assert len(folded) > 3
    for q in folded:
        gate.refer(0, q, 12.0)
        assert refused(gate, JointCommand(0, q, 12.0)).reason is Reason.ITSELF


def test_nothing_moves_while_an_arms_place_is_unknown(gate):
    gate.forget()
    gate.refer(0, PARKED, 12.0)
    assert refused(gate, turned(0, 2.0)).arm == 1, "the other arm might be anywhere"
    assert refused(gate, turned(0, 2.0, arm=1)).reason is Reason.NO_REFERENCE


def test_moves_are_judged_from_where_the_last_one_has_come_to(gate):
    first = turned(0, 15.0)
    gate.check([first], 0.3, 1.0, 1.0)
    gate.accept([first], 0.3, 1.0)
    joints, fingers = gate.held(0, 1.15)
    assert math.degrees(joints[0]) == pytest.approx(7.5)
    assert fingers == 12.0
    back = turned(0, -10.0)
    gate.check([back], 0.3, 1.15, 1.15)
    assert refused(gate, back, 0.3, 1.3, 1.3).reason is Reason.STEP
    gate.freeze(1.15)
    assert math.degrees(gate.held(0, 9.0)[0][0]) == pytest.approx(7.5)


JOINTS = ("base_yaw", "shoulder", "elbow", "wrist_pitch", "wrist_roll")


@given(st.integers(0, 199), st.lists(st.floats(-0.5, 0.5), min_size=5, max_size=5), st.floats(0.02, 2.0), st.floats(0.0, 16.0))
def test_what_passes_is_within_every_limit(anywhere, start, changes, duration_s, fingers):
    """From anywhere that an arm may be, not only from where it is parked."""
    model, gate, postures = anywhere
    q, target = postures[start], postures[start] + np.array(changes)
    gate.refer(0, q, 12.0)
    try:
        gate.check([JointCommand(0, target, fingers)], duration_s, 1.0, 1.0)
    except CommandRejected:
        return
    assert model.arm.within_limits(target)
    assert (np.abs(target - q) <= math.radians(20.0) + 1e-6).all()
    velocities = [model.arm.description.joint(name).velocity for name in JOINTS]
    assert (np.abs(target - q) / duration_s <= np.array(velocities) * (1 + 1e-5)).all()
    assert abs(fingers - 12.0) / duration_s <= 95.0 * (1 + 1e-5)
    way = q + np.linspace(0.0, 1.0, 9)[:, None] * (target - q)
    assert ground_clearance_mm(model.arm, way).min() >= 0.4
    assert self_clearance_mm(model.arm, way).min() >= -0.1


@pytest.fixture(scope="module")
def anywhere(model):
    """The cell, its gate, and postures of the left arm that are close to a limit of some kind but within all of them."""
    Q = np.random.default_rng(1).uniform(model.arm.lower_rad, model.arm.upper_rad, (20_000, 5))
    height, itself = ground_clearance_mm(model.arm, Q), self_clearance_mm(model.arm, Q)
    return model, made_gate(model), Q[(height > 1.0) & (itself > 1.0) & ((height < 20.0) | (itself < 10.0))][:200]


def test_switched_off_it_lets_everything_through(model):
    config = HardwareConfig()
    config.gate.enabled = False
    made_gate(model, config).check([turned(1, 90.0)], 0.02, 1.0, -5.0)
