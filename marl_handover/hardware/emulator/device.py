"""A board with its servos at the far end of a serial line: bytes take their time, and things go wrong when they are told to."""

from __future__ import annotations

import heapq
import math
import random
import re
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.config import require_choice
from marl_handover.errors import BadOverride
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.emulator.board import FRAME_S, EmulatedBoard, Servo, ServoTruth
from marl_handover.hardware.settings import HardwareConfig

KINDS = {
    "unplug": "the USB cable is out",
    "brownout": "the supply breaks down: the board forgets everything (an instant; the duration is how long it is off)",
    "silent": "no supply for the controller: the port is there, nothing answers, nothing moves",
    "drop": "replies get lost, each with the given probability (1)",
    "corrupt": "reply bytes change, each with the given probability (0.5)",
    "late": "replies come the given time late (0.25 s)",
    "stuck": "Q says that a move goes on, for ever",
    "ignore": "moves are not carried out, each with the given probability (1)",
    "random": "QP answers pulses at random, each with the given probability (1)",
    "frozen": "QP answers what it did when the fault began",
    "jam": "the servo of the given channel (0) is held fast",
}
_USUAL = {"drop": 1.0, "corrupt": 0.5, "late": 0.25, "jam": 0.0, "ignore": 1.0, "random": 1.0}


@dataclass(frozen=True)
class Fault:
    """A fault of a kind from ``start_s`` on the device's clock, for ``duration_s``. What ``amount`` means depends on the kind."""

    kind: str
    start_s: float
    duration_s: float = math.inf
    amount: float = 0.0

    @property
    def end_s(self) -> float:
        """When it is over."""
        return self.start_s + self.duration_s

    def active(self, t_s: float) -> bool:
        """Whether it is in force."""
        return self.start_s <= t_s < self.end_s


def make_fault(
    kind: str,
    start_s: float,
    duration_s: float | None = None,
    amount: float | None = None,
    *,
    kinds: Mapping[str, str] = KINDS,
    usual: Mapping[str, float] = _USUAL,
) -> Fault:
    """A fault of one of ``kinds``, with its usual amount and duration where none is given. Raises :class:`UnknownChoice` for another."""
    require_choice("fault", kind, tuple(kinds))
    lasting = (0.0 if kind == "brownout" else math.inf) if duration_s is None else duration_s
    return Fault(kind, start_s, lasting, usual.get(kind, 0.0) if amount is None else amount)


def parse_faults(text: str, *, kinds: Mapping[str, str] = KINDS, usual: Mapping[str, float] = _USUAL) -> list[Fault]:
    """Faults of a text ``kind@start[:duration][=amount]``, separated by commas; times in s.

    Raises :class:`UnknownChoice` for an unknown kind and :class:`BadOverride` for what cannot be read.
    """
    faults = []
    for item in filter(None, (part.strip() for part in text.split(","))):
        head, _, amount = item.partition("=")
        kind, at, times = head.partition("@")
        start, _, duration = times.partition(":")
        try:
            numbers = [float(number) if number else None for number in (start if at else "0", duration, amount)]
        except ValueError:
            raise BadOverride(f"faults={item}", "expected kind@start[:duration][=amount], such as unplug@5:1.5") from None
        if any(number is not None and not (math.isfinite(number) and number >= 0) for number in numbers):
            raise BadOverride(f"faults={item}", "times and amounts are finite and not negative")
        faults.append(make_fault(kind, numbers[0] or 0.0, numbers[1], numbers[2], kinds=kinds, usual=usual))
    return faults


BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""

_ANSWER_S, _REPLY_DELAY_S, _BYTE_GAP_S = 100e-6, 1e-6 * 600, 1e-6 * 70
"""How long the board thinks, and, as it is delivered, waits before a reply and between its bytes."""

_POWER = ("brownout", "silent")


