"""The latched stop at any moment: what the boards hear, what they put out 40 ms later, and that no move follows."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from marl_handover.control.trajectory_player import stream
from marl_handover.hardware.connection import State
from marl_handover.hardware.errors import Stopped
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.safety_filter import JointCommand
from marl_handover.hardware.settings import ARMS
from marl_handover.motion.trajectory import Phase

WITHIN_S = 0.04
FRAME_S = 0.02
STOP = re.compile(rb"\x1b?STOP(\d+)\r")


class Witness:
    """Latches the stop at a time, as another process would, and sees what every board puts out around it, at that time and not later."""

    def __init__(self, rig, latched_s):
        self.rig, self.latched_s = rig, latched_s
        self.before, self.held = {}, []
        rig.clock.at(latched_s - FRAME_S, lambda: self.before.update(self._outputs()))
        rig.clock.at(latched_s, self._latch)
        for frame in range(50):
            rig.clock.at(latched_s + WITHIN_S + frame * FRAME_S, lambda: self.held.append(self._outputs()))

    def _outputs(self):
        return {name: device.outputs_us(self.rig.clock.now_s()) for name, device in self.rig.cell.devices.items()}

    def _latch(self):
        self.moving = self._outputs() != self.before
        StopLatch(self.rig.latch.path).latch("another process")

    def judge(self):
        """Assert that the bar was kept; how long after the latch the last channel's stop was there."""
        self.rig.clock.until(self.latched_s + 1.1)
        wired = {(self.rig.config.arms[arm].board, channel) for arm in ARMS for channel in self.rig.config.channels(arm)}
        heard = {}
        for name, device in self.rig.cell.devices.items():
            for t_s, line in device.lines:
                if t_s > self.latched_s and (match := STOP.fullmatch(line)):
                    heard.setdefault((name, int(match[1])), t_s)
        assert set(heard) == wired, "every channel was told to stop, in a line of its own"
        latest_s = max(heard.values()) - self.latched_s
        assert latest_s <= WITHIN_S
        assert len(self.held) == 50
        assert all(outputs == self.held[0] for outputs in self.held), "no channel moves 40 ms after the latch"
        written = [entry for board in self.rig.driver.boards.by_name.values() for entry in board.log if entry.direction == ">"]
        assert not [entry for entry in written if entry.t_s >= self.latched_s and b"#" in entry.data], "no byte of a move follows"
        assert self.rig.driver.state is State.STOPPED
        return latest_s


def moments(random, config, count, span_s):
    """Times within a session: half of them anywhere, half of them while a group move is being asked about and written."""
    for number in range(count):
        if number % 2:
            yield float(random.uniform(0.001, span_s))
        else:
            yield config.stream.period_s * int(random.integers(span_s / config.stream.period_s)) + float(random.uniform(1e-5, 0.004))


def work(driver, motion):
    """A transfer of one arm, then both together, then the way home."""
    stream(driver, {0: motion.phases})
    swing = driver.parked_rad + np.outer(0.3 * (1 - np.cos(np.linspace(0, np.pi, 41))) / 2, [1, 0, 0, 0, 0])
    phase = Phase("transfer", np.linspace(0, 0.8, 41), swing, np.full(41, 12.0))
    stream(driver, {0: [phase], 1: [phase]})
    driver.park()


def check_stops(armed, config, motion, count, seed, deed=work):
    """Stop ``count`` fresh sessions at their ``deed``."""
    random, moving, latest_s = np.random.default_rng(seed), 0, 0.0
    for after_s in moments(random, config, count, motion.duration_s + 2.5):
        rig = armed(config)
        witness = Witness(rig, rig.clock.now_s() + after_s)
        with pytest.raises(Stopped, match="another process"):
            deed(rig.driver, motion)
        latest_s = max(latest_s, witness.judge())
        assert rig.latch.obeyed_by() is not None
        moving += witness.moving
        rig.driver.close()
        rig.latch.clear()
    assert moving > count / 3, "many of these stops met moving arms"
    assert latest_s < 0.03, "a quarter of it is left for a computer that is late"


