"""Both arms over one board or two: connect, configure, arm, move, park, disconnect. Every move passes the safety gate and the latched stop.

    with ArmDriver(config, model, confirm=ask) as driver:  # connects and configures
        driver.arm()
        stream(driver, {0: motion.phases})

What a fault looks like on the bench: no port or no answer in ``connect`` means cable, supply or baud rate; a joint that turns the wrong
way, or another joint, while parking means wiring or calibration; a :class:`~marl_handover.hardware.errors.BoardReset` in mid-motion means
a supply that is too weak. A power switch in reach is no luxury: software cannot stop a servo that broke.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.errors import NotConfirmed, Stopped, WrongState
from marl_handover.hardware.gate import JointCommand
from marl_handover.hardware.latch import StopLatch
from marl_handover.hardware.session import BoardSession, State
from marl_handover.hardware.settings import ARMS, HardwareConfig
from marl_handover.hardware.ssc32 import SentLine

Floats = NDArray[np.float64]

_FULL_TURN_DEG = 180.0
_Pulses = Mapping[str, Mapping[int, int | None]]


class Sent(NamedTuple):
    """What went out: the lines, and the joints (5,) of each arm that their pulses, whole microseconds, stand for."""

    lines: tuple[SentLine, ...]
    joints_rad: dict[int, Floats]
    duration_s: float


class ArmDriver(BoardSession):
    """The arms of a cell.

    Args:
        config: electronics.
        model: geometry and limits.
        motion: says what the parked pose is, and how far open the fingers are there.
        clock: time; the computer's unless given.
        latch: the stop; the one of the settings unless given.
        confirm: is asked, with a text, before the first move, and says whether the arms are where the text says. None: nobody is asked,
            and so nothing moves.
        dry_run: everything but the last write: boards are asked, never told to move. Stops and letting go are written all the same.
    """

    def __init__(
        self,
        config: HardwareConfig,
        model: CellModel,
        motion: MotionConfig | None = None,
        *,
        clock: Clock | None = None,
        latch: StopLatch | None = None,
        confirm: Callable[[str], bool] | None = None,
        dry_run: bool = False,
    ) -> None:
        super().__init__(config, model, motion, clock=clock, latch=latch, dry_run=dry_run)
        self.parked_rad = np.radians(np.asarray(self.motion.parked_deg, float))
        self._confirm = confirm

    def __enter__(self) -> ArmDriver:
        try:
            self.connect()
            self.configure()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """After an exception, Ctrl-C included, the arms are stopped where they are; else the settings say what becomes of them."""
        if kind is not None:
            self.halt()
        self.disconnect()

    def arm(self) -> Sent:
        """Make the first move of every channel: to the parked pose, after somebody confirmed that this is safe. It opens the fingers.

        A board that was just switched on jumps there at full speed, so that the arms have to stand there already. One that still puts out
        pulses is driven there slowly, if the way is clear.

        Raises:
            NotConfirmed: nobody confirmed, or the settings refuse.
            GateRejection: the way there is not clear; let the arms go limp and put them there.
            BoardReset: a board shows no pulse even after the move.
        """
        if self.state not in (State.CONFIGURED, State.ARMED):
            raise WrongState("arm", self.state, State.CONFIGURED)
        self.obey()
        self.state = State.CONFIGURED
        self.gate.forget()
        commands = [JointCommand(arm, self.parked_rad, self.motion.finger_travel_mm) for arm in range(len(ARMS))]
        with self._watched():
            pulses = self.boards.pulses()
            if self._confirm is None or self.config.first_move == "refuse" or not self._confirm(_question(pulses)):
                raise NotConfirmed()
            duration_s = self._first_move_s(pulses)
            wanted = self.wiring.pulses(commands)
            self.obey()
            sent = self.boards.first_move(wanted, round(1000 * duration_s))
            self.wait(duration_s + self.config.stream.settle_s)
            if not self.dry_run:
                self.boards.verify(wanted)
        for command in commands:
            self.gate.refer(*command)
        self.state = State.ARMED
        return Sent(sent, self._stood_for(wanted, commands), duration_s)

    def move(self, commands: Sequence[JointCommand], duration_s: float, made_s: float | None = None) -> Sent:
        """Send arms somewhere together, in ``duration_s``; what was sent.

        Args:
            commands: one for each arm that is to move.
            duration_s: a multiple of 20 ms is what boards do.
            made_s: when the command was thought of; now unless given.

        Raises:
            GateRejection: it must not be sent.
            Stopped: the stop is latched; every channel was told to stop.
            BoardReset, PortLost, BadReply: the electronics failed; the arms have to be armed again, or the port connected.
        """
        if self.state is State.STOPPED:
            raise Stopped(self.latch.reason() or "earlier")
        if self.state is not State.ARMED:
            raise WrongState("move", self.state, State.ARMED)
        made = self.clock.now_s() if made_s is None else made_s
        self.obey()
        names = self.wiring.boards(command.arm for command in commands)
        with self._watched():
            if self.config.stream.check_reset:
                self.boards.require_powered(names)
            while (backlog_s := self.boards.backlog_s(names)) > self.config.stream.backlog_s:
                self.wait(backlog_s - self.config.stream.backlog_s)
            self.gate.check(commands, duration_s, self.clock.now_s(), made)
            pulses = self.wiring.pulses(commands)
            self.obey()
            time_ms = max(1, round(1000 * duration_s))
            lines = [self.boards.by_name[name].move(found, time_ms, self.wiring.speeds(name, found)) for name, found in pulses.items()]
        self.gate.accept(commands, duration_s, self.clock.now_s())
        return Sent(tuple(lines), self._stood_for(pulses, commands), duration_s)

    def joints_rad(self) -> Floats:
        """Where the arms have been sent to by now: (num_arms, 5); NaN for arms whose position is not known. Servos say nothing."""
        now_s = self.clock.now_s()
        rows = [None if self._gate is None else self._gate.held(arm, now_s) for arm in range(len(ARMS))]
        return np.array([np.full(5, np.nan) if row is None else row[0] for row in rows])

    def gripper_mm(self, arm: int) -> float:
        """How far from closed each finger of an arm has been sent; NaN if that is not known."""
        row = None if self._gate is None else self._gate.held(arm, self.clock.now_s())
        return math.nan if row is None else row[1]

    def park(self) -> None:
        """Drive one arm after the other to the parked pose, slowly and straight in joint angles. Raises as :meth:`move`.

        The gate watches table and arms, but knows nothing of a block in the way: it is for leaving, not for handing over.
        """
        for arm in range(len(ARMS)):
            self.drive(arm, self.parked_rad, self.gripper_mm(arm), self.config.park_deg_s)

    def drive(self, arm: int, joints_rad: Floats, gripper_mm: float, speed_deg_s: float) -> Sent:
        """Drive one arm straight in joint angles to ``joints_rad`` (5,), none faster than ``speed_deg_s``; the last of what was sent.

        Raises as :meth:`move`; the arm then holds where it was sent last.
        """
        held = self.gate.held(arm, self.clock.now_s())
        if held is None:
            raise WrongState("drive", "the position is not known", State.ARMED)
        start, step_s = np.append(*held), self.config.stream.period_s
        change = np.append(joints_rad, gripper_mm) - start
        slowest_s = float(np.abs(np.degrees(change[:5])).max()) / speed_deg_s, abs(float(change[5])) / self.config.gate.finger_mm_s
        steps = max(1, math.ceil(max(slowest_s) / step_s))
        for number in range(1, steps + 1):
            now = start + number / steps * change
            sent = self.move([JointCommand(arm, now[:5], float(now[5]))], step_s)
            self.wait(step_s)
        return sent

    def disconnect(self) -> None:
        """Let go, as the settings say: hold, limp, or park and hold. Again is fine."""
        try:
            if self.state is State.ARMED and self.config.on_disconnect == "park":
                self.park()
            elif self.state in (State.ARMED, State.STOPPED) and self.config.on_disconnect == "limp":
                self.limp()
        finally:
            self.close()

    def _first_move_s(self, pulses: _Pulses) -> float:
        """How long to take for the first move from where the boards hold the arms. Raises :class:`GateRejection` if the way is not clear.

        Channels without a pulse ignore it. Where only some have one, nobody can say how far the others' way is.
        """
        if _none_held(pulses):
            return self.config.stream.period_s
        if not _all_held(pulses):
            return _FULL_TURN_DEG / self.config.park_deg_s
        self.boards.require_powered(self.boards.by_name)  # asking somebody took its time
        self._refer(pulses)
        self.gate.check_room(dict.fromkeys(range(len(ARMS)), self.parked_rad), self.clock.now_s())
        farthest_deg = math.degrees(float(np.abs(self.joints_rad() - self.parked_rad).max()))
        return max(farthest_deg / self.config.park_deg_s, self.config.stream.period_s)

    def _stood_for(self, pulses: Mapping[str, Mapping[int, int]], commands: Sequence[JointCommand]) -> dict[int, Floats]:
        return {command.arm: self.wiring.state(pulses, command.arm)[0] for command in commands}


def _all_held(pulses: _Pulses) -> bool:
    return all(pulse is not None for found in pulses.values() for pulse in found.values())


def _none_held(pulses: _Pulses) -> bool:
    return all(pulse is None for found in pulses.values() for pulse in found.values())


def _question(pulses: _Pulses) -> str:
    """What is asked before the first move."""
    if _all_held(pulses):
        return "The boards hold the arms. They will be driven slowly to the parked pose: is the way free, and a hand at the power switch?"
    return (
        "A board does not know where its arms are: its first move is a jump at full speed. Are both arms standing in the parked pose, "
        "upright and drawn in, with the table free and a hand at the power switch?"
    )