class SerialDevice(ABC):
    """What is behind a serial port: bytes take their time on the line, and faults begin and end.

    All times are in s on one clock, and never go back; nothing happens but by :meth:`advance`.

    Args:
        baud: what it is set to.
        seed: of what faults change at random.
    """

    def __init__(self, baud: int, seed: int) -> None:
        self.baud = self.host_baud = baud
        self.lines: deque[tuple[float, bytes]] = deque(maxlen=1000)
        """The last lines, or packets, that came in, and when each ended."""
        self.unplugged = 0
        """How many times the cable came out; a port that was open then is dead, even if the cable is back."""
        self._random = random.Random(seed)
        self._incoming: deque[tuple[float, bytes]] = deque()
        self._outgoing: deque[tuple[float, int]] = deque()
        self._heard_until_s, self._now_s = 0.0, 0.0
        self._faults: list[Fault] = []
        self._edges: list[tuple[float, int, bool, Fault]] = []

    @property
    @abstractmethod
    def title(self) -> str:
        """What it is, in a few words."""

    @property
    def plugged(self) -> bool:
        """Whether the port is there, at the time the device was last advanced to."""
        return not self._active("unplug")

    def add_faults(self, faults: Iterable[Fault]) -> None:
        """Let things go wrong, at the times the faults say; a start in the past is now."""
        for fault in faults:
            self._faults.append(fault)
            heapq.heappush(self._edges, (fault.start_s, len(self._faults), True, fault))
            if fault.duration_s < float("inf"):
                heapq.heappush(self._edges, (self._over_s(fault), len(self._faults), False, fault))
        self.advance(self._now_s)

    def write(self, data: bytes, t_s: float) -> None:
        """Bytes from the computer; they arrive one after the other at the line's pace."""
        self.advance(t_s)
        begin_s, per_byte_s, count = max(t_s, self._heard_until_s), BITS_PER_BYTE / self.host_baud, 0
        for piece in self._pieces(data):
            if piece:
                count += len(piece)
                self._incoming.append((begin_s + count * per_byte_s, piece))
        self._heard_until_s = begin_s + count * per_byte_s

    def read(self, t_s: float, size: int | None = None) -> bytes:
        """Up to ``size`` bytes that have come back by ``t_s``; all of them without ``size``."""
        self.advance(t_s)
        out = bytearray()
        while self._outgoing and self._outgoing[0][0] <= t_s and (size is None or len(out) < size):
            out.append(self._outgoing.popleft()[1])
        return bytes(out)

    def waiting(self, t_s: float) -> int:
        """Number of bytes that have come back and were not read."""
        self.advance(t_s)
        return sum(at_s <= t_s for at_s, _ in self._outgoing)

    def next_event_s(self, size: int = 1) -> float | None:
        """When something may happen next that somebody could notice who waits for ``size`` bytes; None if nothing is under way."""
        times = [self._incoming[0][0]] if self._incoming else []
        times += [self._outgoing[min(size, len(self._outgoing)) - 1][0]] if self._outgoing else []
        times += [edge[0] for edge in self._edges[:1]]
        return min(times) if times else None

    def sending_until_s(self) -> float:
        """When the last byte written will have arrived."""
        return self._heard_until_s

    def forget_input(self) -> None:
        """Throw away what has come back, as opening or flushing a port does."""
        while self._outgoing and self._outgoing[0][0] <= self._now_s:
            self._outgoing.popleft()

    def advance(self, t_s: float) -> None:
        """Let everything happen up to ``t_s``, in order."""
        while True:
            piece_s = self._incoming[0][0] if self._incoming else float("inf")
            edge_s = self._edges[0][0] if self._edges else float("inf")
            if min(piece_s, edge_s) > t_s:
                break
            self._follow(min(piece_s, edge_s))
            if edge_s <= piece_s:
                _, _, begins, fault = heapq.heappop(self._edges)
                if not begins:
                    self._faults.remove(fault)
                self._edge(fault, begins)
            else:
                self._hear(*self._incoming.popleft())
        self._follow(t_s)

    def _active(self, kind: str) -> Fault | None:
        return next((fault for fault in self._faults if fault.kind == kind and fault.active(self._now_s)), None)

    def _over_s(self, fault: Fault) -> float:
        """When a fault has no more effect."""
        return fault.end_s

    def _pull_out(self, begins: bool) -> None:
        """The cable comes out, or is put back: what was on the line is gone."""
        self.unplugged += begins
        self._incoming.clear()
        self._outgoing.clear()
        self._heard_until_s = self._now_s

    @abstractmethod
    def _pieces(self, data: bytes) -> Iterable[bytes]:
        """What is heard of bytes, in the pieces in which it is looked at."""

    @abstractmethod
    def _edge(self, fault: Fault, begins: bool) -> None:
        """A fault begins or ends."""

    @abstractmethod
    def _hear(self, t_s: float, piece: bytes) -> None:
        """Bytes have arrived."""

    @abstractmethod
    def _follow(self, t_s: float) -> None:
        """Let servos move up to a time."""


