"""Servos, the line's pace, and faults of the emulated device; the URL scheme as pyserial sees it."""

from __future__ import annotations

import errno

import numpy as np
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.errors import BadOverride, UnknownChoice
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.emulator.board import EmulatedBoard, Servo, ServoTruth
from marl_handover.hardware.emulator.device import EmulatedCell, EmulatedDevice, Fault, make_fault, parse_faults
from marl_handover.hardware.emulator.protocol_ssc32emu import mount, unmount
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.hardware.ssc32 import Ssc32  # noqa: F401  # registers the URL scheme

TRUTH = ServoTruth(1500.0, 600.0, -1.2, 1.2, speed=4.5, dead_band_us=8.0, lag_s=0.03)


def settled(servo, pulse_us, steps=200):
    for _ in range(steps):
        servo.step(pulse_us, 0.02)
    return servo.position


def test_a_servo_rests_on_the_near_side_of_its_dead_band():
    servo = Servo(TRUTH, 0.0)
    assert 600 * settled(servo, 1800.0) == pytest.approx(296.0, abs=0.01)
    assert 600 * settled(servo, 1500.0) == pytest.approx(4.0, abs=0.01)
    resting = servo.position
    assert settled(servo, 1503.0) == resting, "within the dead band nothing moves"


def test_a_servo_is_no_faster_than_it_can_be_and_stays_without_a_pulse():
    servo = Servo(TRUTH, -1.0)
    before = servo.position
    for _ in range(10):
        servo.step(2100.0, 0.02)
        assert servo.position - before <= 4.5 * 0.02 + 1e-12
        before = servo.position
    assert settled(servo, 0.0) == before


def test_end_stops_and_jams_are_felt():
    servo = Servo(TRUTH, 0.0)
    assert settled(servo, 2500.0) == pytest.approx(1.2)
    assert servo.pushing
    settled(servo, 1500.0)
    assert not servo.pushing
    servo.jammed = True
    assert settled(servo, 1800.0) == pytest.approx(4 / 600, abs=1e-6)
    assert servo.pushing


@given(st.floats(-1, 1), st.floats(-1, 1), st.integers(1, 7))
def test_following_in_small_steps_is_following(start, goal, parts):
    whole, split = Servo(TRUTH, start), Servo(TRUTH, start)
    for _ in range(50):
        whole.step(1500 + 600 * goal, 0.02)
        for _ in range(parts):
            split.step(1500 + 600 * goal, 0.02 / parts)
    assert split.position == pytest.approx(whole.position, abs=1e-3)


def test_bytes_take_their_time_both_ways():
    device = EmulatedDevice(EmulatedBoard(), baud=9600)
    device.host_baud = 9600
    device.write(b"VER\r", 1.0)
    arrived_s = 1.0 + 4 * 10 / 9600
    first_s = arrived_s + 100e-6 + 600e-6 + 10 / 9600 + 70e-6
    assert device.read(first_s - 1e-6) == b""
    assert device.read(first_s + 1e-6) == b"S"
    last_s = first_s + (len("SC32-V2.50USB\r")) * (10 / 9600 + 70e-6)
    assert device.read(last_s - 1e-6) == b"SC32-V2.50USB"
    assert device.read(last_s + 1e-6) == b"\r"


def test_at_the_wrong_rate_nobody_understands_anybody():
    device = EmulatedDevice(EmulatedBoard(), baud=115200)
    device.host_baud = 9600
    for _ in range(20):
        device.write(b"VER\r", device.sending_until_s())
    assert b"SSC32" not in device.read(10.0)
    assert device.outputs_us(10.0) == [0.0] * 32


@pytest.mark.parametrize(
    ("text", "faults"),
    [
        ("", []),
        ("unplug@5:1.5", [Fault("unplug", 5.0, 1.5)]),
        ("brownout@9, late@12:3=0.2", [Fault("brownout", 9.0, 0.0), Fault("late", 12.0, 3.0, 0.2)]),
        ("silent", [Fault("silent", 0.0)]),
        ("jam@1:2=16", [Fault("jam", 1.0, 2.0, 16.0)]),
    ],
)
def test_faults_are_read_as_written(text, faults):
    assert parse_faults(text) == faults


def test_faults_that_make_no_sense_are_refused():
    with pytest.raises(UnknownChoice, match="earthquake.*unplug"):
        parse_faults("earthquake@3")
    for text in ("unplug@soon", "unplug@-1", "late@nan", "late@1:inf"):
        with pytest.raises(BadOverride):
            parse_faults(text)


def test_a_brown_out_forgets_everything_and_takes_its_time():
    device = EmulatedDevice(EmulatedBoard(), {0: Servo(TRUTH, 0.3)}, boot_s=0.2)
    device.write(b"#0P1600\r", 0.1)
    device.advance(1.0)
    stood = device.servos[0].position
    device.add_faults([make_fault("brownout", 2.0, 0.5)])
    assert device.outputs_us(1.99)[0] == 1600.0
    assert device.outputs_us(2.01)[0] == 0.0
    device.write(b"#0P1200\r", 2.6)  # not up yet
    assert device.outputs_us(3.0)[0] == 0.0
    assert device.servos[0].position == pytest.approx(stood, abs=1e-9)
    device.write(b"QP0\r", 3.0)
    assert device.read(3.1) == b"\0"


def test_power_is_off_while_any_fault_takes_it():
    device = EmulatedDevice(EmulatedBoard(), boot_s=0.1)
    device.add_faults(parse_faults("silent@1:3,brownout@2:0.5"))
    powered = []
    for t_s in (0.9, 1.1, 2.7, 4.05, 4.15):
        device.advance(t_s)
        powered.append(device.powered)
    assert powered == [True, False, False, False, True]


