"""What a board says that it puts out is compared with what it was sent: no board passes that ignores moves or answers anything."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.control.trajectory_player import stream
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.connection import State
from marl_handover.hardware.emulator.board import EmulatedBoard
from marl_handover.hardware.emulator.device import EmulatedDevice, make_fault
from marl_handover.hardware.emulator.protocol_ssc32emu import mount
from marl_handover.hardware.errors import BadReply, DeviceError, PulseMismatch, Stopped
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.expected_pulses import FRAME_S, ExpectedPulses
from marl_handover.hardware.settings import BoardConfig, TimeoutConfig
from marl_handover.hardware.ssc32 import Ssc32
from marl_handover.motion.trajectory import Phase


def connected(board=None, **keywords):
    clock = VirtualClock()
    device = EmulatedDevice(board or EmulatedBoard())
    made = Ssc32("main", BoardConfig(mount("alone", device, clock)), TimeoutConfig(), clock, **keywords)
    made.connect()
    return made, device, clock


PULSES = st.integers(500, 2500)
DEEDS = st.lists(
    st.one_of(
        st.tuples(st.just("move"), PULSES, PULSES, st.integers(1, 400)),
        st.tuples(st.just("stop")),
        st.tuples(st.just("torque_off")),
        st.tuples(st.just("wait"), st.floats(0.0, 0.3)),
    ),
    min_size=1,
    max_size=12,
)


@given(DEEDS, st.integers(50, 8000))
def test_a_board_that_does_as_it_is_told_is_never_accused(deeds, speed):
    """Not even of a microsecond, whatever comes upon what; a frame later, if a move was cut off in its first frame."""
    board, _, clock = connected()
    for deed, *rest in deeds:
        if deed == "move" and board.referenced([0, 1]):
            first, second, time_ms = rest
            board.move({0: first, 1: second}, time_ms, {0: speed, 1: speed})
        elif deed == "move":
            board.first_move({0: rest[0], 1: rest[1]}, rest[2])
            clock.sleep_s(0.05)
        elif deed == "wait":
            clock.sleep_s(rest[0])
        else:
            getattr(board, deed)([0, 1])
        if not board.referenced([0, 1]):
            continue
        try:
            board.require_pulses([0, 1], 0.0)
        except PulseMismatch:
            clock.sleep_s(FRAME_S)
            board.require_pulses([0, 1], 0.0)


@given(PULSES, PULSES, st.integers(20, 400))
def test_a_move_that_is_over_leaves_no_room(before, after, time_ms):
    expected = ExpectedPulses()
    expected.move({0: before}, 0.0, {}, 0.0, 0.0)
    expected.move({0: after}, time_ms / 1000, {}, 1.0, 1.01)
    assert expected.span(0, 1.0, 1.0).lower <= before <= expected.span(0, 1.0, 1.0).upper
    over_s = 1.01 + time_ms / 1000 + 0.051
    assert expected.span(0, over_s, over_s) == (after, after)
    assert expected.span(1, over_s, over_s) is None


def swing(driver, radius_rad=0.2):
    way = driver.parked_rad + np.outer(radius_rad * (1 - np.cos(np.linspace(0, 2 * np.pi, 41))) / 2, [1, 0, 0, 0, 0])
    phase = Phase("transfer", np.linspace(0, 0.8, 41), way, np.full(41, 12.0))
    stream(driver, {0: [phase], 1: [phase]})


def turned(driver, degrees):
    return driver.parked_rad + np.array([math.radians(degrees), 0, 0, 0, 0])


DEEDS_OF_ARMS = {
    "stream": swing,
    "drive": lambda driver: driver.drive(0, turned(driver, 10.0), 12.0, 60.0),
    "park": lambda driver: driver.park(),
}


def told_to_stop(rig, since_s):
    for device in rig.cell.devices.values():
        device.advance(rig.clock.now_s())
    heard = {name: b"".join(line for t_s, line in device.lines if t_s >= since_s) for name, device in rig.cell.devices.items()}
    return all(heard[name].count(b"STOP") >= sum(w.board == name for w in rig.config.arms.values()) * 6 for name in heard)


@pytest.mark.parametrize("kind", ["ignore", "random", "frozen"])
@pytest.mark.parametrize("deed", DEEDS_OF_ARMS)
def test_a_board_that_disobeys_is_a_named_stop(armed, wired, kind, deed):
    rig = armed(wired)
    rig.driver.drive(0, turned(rig.driver, 20.0) if deed == "park" else rig.driver.parked_rad, 12.0, 60.0)
    began_s = rig.clock.now_s()
    rig.device.add_faults([make_fault(kind, began_s)])
    with pytest.raises(PulseMismatch, match=r"board (main|west), channel \d+ puts out") as caught:
        DEEDS_OF_ARMS[deed](rig.driver)
    assert rig.driver.state is State.STOPPED
    assert caught.value.board == next(iter(rig.cell.devices))
    assert rig.clock.now_s() - began_s < 1.0
    rig.clock.sleep_s(0.05)
    assert told_to_stop(rig, began_s)
    with pytest.raises(Stopped):
        rig.driver.park()


@pytest.mark.parametrize("kind", ["ignore", "random", "frozen"])
def test_held_arms_are_not_driven_to_the_parked_pose_by_a_board_that_disobeys(armed, kind):
    rig = armed()
    rig.driver.drive(0, turned(rig.driver, 40.0), 12.0, 60.0)
    rig.driver.disconnect()
    driver = type(rig.driver)(rig.config, rig.driver.model, clock=rig.clock, latch=rig.latch, confirm=lambda text: True)
    driver.connect()
    driver.configure()
    rig.device.add_faults([make_fault(kind, rig.clock.now_s())])
    with pytest.raises((PulseMismatch, BadReply)) as caught:
        driver.arm()
    assert kind == "random" or caught.type is PulseMismatch
    assert driver.state is not State.ARMED
    driver.close()


@pytest.mark.parametrize("faults", ["random@1.0", "frozen@1.0", "ignore@1.0"])
def test_the_first_move_is_looked_after(rig, faults):
    made = rig(faults=faults)
    made.driver.connect()
    made.driver.configure()
    with pytest.raises(DeviceError):
        made.driver.arm()
    assert made.driver.state is not State.ARMED


@pytest.mark.parametrize("seed", range(5))
def test_one_quick_move_in_ten_that_is_lost_is_noticed(armed, seed):
    """Of a slow one no more shows than of a board that is a frame late."""
    rig = armed()
    rig.device.board._random.seed(seed)
    rig.device.add_faults([make_fault("ignore", rig.clock.now_s(), amount=0.1)])

    def swings():
        for _ in range(10):
            swing(rig.driver, 0.7)

    with pytest.raises(PulseMismatch):
        swings()


def test_the_very_last_move_is_looked_at_too(armed):
    """Nothing is sent after it, so nothing would ask any more."""
    rig = armed()
    rig.clock.at(rig.clock.now_s() + 0.775, lambda: rig.device.add_faults([make_fault("ignore", rig.clock.now_s())]))
    way = rig.driver.parked_rad + np.outer(np.linspace(0.0, 1.2, 41), [1, 0, 0, 0, 0])
    with pytest.raises(PulseMismatch):
        stream(rig.driver, {0: [Phase("transfer", np.linspace(0, 0.84, 41), way, np.full(41, 12.0))]})


def test_arms_are_stopped_before_they_are_far_from_where_they_were_sent(armed):
    """Two commands at most: one that is not carried out, and the next that is not sent."""
    rig = armed()
    rig.driver.wait(0.5)
    rig.device.add_faults([make_fault("ignore", rig.clock.now_s())])
    before = sum(entry.data.startswith(b"#") for entry in rig.driver.boards.by_name["main"].log)
    with pytest.raises(PulseMismatch):
        rig.driver.drive(0, turned(rig.driver, 60.0), 12.0, 60.0)
    assert sum(entry.data.startswith(b"#") for entry in rig.driver.boards.by_name["main"].log) - before <= 2


def test_a_board_that_is_late_for_once_is_waited_for(armed):
    """As behind a pseudo-terminal on a busy computer; the arms hold meanwhile, and nobody is stopped for it."""
    rig = armed()
    hear, late = rig.device._hear, []

    def late_once(t_s, piece):
        if piece.startswith(b"#") and not late:
            late.append(piece)
            rig.clock.at(rig.clock.now_s() + 0.1, lambda: hear(rig.clock.now_s(), piece))
        else:
            hear(t_s, piece)

    rig.device._hear = late_once
    swing(rig.driver)
    assert late
    assert rig.driver.state is State.ARMED


class Answers(EmulatedBoard):
    """A board whose ``QP`` says what it is told to, over and over."""

    says = b"\x96"

    def _answer(self, text, frame):
        return [self.says] if text.startswith("QP") else super()._answer(text, frame)


@pytest.mark.parametrize(
    ("says", "error"),
    [
        (b"\xc8", PulseMismatch),  # a steady untruth
        (b"Q", PulseMismatch),  # an echo: Q is 810 us
        (b"\x01", BadReply),  # no pulse at all
        (b"", BadReply),
        (b"\x96", None),
    ],
)
def test_answers_that_cannot_be(says, error):
    board, _, clock = connected(Answers())
    board.first_move({0: 1500}, None)
    clock.sleep_s(0.1)
    board._clock, Answers.says = clock, says
    if error is None:
        board.require_pulses([0])
    else:
        with pytest.raises(error):
            board.require_pulses([0])


def test_a_stop_is_not_kept_waiting_by_an_answer_that_is_late(armed):
    """A board that takes its time, or never answers, must not take the stop's."""
    for fault in ("late", "drop", "corrupt"):
        rig = armed()
        latched_s = rig.clock.now_s() + 0.5
        rig.device.add_faults([make_fault(fault, latched_s - 0.07, amount=1.0)])
        rig.clock.at(latched_s, lambda rig=rig: StopLatch(rig.latch.path).latch("now"))
        with pytest.raises(Stopped):
            swing(rig.driver)
        rig.clock.sleep_s(0.2)
        rig.device.advance(rig.clock.now_s())
        heard = [t_s for t_s, line in rig.device.lines if b"STOP" in line and t_s > latched_s]
        assert len(heard) == 12
        assert max(heard) - latched_s <= 0.04
        rig.driver.close()
        rig.latch.clear()
