"""Feetech STS3215 bus servos: their packets as pure functions, and one bus with checked reads and writes.

One wire, half duplex, 8N1. A packet is ``FF FF id length instruction parameters... checksum``; in a reply the servo's status byte stands in
place of the instruction. Words are little-endian; signed ones are a sign bit and a magnitude. A servo that reports trouble still answers.
Source: Feetech's protocol manual and memory table of the STS series, V3.6, and what owners of SO-101 arms measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import IntFlag
from itertools import pairwise
from numbers import Integral
from typing import Any, NamedTuple, TypeVar

from marl_handover.hardware.errors import BadCommand, BadReply, DuplicateServo, ServoFault, ServoMissing
from marl_handover.hardware.transport import WiredDevice

HEADER = b"\xff\xff"
BROADCAST = 0xFE
LAST_ID = 0xFC
"""Ids of servos are 0 to this; :data:`BROADCAST` is all of them."""

PING, READ, WRITE, REG_WRITE, ACTION, RESET, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x82, 0x83
MAX_PARAMETERS = 250

MODEL = 777
"""What an STS3215 says it is."""


class Status(IntFlag):
    """What a servo reports with every reply."""

    VOLTAGE = 1
    SENSOR = 2
    TEMPERATURE = 4
    CURRENT = 8
    ANGLE = 16
    OVERLOAD = 32


def words(status: Status) -> str:
    """What a servo reports, in words."""
    return ", ".join(str(flag.name).lower() for flag in Status if flag in status)


class Register(NamedTuple):
    """A value in a servo's memory: where, of how many bytes, its sign bit if it is signed, and whether it can be written."""

    address: int
    size: int = 1
    sign_bit: int | None = None
    writable: bool = True

    @property
    def lasting(self) -> bool:
        """Whether it is in EEPROM, which outlives power and wears out."""
        return self.address < FIRST_RAM

    @property
    def limits(self) -> tuple[int, int]:
        """Least and greatest value that it can hold."""
        most = (1 << (8 * self.size if self.sign_bit is None else self.sign_bit)) - 1
        return (0 if self.sign_bit is None else -most), most


FIRST_RAM = 40
MEMORY = 87
"""Registers are bytes 0 to below this."""

REGISTERS = {
    "firmware": Register(0, 2, writable=False),
    "model": Register(3, 2, writable=False),
    "id": Register(5),
    "baud_rate": Register(6),
    "return_delay": Register(7),  # in 2 us
    "response_level": Register(8),  # 0: only ping and read are answered
    "min_position": Register(9, 2),
    "max_position": Register(11, 2),
    "max_temperature": Register(13),  # degrees Celsius
    "max_voltage": Register(14),  # 0.1 V
    "min_voltage": Register(15),
    "max_torque": Register(16, 2),  # per mille of the stall torque
    "phase": Register(18),
    "unloading": Register(19),
    "led_alarm": Register(20),
    "p": Register(21),
    "d": Register(22),
    "i": Register(23),
    "start_force": Register(24, 2),
    "dead_zone_cw": Register(26),
    "dead_zone_ccw": Register(27),
    "protection_current": Register(28, 2),  # 6.5 mA
    "homing_offset": Register(31, 2, sign_bit=11),
    "mode": Register(33),
    "overload_torque": Register(34),  # percent that is left after an overload
    "overload_time": Register(35),  # 10 ms
    "overload_threshold": Register(36),  # percent
    "protection_time": Register(38),  # 10 ms
    "torque_enable": Register(40),
    "acceleration": Register(41),  # 100 steps/s^2
    "goal_position": Register(42, 2, sign_bit=15),
    "goal_time": Register(44, 2),
    "goal_speed": Register(46, 2, sign_bit=15),  # steps/s
    "torque_limit": Register(48, 2),
    "lock": Register(55),  # 0: writes to EEPROM outlive power
    "present_position": Register(56, 2, sign_bit=15, writable=False),
    "present_speed": Register(58, 2, sign_bit=15, writable=False),
    "present_load": Register(60, 2, sign_bit=10, writable=False),  # per mille of the motor's duty
    "present_voltage": Register(62, writable=False),  # 0.1 V
    "present_temperature": Register(63, writable=False),
    "pending": Register(64, writable=False),
    "status": Register(65, writable=False),
    "moving": Register(66, writable=False),
    "present_current": Register(69, 2, sign_bit=15, writable=False),
    "max_speed": Register(84),  # 50 steps/s
    "max_acceleration": Register(85),
}


class Reply(NamedTuple):
    """What a servo answered."""

    servo: int
    status: Status
    data: bytes


def checksum(body: bytes) -> int:
    """Of a packet without header and checksum."""
    return ~sum(body) & 0xFF


