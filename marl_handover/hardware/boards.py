"""The boards of a cell, one or two, as one thing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from marl_handover.hardware.clock import Clock
from marl_handover.hardware.errors import PortLost, TooSlow, WrongState
from marl_handover.hardware.protocol import PULSE_US, SPEED_US_S, TIME_MS, group_move, stop
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.hardware.ssc32 import SentLine, Ssc32
from marl_handover.hardware.transport import BITS_PER_BYTE
from marl_handover.hardware.wiring import board_channels

STOP_WITHIN_S = 0.04
"""From the stop being latched to its last byte at a board, at worst."""

PulsesOfBoards = Mapping[str, Mapping[int, int]]
"""Board -> channel -> pulse in us."""


class Boards:
    """Every board that an arm is wired to; ``by_name`` holds each. ``attend``: see :class:`Ssc32`."""

    def __init__(self, config: HardwareConfig, clock: Clock, *, dry_run: bool = False, attend: Callable[[], object] = lambda: None) -> None:
        self.by_name = {
            name: Ssc32(name, config.boards[name], config.timeouts, clock, log_entries=config.log_entries, dry_run=dry_run, attend=attend)
            for name in config.used_boards()
        }
        self._channels = {name: board_channels(config, name) for name in self.by_name}
        self._tolerance_us = config.stream.pulse_tolerance_us
        self._look_s = config.stream.poll_s + config.stream.backlog_s

    def connect(self) -> None:
        """Connect all. Raises as :meth:`Ssc32.connect`, and :class:`TooSlow`; then none is left open."""
        try:
            for name, board in self.by_name.items():
                board.connect()
                takes_s = self.stop_s(name, board.wire.baud)
                if takes_s > STOP_WITHIN_S:
                    raise TooSlow(name, board.wire.baud, takes_s, STOP_WITHIN_S)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let all ports go."""
        for board in self.by_name.values():
            board.close()

    def stop_s(self, name: str, baud: int) -> float:
        """How long a stop takes at worst to reach the last channel of a board: it is noticed late, and waits for the longest line."""
        channels = self._channels[name]
        longest = group_move(dict.fromkeys(channels, PULSE_US[1]), TIME_MS[1], dict.fromkeys(channels, SPEED_US_S[1]))
        return self._look_s + (len(longest) + len(stop(channels))) * BITS_PER_BYTE / baud

    def pulses(self) -> dict[str, dict[int, int | None]]:
        """What all wired channels put out; None: no pulse, and so no known position."""
        return {name: board.pulses(self._channels[name]) for name, board in self.by_name.items()}

    def require_pulses(self) -> None:
        """Ask whether every wired channel puts out what it was sent by now. Raises as :meth:`Ssc32.require_pulses`."""
        for name, board in self.by_name.items():
            board.require_pulses(self._channels[name], self._tolerance_us)

    def stand(self, pulses: Mapping[str, Mapping[int, int | None]]) -> None:
        """Take readings for where the channels stand. See :meth:`Ssc32.stands`."""
        for name, found in pulses.items():
            self.by_name[name].stands({channel: pulse for channel, pulse in found.items() if pulse is not None})

    def backlog_s(self, names: Iterable[str]) -> float:
        """How long the last byte written to any of these boards is still on its way."""
        return max((self.by_name[name].wire.backlog_s() for name in names), default=0.0)

    def first_move(self, pulses: PulsesOfBoards, time_ms: int | None) -> tuple[SentLine, ...]:
        """As :meth:`Ssc32.first_move`, board by board."""
        return tuple(self.by_name[name].first_move(found, time_ms) for name, found in pulses.items())

    def stop(self) -> bool:
        """Stop every channel of every board that can be reached; whether all could."""
        reached = True
        for name, board in self.by_name.items():
            try:
                board.stop(self._channels[name])
            except (PortLost, WrongState):
                reached = False
        return reached

    def limp(self) -> None:
        """No more pulses on any channel, but for a dry run. Raises :class:`PortLost`, after all boards were tried."""
        lost: PortLost | None = None
        for name, board in self.by_name.items():
            try:
                board.limp(self._channels[name])
            except PortLost as error:
                lost = error
        if lost is not None:
            raise lost
