"""Arms of bus servos through the driver: switched on without a jump, followed, stopped, and what becomes of every fault."""

from __future__ import annotations

import contextlib
import copy
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover.cell import build_cell, cell_config
from marl_handover.compose import from_yaml
from marl_handover.config import MotionConfig
from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile, UnsupportedKinematics
from marl_handover.files import resource_path
from marl_handover.geometry.capsules import ground_clearance_mm
from marl_handover.hardware import feetech
from marl_handover.hardware.calibration import (
    CalibrationProblem,
    calibrations,
    lerobot_motors,
    load_calibration,
    nominal_calibration,
)
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.connection import State
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.emulator.servo_bus import EmulatedServoCell, parse_servo_faults
from marl_handover.hardware.errors import (
    DeviceError,
    DuplicateServo,
    NotConfirmed,
    PortNotFound,
    PulseMismatch,
    ServoAstray,
    ServoFault,
    ServoMissing,
    Stopped,
    TorqueLost,
    UnsuitableFirmware,
)
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.gripper import GripperMap
from marl_handover.hardware.lerobot_file import MOTORS, read_motors, write_motors
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand, Reason
from marl_handover.hardware.settings import ARMS, COUNTS, HardwareConfig
from marl_handover.motion.home import parked_poses
from marl_handover.simulation.effort import holding_n_m

DEG = COUNTS / 360


@pytest.fixture(scope="module")
def model():
    return build_cell(cell_config("so101"))


SHIPPED = from_yaml(HardwareConfig, resource_path("configs/hardware/so101_twin.yaml"))


def hardware() -> HardwareConfig:
    return copy.deepcopy(SHIPPED)


@pytest.fixture
def rig(model, tmp_path):
    """``rig(config, faults, standing)``: clock, emulated cell with gravity, driver; nothing is connected yet."""
    made = []
    parked = parked_poses(model, MotionConfig())[0]

    def make(config=None, faults="", standing=parked, confirm=lambda text: True, dry_run=False):
        config = (config or hardware()).for_arms(model.cell.names)
        clock, latch = VirtualClock(), StopLatch(tmp_path / "stop")
        cell = EmulatedServoCell(config, model.arm, standing, holding_n_m=lambda q: holding_n_m(model.arm, q))
        cell.mount(clock)
        clock.until(1.0)
        cell.devices["left"].add_faults(parse_servo_faults(faults))
        driver = ArmDriver(config, model, clock=clock, latch=latch, confirm=confirm, dry_run=dry_run)

        def gravity():
            cell.joints_rad(clock.now_s())
            clock.at(clock.now_s() + 0.01, gravity)

        clock.at(clock.now_s(), gravity)
        made.append(SimpleNamespace(clock=clock, latch=latch, cell=cell, driver=driver, config=config, left=cell.devices["left"]))
        return made[-1]

    yield make
    for rig in made:
        rig.driver.close()


def now_rad(rig):
    """(2, 5): where the encoders say that the joints are, through the nominal calibration."""
    told = rig.cell.told(rig.clock.now_s())
    return np.array([it.to_rad(row) for it, row in zip(rig.driver.calibrations, told, strict=True)])


def test_arms_are_driven_to_the_parked_pose_and_stand_there(armed):
    """Whatever they sag: the encoders tell it, and it is taken out."""
    rig = armed()
    rig.driver.settle(0.6)
    assert np.abs(now_rad(rig) - rig.driver.parked_rad).max() < math.radians(0.5)
    assert all(servo.holds for device in rig.cell.devices.values() for servo in device.servos)


def test_what_lasts_is_written_once(armed):
    """EEPROM wears out: a second session finds everything as it should be, and writes nothing that lasts."""
    rig = armed()
    rig.driver.close()
    before = {name: len(device.lines) for name, device in rig.cell.devices.items()}
    rig.driver.connect()
    for name, device in rig.cell.devices.items():
        written = [body for _, body in list(device.lines)[before[name] :] if body[2] == feetech.WRITE]
        assert written == []
    gripper = rig.cell.servos(0)[-1]
    assert (gripper["max_torque"], gripper["p"], gripper["i"], gripper["return_delay"]) == (500, 32, 0, 0)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25)