def test_a_stop_at_any_moment(armed, wired, motion):
    check_stops(armed, wired, motion, 24, 0)


@pytest.mark.slow
def test_five_hundred_stops(armed, wired, motion):
    check_stops(armed, wired, motion, 500, 1)


def hurry(driver):
    """Two seconds' worth of moves, given as fast as they are taken."""
    for number in range(200):
        turned = driver.parked_rad + np.array([math.radians(2.0 + number % 2), 0, 0, 0, 0])
        driver.move([JointCommand(arm, turned, 12.0) for arm in range(2)], 0.1)


@pytest.mark.parametrize("check_reset", [True, False])
def test_moves_given_back_to_back_leave_room_for_a_stop(armed, wired, check_reset):
    """Somebody who never waits: the line is kept short, so that a stop is not behind a queue of moves."""
    wired.stream.check_reset = check_reset
    random = np.random.default_rng(2)
    for _ in range(10):
        rig = armed(wired)
        driver, witness = rig.driver, Witness(rig, rig.clock.now_s() + float(random.uniform(0.03, 0.3)))
        with pytest.raises(Stopped):
            hurry(driver)
        witness.judge()
        driver.close()
        rig.latch.clear()


def test_a_stop_while_the_first_move_settles(rig):
    made = rig()
    made.driver.connect()
    made.driver.configure()
    made.clock.at(made.clock.now_s() + 0.05, lambda: StopLatch(made.latch.path).latch("now"))
    with pytest.raises(Stopped):
        made.driver.arm()
    assert made.driver.state is not State.ARMED


def test_nothing_starts_while_a_stop_is_latched(rig):
    made = rig()
    made.latch.latch("yesterday")
    made.driver.connect()
    made.driver.configure()
    with pytest.raises(Stopped, match="yesterday"):
        made.driver.arm()
    assert not any(made.device.outputs_us(made.clock.now_s() + 1.0))


def both(driver, _):
    """Both arms all the time, on one time axis."""
    swing = driver.parked_rad + np.outer(0.3 * (1 - np.cos(np.linspace(0, 2 * np.pi, 61))) / 2, [1, 0, 0, 0, 0])
    phase = Phase("transfer", np.linspace(0, 1.2, 61), swing, np.full(61, 12.0))
    for _ in range(9):
        stream(driver, {0: [phase], 1: [phase]})


def test_a_stop_with_both_arms_moving(armed, wired, motion):
    check_stops(armed, wired, motion, 12, 3, both)


@pytest.mark.slow
def test_two_hundred_stops_with_both_arms_moving(armed, wired, motion):
    check_stops(armed, wired, motion, 200, 4, both)


def test_real_and_simulated_arms_stop_without_each_other(armed, tmp_path, monkeypatch):
    """A simulation beside a session of real arms: neither obeys the other's stop."""
    from marl_handover.hardware import estop
    from marl_handover.hardware.estop import PrivateStop

    monkeypatch.setattr(estop, "user_path", lambda suffix: tmp_path / f"user{suffix}")
    real = armed()
    simulated = armed()  # its boards take the place of the first ones' names; ports that are open stay
    simulated.driver.latch.leave()
    simulated.driver.latch = PrivateStop()
    real.clock.at(real.clock.now_s() + 0.3, lambda: StopLatch(real.latch.path).latch("real arms"))
    with pytest.raises(Stopped, match="real arms"):
        both(real.driver, None)
    both(simulated.driver, None)
    assert simulated.driver.state is State.ARMED
    real.latch.clear()
    real.driver.resume()
    simulated.clock.at(simulated.clock.now_s() + 0.3, lambda: simulated.driver.latch.latch("simulated arms"))
    with pytest.raises(Stopped, match="simulated arms"):
        both(simulated.driver, None)
    assert not real.latch.is_set()
    real.driver.park()
    assert real.driver.state is State.ARMED
    simulated.driver.close()
    assert [path.name for path in tmp_path.glob("user*.stop")] == []
