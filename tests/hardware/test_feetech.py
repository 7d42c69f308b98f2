"""Feetech's packets by hand, and a bus that believes nothing that is damaged."""

from __future__ import annotations

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from marl_handover.hardware import feetech
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.emulator.protocol_ssc32emu import mount
from marl_handover.hardware.emulator.servo_bus import EmulatedBus, parse_servo_faults
from marl_handover.hardware.emulator.sts3215 import Sts3215
from marl_handover.hardware.errors import (
    BadCommand,
    BadReply,
    DuplicateServo,
    PortLost,
    ServoFault,
    ServoMissing,
    WrongState,
)
from marl_handover.hardware.feetech import REGISTERS, FeetechBus, Status
from marl_handover.hardware.settings import BoardConfig, TimeoutConfig

IDS = [1, 2, 3, 4, 5, 6]


def made(faults="", ids=IDS, echo=False, retries=2, **servo):
    clock = VirtualClock()
    device = EmulatedBus([Sts3215(number, at=1000.0 + 100 * number, **servo) for number in ids], echo=echo)
    device.add_faults(parse_servo_faults(faults))
    bus = FeetechBus("left", BoardConfig(mount("servos", device, clock), 1_000_000), TimeoutConfig(retries=retries), clock)
    return bus, device, clock


# Packets of Feetech's manual of the protocol, chapter 1.3.


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (feetech.ping(1), "FF FF 01 02 01 FB"),
        (feetech.read(1, "present_position"), "FF FF 01 04 02 38 02 BE"),
        (feetech.write(254, "id", 1), "FF FF FE 04 03 05 01 F4"),
        (feetech.packet(1, feetech.RESET), "FF FF 01 02 06 F6"),
        (feetech.packet(254, feetech.ACTION), "FF FF FE 02 05 FA"),
        (feetech.packet(1, feetech.WRITE, bytes.fromhex("2A 00 08 00 00 E8 03")), "FF FF 01 09 03 2A 00 08 00 00 E8 03 D5"),
        (
            feetech.sync_write(("goal_position", "goal_time", "goal_speed"), dict.fromkeys([1, 2, 3, 4], (2048, 0, 1000))),
            "FF FF FE 20 83 2A 06 01 00 08 00 00 E8 03 02 00 08 00 00 E8 03 03 00 08 00 00 E8 03 04 00 08 00 00 E8 03 58",
        ),
        (feetech.sync_read("present_position", [1, 2]), "FF FF FE 06 82 38 02 01 02 3C"),
    ],
)
def test_packets_are_those_of_the_manual(packet, expected):
    assert packet == bytes.fromhex(expected)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("goal_position", 2048, "00 08"),
        ("goal_position", -1, "01 80"),  # sign bit 15
        ("homing_offset", -2047, "FF 0F"),  # sign bit 11
        ("homing_offset", 100, "64 00"),
        ("torque_limit", 1000, "E8 03"),
        ("lock", 1, "01"),
    ],
)
def test_values_have_their_own_sign_bit(name, value, expected):
    assert feetech.encoded(name, value) == bytes.fromhex(expected)


@given(st.sampled_from(sorted(REGISTERS)), st.data())
def test_what_a_register_holds_is_what_was_put_there(name, data):
    low, high = REGISTERS[name].limits
    value = data.draw(st.integers(low, high))
    assert feetech.decoded(name, feetech.encoded(name, value)) == value
    for beyond in (low - 1, high + 1):
        with pytest.raises(BadCommand, match=f"{name} = {beyond}: must be a whole number, {low} to {high}"):
            feetech.encoded(name, beyond)


@pytest.mark.parametrize("value", [True, 1.0, 0.5, "1", None, float("nan")])
def test_a_value_that_had_to_be_guessed_at_is_refused(value):
    with pytest.raises(BadCommand):
        feetech.write(1, "goal_position", value)
    with pytest.raises(BadCommand):
        feetech.ping(value)