def test_switching_on_moves_nothing_wherever_an_arm_stands(model, seed):
    starts_without_a_jump(model, seed)


@pytest.mark.slow
def test_switching_on_moves_nothing_at_a_thousand_postures(model):
    for seed in range(1000):
        starts_without_a_jump(model, seed)


def starts_without_a_jump(model, seed):
    """Held where it stands, whatever speed another program left: no servo turns by more than its load takes it, and its play lets it."""
    random = np.random.default_rng(seed)
    arm = model.arm
    standing = random.uniform(arm.lower_rad + 0.1, arm.upper_rad - 0.1)
    config = hardware().for_arms(model.cell.names)
    clock, cell = VirtualClock(), EmulatedServoCell(config, arm, standing, holding_n_m=lambda q: holding_n_m(arm, q))
    cell.mount(clock)
    for servo in cell.servos(0):
        servo.take(feetech.REGISTERS["goal_speed"].address, feetech.encoded("goal_speed", 3000))
    clock.until(0.5)
    driver = ArmDriver(config, model, clock=clock, latch=StopLatch("/nowhere/stop"), confirm=lambda text: True)
    try:
        driver.boards.connect()
        pulses = driver.boards.pulses()
        before = cell.joints_rad(clock.now_s())
        driver.boards.first_move({name: {servo: int(at) for servo, at in found.items()} for name, found in pulses.items()}, 200)
        softest_n_m_rad = 27.0 * (1 - config.emulator.bus_stiffness_share)
        sag_rad = np.concatenate([[0.0], np.abs(holding_n_m(arm, standing[None])[0]) * 1.1 / softest_n_m_rad, [0.0]])
        most_rad = sag_rad + math.radians(config.emulator.bus_play_deg[1] / 2 + 0.3)  # and a few counts
        for _ in range(20):
            clock.sleep_s(0.02)
            turned_rad = np.abs(cell.joints_rad(clock.now_s()) - before)
            assert (turned_rad <= most_rad).all(), f"{np.degrees(turned_rad).round(2)} of {np.degrees(most_rad).round(2)} degrees"
    finally:
        driver.boards.close()


def test_an_arm_creeps_to_the_parked_pose(rig, model):
    """None of its joints is faster than ``park_deg_s``, its own catching up apart."""
    standing = parked_poses(model, MotionConfig())[0] + np.radians([12.0, -20.0, 9.0, -15.0, 20.0])
    made = rig(standing=standing)
    made.driver.connect()
    made.driver.configure()
    fastest, last = [0.0], [made.cell.joints_rad(made.clock.now_s())]

    def watch():
        now = made.cell.joints_rad(made.clock.now_s())
        fastest[0] = max(fastest[0], float(np.degrees(np.abs(now - last[0])).max()) / 0.02)
        last[0] = now
        made.clock.at(made.clock.now_s() + 0.02, watch)

    made.clock.at(made.clock.now_s() + 0.02, watch)
    made.driver.arm()
    assert fastest[0] < 1.6 * made.config.park_deg_s
    assert np.abs(now_rad(made) - made.driver.parked_rad).max() < math.radians(1.0)


def test_nobody_confirms_and_nothing_is_switched_on(rig):
    asked = []
    made = rig(confirm=lambda text: asked.append(text))
    made.driver.connect()
    made.driver.configure()
    with pytest.raises(NotConfirmed):
        made.driver.arm()
    assert "switched on where the arms stand" in asked[0]
    assert "NOT CALIBRATED: left and right. Zeros may be off" in asked[0]
    assert "jump" not in asked[0], "that is of boards"
    assert not any(servo.holds for device in made.cell.devices.values() for servo in device.servos)