class EmulatedDevice(SerialDevice):
    """A controller with its servos.

    Args:
        board: the controller.
        servos: by channel.
        baud: what the board's button or jumpers are set to.
        boot_s: how long the board takes from power to its first ear for bytes.
        seed: of what faults change at random.
    """

    def __init__(
        self, board: EmulatedBoard, servos: Mapping[int, Servo] | None = None, *, baud: int = 115200, boot_s: float = 0.2, seed: int = 0
    ) -> None:
        super().__init__(baud, seed)
        self.board, self.servos, self.boot_s = board, dict(servos or {}), boot_s
        self._said_until_s = 0.0
        self._powered, self._fragment = True, b""

    @property
    def title(self) -> str:
        """Its firmware's own name."""
        return self.board.firmware.text

    @property
    def powered(self) -> bool:
        """Whether the controller runs."""
        return self._powered

    def _over_s(self, fault: Fault) -> float:
        return fault.end_s + (self.boot_s if fault.kind in _POWER else 0.0)

    def _pieces(self, data: bytes) -> Iterable[bytes]:
        return re.split(rb"(?<=\r)", data if self.host_baud == self.baud else self._random.randbytes(len(data)))

    def outputs_us(self, t_s: float) -> list[float]:
        """What each channel puts out; 0: no pulse."""
        self.advance(t_s)
        return self.board.outputs_us(t_s) if self._powered else [0.0] * len(self.board.channels)

    def _edge(self, fault: Fault, begins: bool) -> None:
        """A fault begins or ends."""
        if fault.kind == "unplug":
            self._pull_out(begins)
            self._said_until_s = self._now_s
        elif fault.kind in _POWER:
            # Off while any such fault is on: they may overlap.
            self._powered = not any(other.kind in _POWER and other.start_s <= self._now_s for other in self._faults)
            self._outgoing.clear()
            if self._powered:
                self.board.power_up(self._now_s)
        elif fault.kind == "stuck":
            self.board.stuck = begins
        elif fault.kind == "ignore":
            self.board.ignored = fault.amount if begins else 0.0
        elif fault.kind == "random":
            self.board.guessed = fault.amount if begins else 0.0
        elif fault.kind == "frozen":
            self.board.told = None
            if begins:
                self.board.freeze_told(self._now_s)
        elif fault.kind == "jam" and int(fault.amount) in self.servos:
            self.servos[int(fault.amount)].jammed = begins

    def _hear(self, t_s: float, piece: bytes) -> None:
        """Bytes have arrived at the board."""
        if not self._powered:
            return
        self._fragment = (self._fragment + piece)[-1024:]
        if piece.endswith(b"\r"):
            self.lines.append((t_s, self._fragment))
            self._fragment = b""
        for reply in self.board.receive(piece, t_s):
            if (lost := self._active("drop")) and self._random.random() < lost.amount:
                continue
            late = self._active("late")
            at_s = max(t_s + _ANSWER_S + _REPLY_DELAY_S + (late.amount if late else 0.0), self._said_until_s)
            for byte in self._damaged(reply):
                at_s += BITS_PER_BYTE / self.baud + _BYTE_GAP_S
                self._outgoing.append((at_s, byte))
            self._said_until_s = at_s

    def _damaged(self, data: bytes) -> bytes:
        if self.host_baud != self.baud:
            return self._random.randbytes(len(data))
        fault = self._active("corrupt")
        if fault is None:
            return data
        return bytes(byte ^ self._random.randrange(1, 256) if self._random.random() < fault.amount else byte for byte in data)

    def _follow(self, t_s: float) -> None:
        """Let the servos follow their pulses up to ``t_s``."""
        while self._now_s < t_s:
            frame = self.board.frame(self._now_s)
            until_s = min(t_s, self.board.on_since_s + (frame + 1) * FRAME_S) if self._powered and self.servos else t_s
            for number, servo in self.servos.items():
                servo.step(self.board.channels[number].output(frame) if self._powered else 0.0, until_s - self._now_s)
            self._now_s = until_s


