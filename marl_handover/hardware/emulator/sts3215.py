"""Feetech STS3215 servos that are not there, and the one wire that they share: registers, motion, load, and what goes wrong.

Where sources differ on what a servo does, the choice is said here: at power-up torque is off, the goal is where the shaft is, and the lock
is shut; a reply waits for the return delay and a fixed time of thinking. Two servos of one id answer at once, and the line carries the AND
of their bytes, as an open-drain line does.
"""

from __future__ import annotations

import heapq
import math
import random
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from marl_handover.config import require_choice
from marl_handover.hardware.emulator.device import BITS_PER_BYTE, Fault, parse_faults
from marl_handover.hardware.feetech import (
    ACTION,
    BAUDS,
    BROADCAST,
    COUNTS,
    FIRST_RAM,
    GAP_BYTES,
    MEMORY,
    MODEL,
    PING,
    READ,
    REG_WRITE,
    REGISTERS,
    RESET,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    Status,
    checksum,
    decoded,
    encoded,
    find_packets,
)
from marl_handover.hardware.settings import HardwareConfig

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
STEP_S = 0.002
"""Longest step of a servo's motion."""

STALL_NM, STALL_V = 1.62, 6.0
"""Stall torque of the 7.4 V servo, and the voltage it was measured at."""

STIFFNESS_NM = 27.0 * 2 * math.pi / COUNTS
"""Torque a count of error asks for at the factory's P gain."""

IDLE_NM = 0.05
"""Gears hold so much by themselves."""

FACTORY_P = 32
LAG_S = 0.02
FASTEST = 3400.0
"""Steps per second without load."""

DEFAULTS = {
    "firmware": 3 | 10 << 8,
    "model": MODEL,
    "id": 1,
    "baud_rate": 0,
    "max_position": COUNTS - 1,
    "max_temperature": 70,
    "max_voltage": 80,
    "min_voltage": 40,
    "max_torque": 1000,
    "response_level": 1,
    "phase": 12,
    "unloading": 44,
    "led_alarm": 47,
    "p": FACTORY_P,
    "d": 32,
    "start_force": 16,
    "dead_zone_cw": 1,
    "dead_zone_ccw": 1,
    "protection_current": 500,
    "overload_torque": 20,
    "overload_time": 200,
    "overload_threshold": 80,
    "protection_time": 200,
    "max_speed": 68,
    "max_acceleration": 254,
}
"""What a servo comes with."""


@dataclass(frozen=True)
class Sts3215Truth:
    """What a servo is really like.

    ``low`` and ``high``: end stops in counts of the encoder; ``play`` in counts: the whole way that the shaft has free of the motor;
    ``supply_v`` and ``ambient_c``: volts and degrees Celsius where it stands.
    """

    low: float = 0.0
    high: float = COUNTS - 1.0
    play: float = 0.0
    supply_v: float = 7.4
    ambient_c: float = 30.0


