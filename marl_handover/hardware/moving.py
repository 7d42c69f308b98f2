"""Moves of arms that are ready for them: through the gate, then to the wire, with nothing in between."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.hardware.commanded import SETTLED_S
from marl_handover.hardware.errors import BadCommand, WrongState
from marl_handover.hardware.gate import JointCommand
from marl_handover.hardware.session import BoardSession, State
from marl_handover.hardware.settings import ARMS
from marl_handover.hardware.ssc32 import SentLine

Floats = NDArray[np.float64]


class Sent(NamedTuple):
    """What went out: the lines, and the joints (5,) of each arm that their pulses, whole microseconds, stand for."""

    lines: tuple[SentLine, ...]
    joints_rad: dict[int, Floats]
    duration_s: float


class MovingSession(BoardSession):
    """A session whose arms can be sent somewhere. Arguments: see :class:`~marl_handover.hardware.driver.ArmDriver`."""

    def move(self, commands: Sequence[JointCommand], duration_s: float, made_s: float | None = None) -> Sent:
        """Send arms somewhere together, in ``duration_s``; what was sent.

        Args:
            commands: one for each arm that is to move.
            duration_s: a multiple of 20 ms is what boards do.
            made_s: when the command was thought of; now unless given.

        Raises:
            GateRejection: it must not be sent.
            Stopped: the stop is latched; every channel was told to stop.
            PulseMismatch: a board does not do what it is told; every channel was told to stop.
            BoardReset, PortLost, BadReply: the electronics failed; the arms have to be armed again, or the port connected.
        """
        return self._move(commands, duration_s, made_s, State.ARMED)

    def joints_rad(self) -> Floats:
        """Where the arms have been sent to by now: (num_arms, 5); NaN for arms whose position is not known. Servos say nothing."""
        now_s = self.clock.now_s()
        rows = [None if self._gate is None else self._gate.held(arm, now_s) for arm in range(len(ARMS))]
        return np.array([np.full(5, np.nan) if row is None else row[0] for row in rows])

    def gripper_mm(self, arm: int) -> float:
        """How far from closed each finger of an arm has been sent; NaN if that is not known."""
        row = None if self._gate is None else self._gate.held(arm, self.clock.now_s())
        return math.nan if row is None else row[1]

    def drive(self, arm: int, joints_rad: Floats, gripper_mm: float, speed_deg_s: float) -> Sent:
        """Drive one arm straight in joint angles to ``joints_rad`` (5,), none faster than ``speed_deg_s``; what was sent.

        Raises as :meth:`move`, and :class:`BadCommand` for a speed that is none; the arm then holds where it was sent last.
        """
        return self._drive([JointCommand(arm, joints_rad, gripper_mm)], speed_deg_s, State.ARMED)

    def _drive(self, commands: Sequence[JointCommand], speed_deg_s: float, needs: State) -> Sent:
        """Drive arms together, in short moves."""
        if not (isinstance(speed_deg_s, int | float) and math.isfinite(speed_deg_s) and speed_deg_s > 0):
            raise BadCommand("speed_deg_s", speed_deg_s, "a finite number above 0")
        ways, step_s = {}, self.config.stream.period_s
        slowest_s = 0.0
        for command in commands:
            target, held = self.gate.target(command), self.gate.held(command.arm, self.clock.now_s())
            if held is None:
                raise WrongState("drive", "the position is not known", State.ARMED)
            start = np.append(*held)
            change = np.abs(target - start)
            slowest_s = max(slowest_s, math.degrees(change[:5].max()) / speed_deg_s, change[5] / self.config.gate.finger_mm_s)
            ways[command.arm] = start, target
        steps = max(1, math.ceil(slowest_s / step_s - 1e-9))
        lines: list[SentLine] = []
        for number in range(1, steps + 1):
            share = number / steps
            rows = {arm: (1 - share) * start + share * target for arm, (start, target) in ways.items()}
            sent = self._move([JointCommand(arm, row[:5], float(row[5])) for arm, row in rows.items()], step_s, None, needs)
            lines += sent.lines
            self.wait(step_s)
        self.settle(SETTLED_S)
        return Sent(tuple(lines), sent.joints_rad, steps * step_s)

    def _move(self, commands: Sequence[JointCommand], duration_s: float, made_s: float | None, needs: State) -> Sent:
        self._require(needs)
        made = self.clock.now_s() if made_s is None else made_s
        self.obey()
        stream = self.config.stream
        with self._watched():
            if stream.check_reset:
                # All of them: what one arm may do depends on where the other is, and that is known while its board holds it.
                self.check_pulses()
            while (backlog_s := self.boards.backlog_s(self.boards.by_name)) > stream.backlog_s:
                self.wait(max(backlog_s - stream.backlog_s, stream.poll_s))
            with self._allowed(needs):
                self.gate.check(commands, duration_s, self.clock.now_s(), made)
                pulses = self.wiring.pulses(commands)
                time_ms = max(1, round(1000 * duration_s))
                lines = [self.boards.by_name[name].move(found, time_ms, self.wiring.speeds(name, found)) for name, found in pulses.items()]
                self.gate.accept(commands, duration_s, self.clock.now_s())
        return Sent(tuple(lines), self._stood_for(pulses, commands), duration_s)

    def _stood_for(self, pulses: Mapping[str, Mapping[int, int]], commands: Sequence[JointCommand]) -> dict[int, Floats]:
        return {command.arm: self.wiring.state(pulses, command.arm)[0] for command in commands}
