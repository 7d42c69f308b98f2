"""An emulated STS3215: what its memory keeps, how it moves, gives way and protects itself."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.hardware import feetech
from marl_handover.hardware.emulator.device import parse_faults
from marl_handover.hardware.emulator.servo_bus import EmulatedBus, parse_servo_faults
from marl_handover.hardware.emulator.sts3215 import Sts3215, Sts3215Truth
from marl_handover.hardware.feetech import REGISTERS, Status

BYTE_S = 1e-5


def told(servo, name, value):
    """Write a register as a packet would."""
    servo.take(REGISTERS[name].address, feetech.encoded(name, value))


def settled(servo, seconds=3.0):
    servo.step(seconds)
    return servo["present_position"]


def test_power_up_is_limp_and_forgets_all_but_what_was_unlocked():
    servo = Sts3215(1, at=1500)
    told(servo, "p", 16)
    told(servo, "lock", 0)
    told(servo, "d", 8)
    told(servo, "goal_position", 2000)
    assert servo["torque_enable"] == 1
    servo.power_up()
    assert (servo["p"], servo["d"], servo["torque_enable"], servo["goal_position"], servo["lock"]) == (32, 8, 0, 0, 1)
    assert settled(servo) == 1500


def test_read_only_registers_stay():
    servo = Sts3215(1, at=1500)
    servo.take(0, bytes(feetech.MEMORY))
    assert servo["model"] == feetech.MODEL
    assert servo["present_position"] == 1500


def test_a_goal_switches_torque_on_and_another_mode_does_not():
    servo = Sts3215(1, at=1500)
    told(servo, "goal_position", 1600)
    assert servo.holds
    assert settled(servo) == pytest.approx(1600, abs=2)
    servo = Sts3215(1, at=1500, registers={"mode": 1})
    told(servo, "goal_position", 1600)
    assert not servo.holds
    assert settled(servo) == 1500


def test_torque_on_does_not_jump_wherever_it_was_turned_while_limp():
    servo = Sts3215(1, at=1500)
    told(servo, "goal_position", 3000)
    servo.step(3.0)
    told(servo, "torque_enable", 0)
    servo.step(0.1)
    servo.put(1000)
    servo.step(0.1)
    told(servo, "torque_enable", 1)
    assert settled(servo) == pytest.approx(1000, abs=2)


@given(st.integers(1, 254), st.integers(50, 3000), st.integers(200, 3900))
def test_motion_keeps_speed_and_acceleration(acceleration, speed, goal):
    """Never faster than asked, and there when a trapezoid is."""
    servo = Sts3215(1, at=2048)
    told(servo, "acceleration", acceleration)
    told(servo, "goal_speed", speed)
    told(servo, "goal_position", goal)
    way, rate = abs(goal - 2048), 100.0 * acceleration
    ramp_s = speed / rate
    takes_s = 2 * (way / rate) ** 0.5 if way < speed * ramp_s else way / speed + ramp_s
    at, fastest = servo.at, 0.0
    for _ in range(int(takes_s / 0.02) + 1):
        servo.step(0.02)
        fastest, at = max(fastest, abs(servo.at - at) / 0.02), servo.at
    servo.step(0.3)
    assert fastest <= 1.02 * speed + 1
    assert servo["present_position"] == pytest.approx(goal, abs=3)
    assert servo["moving"] == 0


def test_a_load_makes_it_sag_by_its_stiffness_and_half_the_gain_by_twice_as_much():
    """27 N m a radian at the factory's gain: 1 N m is 2.1 degrees, 24 counts."""
    sag = {}
    for gain in (32, 16):
        servo = Sts3215(1, at=2048, registers={"p": gain})
        servo.load_nm = 0.8
        told(servo, "goal_position", 2048)
        sag[gain] = 2048 - settled(servo)
    assert sag[32] == pytest.approx(0.8 / 27 * 4096 / 6.283, abs=2)
    assert sag[16] == pytest.approx(2 * sag[32], abs=3)
    limp = Sts3215(1, at=2048)
    limp.load_nm = 0.8
    assert settled(limp, 0.5) < 1500