class EmulatedCell:
    """Boards and servos as the settings wire them, each servo with a scale, an offset and a dead band of its own, drawn from the seed.

    Args:
        config: the electronics, wired for the cell's arms alone; ``config.emulator`` says what the servos are like.
        arm: kinematics; their limits say where the end stops are.
        standing_rad: (5,) where the joints stand when nothing was ever switched on: whoever sets up a cell puts the arms there.
        gripper_mm: the same of the fingers.
    """

    def __init__(self, config: HardwareConfig, arm: ArmModel, standing_rad: ArrayLike, gripper_mm: float = 12.0) -> None:
        config.validate()
        self.config, self._arm = config, arm
        self._random = random.Random(config.emulator.seed)
        self.truths = {name: self._drawn(name) for name in config.arms}
        """Arm -> the five joints' servos as they truly are, then the gripper's."""
        servos: dict[str, dict[int, Servo]] = {name: {} for name in config.used_boards()}
        stand = [*(float(angle) for angle in np.asarray(standing_rad, float)), gripper_mm]
        for arm_name, truths in self.truths.items():
            for channel, truth, position in zip(config.channels(arm_name), truths, stand, strict=True):
                servos[config.arms[arm_name].board][channel] = Servo(truth, position, self._random.randrange(2**31))
        emulator = config.emulator
        self.devices = {
            name: EmulatedDevice(
                EmulatedBoard(emulator.firmware, emulator.seed),
                found,
                baud=config.boards[name].baud,
                boot_s=emulator.boot_s,
                seed=emulator.seed,
            )
            for name, found in servos.items()
        }

    def mount(self, clock: Clock) -> dict[str, str]:
        """Put every board behind the URL ``ssc32emu://<its name>``; the URLs by board."""
        from marl_handover.hardware.emulator.protocol_ssc32emu import mount

        return {name: mount(name, device, clock) for name, device in self.devices.items()}

    def joints_rad(self, t_s: float) -> Floats:
        """Where the joints truly are: (num_arms, 5)."""
        return self._positions(t_s)[:, :-1]

    def gripper_mm(self, t_s: float) -> Floats:
        """How far each hand's fingers would be from closed if nothing were between them: (num_arms,)."""
        return self._positions(t_s)[:, -1]

    def put(self, arm: int, joints_rad: ArrayLike, t_s: float) -> None:
        """Turn an arm's joints (5,) by hand; servos that get a pulse turn back."""
        self._positions(t_s)
        for servo, angle in zip(self.servos(arm), np.asarray(joints_rad, float), strict=False):
            servo.put(float(angle))

    def put_hand(self, arm: int, gripper_mm: float, t_s: float) -> None:
        """Open or close a hand by hand."""
        self._positions(t_s)
        self.servos(arm)[-1].put(gripper_mm)

    def limp_arms(self, t_s: float) -> list[int]:
        """Arms that somebody has to put where they should stand: all, if no servo gets a pulse."""
        held = any(any(device.outputs_us(t_s)) for device in self.devices.values())
        return [] if held else list(range(len(self.config.arms)))

    def told(self, t_s: float) -> Floats:
        """Pulses (num_arms, 5) that the joints' servos get; 0: none."""
        outputs = {name: device.outputs_us(t_s) for name, device in self.devices.items()}
        return np.array([[outputs[wiring.board][channel] for channel in wiring.channels] for wiring in self.config.arms.values()])

    def servos(self, arm: int) -> list[Servo]:
        """An arm's servos, the gripper's last."""
        name = tuple(self.config.arms)[arm]
        device = self.devices[self.config.arms[name].board]
        return [device.servos[channel] for channel in self.config.channels(name)]

    def _positions(self, t_s: float) -> Floats:
        for device in self.devices.values():
            device.advance(t_s)
        return np.array([[servo.position for servo in self.servos(arm)] for arm in range(len(self.config.arms))])

    def _drawn(self, arm: str) -> list[ServoTruth]:
        """The servos of an arm."""
        config, emulator = self.config, self.config.emulator
        beyond = math.radians(emulator.end_stop_deg)
        speeds = [math.radians(speed) for speed in emulator.speed_deg_s]
        truths = []
        for index, joint in enumerate(ARM_JOINTS):
            nominal = config.nominal[joint]
            zero_us = nominal.zero_us + self._error(emulator.offset_sd_us)
            slope = math.degrees(nominal.us_per_deg) * (1 + self._error(emulator.scale_sd))
            low, high = self._arm.lower_rad[index] - beyond, self._arm.upper_rad[index] + beyond
            truths.append(self._truth(zero_us, slope, float(low), float(high), speeds[index]))
        gripper = config.arms[arm].gripper
        zero_us = gripper.closed_us + self._error(emulator.offset_sd_us)
        slope = (gripper.open_us - gripper.closed_us) / gripper.open_mm * (1 + self._error(emulator.scale_sd))
        radius_mm = 10.0  # of the gripper servo's crank
        truths.append(self._truth(zero_us, slope, 0.0, config.gate.finger_mm + 1.0, speeds[-1] * radius_mm))
        return truths

    def _truth(self, zero_us: float, slope_us: float, low: float, high: float, speed: float) -> ServoTruth:
        emulator = self.config.emulator
        band_us = max(0.0, emulator.dead_band_us + self._error(emulator.dead_band_sd_us))
        return ServoTruth(zero_us, slope_us, low, high, speed, band_us, emulator.lag_s, emulator.settle_sd_us)

    def _error(self, sd: float) -> float:
        return max(-2.0, min(2.0, self._random.gauss(0.0, 1.0))) * sd