def packet(servo: int, instruction: int, parameters: bytes = b"") -> bytes:
    """A whole packet. Raises :class:`BadCommand` for an id or a length that none can have."""
    if servo != BROADCAST:
        servo = _whole("id", servo, 0, LAST_ID)
    if len(parameters) > MAX_PARAMETERS:
        raise BadCommand("the length of a packet", len(parameters), f"at most {MAX_PARAMETERS} parameters")
    body = bytes([servo, len(parameters) + 2, instruction]) + parameters
    return HEADER + body + bytes([checksum(body)])


def encoded(name: str, value: int) -> bytes:
    """A register's value as bytes. Raises :class:`BadCommand` for one that it cannot hold, or no whole number."""
    register = REGISTERS[name]
    number = _whole(name, value, *register.limits)
    if register.sign_bit is not None and number < 0:
        number = -number | 1 << register.sign_bit
    return number.to_bytes(register.size, "little")


def decoded(name: str, data: bytes) -> int:
    """Inverse of :func:`encoded`; bits beside sign and magnitude are left out."""
    register, number = REGISTERS[name], int.from_bytes(data, "little")
    if register.sign_bit is None:
        return number
    magnitude = number & ((1 << register.sign_bit) - 1)
    return -magnitude if number >> register.sign_bit & 1 else magnitude


def ping(servo: int) -> bytes:
    """Ask whether a servo, or who of all, is there."""
    return packet(servo, PING)


def read(servo: int, name: str) -> bytes:
    """Ask for a register."""
    register = REGISTERS[name]
    return packet(servo, READ, bytes([register.address, register.size]))


def write(servo: int, name: str, value: int) -> bytes:
    """Set a register. Raises :class:`BadCommand` for one that is read-only."""
    return packet(servo, WRITE, bytes([_writable(name).address]) + encoded(name, value))


def sync_read(names: str | Sequence[str], servos: Sequence[int]) -> bytes:
    """Ask several servos for a register, or for all from the first to the last of some; they answer one after the other, in this order."""
    first, size = _span([names] if isinstance(names, str) else names)
    return packet(BROADCAST, SYNC_READ, bytes([first, size, *_distinct(servos)]))


def sync_write(names: Sequence[str], values: Mapping[int, Sequence[int]]) -> bytes:
    """Set registers that lie side by side, of several servos at once: values in the order of ``names`` by servo. No servo answers."""
    registers = [_writable(name) for name in names]
    if not registers or any(one.address + one.size != other.address for one, other in pairwise(registers)):
        raise BadCommand("registers", list(names), "ones that lie side by side")
    data = bytearray([registers[0].address, sum(register.size for register in registers)])
    for servo in _distinct(values):
        data.append(servo)
        for name, value in zip(names, values[servo], strict=True):
            data += encoded(name, value)
    return packet(BROADCAST, SYNC_WRITE, bytes(data))


def find_packets(heard: bytes) -> list[bytes]:
    """Bodies of all whole packets in what was heard, without header and checksum; what is noise, or damaged, is left out."""
    found, at = [], 0
    while (at := heard.find(HEADER, at)) >= 0:
        body = heard[at + 2 : at + 3 + heard[at + 3] if len(heard) > at + 3 else at + 2]
        end = at + 3 + len(body)
        if 3 <= len(body) == body[1] + 1 and end <= len(heard) and heard[end - 1] == checksum(body):
            found.append(body)
            at = end
        else:
            at += 1
    return found


def parse_replies(asked: str, heard: bytes, size: int) -> list[Reply]:
    """All whole replies of ``size`` bytes of data. Raises :class:`DuplicateServo` if one servo's id answers twice."""
    replies = [Reply(body[0], Status(body[2] & 0x3F), body[3:]) for body in find_packets(heard) if len(body) == 3 + size]
    seen: set[int] = set()
    for reply in replies:
        if reply.servo in seen:
            raise DuplicateServo(asked, reply.servo)
        seen.add(reply.servo)
    return replies


def _span(names: Sequence[str]) -> tuple[int, int]:
    """The address of the first of some registers, and the number of bytes to the end of the last."""
    registers = [REGISTERS[name] for name in names]
    first = min(register.address for register in registers)
    return first, max(register.address + register.size for register in registers) - first


def _writable(name: str) -> Register:
    register = REGISTERS[name]
    if not register.writable:
        raise BadCommand("register", name, "one that can be written")
    return register


def _distinct(servos: Iterable[int]) -> list[int]:
    listed = [_whole("id", servo, 0, LAST_ID) for servo in servos]
    if not listed or len(set(listed)) != len(listed):
        raise BadCommand("ids", listed, "at least one, each once")
    return listed


def _whole(name: str, value: Any, low: int, high: int) -> int:
    """``value`` as an int; what is no whole number, or out of its limits, is refused: a guess would move an arm."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
        raise BadCommand(name, value, f"a whole number, {low} to {high}")
    return int(value)


T = TypeVar("T")

REPLY_BYTES = 6
"""Of a reply without data."""

GAP_BYTES = 3
"""Between the slots in which servos answer a sync read, in bytes' times."""