def test_play_lies_on_the_side_of_the_load_and_floats_without_one():
    at = {}
    for load in (-0.1, 0.0, 0.1):
        servo = Sts3215(1, at=2048, truth=Sts3215Truth(play=12.0))
        servo.load_nm = load
        told(servo, "goal_position", 2048)
        at[load] = settled(servo)
    assert at[-0.1] - at[0.1] == pytest.approx(12 + 2 * 0.1 / 27 * 4096 / 6.283, abs=4)
    floating = Sts3215(1, at=2052, truth=Sts3215Truth(play=12.0))
    told(floating, "goal_position", 2048)
    assert settled(floating) == 2052


def test_a_strain_of_two_seconds_leaves_a_fifth_of_the_torque_until_it_is_switched_off():
    servo = Sts3215(1, at=2048)
    servo.jammed = True
    told(servo, "goal_position", 3000)
    servo.step(1.5)
    assert not servo["status"]
    servo.step(2.0)
    assert Status(servo["status"]) == Status.OVERLOAD
    assert servo["present_load"] == pytest.approx(200, abs=2)
    told(servo, "torque_enable", 0)
    assert not servo["status"]


def test_an_overload_ends_when_the_drive_turns_back():
    servo = Sts3215(1, at=2048)
    servo.jammed = True
    told(servo, "goal_position", 3000)
    servo.step(4.0)
    told(servo, "goal_position", 1000)
    servo.step(1.0)
    assert not servo["status"]


def test_a_supply_out_of_its_limits_is_told():
    assert Status(Sts3215(1, truth=Sts3215Truth(supply_v=12.0))["status"]) == Status.VOLTAGE
    assert Status(Sts3215(1, truth=Sts3215Truth(supply_v=3.0))["status"]) == Status.VOLTAGE


@given(st.integers(0, 4095), st.integers(-2047, 2047))
def test_a_position_is_told_less_the_offset_and_wraps(at, offset):
    servo = Sts3215(1, at=at, registers={"homing_offset": offset})
    assert servo["present_position"] == (at - offset) % 4096
    told(servo, "phase", servo["phase"] | 16)
    assert servo["present_position"] == at - offset


@given(st.integers(1, 4094))
def test_torque_128_makes_here_the_middle(at):
    servo = Sts3215(1, at=at)
    told(servo, "lock", 0)
    told(servo, "torque_enable", 128)
    assert servo["present_position"] == 2048
    assert not servo.holds
    servo.power_up()
    assert servo["present_position"] == 2048


def test_goals_are_cut_to_the_limits_in_memory():
    servo = Sts3215(1, at=2048, registers={"min_position": 1800, "max_position": 2200})
    told(servo, "goal_position", 4000)
    assert settled(servo) == pytest.approx(2200, abs=2)
    told(servo, "goal_position", 0)
    assert settled(servo) == pytest.approx(1800, abs=2)


def test_a_kept_write_waits_for_its_signal():
    servo = Sts3215(1, at=2048)
    bus = EmulatedBus([servo])
    bus.write(feetech.packet(1, feetech.REG_WRITE, bytes([42]) + feetech.encoded("goal_position", 2500)), 0.0)
    bus.advance(0.5)
    assert (servo["pending"], servo.holds) == (1, False)
    bus.write(feetech.packet(feetech.BROADCAST, feetech.ACTION), 0.5)
    bus.advance(4.0)
    assert servo["pending"] == 0
    assert servo["present_position"] == pytest.approx(2500, abs=2)


def test_a_reset_keeps_the_id():
    servo = Sts3215(7, at=2048, registers={"p": 5})
    servo.reset()
    assert (servo["id"], servo["p"], servo["present_position"]) == (7, 32, 2048)


