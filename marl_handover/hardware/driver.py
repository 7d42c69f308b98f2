"""Both arms over one board or two: connect, configure, arm, move, park, disconnect. Every move passes the safety gate and the latched stop.

    with ArmDriver(config, model, confirm=ask) as driver:  # connects and configures
        driver.arm()
        stream(driver, {0: motion.phases})

What a fault looks like on the bench: no port or no answer in ``connect`` means cable, supply or baud rate; a joint that turns the wrong
way, or another joint, while parking means wiring or calibration; a :class:`~marl_handover.hardware.errors.BoardReset` in mid-motion means
a supply that is too weak. A power switch in reach is no luxury: software cannot stop a servo that broke.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType

import numpy as np

from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.commanded import SETTLED_S
from marl_handover.hardware.errors import HalfHeld, NotConfirmed, WrongState
from marl_handover.hardware.gate import JointCommand
from marl_handover.hardware.held import Pulses, all_held, middles, none_held
from marl_handover.hardware.latch import StopLatch
from marl_handover.hardware.moving import MovingSession, Sent
from marl_handover.hardware.session import GATE_OFF, State
from marl_handover.hardware.settings import ARMS, HardwareConfig

_RESTATED_S = 0.2
"""Time for moves of half a reading, to where arms are held already."""

_DRIVE = "The boards hold the arms. They will be driven slowly to the parked pose: is the way free, and a hand at the power switch?"
_LET_GO = (
    "A board has forgotten some servos while others are held. All will be let go: the arms sink. Are hands under them, or may they sink?"
)
_JUMP = (
    "A board does not know where its arms are: its first move is a jump at full speed. Are both arms standing in the parked pose, "
    "upright and drawn in, with the table free and a hand at the power switch?"
)
_NOMINAL = " NOT CALIBRATED: {}. With a horn one tooth off, 15 degrees, an arm jumps by that much: stay clear until it has moved."


class ArmDriver(MovingSession):
    """The arms of a cell.

    Args:
        config: electronics.
        model: geometry and limits.
        motion: says what the parked pose is, and how far open the fingers are there.
        clock: time; the computer's unless given.
        latch: the stop; the one of the settings unless given.
        confirm: is asked, with a text, before the first move, and says whether the arms are where the text says. None: nobody is asked,
            and so nothing moves.
        dry_run: everything but the last write: boards are asked, never told to move or to let go. Stops are written all the same.
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
        self._leave(broken=kind is not None)

    def disconnect(self) -> None:
        """Let go, as the settings say: hold, limp, or park and hold. Again is fine.

        If an exception is on its way the arms are stopped where they are instead.
        """
        self._leave(broken=sys.exc_info()[0] is not None)

    def arm(self) -> Sent:
        """Make the first move of every channel: to the parked pose, after somebody confirmed that this is safe. It opens the fingers.

        A board that was just switched on jumps there at full speed, so that the arms have to stand there already. Boards that still put
        out pulses are driven there slowly, if the way is clear. If only some do, everything is let go first, after somebody agreed.

        Raises:
            NotConfirmed: nobody confirmed, or the settings refuse.
            GateRejection: the parked pose is not allowed, or the way there is not clear; let the arms go limp and put them there.
            HalfHeld: only some channels have a pulse, and letting go did not help (a dry run lets nothing go).
            Stopped: somebody stopped the arms meanwhile.
            BoardReset: a board shows no pulse even after the move.
            PulseMismatch: it shows others than it was sent.
        """
        if self.state not in (State.CONFIGURED, State.ARMED):
            raise WrongState("arm", self.state, State.CONFIGURED)
        commands = [JointCommand(arm, self.parked_rad, self.motion.finger_travel_mm) for arm in range(len(ARMS))]
        with self._arming():
            self.gate.check_stand(commands)
            pulses = self._all_or_none()
            self._ask((_DRIVE if all_held(pulses) else _JUMP) + self._warning())
            sent = self._jump(commands) if none_held(pulses) else self._drive_parked(commands)
            if not self.dry_run:
                self.check_pulses()
        return sent

    def rejoin(self) -> None:
        """After a lost port: take the arms where the boards still hold them, and go on from there. Nobody has to be asked: nothing moves.

        Every channel is sent where it is, to 10 us, which is the first move that a board wants to see after a new connection.

        Raises:
            BoardReset: a board has forgotten its arms; they have to be armed.
            GateRejection: it holds one outside its limits.
            Stopped: the stop is latched, or somebody stopped the arms meanwhile.
        """
        if self.state is not State.CONFIGURED:
            raise WrongState("rejoin", self.state, State.CONFIGURED)
        with self._arming():
            self._restate()

    def park(self) -> None:
        """Drive one arm after the other to the parked pose, slowly and straight in joint angles. Raises as :meth:`move`.

        The gate watches table and arms, but knows nothing of a block in the way: it is for leaving, not for handing over.
        """
        for arm in range(len(ARMS)):
            self.drive(arm, self.parked_rad, self.gripper_mm(arm), self.config.park_deg_s)

    @contextlib.contextmanager
    def _arming(self) -> Iterator[None]:
        """Inside, the state is arming; then armed, unless something came in between."""
        with self._writing:
            self.obey()
            self.state = State.ARMING
        try:
            self.gate.forget()
            with self._watched():
                yield
            with self._allowed(State.ARMING):
                self.state = State.ARMED
        finally:
            if self.state is State.ARMING:
                self.gate.forget()
                self.state = State.CONFIGURED

    def _all_or_none(self) -> Pulses:
        """What the boards put out, once it is everything or nothing."""
        pulses = self.boards.pulses()
        if all_held(pulses) or none_held(pulses):
            return pulses
        if not self.dry_run:
            self._ask(_LET_GO)
            with self._allowed(State.ARMING):
                self.boards.limp()
            pulses = self.boards.pulses()
        if not none_held(pulses):
            raise HalfHeld()
        return pulses

    def _ask(self, question: str) -> None:
        """Raise :class:`NotConfirmed` unless somebody says yes."""
        if self._confirm is None or self.config.first_move == "refuse" or not self._confirm(question):
            raise NotConfirmed()

    def _warning(self) -> str:
        """Of arms that nobody has calibrated, and of a gate that is off."""
        off = "" if self.config.gate.enabled else f" {GATE_OFF}."
        nominal = [calibration.arm for calibration in self.calibrations if calibration.measured_unix_s == 0.0]
        return off + (_NOMINAL.format(" and ".join(nominal)) if nominal else "")

    def _jump(self, commands: Sequence[JointCommand]) -> Sent:
        """The first move of boards that know no position: they jump, whatever time they are given."""
        wanted, period_s = self.wiring.pulses(commands), self.config.stream.period_s
        with self._allowed(State.ARMING):
            lines = self.boards.first_move(wanted, round(1000 * period_s))
            for command in commands:
                self.gate.refer(*command)
        self.wait(period_s + self.config.stream.settle_s)
        return Sent(lines, self._stood_for(wanted, commands), period_s)

    def _drive_parked(self, commands: Sequence[JointCommand]) -> Sent:
        """From where the boards hold the arms, in short moves that the gate sees, after a look at the whole ways.

        Each arm's against all of the other's: boards do not tell when a servo is stuck, and then one arm moves by itself.
        """
        self._restate()
        self.gate.check_room({command.arm: self.gate.target(command) for command in commands}, self.clock.now_s(), together=False)
        sent = self._drive(commands, self.config.park_deg_s, State.ARMING)
        self.wait(self.config.stream.settle_s)
        return sent

    def _restate(self) -> None:
        """Send every channel where it is held, and take it for where the arms are. A joint at its limit is not sent past it."""
        pulses = self.boards.pulses()
        stay = self._refer(pulses)
        wanted, within = middles(pulses), self.wiring.pulses(stay)
        for wiring in self.config.arms.values():
            wanted[wiring.board].update({channel: within[wiring.board][channel] for channel in wiring.channels})
        with self._allowed(State.ARMING):
            self.boards.first_move(wanted, round(1000 * _RESTATED_S))
        self.settle(_RESTATED_S + SETTLED_S)

    def _leave(self, broken: bool) -> None:
        try:
            if broken:
                self.halt()
            if self.state is State.ARMED and self.config.on_disconnect == "park":
                self.park()
            elif self.state in (State.ARMED, State.STOPPED) and self.config.on_disconnect == "limp":
                self.limp()
        except BaseException:
            self.halt()
            raise
        finally:
            self.close()
