"""Planned motions on the wire, and a stop at any moment of them."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from marl_handover.errors import InvalidSetting
from marl_handover.hardware.emulator.faults import make_fault
from marl_handover.hardware.errors import BoardReset, PortLost, Stalled, Stopped
from marl_handover.hardware.gate import GateRejection
from marl_handover.hardware.latch import StopLatch
from marl_handover.hardware.session import State
from marl_handover.hardware.streaming import stream
from marl_handover.motion.trajectory import Phase


def exact(config):
    """Servos as they should be, so that what is measured is the stream."""
    emulator = config.emulator
    emulator.scale_sd = emulator.offset_sd_us = emulator.settle_sd_us = 0.0
    emulator.dead_band_us, emulator.lag_s = 1.0, 0.005
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


def test_a_plan_that_must_not_be_is_refused_on_the_way(armed, motion):
    rig = armed()
    phase = motion.phases[0]
    wrong = phase.joints_rad.copy()
    wrong[len(wrong) // 2 :, 1] -= 0.7
    with pytest.raises(GateRejection):
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


MOVE = re.compile(rb"^#")


def stopped_at(rig, motion, after_s):
    """Latch the stop ``after_s`` into a motion, as another process would; what was found."""
    latched_s = rig.clock.now_s() + after_s
    rig.clock.at(latched_s, lambda: StopLatch(rig.latch.path).latch("another process"))
    with pytest.raises(Stopped, match="another process"):
        stream(rig.driver, {0: motion.phases})
    rig.clock.until(latched_s + 0.04)
    outputs = {name: device.outputs_us(rig.clock.now_s()) for name, device in rig.cell.devices.items()}
    rig.clock.sleep_s(1.0)
    later = {name: device.outputs_us(rig.clock.now_s()) for name, device in rig.cell.devices.items()}
    logs = [entry for board in rig.driver.boards.by_name.values() for entry in board.log if entry.direction == ">"]
    lines = [line for device in rig.cell.devices.values() for t_s, line in device.lines if t_s > latched_s]
    return SimpleNamespace(
        held=outputs == later,
        moves_after=[entry for entry in logs if entry.t_s > latched_s and MOVE.match(entry.data)],
        stops=sorted(line for line in lines if line.startswith(b"STOP")),
    )


def check_stops(armed, config, motion, count, seed):
    random = np.random.default_rng(seed)
    for _ in range(count):
        rig = armed(config)
        rig.latch.clear()
        found = stopped_at(rig, motion, float(random.uniform(0.0, motion.duration_s)))
        assert found.held, "every channel had stopped after 40 ms"
        assert not found.moves_after
        assert len(found.stops) == 12
        assert rig.driver.state is State.STOPPED
        assert rig.latch.obeyed_by() is not None
        rig.driver.close()
        rig.latch.clear()


def test_a_stop_at_any_moment(armed, wired, motion):
    check_stops(armed, wired, motion, 20, 0)


@pytest.mark.slow
def test_five_hundred_stops(armed, one_board, motion):
    check_stops(armed, one_board, motion, 500, 1)


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