def test_a_dry_run_switches_nothing_on(rig):
    made = rig(dry_run=True)
    made.driver.connect()
    made.driver.configure()
    made.driver.arm()
    assert not any(servo.holds for device in made.cell.devices.values() for servo in device.servos)
    assert not any(body[2] in (feetech.WRITE, feetech.SYNC_WRITE) for device in made.cell.devices.values() for _, body in device.lines)


def swing(rig, steps, deg=3.0):
    """Move the left shoulder ``steps`` times down."""
    target = rig.driver.joints_rad()[0]
    for _ in range(steps):
        target = target - np.radians([0.0, deg, 0.0, 0.0, 0.0])
        rig.driver.move([JointCommand(0, target, 12.0)], rig.config.stream.period_s)
        rig.driver.wait(rig.config.stream.period_s)


def test_a_motion_is_followed_and_its_end_reached(armed):
    rig = armed()
    swing(rig, 10)
    rig.driver.settle(0.6)
    assert np.abs(now_rad(rig) - rig.driver.joints_rad()).max() < math.radians(0.5)


HOLD = bytes([feetech.SYNC_WRITE, feetech.REGISTERS["goal_position"].address, 2])
"""How a packet begins that gives servos a goal, and nothing else: ids and goals follow."""


def check_stops(make, count, seed=0):
    random = np.random.default_rng(seed)
    rig = make()
    for _ in range(count):
        swing(rig, 3, deg=2.0 if random.random() < 0.5 else -2.0)
        target = rig.driver.joints_rad()[0] + np.radians(random.uniform(-4, 4, 5))
        with contextlib.suppress(CommandRejected):
            rig.driver.move([JointCommand(0, np.clip(target, *limits(rig)), 12.0)], 0.12)
        rig.clock.sleep_s(float(random.uniform(0.0, 0.12)))
        began_s = rig.clock.now_s()
        rig.driver.stop("test")
        rig.clock.sleep_s(max(0.0, began_s + 0.04 - rig.clock.now_s()))
        for name, device in rig.cell.devices.items():
            device.advance(rig.clock.now_s())
            held = [body[5::3] for t_s, body in device.lines if t_s >= began_s and body[2:5] == HOLD]
            assert bytes(rig.config.channels(name)) in held, "every servo has its place to hold within 40 ms"
        held = rig.cell.joints_rad(rig.clock.now_s())
        rig.clock.sleep_s(0.3)
        assert np.abs(rig.cell.joints_rad(rig.clock.now_s()) - held).max() < math.radians(2.5), "a servo goes on"
        with pytest.raises(Stopped):
            rig.driver.move([JointCommand(0, rig.driver.joints_rad()[0], 12.0)], 0.06)
        rig.latch.clear()
        rig.driver.resume()
        rig.driver.park()


def test_a_stop_that_reaches_only_one_arm_says_so(armed):
    rig = armed()
    rig.left.add_faults(parse_servo_faults(f"unplug@{rig.clock.now_s() + 0.01}"))
    rig.clock.sleep_s(0.05)
    assert rig.driver.halt() is False
    rig.driver.boards.by_name["left"].close()
    assert rig.driver.halt() is False


def limits(rig):
    arm = rig.driver.model.arm
    return arm.lower_rad, arm.upper_rad


def test_a_stop_holds_every_servo_where_it_is(armed):
    check_stops(armed, 8)


@pytest.mark.slow
def test_five_hundred_stops_hold_every_servo(armed):
    check_stops(armed, 500)


RUBBISH = [math.nan, math.inf, 1e300, -40.0]


