"""The safety gate alone: each limit by itself, and what it says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.config import MotionConfig
from marl_handover.geometry.capsules import ground_clearance_mm, self_clearance_mm
from marl_handover.hardware.calibration import nominal_calibration
from marl_handover.hardware.clearance import arm_shapes, between_mm
from marl_handover.hardware.gate import GateRejection, JointCommand, Reason, SafetyGate
from marl_handover.hardware.settings import ARMS, HardwareConfig

PARKED = np.radians(MotionConfig().parked_deg)


def made_gate(model, config=None):
    config = config or HardwareConfig()
    gate = SafetyGate(model, config, [nominal_calibration(config, arm, model.arm) for arm in ARMS])
    for arm in range(2):
        gate.refer(arm, PARKED, 12.0)
    return gate


@pytest.fixture
def gate(model):
    return made_gate(model)


def turned(joint, degrees, fingers=12.0, arm=0, start=PARKED):
    q = start.copy()
    q[joint] += math.radians(degrees)
    return JointCommand(arm, q, fingers)


def refused(gate, command, duration_s=0.06, now_s=1.0, made_s=1.0):
    commands = command if isinstance(command, list) else [command]
    with pytest.raises(GateRejection) as caught:
        gate.check(commands, duration_s, now_s, made_s)
    rejection = caught.value
    assert str(rejection).startswith(f"safety gate ({rejection.reason}): ")
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
    bases = [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]
    other, across = (np.asarray(model.arm.ik([radius, 0.0, 60.0])[0]) for radius in (150.0, 205.0))
    ends = [across + np.radians([side * 40.0, 0, 0, 0, 0]) for side in (-1, 1)]
    gaps = [between_mm(q[None], other[None], True, arm_shapes(model), *bases) for q in (*ends, across)]
    assert gaps[2] < 3.0 < min(gaps[:2])
    gate.refer(0, ends[0], 12.0)
    gate.refer(1, other, 12.0)
    assert refused(gate, JointCommand(0, ends[1], 12.0), 1.0).reason is Reason.OTHER_ARM
    gate.check([JointCommand(0, ends[0], 12.0)], 1.0, 1.0, 1.0)


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


def test_boards_may_be_a_little_behind(model):
    """The right arm has just been sent out of the way, by a hand's width; 50 ms later its board has put that out for certain."""
    config = HardwareConfig()
    config.gate.step_deg = 90.0
    gate = made_gate(model, config)
    reach = np.asarray(model.arm.ik([205.0, 0.0, 60.0])[0])
    aside, nearly = (reach - np.radians([degrees, 0, 0, 0, 0]) for degrees in (25.0, 22.5))
    bases = [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]
    gaps = [between_mm(reach[None], q[None], True, arm_shapes(model), *bases) for q in (nearly, aside)]
    assert gaps[0] < config.gate.arm_clearance_mm < gaps[1]
    gate.refer(0, reach + np.radians([0, 35.0, 0, 0, 0]), 12.0)
    gate.refer(1, reach, 12.0)
    gate.accept([JointCommand(1, aside, 12.0)], 0.3, 1.0)
    assert refused(gate, JointCommand(0, reach, 12.0), 0.4, 1.31, 1.31).reason is Reason.OTHER_ARM
    gate.check([JointCommand(0, reach, 12.0)], 0.4, 1.36, 1.36)


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
    except GateRejection:
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
