"""Random and adversarial commands through gate and driver to the board: what it puts out stays within every limit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from marl_handover.hardware.clearance import alone_mm, arm_shapes, between_mm
from marl_handover.hardware.emulator.board import FRAME_S
from marl_handover.hardware.gate import GateRejection, JointCommand, Reason
from marl_handover.hardware.settings import ARMS

POSES = np.radians(
    [[0.0, 140.0, -115.0, 70.0, 0.0], [0.0, 60.0, -109.0, 49.0, 0.0], [0.0, 15.0, -109.0, 80.0, 0.0], [30.0, 60.0, -110.0, -60.0, 80.0],
     [-85.0, 150.0, -168.0, -95.0, -90.0], [85.0, -14.0, -108.5, 95.0, 90.0], [0.0, 40.0, -109.0, 60.0, 0.0]]
)  # fmt: skip
commands = st.tuples(
    st.sampled_from([0, 0, 1, 1, 2]),
    st.integers(0, len(POSES) - 1),
    st.floats(0.0, 0.4) | st.sampled_from([1.0, math.nan, -1.0]),
    st.sampled_from([0.06, 0.06, 0.1, 0.2, 0.02, 0.0, 1.0]),
    st.sampled_from([12.0, 6.0, 0.0, 20.0, math.inf]),
    st.floats(0.0, 0.12),
    st.sampled_from([0.0, 0.0, 0.0, 0.5]),
)


class Watch:
    """Looks at what the boards put out in every frame."""

    def __init__(self, rig):
        self.rig, self.shapes = rig, arm_shapes(rig.driver.model)
        self.bases = [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in rig.driver.model.cell.bases]
        self.speeds = rig.driver.wiring
        self.before, self.refused = None, set()

    def look(self):
        pulses, arm = self.rig.device.outputs_us(self.rig.clock.now_s()), self.rig.driver.model.arm
        wired = {channel: pulses[channel] for name in ARMS for channel in self.rig.config.channels(name)}
        assert all(500 <= pulse <= 2500 for pulse in wired.values())
        frame = self.rig.device.board.frame(self.rig.clock.now_s())
        if self.before is not None:
            fastest, spent_s = self.speeds.speeds("main", wired), (frame - self.before[0]) * FRAME_S
            assert all(abs(wired[channel] - self.before[1][channel]) <= fastest[channel] * spent_s + 1e-6 for channel in wired)
        self.before = frame, wired
        joints, out = [self.speeds.state({"main": wired}, arm)[0] for arm in range(2)], np.empty(2)
        for q in joints:
            assert (q >= arm.lower_rad - math.radians(0.06)).all()
            assert (q <= arm.upper_rad + math.radians(0.06)).all()
            alone_mm(q[None], self.shapes, out)
            assert out[0] > 0.0
        assert between_mm(joints[0][None], joints[1][None], True, self.shapes, *self.bases) > 0.0


def play(rig, sequence):
    """Send commands, good and bad, and look at the boards' outputs all the time."""
    try:
        rig.driver.arm()
    except GateRejection:  # the last sequence left them where the way back is not clear: as a person would
        rig.driver.limp()
        for arm in range(2):
            rig.cell.put(arm, rig.driver.parked_rad, rig.clock.now_s())
        rig.driver.arm()
    watch = Watch(rig)
    for arm, pose, share, duration_s, fingers, pause_s, age_s in sequence:
        held = rig.driver.joints_rad()[min(arm, 1)]
        command = JointCommand(arm, held + share * (POSES[pose] - held), fingers)
        try:
            rig.driver.move([command], duration_s, rig.clock.now_s() - age_s)
        except GateRejection as rejection:
            watch.refused.add((rejection.reason, "allowed: " in str(rejection)))
        for _ in range(1 + int(pause_s / FRAME_S)):
            watch.look()
            rig.clock.sleep_s(FRAME_S)
    for _ in range(12):
        watch.look()
        rig.clock.sleep_s(FRAME_S)
    assert all(explained for _, explained in watch.refused)
    return {reason for reason, _ in watch.refused}


@pytest.fixture
def playground(armed):
    return armed()


relaxed = {"suppress_health_check": [HealthCheck.function_scoped_fixture], "derandomize": True}


@settings(max_examples=100, **relaxed)
@given(st.lists(commands, min_size=4, max_size=16))
def test_no_sequence_of_commands_leaves_the_limits(playground, sequence):
    play(playground, sequence)


@pytest.mark.slow
@settings(max_examples=10_000, **relaxed)
@given(st.lists(commands, min_size=4, max_size=16))
def test_no_sequence_out_of_ten_thousand_leaves_the_limits(playground, sequence):
    play(playground, sequence)


def walk(random):
    """Sixty commands that insist on going where they should not, with some rubbish in between."""
    aims = random.integers(len(POSES), size=2)
    for _ in range(60):
        arm = int(random.choice(3, p=[0.49, 0.49, 0.02]))
        share = float(random.choice([random.uniform(0.05, 0.25), 1.0, np.nan], p=[0.94, 0.03, 0.03]))
        duration_s, fingers = float(random.choice([0.06, 0.1, 0.2, 0.02])), float(random.choice([12.0, 11.0, 20.0], p=[0.7, 0.25, 0.05]))
        pause_s, age_s = float(random.uniform(0, 0.12)), float(random.choice([0.0, 0.5], p=[0.97, 0.03]))
        yield arm, int(aims[min(arm, 1)]), share, duration_s, fingers, pause_s, age_s


def test_long_adversarial_walks_meet_every_limit_and_pass_none(armed):
    random, refused = np.random.default_rng(5), set()
    for _ in range(12):
        refused |= play(armed(), walk(random))
    assert refused >= {
        Reason.NOT_FINITE,
        Reason.STALE,
        Reason.GRIPPER,
        Reason.STEP,
        Reason.SPEED,
        Reason.TABLE,
        Reason.OTHER_ARM,
        Reason.SHAPE,
    }
