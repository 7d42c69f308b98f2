"""Bus servos that are not there behind one port: the wire that they share, its time, and what goes wrong on it.

A reply waits for the servo's return delay and a fixed time of thinking. Two servos of one id answer at once, and the line carries the AND
of their bytes, as an open-drain line does.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Iterable

from marl_handover.config import require_choice
from marl_handover.hardware.emulator.device import BITS_PER_BYTE, Fault, SerialDevice, parse_faults
from marl_handover.hardware.emulator.sts3215 import Sts3215, Sts3215Truth
from marl_handover.hardware.feetech import (
    ACTION,
    BROADCAST,
    COUNTS,
    GAP_BYTES,
    PING,
    READ,
    REG_WRITE,
    REPLY_BYTES,
    RESET,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    find_packets,
    packet,
)
from marl_handover.hardware.settings import SERVO_BAUDS, HardwareConfig

SERVO_FAULTS = {
    "unplug": "the USB cable is out",
    "brownout": "the supply breaks down: torque off, goals forgotten (an instant; the duration is how long it is off)",
    "silent": "the bus is dead: nothing answers, arms hold",
    "missing": "the servo of the given id (1) is gone",
    "cut": "the cable is out behind the servo of the given id (1)",
    "drop": "replies get lost, each with the given probability (1)",
    "corrupt": "reply bytes change, each with the given probability (0.5)",
    "truncate": "replies break off, each with the given probability (1)",
    "late": "replies come the given time late (0.05 s)",
    "overload": "the servo of the given id (1) has an overload latched",
    "jam": "the servo of the given id (1) is held fast",
}
USUAL = {"missing": 1.0, "cut": 1.0, "drop": 1.0, "corrupt": 0.5, "truncate": 1.0, "late": 0.05, "overload": 1.0, "jam": 1.0}


def parse_servo_faults(text: str) -> list[Fault]:
    """Faults of a bus, in the form of :func:`~marl_handover.hardware.emulator.device.parse_faults`."""
    return parse_faults(text, kinds=SERVO_FAULTS, usual=USUAL)


THINKING_S = 30e-6


class EmulatedBus(SerialDevice):
    """Servos on one wire behind one port.

    Args:
        servos: in the order of the cable.
        echo: whether the adapter hands back what is sent.
        seed: of what faults change at random.
    """

    def __init__(self, servos: Iterable[Sts3215], *, echo: bool = False, seed: int = 0) -> None:
        super().__init__(SERVO_BAUDS[0], seed)
        self.servos, self.echo, self._heard = list(servos), echo, b""

    @property
    def title(self) -> str:
        """Which servos there are."""
        return f"STS3215 servos {', '.join(str(servo['id']) for servo in self.servos)}"

    def add_faults(self, faults: Iterable[Fault]) -> None:
        """As the base class. Raises :class:`UnknownChoice` for a kind that no bus has."""
        listed = list(faults)
        for fault in listed:
            require_choice("fault", fault.kind, tuple(SERVO_FAULTS))
        super().add_faults(listed)

    def _pieces(self, data: bytes) -> Iterable[bytes]:
        return (bytes([byte]) for byte in data)

    def _edge(self, fault: Fault, begins: bool) -> None:
        """A fault begins or ends."""
        of = [servo for servo in self.servos if servo["id"] == int(fault.amount)]
        if fault.kind == "unplug":
            self._pull_out(begins)
            self._heard = b""
        elif fault.kind == "brownout":
            for servo in self.servos:
                servo.power_up()
        elif fault.kind == "overload" and begins:
            for servo in of:
                servo.latch_overload()
        elif fault.kind == "jam":
            for servo in of:
                servo.jammed = begins

    def _follow(self, t_s: float) -> None:
        if t_s > self._now_s:
            for servo in self.servos:
                servo.step(t_s - self._now_s)
            self._now_s = t_s

    def _hear(self, t_s: float, piece: bytes) -> None:
        """A byte has arrived at all servos."""
        if self.echo:
            self._say(t_s, piece)
        self._heard = (self._heard + piece)[-300:]
        found = find_packets(self._heard)
        if found:
            self._heard = b""
            self.lines.append((t_s, found[-1]))
            if not self._active("silent") and not self._active("brownout"):
                self._obey(t_s, found[-1])

    def _there(self) -> list[Sts3215]:
        """Servos that hear and are heard."""
        cut, missing = self._active("cut"), self._active("missing")
        reached = []
        for servo in self.servos:
            if SERVO_BAUDS[servo["baud_rate"] % len(SERVO_BAUDS)] == self.host_baud and not (
                missing and servo["id"] == int(missing.amount)
            ):
                reached.append(servo)
            if cut and servo["id"] == int(cut.amount):
                break
        return reached

    def _obey(self, t_s: float, body: bytes) -> None:
        """Carry out one packet."""
        to, instruction, data = body[0], body[2], body[3:]
        servos = self._there()
        if to == BROADCAST and instruction == SYNC_READ and len(data) > 2:
            slot_s = (REPLY_BYTES + data[1] + GAP_BYTES) * BITS_PER_BYTE / self.host_baud
            for number, wanted in enumerate(data[2:]):
                for servo in (each for each in servos if each["id"] == wanted):
                    self._answer(t_s + number * slot_s, servo, _memory(servo, data[0], data[1]))
            return
        if to == BROADCAST and instruction == SYNC_WRITE and len(data) > 2:
            size = data[1] + 1
            for at in range(2, len(data) - data[1], size):
                for servo in (each for each in servos if each["id"] == data[at]):
                    servo.take(data[0], data[at + 1 : at + size])
            return
        for servo in servos:
            if to not in (BROADCAST, servo["id"]):
                continue
            answer, told = b"", servo["id"]
            if instruction == READ and len(data) == 2:
                answer = _memory(servo, *data)
            elif instruction == WRITE and data:
                servo.take(data[0], data[1:])
            elif instruction == REG_WRITE and data:
                servo.note(data[0], data[1:])
            elif instruction == ACTION:
                servo.act()
            elif instruction == RESET:
                servo.reset()
            elif instruction != PING:
                continue
            slot_s = told * (REPLY_BYTES + GAP_BYTES) * BITS_PER_BYTE / self.host_baud if to == BROADCAST else 0.0
            if (to != BROADCAST or instruction == PING) and (servo["response_level"] or instruction in (PING, READ)):
                self._answer(t_s + slot_s, servo, answer, told)

    def _answer(self, t_s: float, servo: Sts3215, data: bytes, told: int | None = None) -> None:
        if (lost := self._active("drop")) and self._random.random() < lost.amount:
            return
        reply = packet(servo["id"] if told is None else told, servo["status"], data)
        if (broken := self._active("truncate")) and self._random.random() < broken.amount:
            reply = reply[: self._random.randrange(1, len(reply))]
        if damaged := self._active("corrupt"):
            changed = (byte ^ self._random.randrange(1, 256) if self._random.random() < damaged.amount else byte for byte in reply)
            reply = bytes(changed)
        late = self._active("late")
        self._say(t_s + THINKING_S + servo["return_delay"] * 2e-6 + (late.amount if late else 0.0), reply)

    def _say(self, t_s: float, data: bytes) -> None:
        """Bytes onto the wire from a time on; where others are on it already, zeros win."""
        byte_s = BITS_PER_BYTE / self.host_baud
        for number, byte in enumerate(data):
            at_s = t_s + (number + 1) * byte_s
            for index, (other_s, other) in enumerate(self._outgoing):
                if abs(other_s - at_s) < 0.6 * byte_s:
                    self._outgoing[index] = other_s, other & byte
                    break
            else:
                self._outgoing.append((at_s, byte))
        self._outgoing = deque(sorted(self._outgoing))


def emulated_buses(config: HardwareConfig) -> dict[str, EmulatedBus]:
    """The buses of a cell by name, each servo with play and a place in its travel of its own, drawn from ``emulator.seed``."""
    draw = random.Random(config.emulator.seed)
    ids: dict[str, list[int]] = {}
    for arm, wiring in config.arms.items():
        ids.setdefault(wiring.board, []).extend(config.channels(arm))
    buses = {}
    for name, listed in ids.items():
        servos = [Sts3215(servo, COUNTS / 2 + _turn(draw, 3.0), Sts3215Truth(play=_turn(draw, 1.3, 0.6))) for servo in listed]
        buses[name] = EmulatedBus(servos, seed=config.emulator.seed)
        buses[name].baud = config.boards[name].baud
    return buses


def _turn(draw: random.Random, most_deg: float, least_deg: float | None = None) -> float:
    """Counts of an angle between limits; between minus and plus the greater one without a least."""
    return draw.uniform(-most_deg if least_deg is None else least_deg, most_deg) * COUNTS / 360


def _memory(servo: Sts3215, address: int, size: int) -> bytes:
    """Registers from an address on; beyond the last there are zeros."""
    return bytes(servo.memory[address : address + size]).ljust(size, b"\0")