def test_bytes_take_their_time_and_servos_answer_in_slots():
    """A ping of six bytes, then the reply of six: nothing is there before."""
    bus = EmulatedBus([Sts3215(1), Sts3215(2)])
    bus.write(feetech.ping(1), 0.0)
    assert bus.read(6 * BYTE_S + 1e-5) == b""
    assert bus.read(6 * BYTE_S + 30e-6 + 6 * BYTE_S + 1e-7) == feetech.packet(1, 0)
    begun = 0.1
    question = feetech.sync_read("present_position", [2, 1])
    bus.write(question, begun)
    heard_s = begun + len(question) * BYTE_S
    first = bus.read(heard_s + 30e-6 + 8 * BYTE_S + 1e-7)
    assert first == feetech.packet(2, 0, feetech.encoded("present_position", 2048))
    assert bus.read(heard_s + 30e-6 + 11 * BYTE_S) == b""
    assert bus.read(heard_s + 30e-6 + (11 + 8) * BYTE_S + 1e-7) == feetech.packet(1, 0, feetech.encoded("present_position", 2048))


def test_broadcast_writes_are_not_answered_and_everybody_answers_a_ping():
    bus = EmulatedBus([Sts3215(1), Sts3215(2)])
    bus.write(feetech.write(feetech.BROADCAST, "acceleration", 9), 0.0)
    assert bus.read(0.1) == b""
    assert [servo["acceleration"] for servo in bus.servos] == [9, 9]
    bus.write(feetech.ping(feetech.BROADCAST), 0.2)
    assert [body[0] for body in feetech.find_packets(bus.read(0.3))] == [1, 2]


def test_status_level_0_answers_pings_and_reads_only():
    bus = EmulatedBus([Sts3215(1, registers={"response_level": 0})])
    bus.write(feetech.write(1, "acceleration", 9), 0.0)
    assert bus.read(0.1) == b""
    bus.write(feetech.read(1, "acceleration"), 0.2)
    assert feetech.find_packets(bus.read(0.3))[0][3:] == b"\x09"


def test_a_new_id_and_a_new_rate_hold_from_then_on():
    bus = EmulatedBus([Sts3215(1)])
    bus.write(feetech.write(1, "id", 5), 0.0)
    assert feetech.find_packets(bus.read(0.1))[0][0] == 1
    bus.write(feetech.ping(5), 0.2)
    assert feetech.find_packets(bus.read(0.3))[0][0] == 5
    bus.write(feetech.write(5, "baud_rate", 1), 0.4)
    bus.read(0.5)
    bus.write(feetech.ping(5), 0.6)
    assert bus.read(0.7) == b""
    bus.host_baud = 500_000
    bus.write(feetech.ping(5), 0.8)
    assert feetech.find_packets(bus.read(0.9))[0][0] == 5


def test_a_brownout_lets_all_arms_go():
    bus = EmulatedBus([Sts3215(1, at=2048)])
    bus.add_faults(parse_servo_faults("brownout@1"))
    bus.write(feetech.write(1, "goal_position", 2500), 0.0)
    bus.advance(0.9)
    assert bus.servos[0].holds
    bus.advance(1.1)
    assert not bus.servos[0].holds


def test_a_fault_of_another_device_is_refused_with_those_there_are():
    with pytest.raises(Exception, match="frozen.*missing"):
        parse_servo_faults("frozen")
    with pytest.raises(Exception, match="missing.*frozen"):
        parse_faults("missing")


@given(st.binary(max_size=400), st.integers(0, 1000))
def test_no_bytes_break_a_bus(noise, seed):
    bus = EmulatedBus([Sts3215(1), Sts3215(2)], seed=seed)
    bus.write(noise, 0.0)
    bus.read(0.1)
    bus.forget_input()
    bus.write(b"\0" * 300 + feetech.ping(2), 0.2)
    bus.advance(0.3)
    if all(servo["baud_rate"] == 0 for servo in bus.servos) and [servo["id"] for servo in bus.servos] == [1, 2]:
        assert feetech.packet(2, bus.servos[1]["status"]) in bus.read(0.4)