class Sts3215:
    """A servo by itself. Times are the caller's and never go back.

    Args:
        servo: its id.
        at: counts of the encoder where the shaft stands.
        truth: what it is like.
        registers: values other than the factory's, by name.
    """

    def __init__(self, servo: int, at: float = COUNTS / 2, truth: Sts3215Truth | None = None, registers: Mapping[str, int] | None = None):
        self.truth = truth or Sts3215Truth()
        self.at, self.load_nm, self.jammed = float(at), 0.0, False
        self._stored = _factory({"id": servo, **(registers or {})})
        self._pending: list[tuple[int, bytes]] = []
        self._motor = self._motor_goal = self.at
        self._speed, self._strained_s, self.temperature_c = 0.0, 0.0, self.truth.ambient_c
        self._overload = self._drive = self._velocity = 0.0
        self.power_up()

    def __getitem__(self, name: str) -> int:
        register = REGISTERS[name]
        return decoded(name, bytes(self.memory[register.address : register.address + register.size]))

    def __setitem__(self, name: str, value: int) -> None:
        register = REGISTERS[name]
        self.memory[register.address : register.address + register.size] = encoded(name, value)

    def power_up(self) -> None:
        """Forget all but EEPROM; the shaft stays where it is."""
        self.memory = bytearray(self._stored)
        self._pending.clear()
        self._motor = self._motor_goal = self.at
        self._speed, self._strained_s, self._overload = 0.0, 0.0, 0.0
        self["torque_limit"], self["lock"] = self["max_torque"], 1
        self._tell()

    def take(self, address: int, data: bytes) -> None:
        """Write registers from an address on; read-only ones stay as they are."""
        fixed = {a for r in REGISTERS.values() if not r.writable for a in range(r.address, r.address + r.size)}
        touched = {address + offset for offset in range(len(data))}
        was = self["torque_enable"]
        unlocked = self["lock"] == 0
        for offset, byte in enumerate(data):
            where = address + offset
            if where < MEMORY and where not in fixed:
                self.memory[where] = byte
                if where < FIRST_RAM and unlocked:
                    self._stored[where] = byte
        if REGISTERS["torque_enable"].address in touched:
            self._switch(was)
        if REGISTERS["goal_position"].address in touched and self["mode"] in (0, 3):
            if not self["torque_enable"]:
                self._motor, self._speed = self.at, 0.0
            self["torque_enable"] = 1
            self._motor_goal = self._allowed(self["goal_position"])
        self._tell()

    def note(self, address: int, data: bytes) -> None:
        """Keep a write for :meth:`act`."""
        self._pending.append((address, data))
        self["pending"] = 1

    def act(self) -> None:
        """Carry out what was kept."""
        for address, data in self._pending:
            self.take(address, data)
        self._pending.clear()
        self["pending"] = 0

    def reset(self) -> None:
        """Back to the factory's settings, but for the id."""
        self._stored = _factory({"id": self["id"]})
        self.power_up()

    def put(self, at: float) -> None:
        """Turn the shaft by hand, to counts of the encoder; a servo that holds turns back."""
        self.at = min(max(at, self.truth.low), self.truth.high)

    def latch_overload(self) -> None:
        """An overload as after too long a strain."""
        self._overload = math.copysign(1.0, self._motor_goal - self.at)
        self._tell()

    def step(self, duration_s: float) -> None:
        """Move on."""
        while duration_s > 0:
            part = min(duration_s, STEP_S)
            self._move(part)
            duration_s -= part
        self._tell()

    @property
    def holds(self) -> bool:
        """Whether torque is on."""
        return self["torque_enable"] == 1

    def _switch(self, was: int) -> None:
        """Torque goes on or off, or the middle is set to here."""
        wanted = self["torque_enable"]
        if wanted == 128:
            offset = round(self.at) - COUNTS // 2
            self["homing_offset"] = max(-2047, min(2047, offset))
            register = REGISTERS["homing_offset"]
            if self["lock"] == 0:
                where = slice(register.address, register.address + register.size)
                self._stored[where] = self.memory[where]
            self["torque_enable"] = was
        elif not wanted:
            self._overload = self._strained_s = 0.0
        elif not was:
            self._motor = self._motor_goal = self.at
            self._speed = 0.0

    def _allowed(self, goal: int) -> float:
        """Counts of the encoder that a goal means."""
        low, high = self["min_position"], self["max_position"]
        if low or high:
            goal = min(max(goal, low), high)
        return float(goal + self["homing_offset"])

    def _move(self, duration_s: float) -> None:
        strength = STALL_NM * self.truth.supply_v / STALL_V * min(self["torque_limit"], self["max_torque"]) / 1000
        if self._overload and math.copysign(1.0, self._motor_goal - self.at) == self._overload:
            strength *= self["overload_torque"] / 100
        if not self.holds:
            self._motor = self._motor_goal = self.at
            self._speed = 0.0
            self._fall(self.load_nm, duration_s)
            self._drive, self._velocity = 0.0, 0.0
            return
        self._profile(duration_s)
        stiff = STIFFNESS_NM * self["p"] / FACTORY_P
        error = self._motor - self.at
        zone = self["dead_zone_cw"] if error < 0 else self["dead_zone_ccw"]
        wanted = 0.0 if abs(error) <= zone else stiff * error
        drive = max(-strength, min(strength, wanted))
        before = self.at
        if not self.jammed:
            if abs(self.load_nm) > strength:
                self._fall(self.load_nm - math.copysign(strength, self.load_nm), duration_s)
            else:
                pulled = abs(self.load_nm) > IDLE_NM  # the gears' play is on one side then, and the shaft floats else
                rest = self._motor - self.load_nm / max(stiff, 1e-9)
                rest -= math.copysign(self.truth.play / 2, self.load_nm) if pulled else 0.0
                gap, free = rest - self.at, zone + (0.0 if pulled else self.truth.play / 2)
                if abs(gap) > free:
                    gap -= math.copysign(free, gap)
                    reach = FASTEST * self.truth.supply_v / 7.4 * duration_s
                    self.put(self.at + max(-reach, min(reach, gap * -math.expm1(-duration_s / LAG_S))))
        self._velocity = (self.at - before) / duration_s
        self._drive = drive / max(STALL_NM * self.truth.supply_v / STALL_V, 1e-9)
        self._strain(abs(drive) >= strength * self["overload_threshold"] / 100, duration_s, drive)

    def _strain(self, strained: bool, duration_s: float, drive: float) -> None:
        """Too much for too long, and the servo lets go of most of its torque until it is switched off or turns back."""
        if self._overload and drive * self._overload < 0:
            self._overload = 0.0
        self._strained_s = self._strained_s + duration_s if strained else 0.0
        if self["overload_time"] and self._strained_s >= self["overload_time"] * 0.01 and self["unloading"] & Status.OVERLOAD:
            self._overload = math.copysign(1.0, drive)

    def _profile(self, duration_s: float) -> None:
        """The motor's own set point goes to the goal, by a trapezoid of acceleration and speed."""
        most = self["max_acceleration"]
        asked = self["acceleration"]
        rate = 100.0 * (asked if 0 < asked <= most else most)
        top = abs(self["goal_speed"]) or (50.0 * self["max_speed"] if self["phase"] & 8 else 0.0)
        left = self._motor_goal - self._motor
        wanted = math.copysign(min(top, math.sqrt(2 * rate * abs(left))), left)
        change = max(-rate * duration_s, min(rate * duration_s, wanted - self._speed))
        self._speed += change
        moved = self._speed * duration_s
        if abs(moved) >= abs(left) and moved * left >= 0:
            self._motor, self._speed = self._motor_goal, 0.0
        else:
            self._motor += moved

    def _fall(self, torque_nm: float, duration_s: float) -> None:
        """What nothing holds goes where the load pulls; gears hold against a little."""
        if not self.jammed and abs(torque_nm) > IDLE_NM:
            self.put(self.at - math.copysign(min(FASTEST, 2000.0 * abs(torque_nm)) * duration_s, torque_nm))

    def _tell(self) -> None:
        """Put what is measured into the registers."""
        count = round(self.at - self["homing_offset"])
        self["present_position"] = max(-32767, min(32767, count if self["phase"] & 16 else count % COUNTS))
        self["present_speed"] = max(-32767, min(32767, round(self._velocity)))
        self["present_load"] = max(-1000, min(1000, round(1000 * self._drive)))
        self["present_voltage"] = round(10 * self.truth.supply_v)
        self["present_temperature"] = round(self.temperature_c)
        self["present_current"] = round(abs(self._drive) * 2000 / 6.5)
        self["moving"] = int(self.holds and abs(self._speed) > 0)
        status = Status(0)
        if not self["min_voltage"] <= self["present_voltage"] <= self["max_voltage"]:
            status |= Status.VOLTAGE
        if self["present_temperature"] > self["max_temperature"]:
            status |= Status.TEMPERATURE
        if self._overload:
            status |= Status.OVERLOAD
        self["status"] = int(status)