def test_registers_do_not_overlap_and_read_only_ones_are_never_written():
    taken = [byte for register in REGISTERS.values() for byte in range(register.address, register.address + register.size)]
    assert len(taken) == len(set(taken))
    assert max(taken) < feetech.MEMORY
    for name, register in REGISTERS.items():
        if not register.writable:
            with pytest.raises(BadCommand, match="can be written"):
                feetech.write(1, name, 0)
            with pytest.raises(BadCommand, match="can be written"):
                feetech.sync_write((name,), {1: (0,)})


@pytest.mark.parametrize("ids", [[], [1, 1], [253], [-1], [True]])
def test_a_question_to_several_names_each_once(ids):
    with pytest.raises(BadCommand):
        feetech.sync_read("present_position", ids)


def test_what_is_written_together_lies_side_by_side():
    with pytest.raises(BadCommand, match="side by side"):
        feetech.sync_write(("goal_position", "goal_speed"), {1: (0, 0)})


BODIES = st.lists(st.tuples(st.integers(0, 252), st.integers(0, 63), st.binary(max_size=8)), max_size=4)


@given(BODIES, st.binary(max_size=12))
def test_whole_packets_are_found_behind_noise(bodies, noise):
    assume(b"\xff" not in noise)
    packets = [feetech.packet(servo, status, data) for servo, status, data in bodies]
    found = feetech.find_packets(noise + b"".join(packets))
    assert [(body[0], body[2], body[3:]) for body in found] == bodies


@given(st.integers(0, 252), st.binary(min_size=0, max_size=6), st.data())
def test_a_reply_with_one_byte_changed_is_none(servo, data, draw):
    reply = bytearray(feetech.packet(servo, 0, data))
    at = draw.draw(st.integers(0, len(reply) - 1))
    reply[at] ^= draw.draw(st.integers(1, 255))
    assert [body for body in feetech.find_packets(bytes(reply)) if (body[0], body[3:]) == (servo, data)] == []


@given(st.binary(max_size=300))
def test_noise_is_no_reply_but_by_its_checksum(noise):
    for body in feetech.find_packets(noise):
        assert feetech.packet(0, 0)[:2] + body + bytes([feetech.checksum(body)]) in noise


# The bus.


@pytest.mark.parametrize("echo", [False, True])
def test_a_bus_finds_its_servos_and_reads_them(echo):
    bus, _, clock = made(echo=echo)
    with pytest.raises(WrongState, match="not connected"):
        _ = bus.wire
    assert bus.open(IDS) == dict.fromkeys(IDS, 777)
    assert bus.echo is echo
    assert bus.read_all("present_position", IDS) == {number: 1000 + 100 * number for number in IDS}
    assert bus.read(3, "present_position") == 1300
    assert bus.ping(6) == Status(0)
    assert clock.now_s() < 0.5
    assert bus.scan(8) == IDS
    bus.close()
    bus.close()


@pytest.mark.parametrize("count", [6, 12])
def test_servos_are_streamed_and_read_back_two_hundred_times_a_second(count):
    """As the line allows: two arms on one bus, goals out and positions in, in virtual time."""
    ids = list(range(1, count + 1))
    bus, _, clock = made(ids=ids)
    bus.open(ids)
    begun = clock.now_s()
    for _ in range(20):
        bus.write_all(("goal_position",), {number: (1000 + 100 * number,) for number in ids})
        bus.read_all("present_position", ids)
    assert (clock.now_s() - begun) / 20 < 0.005


def test_what_is_written_is_confirmed_and_lasts():
    bus, device, _ = made()
    bus.open(IDS)
    assert bus.configure(2, {"p": 16, "return_delay": 0, "max_temperature": 65}) == ["p", "max_temperature"]
    before = len(device.lines)
    assert bus.configure(2, {"p": 16, "return_delay": 0, "max_temperature": 65}) == []
    assert not [body for _, body in list(device.lines)[before:] if body[2] == feetech.WRITE]
    assert device.servos[1]["lock"] == 1
    device.servos[1].power_up()
    assert bus.read(2, "p") == 16
    bus.write(2, "d", 10)  # locked: it is used, and forgotten
    assert bus.read(2, "d") == 10
    device.servos[1].power_up()
    assert bus.read(2, "d") == 32


