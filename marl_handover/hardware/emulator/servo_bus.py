"""Bus servos that are not there behind one port: the wire that they share, its time, and what goes wrong on it.

A reply waits for the servo's return delay and a fixed time of thinking. Two servos of one id answer at once, and the line carries the AND
of their bytes, as an open-drain line does.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.config import require_choice
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.emulator.device import BITS_PER_BYTE, Fault, SerialDevice, parse_faults
from marl_handover.hardware.emulator.sts3215 import Sts3215, Sts3215Truth
from marl_handover.hardware.feetech import (
    ACTION,
    BROADCAST,
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
from marl_handover.hardware.settings import COUNTS, COUNTS_PER_RAD, SERVO_BAUDS, HardwareConfig

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

_LOAD_STEP_RAD = math.radians(1.0)


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
        return (bytes([byte]) for byte in data) if self.echo else (data,)

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
        """Bytes have arrived at all servos."""
        if self.echo:
            self._say(t_s, piece)
        self._heard = (self._heard + piece)[-1000:]
        found = find_packets(self._heard)
        if found:
            self._heard = b""
        for body in found:
            self.lines.append((t_s, body))
            if not self._active("silent") and not self._active("brownout"):
                self._obey(t_s, body)

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
                    self._answer(t_s + number * slot_s, servo, servo.read(data[0], data[1]))
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
                answer = servo.read(*data)
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
        if not self._outgoing or self._outgoing[-1][0] + 0.6 * byte_s <= t_s + byte_s:
            self._outgoing.extend((t_s + number * byte_s, byte) for number, byte in enumerate(data, start=1))
            return
        for number, byte in enumerate(data):
            at_s = t_s + (number + 1) * byte_s
            for index, (other_s, other) in enumerate(self._outgoing):
                if abs(other_s - at_s) < 0.6 * byte_s:
                    self._outgoing[index] = other_s, other & byte
                    break
            else:
                self._outgoing.append((at_s, byte))
        self._outgoing = deque(sorted(self._outgoing))


class EmulatedServoCell:
    """Buses and servos as the settings wire them, each servo with a zero, a stiffness and play of its own, drawn from the seed.

    Args:
        config: the electronics, wired for the cell's arms alone; ``config.emulator`` says what the servos are like.
        arm: kinematics; their limits say where the end stops are.
        standing_rad: (5,) where the joints stand when nothing was ever switched on.
        gripper_mm: the same of the fingers.
        holding_n_m: joints (n, 5) -> the torques (n, 3) that hold shoulder, elbow and wrist pitch up; None: nothing weighs anything.
    """

    def __init__(
        self,
        config: HardwareConfig,
        arm: ArmModel,
        standing_rad: ArrayLike,
        gripper_mm: float = 12.0,
        holding_n_m: Callable[[Floats], Floats] | None = None,
    ) -> None:
        config.validate()
        self.config, self._arm, self._holding_n_m = config, arm, holding_n_m
        self._draw, emulator = random.Random(config.emulator.seed), config.emulator
        self._signs = [source.sign for source in arm.description.sources]
        self._middles = [-source.sign * source.offset_rad for source in arm.description.sources]
        self.zeros: dict[str, list[float]] = {}
        """Arm -> the counts that the five joints' servos tell where the URDF's joints are 0, then where the hand is closed."""
        self._homing: dict[str, list[int]] = {}
        self._own: list[list[Sts3215]] = []
        listed: dict[str, list[Sts3215]] = {name: [] for name in config.used_boards()}
        for name, wiring in config.arms.items():
            ids, own = config.channels(name), list[Sts3215]()
            self.zeros[name] = [COUNTS / 2 + self._turn(emulator.bus_zero_deg) for _ in ARM_JOINTS]
            self.zeros[name].append(wiring.gripper.closed_us + self._turn(emulator.bus_zero_deg / 4))
            self._homing[name] = [round(self._turn(60.0)) for _ in ids]
            for index, servo in enumerate(ids):
                limits = self._end_stops(name, index)
                truth = Sts3215Truth(
                    *limits,
                    play=self._turn(*reversed(emulator.bus_play_deg)),
                    stiffness=1.0 + self._draw.uniform(-1.0, 1.0) * emulator.bus_stiffness_share,
                    supply_v=emulator.supply_v,
                )
                registers = {"homing_offset": self._homing[name][index]}
                own.append(Sts3215(servo, COUNTS / 2, truth, registers))
            listed[wiring.board] += own
            self._own.append(own)
        self.devices = {name: EmulatedBus(servos, seed=emulator.seed) for name, servos in listed.items()}
        for name, bus in self.devices.items():
            bus.baud = config.boards[name].baud
        self._loaded_at: Floats | None = None
        self._supported: set[int] = set()
        for number in range(len(config.arms)):
            self.put(number, standing_rad, 0.0)
            self.put_hand(number, gripper_mm, 0.0)

    def mount(self, clock: Clock) -> dict[str, str]:
        """Put every bus behind the URL ``ssc32emu://<its name>``; the URLs by bus."""
        from marl_handover.hardware.emulator.protocol_ssc32emu import mount

        return {name: mount(name, device, clock) for name, device in self.devices.items()}

    def joints_rad(self, t_s: float) -> Floats:
        """Where the joints truly are: (num_arms, 5)."""
        return self._positions(t_s)[0]

    def gripper_mm(self, t_s: float) -> Floats:
        """How far each hand's pads would be from closed if nothing were between them: (num_arms,)."""
        return self._positions(t_s)[1]

    def put(self, arm: int, joints_rad: ArrayLike, t_s: float) -> None:
        """Turn an arm's joints (5,) by hand; servos that hold turn back. The hand stays under it until a servo holds."""
        self._advance(t_s)
        self._supported.add(arm)
        self._loaded_at = None
        name = tuple(self.config.arms)[arm]
        for index, (servo, angle) in enumerate(zip(self.servos(arm), np.asarray(joints_rad, float), strict=False)):
            servo.put(self._raw(name, index, float(angle)))

    def put_hand(self, arm: int, gripper_mm: float, t_s: float) -> None:
        """Open or close a hand by hand."""
        self._advance(t_s)
        name, hand = tuple(self.config.arms)[arm], self._arm.description.gripper
        turned = (hand.joint_values(gripper_mm)[hand.joints[0]] - hand.closed[0]) / hand.opening[0]
        self.servos(arm)[-1].put(self.zeros[name][-1] + self._homing[name][-1] + turned * COUNTS_PER_RAD)

    def servos(self, arm: int) -> list[Sts3215]:
        """An arm's servos, the gripper's last."""
        return self._own[arm]

    def limp_arms(self, t_s: float) -> list[int]:
        """Arms of which no joint holds."""
        self._advance(t_s)
        return [arm for arm, own in enumerate(self._own) if not any(servo.holds for servo in own[:-1])]

    def told(self, t_s: float) -> Floats:
        """What the joints' servos tell of where they stand, in counts (num_arms, 5); 0 of one that does not hold."""
        self._advance(t_s)
        return np.array([[servo["present_position"] if servo.holds else 0 for servo in own[:-1]] for own in self._own], float)

    def _advance(self, t_s: float) -> None:
        for device in self.devices.values():
            device.advance(t_s)

    def _positions(self, t_s: float) -> tuple[Floats, Floats]:
        """Joints (num_arms, 5) and fingers (num_arms,); loads are those of the joints."""
        self._advance(t_s)
        joints, fingers = [], []
        hand = self._arm.description.gripper
        for number, name in enumerate(self.config.arms):
            counts = [servo.at - homing for servo, homing in zip(self._own[number], self._homing[name], strict=True)]
            zeros = self.zeros[name]
            turned = [(count - zero) / COUNTS_PER_RAD for count, zero in zip(counts, zeros, strict=True)]
            joints.append([middle + sign * at for middle, sign, at in zip(self._middles, self._signs, turned, strict=False)])
            fingers.append(hand.gripper_mm([hand.closed[0] + hand.opening[0] * turned[-1]]))
        found = np.array(joints)
        self._load(found)
        return found, np.array(fingers)

    def _load(self, joints_rad: Floats) -> None:
        """Let gravity pull at the servos; a turn of a degree changes little."""
        if self._holding_n_m is None:
            return
        let_go = [arm for arm in self._supported if any(servo.holds for servo in self._own[arm][:-1])]
        if let_go:
            self._supported.difference_update(let_go)
            self._loaded_at = None
        if self._loaded_at is not None and np.abs(joints_rad - self._loaded_at).max() < _LOAD_STEP_RAD:
            return
        self._loaded_at = joints_rad.copy()
        for arm, (servos, torques) in enumerate(zip(self._own, self._holding_n_m(joints_rad), strict=True)):
            for servo, sign, torque in zip(servos[1:4], self._signs[1:4], torques, strict=True):
                servo.load_nm = 0.0 if arm in self._supported else float(sign * torque)

    def _raw(self, name: str, index: int, angle_rad: float) -> float:
        """Counts of the encoder itself at a joint's angle."""
        turned = self._signs[index] * (angle_rad - self._middles[index])
        return self.zeros[name][index] + self._homing[name][index] + turned * COUNTS_PER_RAD

    def _end_stops(self, name: str, index: int) -> tuple[float, float]:
        """Counts of the encoder where a servo can go no further."""
        beyond = math.radians(self.config.emulator.end_stop_deg)
        if index < len(ARM_JOINTS):
            ends = self._arm.lower_rad[index] - beyond, self._arm.upper_rad[index] + beyond
            low, high = sorted(self._raw(name, index, float(end)) for end in ends)
            return low, high
        closed = self.zeros[name][-1] + self._homing[name][-1]
        return closed, closed + COUNTS / 3

    def _turn(self, most_deg: float, least_deg: float | None = None) -> float:
        """Counts of an angle between limits; between minus and plus the greater one without a least."""
        return self._draw.uniform(-most_deg if least_deg is None else least_deg, most_deg) * COUNTS / 360