class EmulatedBus:
    """Servos on one wire behind one port. Times are in s on one clock; nothing happens but by :meth:`advance`.

    Args:
        servos: in the order of the cable.
        echo: whether the adapter hands back what is sent.
        seed: of what faults change at random.
    """

    def __init__(self, servos: Iterable[Sts3215], *, echo: bool = False, seed: int = 0) -> None:
        self.servos, self.echo = list(servos), echo
        self.host_baud = self.baud = BAUDS[0]
        self.lines: deque[tuple[float, bytes]] = deque(maxlen=1000)
        """The last packets that came in, and when each ended."""
        self.unplugged = 0
        self._random = random.Random(seed)
        self._incoming: deque[tuple[float, bytes]] = deque()
        self._outgoing: list[tuple[float, int]] = []
        self._heard = b""
        self._heard_until_s, self._now_s = 0.0, 0.0
        self._faults: list[Fault] = []
        self._edges: list[tuple[float, int, bool, Fault]] = []

    def add_faults(self, faults: Iterable[Fault]) -> None:
        """Let things go wrong, at the times the faults say. Raises :class:`UnknownChoice` for a kind that no bus has."""
        for fault in faults:
            require_choice("fault", fault.kind, tuple(SERVO_FAULTS))
            self._faults.append(fault)
            heapq.heappush(self._edges, (fault.start_s, len(self._faults), True, fault))
            if math.isfinite(fault.duration_s):
                heapq.heappush(self._edges, (fault.end_s, len(self._faults), False, fault))
        self.advance(self._now_s)

    @property
    def title(self) -> str:
        """Which servos there are."""
        return f"STS3215 servos {', '.join(str(servo['id']) for servo in self.servos)}"

    @property
    def plugged(self) -> bool:
        """Whether the port is there."""
        return not self._active("unplug")

    def write(self, data: bytes, t_s: float) -> None:
        """Bytes from the computer; they arrive one after the other at the line's pace."""
        self.advance(t_s)
        begin_s, byte_s = max(t_s, self._heard_until_s), BITS_PER_BYTE / self.host_baud
        for number, byte in enumerate(data):
            self._incoming.append((begin_s + (number + 1) * byte_s, bytes([byte])))
        self._heard_until_s = begin_s + len(data) * byte_s

    def read(self, t_s: float, size: int | None = None) -> bytes:
        """Up to ``size`` bytes that have come back by ``t_s``; all of them without ``size``."""
        self.advance(t_s)
        count = 0
        while count < len(self._outgoing) and self._outgoing[count][0] <= t_s and (size is None or count < size):
            count += 1
        out, self._outgoing = self._outgoing[:count], self._outgoing[count:]
        return bytes(byte for _, byte in out)

    def waiting(self, t_s: float) -> int:
        """Number of bytes that have come back and were not read."""
        self.advance(t_s)
        return sum(at_s <= t_s for at_s, _ in self._outgoing)

    def next_event_s(self) -> float | None:
        """When something may happen next that the computer could notice; None if nothing is under way."""
        times = [queue[0][0] for queue in (self._incoming, self._outgoing, self._edges) if queue]
        return min(times) if times else None

    def sending_until_s(self) -> float:
        """When the last byte written will have arrived."""
        return self._heard_until_s

    def forget_input(self) -> None:
        """Throw away what has come back, as opening or flushing a port does."""
        self._outgoing = [pair for pair in self._outgoing if pair[0] > self._now_s]

    def advance(self, t_s: float) -> None:
        """Let everything happen up to ``t_s``, in order."""
        while True:
            byte_s = self._incoming[0][0] if self._incoming else math.inf
            edge_s = self._edges[0][0] if self._edges else math.inf
            if min(byte_s, edge_s) > t_s:
                break
            self._follow(min(byte_s, edge_s))
            if edge_s <= byte_s:
                _, _, begins, fault = heapq.heappop(self._edges)
                self._edge(fault, begins)
            else:
                self._hear(*self._incoming.popleft())
        self._follow(t_s)

    def _active(self, kind: str) -> Fault | None:
        return next((fault for fault in self._faults if fault.kind == kind and fault.active(self._now_s)), None)

    def _edge(self, fault: Fault, begins: bool) -> None:
        """A fault begins or ends."""
        if not begins:
            self._faults.remove(fault)
        of = [servo for servo in self.servos if servo["id"] == int(fault.amount)]
        if fault.kind == "unplug":
            self.unplugged += begins
            self._incoming.clear()
            self._outgoing.clear()
            self._heard_until_s, self._heard = self._now_s, b""
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

    def _hear(self, t_s: float, byte: bytes) -> None:
        """A byte has arrived at all servos."""
        if self.echo:
            self._say(t_s, byte)
        self._heard = (self._heard + byte)[-300:]
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
            if BAUDS[servo["baud_rate"] % len(BAUDS)] == self.host_baud and not (missing and servo["id"] == int(missing.amount)):
                reached.append(servo)
            if cut and servo["id"] == int(cut.amount):
                break
        return reached

    def _obey(self, t_s: float, body: bytes) -> None:
        """Carry out one packet."""
        to, instruction, data = body[0], body[2], body[3:]
        servos = self._there()
        if to == BROADCAST and instruction == SYNC_READ and len(data) > 2:
            slot_s = (6 + data[1] + GAP_BYTES) * BITS_PER_BYTE / self.host_baud
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
            slot_s = told * (6 + GAP_BYTES) * BITS_PER_BYTE / self.host_baud if to == BROADCAST else 0.0
            if (to != BROADCAST or instruction == PING) and (servo["response_level"] or instruction in (PING, READ)):
                self._answer(t_s + slot_s, servo, answer, told)

    def _answer(self, t_s: float, servo: Sts3215, data: bytes, told: int | None = None) -> None:
        if (lost := self._active("drop")) and self._random.random() < lost.amount:
            return
        body = bytes([servo["id"] if told is None else told, len(data) + 2, servo["status"]]) + data
        reply = b"\xff\xff" + body + bytes([checksum(body)])
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
        self._outgoing.sort()


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


def _factory(registers: Mapping[str, int]) -> bytearray:
    """The memory of a new servo, but for some registers."""
    memory = bytearray(MEMORY)
    for name, value in {**DEFAULTS, **registers}.items():
        register = REGISTERS[name]
        memory[register.address : register.address + register.size] = encoded(name, value)
    return memory


def _memory(servo: Sts3215, address: int, size: int) -> bytes:
    """Registers from an address on; beyond the last there are zeros."""
    return bytes(servo.memory[address : address + size]).ljust(size, b"\0")
