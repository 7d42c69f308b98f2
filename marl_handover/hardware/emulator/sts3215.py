"""A Feetech STS3215 servo that is not there: its registers, and how it moves, gives way and protects itself.

Where sources differ on what a servo does, the choice is said here: at power-up torque is off, the goal is where the shaft is, and the lock
is shut.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from marl_handover.hardware.feetech import (
    FIRST_RAM,
    MEMORY,
    MODEL,
    REGISTERS,
    Status,
    decoded,
    encoded,
)
from marl_handover.hardware.settings import COUNTS

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
_MOVING = (
    *("p", "torque_limit", "max_torque", "overload_torque", "overload_threshold", "overload_time", "unloading", "phase", "torque_enable"),
    *("dead_zone_cw", "dead_zone_ccw", "max_acceleration", "acceleration", "goal_speed", "max_speed"),
)
"""Registers that say how it moves."""

_MOVING = (
    *("p", "torque_limit", "max_torque", "overload_torque", "overload_threshold", "overload_time", "unloading", "phase", "torque_enable"),
    *("dead_zone_cw", "dead_zone_ccw", "max_acceleration", "acceleration", "goal_speed", "max_speed"),
)
"""Registers that say how it moves."""

_STILL = 1e-3
"""Counts in a step below which a shaft is at rest."""

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
    ``stiffness``: of the usual one, at equal gains; ``supply_v`` and ``ambient_c``: volts and degrees Celsius where it stands.
    """

    low: float = 0.0
    high: float = COUNTS - 1.0
    play: float = 0.0
    stiffness: float = 1.0
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
        self._resting: tuple[float, ...] | None = None  # in what state another step would change nothing
        self._told = False
        self._stored = _factory({"id": servo, **(registers or {})})
        self._pending: list[tuple[int, bytes]] = []
        self._motor = self._motor_goal = self.at
        self._speed, self._strained_s, self.temperature_c = 0.0, 0.0, self.truth.ambient_c
        self._overload = self._drive = self._velocity = 0.0
        self.power_up()

    def __getitem__(self, name: str) -> int:
        register = REGISTERS[name]
        if not register.writable and not self._told:
            self._tell()
        return decoded(name, bytes(self._memory[register.address : register.address + register.size]))

    def __setitem__(self, name: str, value: int) -> None:
        register = REGISTERS[name]
        self._memory[register.address : register.address + register.size] = encoded(name, value)

    def read(self, address: int, size: int) -> bytes:
        """Registers from an address on; beyond the last there are zeros."""
        if not self._told:
            self._tell()
        return bytes(self._memory[address : address + size]).ljust(size, b"\0")

    def power_up(self) -> None:
        """Forget all but EEPROM; the shaft stays where it is."""
        self._memory = bytearray(self._stored)
        self._pending.clear()
        self._motor = self._motor_goal = self.at
        self._speed, self._strained_s, self._overload = 0.0, 0.0, 0.0
        self["torque_limit"], self["lock"] = self["max_torque"], 1
        self._changed()

    def take(self, address: int, data: bytes) -> None:
        """Write registers from an address on; read-only ones stay as they are."""
        fixed = {a for r in REGISTERS.values() if not r.writable for a in range(r.address, r.address + r.size)}
        touched = {address + offset for offset in range(len(data))}
        was = self["torque_enable"]
        unlocked = self["lock"] == 0
        for offset, byte in enumerate(data):
            where = address + offset
            if where < MEMORY and where not in fixed:
                self._memory[where] = byte
                if where < FIRST_RAM and unlocked:
                    self._stored[where] = byte
        if REGISTERS["torque_enable"].address in touched:
            self._switch(was)
        if REGISTERS["goal_position"].address in touched and self["mode"] in (0, 3):
            if not self["torque_enable"]:
                self._motor, self._speed = self.at, 0.0
            self["torque_enable"] = 1
            self._motor_goal = self._allowed(self["goal_position"])
        self._changed()

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
        self._resting, self._told = None, False

    def latch_overload(self) -> None:
        """An overload as after too long a strain."""
        self._overload = math.copysign(1.0, self._motor_goal - self.at)
        self._changed()

    def step(self, duration_s: float) -> None:
        """Move on."""
        while duration_s > 0:
            state = (self.at, self._motor, self.load_nm, float(self.jammed), self._strained_s)
            if state == self._resting:
                return
            part = min(duration_s, STEP_S)
            self._move(part)
            duration_s -= part
            self._told = False
            now = (self.at, self._motor, self.load_nm, float(self.jammed), self._strained_s)
            still = self._motor == self._motor_goal and abs(now[0] - state[0]) < _STILL and now[1:] == state[1:]
            self._resting = now if still else None

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
                self._stored[where] = self._memory[where]
            self["torque_enable"] = was
        elif not wanted:
            self._overload = self._strained_s = 0.0
        elif not was:
            self._motor = self._motor_goal = self.at
            self._speed = 0.0

    def _changed(self) -> None:
        """Registers are not what they were: look at them anew."""
        self._resting, self._told = None, False
        self._now = {name: self[name] for name in _MOVING}

    def _allowed(self, goal: int) -> float:
        """Counts of the encoder that a goal means."""
        low, high = self["min_position"], self["max_position"]
        if low or high:
            goal = min(max(goal, low), high)
        return float(goal + self["homing_offset"])

    def _move(self, duration_s: float) -> None:
        strength = STALL_NM * self.truth.supply_v / STALL_V * min(self._now["torque_limit"], self._now["max_torque"]) / 1000
        if self._overload and math.copysign(1.0, self._motor_goal - self.at) == self._overload:
            strength *= self._now["overload_torque"] / 100
        if self._now["torque_enable"] != 1:
            self._motor = self._motor_goal = self.at
            self._speed = 0.0
            self._fall(self.load_nm, duration_s)
            self._drive, self._velocity = 0.0, 0.0
            return
        self._profile(duration_s)
        stiff = STIFFNESS_NM * self.truth.stiffness * self._now["p"] / FACTORY_P
        error = self._motor - self.at
        zone = self._now["dead_zone_cw"] if error < 0 else self._now["dead_zone_ccw"]
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
        self._strain(abs(drive) >= strength * self._now["overload_threshold"] / 100, duration_s, drive)

    def _strain(self, strained: bool, duration_s: float, drive: float) -> None:
        """Too much for too long, and the servo lets go of most of its torque until it is switched off or turns back."""
        if self._overload and drive * self._overload < 0:
            self._overload = 0.0
        self._strained_s = self._strained_s + duration_s if strained else 0.0
        if (
            self._now["overload_time"]
            and self._strained_s >= self._now["overload_time"] * 0.01
            and self._now["unloading"] & Status.OVERLOAD
        ):
            self._overload = math.copysign(1.0, drive)

    def _profile(self, duration_s: float) -> None:
        """The motor's own set point goes to the goal, by a trapezoid of acceleration and speed."""
        most = self._now["max_acceleration"]
        asked = self._now["acceleration"]
        rate = 100.0 * (asked if 0 < asked <= most else most)
        top = abs(self._now["goal_speed"]) or (50.0 * self._now["max_speed"] if self._now["phase"] & 8 else 0.0)
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
        self._told = True
        count = round(self.at - self["homing_offset"])
        self["present_position"] = max(-32767, min(32767, count if self["phase"] & 16 else count % COUNTS))
        self["present_speed"] = max(-32767, min(32767, round(self._velocity)))
        self["present_load"] = max(-1000, min(1000, round(1000 * self._drive)))
        self["present_voltage"] = round(10 * self.truth.supply_v)
        self["present_temperature"] = round(self.temperature_c)
        self["present_current"] = round(abs(self._drive) * 2000 / 6.5)
        self["moving"] = int(self.holds and abs(self._speed) > 0)
        status = Status(0)
        if not self["min_voltage"] <= round(10 * self.truth.supply_v) <= self["max_voltage"]:
            status |= Status.VOLTAGE
        if round(self.temperature_c) > self["max_temperature"]:
            status |= Status.TEMPERATURE
        if self._overload:
            status |= Status.OVERLOAD
        self["status"] = int(status)


def _factory(registers: Mapping[str, int]) -> bytearray:
    """The memory of a new servo, but for some registers."""
    memory = bytearray(MEMORY)
    for name, value in {**DEFAULTS, **registers}.items():
        register = REGISTERS[name]
        memory[register.address : register.address + register.size] = encoded(name, value)
    return memory