def check_limits(make, count):
    """Commands towards places within and beyond every limit, fast, slow, late and nonsense: what the arms truly do keeps the limits."""
    config, random = hardware(), np.random.default_rng(11)
    config.emulator.bus_zero_deg = 0.0  # so that the nominal calibration is right
    rig = make(config)
    driver, model, gate = rig.driver, rig.driver.model, rig.config.gate
    arm, speeds = model.arm, rig.driver.safety_filter.speed_rad_s
    rows, met, sent, aims, speed = [], set(), 0, np.zeros((2, 5)), np.zeros((2, 5))
    for number in range(count):
        if number % 25 == 0:
            aims = random.uniform(arm.lower_rad - 0.5, arm.upper_rad + 0.5, (2, 5))
        duration_s = float(random.choice([0.02, 0.04, 0.1, 0.2]))
        held = driver.joints_rad()
        most = np.minimum(speeds * duration_s, math.radians(gate.step_deg)) * random.choice([0.2, 0.5, 0.9, 1.3])
        who = [[0], [1], [0, 1]][int(random.integers(3))]
        change = math.radians(rig.config.bus.speed_change_deg_s) * random.choice([0.3, 0.9, 0.9, 1.5])
        pace = speed + np.clip(np.clip(aims - held, -most, most) / duration_s - speed, -change, change)
        given = [JointCommand(one, held[one] + pace[one] * duration_s, 12.0) for one in who]
        if random.random() < 0.03:
            given = [JointCommand(0, held[0] + random.choice(RUBBISH), 12.0)]
        try:
            driver.move(given, duration_s, rig.clock.now_s() - float(random.choice([0.0, 0.0, 0.0, 0.4])))
            sent += 1
            speed = np.where(np.isin([[0], [1]], who), pace, 0.0)
        except CommandRejected as rejection:
            met.add(rejection.reason)
            speed = np.zeros((2, 5))
        except ServoAstray:  # no servo turns back as suddenly as these commands do: all hold, and go on from where they are
            driver.wait(0.5)
            driver.recover()
        driver.wait(duration_s - 0.001)
        rows.append(rig.cell.joints_rad(rig.clock.now_s()))
    true = np.array(rows)
    slack_rad = math.radians(2.5)  # play of the gears, and what a fast servo is sent ahead by
    assert (true >= arm.lower_rad - slack_rad).all()
    assert (true <= arm.upper_rad + slack_rad).all()
    assert ground_clearance_mm(arm, true).min() > -5.0, "0.65 degrees of play, 440 mm out"
    assert sent > count / 5
    assert met >= {Reason.JOINT_LIMIT, Reason.SPEED_CHANGE, Reason.STALE, Reason.NOT_FINITE}
    rig.clock.sleep_s(0.3)
    assert driver.state is State.ARMED


def test_no_command_makes_arms_leave_their_limits(armed):
    check_limits(armed, 400)


@pytest.mark.slow
def test_none_of_ten_thousand_commands_makes_arms_leave_their_limits(armed):
    check_limits(armed, 10_000)


