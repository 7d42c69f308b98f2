"""Random and adversarial commands through driver and gate to the board: what it puts out stays within every limit.

Sequences begin anywhere both arms may stand, and head for places beyond a limit, fast enough to get there, slowly enough not to be refused
for that. What is allowed is worked out here from settings and URDF, and what is clear by the cell's own slow geometry, not by the gate's.
"""

from __future__ import annotations

import math
import re
from collections import Counter

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from marl_handover.geometry.capsules import capsule_pairs, ground_clearance_mm, segment_distance, self_clearance_mm
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.emulator.board import FRAME_S
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason
from marl_handover.hardware.settings import ARMS

EXPLAINED = re.compile(r"safety filter \((?P<reason>[a-z ]+)\): .+ is .+; allowed: .+", re.DOTALL)
BASE_YAW_US = (900, 2100)
"""Pulse limits of the left base, narrower than the joint's own."""

HALF_US = 0.5 + 1e-6
TIMES_S = (0.02, 0.04, 0.06, 0.1, 0.2)
RUBBISH = [
    lambda held: (JointCommand(2, held, 12.0), 0.06),
    lambda held: (JointCommand(True, held, 12.0), 0.06),
    lambda held: (JointCommand(0, held * math.nan, 12.0), 0.06),
    lambda held: (JointCommand(0, held, math.inf), 0.06),
    lambda held: (JointCommand(1, held[:4], 12.0), 0.06),
    lambda held: (JointCommand(0, "park", 12.0), 0.06),
    lambda held: (JointCommand(0, held, 12.0), -1.0),
    lambda held: (JointCommand(0, held, 12.0), 1e9),
    lambda held: (JointCommand(0, held, 12.0), math.nan),
    lambda held: (JointCommand(0, held, 20.0), 0.2),
    lambda held: (JointCommand(0, held, -0.5), 0.2),
    lambda held: (JointCommand(0, held * 1e300, 12.0), 0.2),
    lambda held: (JointCommand(0, held + 2.0, 12.0), 5.0),
]
PROVOKED = set(Reason) - {Reason.NO_REFERENCE, Reason.SPEED_CHANGE}
"""An armed driver always knows where its arms are; the gate's own tests provoke that one. Speeds of boards' servos may change at once."""

rubbish = st.sampled_from([None] * 50 + list(range(len(RUBBISH))))
paces = st.sampled_from([0.97, 0.97, 0.97, 0.7, 0.4, 0.15, 0.05, 1.2, 3.0])
ages_s = st.sampled_from([0.0] * 12 + [0.2, 0.4])
commands = st.tuples(st.integers(0, 2), st.booleans(), paces, st.sampled_from(TIMES_S), st.floats(0.0, 1.3), ages_s, rubbish)
aims = st.tuples(st.sampled_from([0, 1, 2, 3, 3, 4, 5]), st.integers(0, 399), st.integers(0, 399))
# The left arm alone, straight for joints beyond their limits: the pulse limits of its base come first, however the random ones fall out.
TO_THE_PULSE_LIMIT = [(start, ((1, start, start),) * 2, [(0, False, 0.97, 0.2, 1.0, 0.0, None)] * 20) for start in range(6)]
sequences = st.tuples(st.integers(0, 399), st.tuples(aims, aims), st.lists(commands, min_size=8, max_size=20))