@pytest.mark.parametrize(
    ("fault", "reply"), [("drop@0", b""), ("stuck@0", b"+"), ("late@0=0.5", b""), ("silent@0", b""), ("jam@0", b"."), ("drop@0=0", b".")]
)
def test_faults_of_the_replies(fault, reply):
    device = EmulatedDevice(EmulatedBoard())
    device.add_faults(parse_faults(fault))
    device.write(b"Q\r", 1.0)
    assert device.read(1.1) == reply


def test_corrupt_replies_are_wrong_and_repeatable():
    def heard(seed):
        device = EmulatedDevice(EmulatedBoard(), seed=seed)
        device.add_faults(parse_faults("corrupt@0=1"))
        device.write(b"VER\r", 1.0)
        return device.read(2.0)

    assert heard(1) == heard(1) != heard(2)
    assert all(wrong != right for wrong, right in zip(heard(1), b"SSC32-V2.50USB\r", strict=True))


@pytest.fixture
def port():
    """A pyserial port to a mounted device, in virtual time."""
    clock = VirtualClock()
    device = EmulatedDevice(EmulatedBoard())
    ports = []

    def make(faults="", **settings):
        device.add_faults(parse_faults(faults))
        ports.append(serial.serial_for_url(mount("here", device, clock), baudrate=115200, **settings))
        return ports[-1], device, clock

    yield make
    for opened in ports:
        opened.close()
    unmount("here")


def test_the_url_scheme_is_a_serial_port(port):
    opened, _, clock = port(timeout=0.1)
    opened.write(b"VER\r")
    assert opened.out_waiting == 4
    assert opened.read(20) == b"SSC32-V2.50USB\r"
    assert clock.now_s() == pytest.approx(0.1)
    opened.write(b"Q\r")
    opened.flush()
    clock.sleep_s(0.01)
    assert opened.in_waiting == 1
    opened.reset_input_buffer()
    assert opened.read(1) == b""


def test_a_port_can_be_had_for_oneself(port):
    port(exclusive=True)
    with pytest.raises(serial.SerialException, match="exclusively lock"):
        serial.serial_for_url("ssc32emu://here", exclusive=True)
    serial.serial_for_url("ssc32emu://here").close()


def test_a_cable_that_comes_out_fails_as_a_real_one_does(port):
    opened, _, clock = port("unplug@1:1", timeout=0.1, write_timeout=0.1)
    clock.until(2.5)  # it is back, but this port is dead
    with pytest.raises(serial.SerialException, match="returned no data"):
        opened.read(1)
    with pytest.raises(serial.SerialException):
        opened.write(b"Q\r")
    with pytest.raises(OSError, match=rf"\[Errno {errno.EIO}\]") as caught:
        _ = opened.in_waiting
    assert not isinstance(caught.value, serial.SerialException)
    assert opened.is_open
    opened.close()
    again = serial.serial_for_url("ssc32emu://here", timeout=0.1)
    again.baudrate = 115200
    again.write(b"Q\r")
    assert again.read(1) == b"."
    again.close()


def test_there_is_no_port_while_the_cable_is_out(port):
    _, _, clock = port("unplug@1:1")
    clock.until(1.5)
    with pytest.raises(serial.SerialException, match="could not open"):
        serial.serial_for_url("ssc32emu://here")
    with pytest.raises(serial.SerialException, match="no emulated board"):
        serial.serial_for_url("ssc32emu://nowhere")


def test_a_full_buffer_makes_writes_wait_and_then_fail(port):
    opened, device, _ = port(write_timeout=0.05)
    device.host_baud = opened.baudrate = 9600
    opened.write(b"#" * 4096)
    with pytest.raises(serial.SerialTimeoutException):
        opened.write(b"#" * 512)


@given(st.lists(st.tuples(st.binary(min_size=1, max_size=60), st.floats(0, 0.1)), max_size=10))
def test_no_byte_overtakes_another(pieces):
    """What arrives is what was sent, in order, whatever the pauses."""
    device, now_s = EmulatedDevice(EmulatedBoard()), 0.0
    for data, pause_s in pieces:
        now_s += pause_s
        device.write(data.replace(b"\r", b"") + b"\r", now_s)
    device.advance(now_s + 10.0)
    assert b"".join(line for _, line in device.lines) == b"".join(data.replace(b"\r", b"") + b"\r" for data, _ in pieces)
    times = [t_s for t_s, _ in device.lines]
    assert times == sorted(times)
    assert np.all(np.diff(times) >= 0)


def test_no_two_servos_are_alike_the_grippers_neither(model):
    def drawn(**changes):
        config = HardwareConfig()
        for name, value in changes.items():
            setattr(config.emulator, name, value)
        return EmulatedCell(config, model.arm, np.zeros(5)).truths

    emulator, gripper = HardwareConfig().emulator, HardwareConfig().arms["left"].gripper
    truths = [truth for seed in range(20) for arm in drawn(seed=seed).values() for truth in arm]
    bands = np.array([truth.dead_band_us for truth in truths])
    assert np.abs(bands - emulator.dead_band_us).max() <= 2 * emulator.dead_band_sd_us
    assert 0.6 * emulator.dead_band_sd_us < bands.std() < emulator.dead_band_sd_us
    closed = np.array([truth.zero_us for truth in truths[5::6]]) - gripper.closed_us
    assert 5.0 < closed.std() < 25.0
    assert np.ptp([truth.slope_us for truth in truths[5::6]]) > 0.02 * abs(truths[5].slope_us)
    assert drawn(seed=3) == drawn(seed=3)
    exact = drawn(dead_band_sd_us=0.0, offset_sd_us=0.0, scale_sd=0.0)
    assert exact["left"] == exact["right"]
    assert {truth.dead_band_us for truth in exact["left"]} == {emulator.dead_band_us}
