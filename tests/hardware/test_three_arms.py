"""Three arms on two boards: wiring by name, the bytes of each board, stops and lost ports of all, and the safety filter."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.cli import main
from marl_handover.compose import from_yaml
from marl_handover.errors import InvalidSetting
from marl_handover.files import resource_path
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.connection import State
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.emulator.device import EmulatedCell, make_fault
from marl_handover.hardware.errors import PortLost, Stopped
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason
from marl_handover.hardware.settings import ArmWiring, BoardConfig, GripperConfig, HardwareConfig, twin_of
from tests.canonical_arms import PARKED_DEG

PARKED = np.radians(PARKED_DEG)
NAMES = ("north", "west", "east")


@pytest.fixture(scope="module")
def triangle():
    return build_cell(cell_config("triangle"))


@pytest.fixture
def config() -> HardwareConfig:
    return from_yaml(HardwareConfig, resource_path("configs/hardware/triangle_twin.yaml"))


@pytest.fixture
def three(triangle, config, tmp_path):
    """Clock, emulated cell and armed driver of the triangle."""
    clock, wired, asked = VirtualClock(), config.for_arms(NAMES), []
    cell = EmulatedCell(wired, triangle.arm, PARKED)
    cell.mount(clock)
    clock.until(1.0)
    latch = StopLatch(tmp_path / "stop")
    driver = ArmDriver(config, triangle, clock=clock, latch=latch, confirm=lambda text: asked.append(text) or True)
    driver.connect()
    driver.configure()
    driver.arm()
    assert "Are all 3 arms standing" in asked[0]
    yield clock, cell, driver
    driver.close()


def heard(rig, board):
    """(t_s, line) of all that a board has heard by now."""
    clock, cell, _ = rig
    cell.devices[board].advance(clock.now_s())
    return list(cell.devices[board].lines)


def moves(rig, board):
    return [line for _, line in heard(rig, board) if line.startswith(b"#")]


def test_the_first_move_of_each_board_by_hand(three):
    """Zero, slope and parked angle of each joint, in us: yaw 1500; 874 + 9.2 * 140; 732 + 9.2 * 115; 1500 + 9.5 * 70; roll 1500."""
    joints = [(0, 1500), (1, 2162), (2, 1790), (3, 2165), (5, 1500), (4, round(1900 - 12 / 14 * 900))]
    north = "".join(f"#{channel}P{pulse}" for channel, pulse in joints).encode()
    west = "".join(f"#{channel + 16}P{pulse}" for channel, pulse in joints).encode()
    assert moves(three, "main")[0].startswith(north + west)
    assert moves(three, "second")[0].startswith(north)
    assert b"#16" not in moves(three, "second")[0]


@pytest.mark.parametrize(("arm", "board", "first"), [(0, "main", 0), (1, "main", 16), (2, "second", 0)])
def test_a_move_goes_to_the_arms_own_board_and_channels(three, arm, board, first):
    clock, cell, driver = three
    before = {name: len(moves(three, name)) for name in cell.devices}
    driver.move([JointCommand(arm, PARKED + np.radians([8.0, 0, 0, 0, 0]), 12.0)], 0.1)
    driver.wait(0.3)
    for name in cell.devices:
        assert len(moves(three, name)) - before[name] == (name == board)
    line = moves(three, board)[-1]
    assert re.match(rb"#%dP1576S\d+#%dP2162S" % (first, first + 1), line), "1500 + 8 * 9.5"
    assert line.endswith(b"T100\r")
    np.testing.assert_allclose(np.degrees(driver.joints_rad()[:, 0]), 8.0 * np.eye(3)[arm])
    turned = np.degrees(cell.joints_rad(clock.now_s()) - PARKED)[:, 0]
    assert np.argmax(np.abs(turned)) == arm, "and it is that arm's servo that turns"


def test_arms_of_both_boards_move_in_one_command(three):
    *_, driver = three
    sent = driver.move([JointCommand(arm, PARKED + np.radians([4.0, 0, 0, 0, 0]), 12.0) for arm in range(3)], 0.1)
    assert len(sent.lines) == 2
    assert sorted(sent.joints_rad) == [0, 1, 2]
    assert len(re.findall(rb"#\d+P", moves(three, "main")[-1])) == 12
    assert len(re.findall(rb"#\d+P", moves(three, "second")[-1])) == 6


def test_the_latched_stop_reaches_every_channel_of_both_boards(three):
    clock, cell, driver = three
    driver.move([JointCommand(arm, PARKED + np.radians([15.0, 0, 0, 0, 0]), 12.0) for arm in range(3)], 0.3)
    latched_s = clock.now_s() + 0.1
    clock.at(latched_s, lambda: StopLatch(driver.latch.path).latch("somebody"))
    with pytest.raises(Stopped, match="somebody"):
        driver.wait(1.0)
    clock.sleep_s(0.1)
    for name, wired in (("main", [0, 1, 2, 3, 4, 5, 16, 17, 18, 19, 20, 21]), ("second", [0, 1, 2, 3, 4, 5])):
        stops = [(t_s, line) for t_s, line in heard(three, name) if b"STOP" in line]
        assert sorted(int(re.search(rb"STOP(\d+)", line)[1]) for _, line in stops) == wired
        assert all(0 < t_s - latched_s < 0.04 for t_s, _ in stops)
    held = [device.outputs_us(clock.now_s()) for device in cell.devices.values()]
    clock.sleep_s(1.0)
    assert [device.outputs_us(clock.now_s()) for device in cell.devices.values()] == held
    assert driver.state is State.STOPPED
    with pytest.raises(Stopped):
        driver.move([JointCommand(2, PARKED, 12.0)], 0.1)


@pytest.mark.parametrize("lost", ["main", "second"])
def test_one_board_that_is_lost_stops_the_arms_of_the_other_and_is_taken_up_again(three, lost):
    clock, cell, driver = three
    other = {"main": "second", "second": "main"}[lost]
    cell.devices[lost].add_faults([make_fault("unplug", clock.now_s(), 0.5)])
    with pytest.raises(PortLost):  # whichever arm is asked: where the others are is not known any more
        driver.move([JointCommand(1 if lost == "second" else 2, PARKED + np.radians([5.0, 0, 0, 0, 0]), 12.0)], 0.1)
    assert driver.state is State.LOST
    assert not driver.halt(), "one board was not reached"
    clock.sleep_s(0.05)
    assert any(b"STOP" in line for _, line in heard(three, other))
    driver.reconnect()
    driver.resync()
    driver.move([JointCommand(arm, PARKED + np.radians([5.0, 0, 0, 0, 0]), 12.0) for arm in range(3)], 0.2)
    driver.wait(0.4)
    np.testing.assert_allclose(np.degrees(driver.joints_rad()[:, 0]), 5.0)


def test_the_filter_keeps_each_pair_of_arms_apart_and_says_which(three, triangle):
    """Hands that would meet between two bases are refused, and both arms named; either of them alone may be there."""
    *_, driver = three
    reach = np.asarray(triangle.arm.ik([235.0, 0.0, 60.0])[0])
    for arm, other in ((0, 1), (1, 2), (2, 0)):
        bases = triangle.cell.bases
        joints = {}
        for one, two in ((arm, other), (other, arm)):
            joints[one] = reach.copy()
            towards = bases[one].to_local(np.append(bases[two].position_mm, 0.0))
            joints[one][0] = math.atan2(towards[1], towards[0])
        with pytest.raises(CommandRejected) as caught:
            driver.safety_filter.check_stand([JointCommand(each, joints.get(each, PARKED), 12.0) for each in range(3)])
        assert caught.value.reason is Reason.OTHER_ARM
        message = str(caught.value)
        assert {name for name in NAMES if f"arm {name}" in message} == {NAMES[arm], NAMES[other]}
        alone = [JointCommand(each, joints[arm] if each == arm else PARKED, 12.0) for each in range(3)]
        driver.safety_filter.check_stand(alone)
    assert "the other arm" not in message


def test_the_wiring_is_that_of_the_cells_arms_in_their_order(config):
    assert tuple(config.for_arms(("east", "north", "west")).arms) == ("east", "north", "west")
    assert tuple(config.for_arms().arms) == NAMES, "the pair as it is shipped gives way"
    assert config.for_arms(NAMES).for_arms(NAMES) == config.for_arms(NAMES)
    assert config.for_arms(NAMES).used_boards() == ("main", "second")


def test_a_pair_of_other_names_is_wired_left_and_right():
    assert tuple(HardwareConfig().for_arms(("red", "blue")).arms) == ("left", "right")
    assert tuple(HardwareConfig().for_arms(("right", "left")).arms) == ("right", "left"), "names count, not places"
    third = HardwareConfig()
    third.boards["second"], third.arms["third"] = BoardConfig("ssc32emu://second"), ArmWiring(board="second")
    assert tuple(third.for_arms(("left", "third", "right")).arms) == ("left", "third", "right")
    assert third.for_arms(("left", "third", "right")).used_boards() == ("main", "second")


@pytest.mark.parametrize(
    ("names", "change", "word"),
    [
        (("north", "west"), lambda config: None, "hardware.arms"),
        (("north", "west", "east", "south"), lambda config: None, "south"),
        (("left", "right"), lambda config: None, "hardware.arms"),
        (NAMES, lambda config: setattr(config.boards["second"], "port", config.boards["main"].port), "hardware.boards.second.port"),
        (NAMES, lambda config: setattr(config.arms["east"], "board", "main"), "channels of board main"),
        (NAMES, lambda config: setattr(config.arms["east"], "board", "third"), "hardware.arms.east.board"),
        (NAMES, lambda config: setattr(config.boards["second"], "baud", 57600), "hardware.boards.second.baud"),
        ((*NAMES, "play"), lambda config: config.arms.update(play=ArmWiring("third")), "play"),
        ((*NAMES, "a/b"), lambda config: config.arms.update({"a/b": ArmWiring("third")}), "a/b"),
    ],
)
def test_wiring_that_does_not_fit_the_cell_is_named(config, names, change, word):
    change(config)
    with pytest.raises(InvalidSetting, match=re.escape(word)):
        config.for_arms(names)


def test_four_arms_fit_two_boards_and_stop_in_time(tmp_path):
    """Two arms a board, all four of them told to stop within 40 ms."""
    names = ("first", "second", "third", "fourth")
    right = {"channels": [16, 17, 18, 19, 21], "gripper": GripperConfig(channel=20)}
    arms = {name: ArmWiring(board=("a", "b")[number // 2], **(right if number % 2 else {})) for number, name in enumerate(names)}
    config = HardwareConfig("four_twin", {name: BoardConfig(f"ssc32emu://{name}") for name in "ab"}, arms)
    model, clock = build_cell(cell_config("line4")), VirtualClock()
    cell = EmulatedCell(config.for_arms(names), model.arm, PARKED)
    cell.mount(clock)
    clock.until(1.0)
    with ArmDriver(config, model, clock=clock, latch=StopLatch(tmp_path / "stop"), confirm=lambda text: True) as driver:
        driver.arm()
        np.testing.assert_array_equal(driver.joints_rad(), [driver.parked_rad] * 4)
        driver.stop("enough")
        begun_s = clock.now_s()
        clock.sleep_s(0.1)
        for device in cell.devices.values():
            device.advance(clock.now_s())
            stops = [t_s for t_s, line in device.lines if b"STOP" in line]
            assert len(stops) == 12
            assert max(stops) - begun_s < 0.04


@pytest.mark.parametrize(
    ("name", "twin"), [("lynxmotion", "twin"), ("twin", "twin"), ("triangle", "triangle_twin"), ("triangle_twin", "triangle_twin")]
)
def test_a_twin_is_told_by_its_name(name, twin):
    assert twin_of(name) == twin
    assert HardwareConfig(twin).emulated
    assert HardwareConfig(name).emulated == (name == twin)


def test_a_cell_whose_arms_are_not_wired_says_so_in_a_line(tmp_path, capsys):
    for command in (
        ["evaluate", "backend=twin", "cell=triangle", "episodes=1"],
        ["run", "hardware=twin", "cell=triangle", "policy=exact"],
        ["calibrate", "hardware=triangle_twin", f"calibration={tmp_path}"],
    ):
        assert main(command) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert len(error) <= 300
        assert "hardware.arms" in error
        assert "north" in error