class Places:
    """Where arms may stand together (400, 2, 5), and six kinds of places (400, 5) where they must not go, or that lead there."""

    def __init__(self, model):
        random, arm, n = np.random.default_rng(7), model.arm, 400
        low, high = arm.lower_rad, arm.upper_rad
        Q = random.uniform(low, high, (30_000, 5))
        height, itself = ground_clearance_mm(arm, Q), self_clearance_mm(arm, Q)
        # Taken over from a reading of 10 us, an arm may be half of that further on.
        inside = (np.abs(Q - (low + high) / 2) < (high - low) / 2 - 0.02).all(axis=1)
        clear = Q[(height > 3.0) & (itself > 3.0) & inside]
        self.distance = Distance(model)
        pairs = np.stack([clear[: len(clear) // 2], clear[len(clear) // 2 : 2 * (len(clear) // 2)]], axis=1)
        pairs[:, :, 0] = np.clip(pairs[:, :, 0], -1.0, 1.0)  # within the pulse limits of the left base
        gaps = self.distance(pairs[:, 0], pairs[:, 1])
        near = pairs[(gaps > 8.0) & (gaps < 60.0)]
        self.starts = np.concatenate([pairs[gaps > 8.0][: n // 2], np.resize(near, (n // 2, 2, 5))])
        across = np.array([[random.uniform(150.0, 215.0), random.uniform(-60.0, 60.0), random.uniform(40.0, 120.0)] for _ in range(n)])
        self.aims = [
            random.uniform(low - 0.5, high + 0.5, (n, 5)),
            np.where(random.random((n, 5)) < 0.5, low - 0.3, high + 0.3),
            Q[height < -5.0][:n],
            np.nan_to_num(arm.ik(across)[:, 0]),
            np.resize(Q[(itself < -2.0) & (height > 5.0)], (n, 5)),
            clear[-n:],
        ]
        self.aims[1][:, 1:4] = clear[:n, 1:4]
        assert len(self.starts) == n
        assert all(aim.shape == (n, 5) for aim in self.aims)


class Distance:
    """Smallest distance (n,) of the two arms, for the left's joints (n, 5) and the right's, the slow way."""

    def __init__(self, model):
        self.arm, self.capsules = model.arm, capsule_pairs(model.arm.description)[0]
        self.bases = [transform((base.x_mm, base.y_mm, 0.0), (0.0, 0.0, base.facing_rad)) for base in model.cell.bases]
        self.radii = np.array([capsule.radius_mm for capsule in self.capsules])

    def __call__(self, left, right):
        (a, b), (c, d) = self._ends(left, 0), self._ends(right, 1)
        gaps = segment_distance(a[:, None], b[:, None], c[None], d[None])
        return (gaps - (self.radii[:, None] + self.radii[None])[:, :, None]).min(axis=(0, 1))

    def _ends(self, q, arm):
        frames = self.arm.link_transforms(q)
        return tuple(
            np.stack([(self.bases[arm] @ frames[c.link])[:, :3] @ np.append(getattr(c, end), 1.0) for c in self.capsules])
            for end in ("start_mm", "end_mm")
        )


class Watch:
    """Notes what the board puts out in every frame, and judges it in the end."""

    def __init__(self, rig, places):
        self.rig, self.places, self.rows = rig, places, []
        config, arm = rig.config, rig.driver.model.arm
        self.channels = [channel for name in ARMS for channel in config.channels(name)]
        servos = [config.nominal[joint] for joint in ARM_JOINTS]
        self.zero = np.array([servo.zero_us for servo in servos])
        self.slope = np.degrees(np.array([servo.us_per_deg for servo in servos]))
        joints = np.array([arm.description.joint(name).velocity for name in ARM_JOINTS]) * np.abs(self.slope)
        gripper = config.arms["left"].gripper
        fingers = config.gate.finger_mm_s * abs(gripper.open_us - gripper.closed_us) / gripper.open_mm
        self.speeds_us_s = np.tile(np.append(joints, fingers), 2)

    def look(self, until_s):
        """Let time pass, frame by frame."""
        clock, device = self.rig.clock, self.rig.device
        while clock.now_s() < until_s:
            pulses = device.outputs_us(clock.now_s())
            self.rows.append((device.board.frame(clock.now_s()), *(pulses[channel] for channel in self.channels)))
            clock.sleep_s(FRAME_S)

    def judge(self):
        """Assert every limit; how near the outputs came to the table and to the other arm, in mm."""
        rows, arm, limits = np.array(self.rows), self.rig.driver.model.arm, self.rig.config.gate
        pulses = rows[:, 1:].reshape(-1, 2, 6)
        assert pulses.min() >= 500.0
        assert pulses.max() <= 2500.0
        assert BASE_YAW_US[0] <= pulses[:, 0, 0].min()
        assert pulses[:, 0, 0].max() <= BASE_YAW_US[1]
        spent_s = FRAME_S * np.diff(rows[:, 0])[:, None]
        assert (np.abs(np.diff(rows[:, 1:], axis=0)) <= self.speeds_us_s * spent_s + 1e-6).all(), "no channel is ever faster"
        joints = (pulses[:, :, :5] - self.zero) / self.slope
        slack = HALF_US / np.abs(self.slope)
        assert (joints >= arm.lower_rad - slack).all()
        assert (joints <= arm.upper_rad + slack).all()
        height, itself = ground_clearance_mm(arm, joints).min(), self_clearance_mm(arm, joints).min()
        gap = self.places.distance(joints[:, 0], joints[:, 1]).min()
        assert height > 0.0
        assert itself > -1.0, "half a microsecond of every joint beyond what the gate lets through, no more"
        assert gap > limits.arm_clearance_mm - 2.0
        return float(height), float(gap)


class Playground:
    """One cell for all sequences: its board is switched off and on, its arms are put somewhere, and a session takes them from there."""

    def __init__(self, make):
        self.rig = make(cut(make))
        self.places = Places(self.rig.driver.model)
        self.met, self.sent, self.nearest = Counter(), 0, np.full(2, np.inf)
        for device in self.rig.cell.devices.values():
            device.servos.clear()  # only pulses are judged, so nobody has to follow them

    def play(self, sequence):
        """Send a sequence of commands, good and bad, and judge everything that the board put out."""
        start, aims, commands = sequence
        driver, clock = self.rig.driver, self.rig.clock
        self._stand(self.places.starts[start])
        watch = Watch(self.rig, self.places)
        for command in commands:
            until_s = clock.now_s() + self._give(command, aims)
            watch.look(until_s)
        watch.look(clock.now_s() + 0.3)
        self.nearest = np.minimum(self.nearest, watch.judge())
        driver.close()

    def _stand(self, joints):
        """Both arms held at joints (2, 5) by a board that was switched on a moment ago."""
        driver, device, clock = self.rig.driver, self.rig.device, self.rig.clock
        device.board.power_up(clock.now_s())
        driver.connect()
        driver.configure()
        pulses = driver.wiring.pulses([JointCommand(arm, joints[arm], 12.0) for arm in range(2)])["main"]
        device.write("".join(f"#{channel}P{pulse}" for channel, pulse in pulses.items()).encode() + b"\r", clock.now_s())
        clock.sleep_s(2 * FRAME_S)
        driver.resync()

    def _give(self, command, aims):
        """Give one command to the driver; how long to wait before the next."""
        driver, clock = self.rig.driver, self.rig.clock
        who, second, pace, duration_s, wait, age_s, rubbish = command
        if rubbish is not None:
            made, duration_s = RUBBISH[rubbish](driver.joints_rad()[0])
            given, pause_s = [made], 0.0
        else:
            kind, *numbers = aims[second]
            places = [self.places.aims[kind][number] for number in numbers]
            given = [self._towards(arm, places[arm], pace, duration_s) for arm in ([who] if who < 2 else [0, 1])]
            pause_s = wait * duration_s
        before = len(driver.boards.by_name["main"].log)
        try:
            driver.move(given, duration_s, clock.now_s() - age_s)
            self.sent += 1
        except CommandRejected as rejection:
            log = driver.boards.by_name["main"].log[before:]
            self._refused(rejection, [entry.data for entry in log if entry.direction == ">"])
        return pause_s

    def _refused(self, rejection, written):
        """A refusal says why, what it found and what is allowed, and nothing of the command was sent."""
        explained = EXPLAINED.fullmatch(str(rejection))
        assert explained, str(rejection)
        assert explained["reason"] == rejection.reason
        assert not any(b"#" in data for data in written)
        self.met[rejection.reason] += 1

    def _towards(self, arm, aim, pace, duration_s):
        """As far towards ``aim`` as ``pace`` times speed and step limits let an arm go in ``duration_s``, fingers going with it."""
        model, gate = self.rig.driver.model.arm, self.rig.config.gate
        held = self.rig.driver.joints_rad()[arm]
        speeds = np.array([model.description.joint(name).velocity for name in ARM_JOINTS])
        most = np.minimum(speeds * duration_s, math.radians(gate.step_deg)) * pace
        fingers = 12.0 - min(9.0, gate.finger_mm_s * duration_s * 0.45) * (aim[0] > 0)
        return JointCommand(arm, held + np.clip(aim - held, -most, most), fingers)

    def require_all(self):
        """Assert that this was a test: every reason was met, much was sent, and the arms got near what they must not touch."""
        assert set(self.met) >= PROVOKED, f"never met: {sorted(PROVOKED - set(self.met))}"
        assert self.sent > 0.3 * (self.sent + self.met.total())
        assert self.nearest[0] < 5.0
        assert self.nearest[1] < 12.0


def cut(make):
    config = make().config
    config.arms["left"].pulse_limits_us[0] = list(BASE_YAW_US)
    return config


def check_sequences(rig, count):
    playground = Playground(rig)
    for sequence in TO_THE_PULSE_LIMIT:
        playground.play(sequence)
    assert playground.met[Reason.PULSE_LIMIT]

    @settings(max_examples=count, phases=[Phase.generate])
    @given(sequences)
    def none_leaves_the_limits(sequence):
        playground.play(sequence)

    none_leaves_the_limits()
    playground.require_all()
    return playground


def test_no_sequence_of_commands_leaves_the_limits(rig):
    check_sequences(rig, 120)


@pytest.mark.slow
def test_no_sequence_out_of_ten_thousand_leaves_the_limits(rig):
    check_sequences(rig, 10_000)