def test_a_register_that_does_not_keep_its_value_is_told_and_the_lock_is_shut():
    bus, device, _ = made()
    bus.open(IDS)
    taking = device.servos[0].take
    device.servos[0].take = lambda address, data: None if address == REGISTERS["phase"].address else taking(address, data)
    with pytest.raises(BadReply, match="phase of servo 1"):
        bus.configure(1, {"phase": 0})
    assert device.servos[0]["lock"] == 1


@pytest.mark.parametrize(("faults", "gone"), [("missing=4", [4]), ("cut=3", [4, 5, 6]), ("silent", IDS)])
def test_servos_that_do_not_answer_are_named_with_those_that_do(faults, gone):
    bus, _, clock = made(faults)
    left = ", ".join(str(number) for number in IDS if number not in gone) or "none"
    with pytest.raises(ServoMissing, match=f"no answer from servo {', '.join(map(str, gone))}; answering: {left}") as caught:
        bus.open(IDS)
    assert caught.value.servos == tuple(gone)
    assert clock.now_s() < 6.0
    with pytest.raises(WrongState):
        _ = bus.wire


@pytest.mark.parametrize("faults", ["drop@0.2=0.3", "corrupt@0.2=0.02", "truncate@0.2=0.3", "late@0.2:0.5=0.02"])
def test_damaged_answers_are_asked_for_again_and_never_believed(faults):
    bus, _, clock = made(faults, retries=12)
    bus.open(IDS)
    clock.until(0.3)
    for _ in range(30):
        assert bus.read_all("present_position", IDS) == {number: 1000 + 100 * number for number in IDS}


def test_a_bus_that_falls_silent_is_missed_in_time():
    bus, _, clock = made("silent@1:1")
    bus.open(IDS)
    clock.until(1.1)
    begun = clock.now_s()
    with pytest.raises(ServoMissing):
        bus.read(1, "present_position")
    assert clock.now_s() - begun < 0.5
    clock.until(2.5)
    assert bus.read(1, "present_position") == 1100


def test_two_servos_of_one_id_are_noticed():
    bus, device, _ = made(ids=[1, 2, 2, 3])
    device.servos[2].put(2500.0)
    with pytest.raises((ServoMissing, DuplicateServo), match="servo 2"):
        bus.open([1, 2, 3])


def test_one_id_that_answers_twice_is_told():
    answer = feetech.packet(4, 0, b"\1\2")
    with pytest.raises(DuplicateServo, match="servo 4 answered twice"):
        feetech.parse_replies("present_position", answer + answer, 2)


def test_a_servo_with_trouble_still_answers_and_a_write_says_so():
    bus, _, clock = made("overload@1=2")
    bus.open(IDS)
    clock.until(1.1)
    assert bus.ping(2) == Status.OVERLOAD
    assert bus.read(2, "present_position") == 1200
    with pytest.raises(ServoFault, match="servo 2 reports overload"):
        bus.write(2, "acceleration", 20)
    with pytest.raises(ServoFault):
        bus.write(2, "torque_enable", 1)
    bus.write(2, "torque_enable", 0)
    assert bus.ping(2) == Status(0)


def test_a_cable_that_comes_out_is_a_lost_port():
    bus, _, clock = made("unplug@1:1")
    bus.open(IDS)
    clock.until(1.5)
    with pytest.raises(PortLost):
        bus.read(1, "present_position")
    clock.until(2.5)
    assert bus.open(IDS) == dict.fromkeys(IDS, 777)


def test_another_rate_is_silence():
    bus, _, _ = made(registers={"baud_rate": 4})
    with pytest.raises(ServoMissing, match="baud"):
        bus.open([1])
