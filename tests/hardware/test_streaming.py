"""Planned motions on the wire, and a stop at any moment of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.control.trajectory_player import stream
from marl_handover.errors import InvalidSetting
from marl_handover.hardware.connection import State
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.errors import BoardReset, PortLost, Stalled
from marl_handover.hardware.safety_filter import CommandRejected
from marl_handover.motion.trajectory import Phase


def exact(config):
    """Servos as they should be, so that what is measured is the stream."""
    emulator = config.emulator
    emulator.scale_sd = emulator.offset_sd_us = emulator.settle_sd_us = 0.0
    emulator.dead_band_us, emulator.dead_band_sd_us, emulator.lag_s = 1.0, 0.0, 0.005
    return config


def test_a_planned_motion_is_followed(armed, wired, motion):
    rig = armed(exact(wired))
    off_deg = []

    def look(t_s):
        off_deg.append(np.degrees(np.abs(rig.cell.joints_rad(rig.clock.now_s()) - rig.driver.joints_rad())).max())

    began_s = rig.clock.now_s()
    report = stream(rig.driver, {0: motion.phases}, on_tick=look)
    period_s = wired.stream.period_s
    assert report.finished
    assert report.moves == math.ceil(motion.duration_s / period_s)
    taken_s = rig.clock.now_s() - began_s
    assert motion.duration_s <= taken_s <= motion.duration_s + 2 * period_s + wired.stream.settle_s
    # One period, two frames and a little of the fastest joint.
    assert max(off_deg) < math.degrees(5.8 * 0.8) * (period_s + 0.045)
    end = rig.cell.joints_rad(rig.clock.now_s())
    np.testing.assert_allclose(end[0], motion.phases[-1].joints_rad[-1], atol=math.radians(0.2))
    np.testing.assert_allclose(end[1], rig.driver.parked_rad, atol=math.radians(0.2))


def test_the_fingers_close_on_the_pin_and_no_further(armed, one_board, motion):
    rig = armed(exact(one_board))
    seen = []
    stream(rig.driver, {0: motion.phases}, on_tick=lambda t_s: seen.append((t_s, rig.cell.gripper_mm(rig.clock.now_s())[0])))
    pin, preload = rig.driver.model.cell.config.block.pin_diameter_mm, one_board.arms["left"].gripper.preload_mm
    assert min(opening for _, opening in seen) == pytest.approx(pin / 2 - preload, abs=0.05)
    assert seen[-1][1] == pytest.approx(12.0, abs=0.1)
    carried = next(phase for phase in motion.phases if phase.name == "transfer")
    assert all(opening < pin / 2 for t_s, opening in seen if carried.t_s[0] + 0.1 < t_s < carried.t_s[-1])


def test_both_arms_play_on_one_time_axis(armed, wired):
    rig = armed(exact(wired))
    swing = rig.driver.parked_rad + np.outer(0.3 * (1 - np.cos(np.linspace(0, np.pi, 41))) / 2, [1, 0, 0, 0, 0])
    phases = [Phase("transfer", np.linspace(0, 0.8, 41), swing, np.full(41, 12.0))]
    report = stream(rig.driver, {0: phases, 1: phases})
    assert report.finished
    np.testing.assert_allclose(rig.cell.joints_rad(rig.clock.now_s())[:, 0], [0.3, 0.3], atol=math.radians(0.2))


def test_a_motion_begins_where_the_arm_is(armed, motion):
    rig = armed()
    rig.driver.drive(0, rig.driver.parked_rad + np.array([0.2, 0, 0, 0, 0]), 12.0, 60.0)
    with pytest.raises(InvalidSetting, match="11.5 degrees"):
        stream(rig.driver, {0: motion.phases})
    assert stream(rig.driver, {}).moves == 0


def test_a_motion_can_be_called_off(armed, motion):
    rig = armed()
    began_s = rig.clock.now_s()
    report = stream(rig.driver, {0: motion.phases}, called_off=lambda: rig.clock.now_s() - began_s > 0.5)
    assert not report.finished
    held = rig.device.outputs_us(rig.clock.now_s())
    rig.clock.sleep_s(1.0)
    assert rig.device.outputs_us(rig.clock.now_s()) == held
    assert rig.driver.state is State.ARMED
    rig.driver.park()


def test_a_host_that_falls_behind_gives_up(armed, motion):
    rig = armed()

    def hang(t_s):
        if t_s > 0.5:
            rig.clock.sleep_s(rig.config.stream.late_s + 0.2)

    with pytest.raises(Stalled) as caught:
        stream(rig.driver, {0: motion.phases}, on_tick=hang)
    assert caught.value.late_s > rig.config.stream.late_s
    held = rig.device.outputs_us(rig.clock.now_s())
    rig.clock.sleep_s(1.0)
    assert rig.device.outputs_us(rig.clock.now_s()) == held, "no more than a period was ever on the board"


@pytest.mark.parametrize("late_s", [0.0, 0.03, 0.1, 0.2])
@pytest.mark.parametrize("where", ["on_tick", "asking"])
def test_a_late_host_does_not_hurry_the_arms(armed, late_s, where):
    rig = armed()
    swing = rig.driver.parked_rad + np.outer(1.2 * (1 - np.cos(np.linspace(0, np.pi, 51))) / 2, [1, 0, 0, 0, 0])
    phases = [Phase("transfer", np.linspace(0, 1.0, 51), swing, np.full(51, 12.0))]
    planned_deg_s = math.degrees(np.abs(np.diff(swing[:, 0])).max() / 0.02)
    pulses, hangs, ask = [], [late_s], rig.driver.boards.require_pulses

    def look():
        pulses.append(rig.device.outputs_us(rig.clock.now_s())[0])
        rig.clock.at(rig.clock.now_s() + 0.02, look)

    def hang(_):
        if len(pulses) > 23 and hangs:
            rig.clock.sleep_s(hangs.pop())

    def slow():
        hang(0)
        ask()

    rig.clock.at(rig.clock.now_s() + 0.001, look)
    rig.driver.boards.require_pulses = slow if where == "asking" else ask
    began_s = rig.clock.now_s()
    report = stream(rig.driver, {0: phases}, on_tick=hang if where == "on_tick" else None)
    assert report.finished
    assert not hangs
    assert np.abs(np.diff(pulses)).max() / 9.5 / 0.02 < 1.2 * planned_deg_s
    assert rig.clock.now_s() - began_s < 1.0 + late_s + 0.15 + rig.config.stream.settle_s
    assert pulses[-1] == pytest.approx(1500 + 9.5 * math.degrees(1.2), abs=1.0)


def test_a_plan_that_must_not_be_is_refused_on_the_way(armed, motion):
    rig = armed()
    phase = motion.phases[0]
    wrong = phase.joints_rad.copy()
    wrong[len(wrong) // 2 :, 1] -= 0.7
    with pytest.raises(CommandRejected):
        stream(rig.driver, {0: [Phase("approach", phase.t_s, wrong, phase.gripper_mm)]})
    assert rig.driver.state is State.ARMED


@pytest.mark.parametrize(("fault", "error"), [("brownout", BoardReset), ("unplug", PortLost)])
def test_faults_in_mid_motion_end_it_with_their_name(armed, motion, fault, error):
    rig = armed()
    rig.device.add_faults([make_fault(fault, rig.clock.now_s() + 1.0)])
    with pytest.raises(error):
        stream(rig.driver, {0: motion.phases})
    moves = [t_s for t_s, line in rig.device.lines if line.startswith(b"#")]
    assert max(moves) < rig.clock.now_s()
    if fault == "brownout":
        assert not any(rig.device.outputs_us(rig.clock.now_s() + 1.0)), "nothing jumped"


def test_few_bytes_are_ever_on_the_way(armed, wired, motion):
    rig = armed(wired)
    most = 0.0
    write = {}
    for name, board in rig.driver.boards.by_name.items():
        inner = board.wire.write

        def noted(data, inner=inner, board=board):
            nonlocal most
            most = max(most, board.wire.backlog_s() if data.startswith(b"#") else 0.0)
            return inner(data)

        write[name], board.wire.write = inner, noted
    stream(rig.driver, {0: motion.phases})
    assert most <= wired.stream.backlog_s + 1e-9
