"""A board with its servos at the far end of a serial line: bytes take their time, and things go wrong when they are told to."""

from __future__ import annotations

import heapq
import random
import re
from collections import deque
from collections.abc import Iterable, Mapping

from marl_handover.hardware.emulator.board import FRAME_S, Board
from marl_handover.hardware.emulator.faults import Fault
from marl_handover.hardware.emulator.servo import Servo

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""

_POWER = ("brownout", "silent")


class Device:
    """What is plugged into one port. All times are in s on one clock, and never go back; nothing happens but by :meth:`advance`.

    Args:
        board: the controller.
        servos: by channel.
        baud: what the board's button or jumpers are set to.
        boot_s: how long the board takes from power to its first ear for bytes.
        seed: of what faults change at random.
    """

    def __init__(
        self, board: Board, servos: Mapping[int, Servo] | None = None, *, baud: int = 115200, boot_s: float = 0.2, seed: int = 0
    ) -> None:
        self.board, self.servos = board, dict(servos or {})
        self.baud, self.boot_s = board.baud or baud, boot_s
        self.host_baud = self.baud
        self.lines: deque[tuple[float, bytes]] = deque(maxlen=1000)
        """The last lines that the board was sent, and when each ended."""
        self.unplugged = 0
        """How many times the cable came out; a port that was open then is dead, even if the cable is back."""
        self._random = random.Random(seed)
        self._incoming: deque[tuple[float, bytes]] = deque()
        self._outgoing: deque[tuple[float, int]] = deque()
        self._heard_until_s, self._said_until_s, self._now_s = 0.0, 0.0, 0.0
        self._powered, self._fragment = True, b""
        self._faults: list[Fault] = []
        self._edges: list[tuple[float, int, bool, Fault]] = []

    def add_faults(self, faults: Iterable[Fault]) -> None:
        """Let things go wrong, at the times the faults say; a start in the past is now."""
        for fault in faults:
            self._faults.append(fault)
            heapq.heappush(self._edges, (fault.start_s, len(self._faults), True, fault))
            if fault.duration_s < float("inf"):
                end_s = fault.end_s + (self.boot_s if fault.kind in _POWER else 0.0)
                heapq.heappush(self._edges, (end_s, len(self._faults), False, fault))
        self.advance(self._now_s)

    @property
    def plugged(self) -> bool:
        """Whether the port is there, at the time the device was last advanced to."""
        return not self._active("unplug")

    @property
    def powered(self) -> bool:
        """Whether the controller runs."""
        return self._powered

    def write(self, data: bytes, t_s: float) -> None:
        """Bytes from the computer; they arrive one after the other at the line's pace."""
        self.advance(t_s)
        if self.host_baud != self.baud:
            data = self._random.randbytes(len(data))
        begin_s, per_byte_s, count = max(t_s, self._heard_until_s), BITS_PER_BYTE / self.host_baud, 0
        for piece in re.split(rb"(?<=\r)", data):
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

    def next_event_s(self) -> float | None:
        """When something may happen next that the computer could notice; None if nothing is under way."""
        times = [queue[0][0] for queue in (self._incoming, self._outgoing) if queue] + [edge[0] for edge in self._edges[:1]]
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
            line_s = self._incoming[0][0] if self._incoming else float("inf")
            edge_s = self._edges[0][0] if self._edges else float("inf")
            if min(line_s, edge_s) > t_s:
                break
            self._follow(min(line_s, edge_s))
            if edge_s <= line_s:
                _, _, begins, fault = heapq.heappop(self._edges)
                self._edge(fault, begins)
            else:
                self._hear(*self._incoming.popleft())
        self._follow(t_s)

    def outputs_us(self, t_s: float) -> list[float]:
        """What each channel puts out; 0: no pulse."""
        self.advance(t_s)
        return self.board.outputs_us(t_s) if self._powered else [0.0] * len(self.board.channels)

    def _active(self, kind: str) -> Fault | None:
        return next((fault for fault in self._faults if fault.kind == kind and fault.active(self._now_s)), None)

    def _edge(self, fault: Fault, begins: bool) -> None:
        """A fault begins or ends."""
        if not begins:
            self._faults.remove(fault)
        if fault.kind == "unplug":
            self.unplugged += begins
            self._incoming.clear()
            self._outgoing.clear()
            self._heard_until_s = self._said_until_s = self._now_s
        elif fault.kind in _POWER:
            # Off while any such fault is on: they may overlap.
            self._powered = not any(other.kind in _POWER and other.start_s <= self._now_s for other in self._faults)
            self._outgoing.clear()
            if self._powered:
                self.board.power_up(self._now_s)
                self.baud = self.board.baud or self.baud
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
        delay_s, between_s = self.board.delays_s
        for reply in self.board.receive(piece, t_s):
            if (lost := self._active("drop")) and self._random.random() < lost.amount:
                continue
            late = self._active("late")
            at_s = max(t_s + reply.delay_s + delay_s + (late.amount if late else 0.0), self._said_until_s)
            for byte in self._damaged(reply.data):
                at_s += BITS_PER_BYTE / self.baud + between_s
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