QUIET_S = 0.003


class FeetechBus(WiredDevice):
    """A chain of servos on one port, every answer checked, asked again when it is damaged, and the bus made quiet in between."""

    echo = False
    """Whether the adapter hands back what is sent, as bare one-wire wiring does."""

    def open(self, servos: Sequence[int]) -> dict[int, int]:
        """Open the port and find servos on it, none without any; their models by id.

        Raises:
            PortNotFound: there is no port, or it is in use.
            ServoMissing: some do not answer; the message says who does.
        """
        self.close()
        self._wire = self._opened()
        try:
            self.echo = ping(BROADCAST) in self.wire.ask(ping(BROADCAST), REPLY_BYTES, on_wait=self._attend)
            self.wire.drain(QUIET_S, self._attend)
            if not servos:
                return {}
            self.read_all("present_position", servos)  # where two have one id, their answers differ here and clash
            return self.read_all("model", servos)
        except BaseException as error:
            present = self.scan() if isinstance(error, ServoMissing) else []
            self.close()
            if isinstance(error, ServoMissing):
                raise ServoMissing(self.name, error.servos, present) from None
            raise

    def scan(self, last: int = 20) -> list[int]:
        """Ids up to ``last`` that answer a ping."""
        return [servo for servo in range(last + 1) if self._heard("ping", ping(servo), 1, 0)]

    def ping(self, servo: int) -> Status:
        """What a servo reports. Raises :class:`ServoMissing` if it is not there."""
        return self._one("ping", servo, ping(servo), 0).status

    def read(self, servo: int, name: str) -> int:
        """A register's value."""
        return decoded(name, self._one(name, servo, read(servo, name), REGISTERS[name].size).data)

    def read_all(self, name: str, servos: Sequence[int]) -> dict[int, int]:
        """A register of several servos in one question; those that are not heard are asked again.

        Raises :class:`ServoMissing` with all that never answered.
        """
        return {servo: row[0] for servo, row in self.read_group((name,), servos).items()}

    def read_group(self, names: Sequence[str], servos: Sequence[int]) -> dict[int, tuple[int, ...]]:
        """Registers that lie near each other, of several servos, in one question; as :meth:`read_all`."""
        first, size = _span(names)
        found: dict[int, tuple[int, ...]] = {}
        missing = list(servos)
        for _ in range(1 + self._timeouts.retries):
            for reply in self._heard(names[0], sync_read(names, missing), len(missing), size):
                parts = (reply.data[REGISTERS[name].address - first :][: REGISTERS[name].size] for name in names)
                found[reply.servo] = tuple(decoded(name, part) for name, part in zip(names, parts, strict=True))
            missing = [servo for servo in servos if servo not in found]
            if not missing:
                return {servo: found[servo] for servo in servos}
            self.wire.drain(QUIET_S, self._attend)
        raise ServoMissing(self.name, missing)

    def write(self, servo: int, name: str, value: int) -> None:
        """Set a register and wait for the servo's answer. Raises :class:`ServoMissing`; :class:`ServoFault` if it reports trouble."""
        reply = self._one(name, servo, write(servo, name, value), 0)
        if reply.status:
            raise ServoFault(self.name, servo, words(reply.status))

    def write_all(self, names: Sequence[str], values: Mapping[int, Sequence[int]]) -> None:
        """Set registers that lie side by side, of several servos at once. Nobody answers: read back what matters."""
        self.wire.write(sync_write(names, values))

    def configure(self, servo: int, wanted: Mapping[str, int]) -> list[str]:
        """Set lasting registers where they differ, and read them back; the names of those that did.

        EEPROM wears out, so it is unlocked and written for what differs only, and locked again whatever happens.

        Raises:
            BadReply: a register does not keep what it was given.
        """
        changed = [name for name, value in wanted.items() if self.read(servo, name) != value]
        if not changed:
            return []
        self.write(servo, "lock", 0)
        try:
            for name in changed:
                self.write(servo, name, wanted[name])
                found = self.read(servo, name)
                if found != wanted[name]:
                    raise BadReply(f"{name} of servo {servo}", encoded(name, found), f"{wanted[name]}, which was written")
        finally:
            self.write(servo, "lock", 1)
        return changed

    def _one(self, asked: str, servo: int, question: bytes, size: int) -> Reply:
        for _ in range(1 + self._timeouts.retries):
            for reply in self._heard(asked, question, 1, size):
                if reply.servo == servo:
                    return reply
            self.wire.drain(QUIET_S, self._attend)
        raise ServoMissing(self.name, [servo])

    def _heard(self, asked: str, question: bytes, count: int, size: int) -> list[Reply]:
        """Whole replies to a question that up to ``count`` servos answer with ``size`` bytes each."""
        echo = len(question) if self.echo else 0
        heard = self.wire.ask(question, echo + count * (REPLY_BYTES + size), on_wait=self._attend)
        return parse_replies(asked, heard[echo:], size)