FAULTS = {
    "brownout": (TorqueLost, State.CONFIGURED),
    "overload=2": (ServoFault, State.CONFIGURED),
    "missing=3": (ServoMissing, State.LOST),
    "silent": (ServoMissing, State.LOST),
    "cut=2": (ServoMissing, State.LOST),
    "jam=2": (PulseMismatch, State.STOPPED),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_mid_move_has_its_name_and_its_state(armed, fault):
    kind, state = FAULTS[fault]
    rig = armed()
    word, _, amount = fault.partition("=")
    rig.left.add_faults(parse_servo_faults(f"{word}@{rig.clock.now_s() + 0.1}" + (f"={amount}" if amount else "")))
    with pytest.raises(kind):
        swing(rig, 20)
    assert rig.driver.state is state


def test_after_a_servo_that_was_gone_the_arms_go_on_where_they_are_held(armed):
    rig = armed()
    rig.left.add_faults(parse_servo_faults(f"missing@{rig.clock.now_s() + 0.1}:1=3"))
    with pytest.raises(ServoMissing):
        swing(rig, 20)
    rig.driver.reconnect()
    before = rig.cell.joints_rad(rig.clock.now_s())
    rig.driver.resync()
    assert rig.driver.state is State.ARMED
    assert np.abs(rig.cell.joints_rad(rig.clock.now_s()) - before).max() < math.radians(1.5)
    swing(rig, 3)


def test_after_a_brown_out_arms_are_not_taken_to_be_where_they_fell(armed):
    rig = armed()
    rig.left.add_faults(parse_servo_faults(f"brownout@{rig.clock.now_s() + 0.1}"))
    with pytest.raises(TorqueLost):
        swing(rig, 20)
    rig.driver.halt()
    rig.clock.sleep_s(0.1)
    assert not any(servo.holds for servo in rig.left.servos), "a goal would have switched them on, wherever they are"
    with pytest.raises(TorqueLost):
        rig.driver.resync()


def test_an_overload_ends_when_its_torque_goes_off_and_the_arm_goes_on(armed):
    rig = armed()
    rig.left.add_faults(parse_servo_faults(f"overload@{rig.clock.now_s() + 0.1}=2"))
    with pytest.raises(ServoFault, match="servo 2 reports overload"):
        swing(rig, 20)
    rig.driver.resync()
    assert rig.driver.state is State.ARMED
    assert not any(servo["status"] for servo in rig.left.servos)


def test_no_answer_of_random_bytes_hangs_or_is_believed(armed):
    fuzz(armed, 20_000)


@pytest.mark.slow
def test_a_million_random_bytes_neither_hang_nor_are_believed(armed):
    fuzz(armed, 1_000_000)


def fuzz(armed, count):
    """The bus answers noise, sometimes with a header: every question ends, in an error or, by a checksum's chance, in a reading."""
    rig = armed()
    board, random, said = rig.driver.boards.by_name["left"], np.random.default_rng(0), [0]

    def noise(t_s, piece):
        data = random.bytes(int(random.integers(1, 400)))
        data = data if random.random() < 0.5 else b"\xff\xff" + bytes([int(random.integers(1, 7))]) + data
        said[0] += len(data)
        rig.left._say(t_s, data)

    rig.left._hear = noise
    while said[0] < count:
        begun_s = rig.clock.now_s()
        with contextlib.suppress(DeviceError):
            board.require_pulses(rig.config.channels("left"))
        assert rig.clock.now_s() - begun_s < 3.0


SETUPS = {
    "another id": (
        lambda cell: cell.servos(0)[3].__setitem__("id", 9),
        ServoMissing,
        "no answer from servo 4; answering: 1, 2, 3, 5, 6, 9",
    ),
    "two equal ids": (lambda cell: cell.servos(0)[3].__setitem__("id", 3), (DuplicateServo, ServoMissing), "servo"),
    "another baud rate": (lambda cell: cell.servos(0)[3].__setitem__("baud_rate", 4), ServoMissing, "no answer from servo 4"),
    "another model": (lambda cell: cell.servos(0)[3].__setitem__("model", 1284), UnsuitableFirmware, "servo 4 is no STS3215"),
    "mixed firmware": (lambda cell: cell.servos(0)[3].__setitem__("firmware", 3 | 9 << 8), UnsuitableFirmware, "4: 3.9"),
}


@pytest.mark.parametrize("name", SETUPS)
def test_an_arm_that_is_not_what_it_should_be_is_told_in_a_line(rig, name):
    change, kind, words = SETUPS[name]
    made = rig()
    change(made.cell)
    with pytest.raises(kind, match=words) as caught:
        made.driver.connect()
    assert "\n" not in str(caught.value)
    assert made.driver.state is State.DISCONNECTED
    assert not any(servo.holds for device in made.cell.devices.values() for servo in device.servos)


def test_servos_on_the_wrong_supply_are_not_switched_on(rig):
    config = hardware()
    config.emulator.supply_v = 12.0
    made = rig(config)
    with pytest.raises(ServoFault, match=r"12 V, made for 4 to 8 V"):
        made.driver.connect()
    assert not any(servo.holds for device in made.cell.devices.values() for servo in device.servos)


def test_a_port_that_somebody_else_has_is_named(rig):
    made = rig()
    made.driver.connect()
    other = ArmDriver(made.config, made.driver.model, clock=made.clock, latch=StopLatch(made.latch.path))
    with pytest.raises(PortNotFound, match="ssc32emu://left"):
        other.connect()
    assert other.state is State.DISCONNECTED


def measured(rig, folder: Path):
    """Calibration files of both arms, with the homing offsets that their servos keep."""
    paths = {}
    for arm, marks in zip(ARMS, rig.driver.boards.marks(rig.config), strict=True):
        found = nominal_calibration(rig.config, arm, rig.driver.model.arm)
        object.__setattr__(found, "homing_offsets", marks)
        found.save(paths.setdefault(arm, folder / f"{arm}.json"))
    return paths


def test_swapped_arms_and_arms_of_somebody_else_are_noticed(rig, tmp_path, model):
    made = rig()
    made.driver.connect()
    paths = measured(made, tmp_path)
    made.driver.close()
    config = hardware()
    for arm, path in paths.items():
        config.arms[arm].calibration = str(path)
    made = rig(config)
    made.driver.connect()
    made.driver.configure()
    assert made.driver.calibrations[0].homing_offsets
    made.driver.close()
    config.boards["left"].port, config.boards["right"].port = "ssc32emu://right", "ssc32emu://left"
    made = rig(config)
    made.driver.connect()
    with pytest.raises(CalibrationProblem, match="the arm at its port is the right one: swap"):
        made.driver.configure()
    made.driver.close()
    config.boards["left"].port, config.boards["right"].port = "ssc32emu://left", "ssc32emu://right"
    config.emulator.seed = 5
    made = rig(config)
    made.driver.connect()
    with pytest.raises(CalibrationProblem, match="another arm, or calibrated since"):
        made.driver.configure()


# LeRobot's file.


def test_lerobots_file_says_where_the_zeros_are_and_comes_back(model, tmp_path):
    config, path = hardware(), tmp_path / "left.json"
    nominal = nominal_calibration(config, "left", model.arm)
    object.__setattr__(nominal, "homing_offsets", (10, -20, 30, -40, 50, -60))
    motors = lerobot_motors(nominal, model.arm, config.channels("left"), 1514)
    write_motors(path, motors)
    assert read_motors(path) == motors
    assert tuple(json.loads(path.read_text())) == MOTORS
    config.arms["left"].lerobot = str(path)
    again = nominal_calibration(config, "left", model.arm)
    q = np.radians([10.0, 100.0, -60.0, 20.0, 5.0])
    assert again.to_us(q) == pytest.approx(nominal.to_us(q), abs=1.0)
    assert again.homing_offsets == nominal.homing_offsets


@given(offsets=st.lists(st.integers(-150, 150), min_size=5, max_size=5))
def test_a_degree_in_lerobot_is_a_degree_here(model, tmp_path_factory, offsets):
    """LeRobot: degrees = (count - middle of the range) * 360 / 4095, of the URDF's joint; ours count from another zero, by its sign."""
    path = tmp_path_factory.mktemp("lerobot") / "arm.json"
    entries = {
        name: {"id": number, "drive_mode": 0, "homing_offset": 0, "range_min": 900, "range_max": 3196}
        for number, name in enumerate(MOTORS, 1)
    }
    for name, offset in zip(MOTORS, offsets, strict=False):
        entries[name]["range_min"] += offset
        entries[name]["range_max"] += offset
    path.write_text(json.dumps(entries))
    config = hardware()
    config.arms["left"].lerobot = str(path)
    found = nominal_calibration(config, "left", model.arm)
    q = (model.arm.lower_rad + model.arm.upper_rad) / 2
    for index, (source, offset) in enumerate(zip(model.arm.description.sources, offsets, strict=True)):
        urdf_deg = math.degrees(source.sign * q[index] + source.offset_rad)
        degrees = (float(found.to_us(q)[index]) - (2048 + offset)) * 360 / 4095
        assert degrees == pytest.approx(urdf_deg, abs=0.02 + 0.0003 * abs(urdf_deg))


BAD_FILES = {
    "a motor is missing": (lambda it: it.pop("elbow_flex"), "no motor elbow_flex"),
    "a value is missing": (lambda it: it["gripper"].pop("range_max"), "motor gripper"),
    "a value is text": (lambda it: it["gripper"].update(range_max="3000"), "'3000' is no whole number"),
    "a range is empty": (lambda it: it["wrist_flex"].update(range_min=3000, range_max=2000), "range_min < range_max"),
    "an offset no servo keeps": (lambda it: it["wrist_flex"].update(homing_offset=2048), "2047"),
    "a mirrored motor": (lambda it: it["wrist_flex"].update(drive_mode=1), "drive_mode 1"),
    "no calibration at all": (lambda it: it.clear(), "no motor shoulder_pan"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_file_of_lerobot_that_cannot_be_right_is_refused(tmp_path, name):
    change, words = BAD_FILES[name]
    content = {motor: {"id": 1, "drive_mode": 0, "homing_offset": 5, "range_min": 700, "range_max": 3300} for motor in MOTORS}
    change(content)
    path = tmp_path / "arm.json"
    path.write_text(json.dumps(content))
    with pytest.raises(CorruptFile, match=words):
        read_motors(path)


def test_a_file_of_lerobot_that_is_not_there_is_named(tmp_path):
    with pytest.raises(MissingFile, match="lerobot-calibrate"):
        read_motors(tmp_path / "nobody.json")


# Calibration and the hand.


def test_homing_offsets_are_kept_with_the_calibration(model, tmp_path):
    found = nominal_calibration(hardware(), "left", model.arm)
    object.__setattr__(found, "homing_offsets", (1, 2, 3, 4, 5, 6))
    found.save(tmp_path / "left.json")
    assert load_calibration(tmp_path / "left.json", "left", model.arm).homing_offsets == (1, 2, 3, 4, 5, 6)


@given(opening_mm=st.floats(1.3, 16.0))
def test_a_jaw_opens_as_its_hinge_turns_and_back(model, opening_mm):
    hand = model.arm.description.gripper
    to_pulse = GripperMap(hardware(), "left", hand)
    pulse = to_pulse.closing_pulse(opening_mm, 2.5)
    assert to_pulse.mm(pulse) == pytest.approx(opening_mm, abs=0.04)
    turned = 2 * math.asin(2 * opening_mm / (2 * hand.lever_mm))  # one pad moves, and so twice as far
    assert pulse - 1514 == pytest.approx(turned * COUNTS / (2 * math.pi), abs=1.0)


@given(further_mm=st.floats(-1.6, 1.6))
def test_a_jaw_closes_further_by_as_much_as_it_is_told(model, further_mm):
    config = hardware()
    before = GripperMap(config, "left", model.arm.description.gripper)
    config.arms["left"].gripper = before.shifted(further_mm)
    after = GripperMap(config, "left", model.arm.description.gripper)
    assert before.mm(after.closing_pulse(8.0, 2.5)) == pytest.approx(8.0 - further_mm, abs=0.08)


def test_boards_do_not_drive_a_jaw_and_bus_servos_no_sliding_fingers(model):
    with pytest.raises(UnsupportedKinematics, match="lacks a hand with two fingers that slide"):
        calibrations(HardwareConfig(), model.arm)
    paper = build_cell(cell_config("paper"))
    with pytest.raises(UnsupportedKinematics, match="lacks a hand with a jaw that turns"):
        calibrations(hardware(), paper.arm)


def test_a_pulse_of_a_hand_has_the_limits_of_its_servo():
    config = hardware()
    config.arms["left"].gripper.closed_us = 4095
    config.validate()
    config = HardwareConfig()
    config.arms["left"].gripper.closed_us = 4000
    with pytest.raises(InvalidSetting, match="between 500 and 2500"):
        config.validate()
