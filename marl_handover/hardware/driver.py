"""A cell's arms over one board or more: connect, arm, move, park, disconnect. Every move passes the safety filter and the latched stop.

    with ArmDriver(config, model, confirm=ask) as driver:  # connects and configures
        driver.arm()
        stream(driver, {0: motion.phases})

What a fault looks like on the bench: no port or no answer in ``connect`` means cable, supply or baud rate; a joint that turns the wrong
way, or another joint, while parking means wiring or calibration; a :class:`~marl_handover.hardware.errors.BoardReset` in mid-motion means
a supply that is too weak. A power switch in reach is no luxury: software cannot stop a servo that broke.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.hardware.board_group import Pulses, all_held, none_held, readback_middles
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.connection import FILTER_OFF, ArmConnection, State
from marl_handover.hardware.errors import BadCommand, HalfHeld, NotConfirmed, Stopped, WrongState
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.expected_pulses import SETTLED_S
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand
from marl_handover.hardware.settings import COUNTS_PER_RAD, HardwareConfig
from marl_handover.hardware.transport import LineRecord
from marl_handover.motion.home import parked_poses


class MoveRecord(NamedTuple):
    """What went out: the lines, and the joints (5,) of each arm that their pulses, whole microseconds, stand for."""

    lines: tuple[LineRecord, ...]
    joints_rad: dict[int, Floats]
    duration_s: float


_STILL_WITHIN_S, _STILL_COUNTS = 1.0, 3
_RESTATED_S = 0.2
"""Time for moves of half a reading, to where arms are held already."""

_DRIVE = "The boards hold the arms. They will be driven slowly to the parked pose: is the way free, and a hand at the power switch?"
_SWITCH_ON = (
    "The servos will be switched on where the arms stand, and drive them slowly to the parked pose: do they stand free of the table and of "
    "each other, best upright and drawn in, and is a hand at the power switch?"
)
_LET_GO = (
    "A board has forgotten some servos while others are held. All will be let go: the arms sink. Are hands under them, or may they sink?"
)
_JUMP = (
    "A board does not know where its arms are: its first move is a jump at full speed. Are {} arms standing in the parked pose, "
    "upright and drawn in, with the table free and a hand at the power switch?"
)
_ZEROS = " NOT CALIBRATED: {}. Zeros may be off by some degrees, and so are all places: keep the table free."
_NOMINAL = " NOT CALIBRATED: {}. With a horn one tooth off, 15 degrees, an arm jumps by that much: stay clear until it has moved."


class ArmDriver(ArmConnection):
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
        said = self.motion.parked_deg  # whether the arms may go there is for the safety filter to say
        self.parked_rad = parked_poses(model, self.motion)[0] if said is None else np.radians(np.asarray(said, float))
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

    def arm(self) -> MoveRecord:
        """Make the first move of every channel: to the parked pose, after somebody confirmed that this is safe. It opens the fingers.

        A board that was just switched on jumps there at full speed, so that the arms have to stand there already. Boards that still put
        out pulses are driven there slowly, if the way is clear. If only some do, everything is let go first, after somebody agreed.

        Raises:
            NotConfirmed: nobody confirmed, or the settings refuse.
            CommandRejected: the parked pose is not allowed, or the way there is not clear; let the arms go limp and put them there.
            HalfHeld: only some channels have a pulse, and letting go did not help (a dry run lets nothing go).
            Stopped: somebody stopped the arms meanwhile.
            BoardReset, TorqueLost: a board shows no pulse even after the move, or a servo does not hold.
            PulseMismatch: it shows others than it was sent.
        """
        if self.state not in (State.CONFIGURED, State.ARMED):
            raise WrongState("arm", self.state, State.CONFIGURED)
        commands = [JointCommand(arm, self.parked_rad, self.motion.finger_travel_mm) for arm in range(len(self.config.arms))]
        with self._arming():
            self.safety_filter.check_stand(commands)
            pulses = self._all_or_none()
            jump = _JUMP.format("both" if len(commands) == 2 else f"all {len(commands)}")
            driven = _SWITCH_ON if self.boards.have_encoders else _DRIVE
            self._ask((driven if all_held(pulses) else jump) + self._warning())
            sent = self._jump(commands) if none_held(pulses) else self._drive_parked(commands)
            if not self.dry_run:
                self.check_pulses()
        return sent

    def move(self, commands: Sequence[JointCommand], duration_s: float, made_s: float | None = None) -> MoveRecord:
        """Send arms somewhere together, in ``duration_s``; what was sent.

        Args:
            commands: one for each arm that is to move.
            duration_s: a multiple of 20 ms is what boards do.
            made_s: when the command was thought of; now unless given.

        Raises:
            CommandRejected: it must not be sent.
            Stopped: the stop is latched; every channel was told to stop.
            PulseMismatch: a board does not do what it is told; every channel was told to stop.
            ArmingLost, ConnectionLost, BadReply: the electronics failed; the arms have to be armed again, or the port connected.
        """
        return self._move(commands, duration_s, made_s, State.ARMED)

    def joints_rad(self) -> Floats:
        """Where the arms have been sent to by now: (num_arms, 5); NaN for arms whose position is not known. Servos say nothing."""
        now_s = self.clock.now_s()
        rows = [None if self._safety_filter is None else self._safety_filter.held(arm, now_s) for arm in range(len(self.config.arms))]
        return np.array([np.full(5, np.nan) if row is None else row[0] for row in rows])

    def gripper_mm(self, arm: int) -> float:
        """How far from closed each finger of an arm has been sent; NaN if that is not known."""
        row = None if self._safety_filter is None else self._safety_filter.held(arm, self.clock.now_s())
        return math.nan if row is None else row[1]

    def drive(self, arm: int, joints_rad: Floats, gripper_mm: float, speed_deg_s: float) -> MoveRecord:
        """Drive one arm straight in joint angles to ``joints_rad`` (5,), none faster than ``speed_deg_s``; what was sent.

        Raises as :meth:`move`, and :class:`BadCommand` for a speed that is none; the arm then holds where it was sent last.
        """
        return self._drive([JointCommand(arm, joints_rad, gripper_mm)], speed_deg_s, State.ARMED)

    def resync(self) -> None:
        """After a lost port: take the arms where the boards still hold them, and go on from there. Nobody has to be asked: nothing moves.

        Every channel is sent where it is, to 10 us, which is the first move that a board wants to see after a new connection.

        Raises:
            BoardReset, TorqueLost: a board has forgotten its arms, or servos let go; they have to be armed.
            CommandRejected: it holds one outside its limits.
            Stopped: the stop is latched, or somebody stopped the arms meanwhile.
        """
        if self.state is not State.CONFIGURED:
            raise WrongState("resync", self.state, State.CONFIGURED)
        with self._arming():
            self.boards.require_holding()
            self._restate()

    def recover(self) -> None:
        """After :class:`ServoAstray`: take the arms where they stand, and go on from there; an overload ends with it. Nothing moves.

        Raises as :meth:`resync`.
        """
        if self.state is not State.STOPPED:
            raise WrongState("recover", self.state, State.STOPPED)
        if self.latch.is_set():
            raise Stopped(self.latch.reason())
        self.state = State.CONFIGURED
        self.resync()

    def park(self) -> None:
        """Drive one arm after the other to the parked pose, slowly and straight in joint angles. Raises as :meth:`move`.

        The safety filter watches table and arms, but knows nothing of a block in the way: it is for leaving, not for handing over.
        """
        for arm in range(len(self.config.arms)):
            self.drive(arm, self.parked_rad, self.gripper_mm(arm), self.config.park_deg_s)

    def _drive(self, commands: Sequence[JointCommand], speed_deg_s: float, needs: State) -> MoveRecord:
        """Drive arms together, in short moves."""
        if not (isinstance(speed_deg_s, int | float) and math.isfinite(speed_deg_s) and speed_deg_s > 0):
            raise BadCommand("speed_deg_s", speed_deg_s, "a finite number above 0")
        ways, step_s = {}, self.config.stream.period_s
        slowest_s = 0.0
        for command in commands:
            target, held = self.safety_filter.target(command), self.safety_filter.held(command.arm, self.clock.now_s())
            if held is None:
                raise WrongState("drive", "the position is not known", State.ARMED)
            start = np.append(*held)
            change = np.abs(target - start)
            slowest_s = max(slowest_s, math.degrees(change[:5].max()) / speed_deg_s, change[5] / self.config.gate.finger_mm_s)
            ways[command.arm] = start, target
        steps = max(1, math.ceil(slowest_s / step_s - 1e-9))
        lines: list[LineRecord] = []
        for number in range(1, steps + 1):
            share = number / steps
            rows = {arm: (1 - share) * start + share * target for arm, (start, target) in ways.items()}
            sent = self._move([JointCommand(arm, row[:5], float(row[5])) for arm, row in rows.items()], step_s, None, needs)
            lines += sent.lines
            self.wait(step_s)
        self.settle(SETTLED_S)
        return MoveRecord(tuple(lines), sent.joints_rad, steps * step_s)

    def _move(self, commands: Sequence[JointCommand], duration_s: float, made_s: float | None, needs: State) -> MoveRecord:
        self._require(needs)
        made = self.clock.now_s() if made_s is None else made_s
        self.check_stop()
        stream = self.config.stream
        with self._watched():
            if stream.check_reset:
                # All of them: what one arm may do depends on where the other is, and that is known while its board holds it.
                self.check_pulses()
            while (backlog_s := self.boards.backlog_s(self.boards.by_name)) > stream.backlog_s:
                self.wait(max(backlog_s - stream.backlog_s, stream.poll_s))
            with self._allowed(needs):
                self.safety_filter.check(commands, duration_s, self.clock.now_s(), made)
                ahead, pulses = self._ahead(commands, duration_s), self.wiring.pulses(commands)
                aims = pulses if ahead is commands else self.wiring.pulses(ahead)
                time_ms = max(1, round(1000 * duration_s))
                lines = [
                    self.boards.by_name[name].move(found, time_ms, self.wiring.speeds(name, found), aims[name])
                    for name, found in pulses.items()
                ]
                self.safety_filter.accept(commands, duration_s, self.clock.now_s())
        return MoveRecord(tuple(lines), self._stood_for(pulses, commands), duration_s)

    def _ahead(self, commands: Sequence[JointCommand], duration_s: float) -> Sequence[JointCommand]:
        """Where servos have to be sent that brake for their goals, so as to be in time at ``commands``; these, if the way on is not clear.

        They go on by so much if nothing follows, because the host died; hence the bound, ``bus.lead_deg``, and the look.
        """
        if not self.boards.have_encoders:
            return commands
        bus, now_s, arm = self.config.bus, self.clock.now_s(), self.model.arm
        most_rad, brakes_rad_s2 = math.radians(bus.lead_deg), 100.0 * bus.acceleration / COUNTS_PER_RAD
        ahead = []
        for command in commands:
            held, target = self.safety_filter.held(command.arm, now_s), np.asarray(command.joints_rad, float)
            speed = np.zeros(5) if held is None else (target - held[0]) / duration_s
            further = np.copysign(np.minimum(speed**2 / (2 * brakes_rad_s2), most_rad), speed)
            ahead.append(command._replace(joints_rad=np.clip(target + further, arm.lower_rad, arm.upper_rad)))
        try:
            if self.config.gate.enabled:
                self.safety_filter.check_room({command.arm: self.safety_filter.target(command) for command in ahead}, now_s)
        except CommandRejected:
            return commands
        return ahead

    def _stood_for(self, pulses: Mapping[str, Mapping[int, int]], commands: Sequence[JointCommand]) -> dict[int, Floats]:
        return {command.arm: self.wiring.state(pulses, command.arm)[0] for command in commands}

    @contextlib.contextmanager
    def _arming(self) -> Iterator[None]:
        """Inside, the state is arming; then armed, unless something came in between."""
        with self._writing:
            self.check_stop()
            self.state = State.ARMING
        try:
            self.safety_filter.forget()
            with self._watched():
                yield
            with self._allowed(State.ARMING):
                self.state = State.ARMED
        finally:
            if self.state is State.ARMING:
                self.safety_filter.forget()
                self.state = State.CONFIGURED

    def _all_or_none(self) -> Pulses:
        """What the boards put out, once it is everything or nothing."""
        pulses = self.boards.pulses()
        if all_held(pulses) or none_held(pulses):
            return pulses
        if not self.dry_run:
            self._ask(_LET_GO)
            with self._allowed(State.ARMING):
                self.boards.torque_off()
            pulses = self.boards.pulses()
        if not none_held(pulses):
            raise HalfHeld()
        return pulses

    def _ask(self, question: str) -> None:
        """Raise :class:`NotConfirmed` unless somebody says yes."""
        if self._confirm is None or self.config.first_move == "refuse" or not self._confirm(question):
            raise NotConfirmed()

    def _warning(self) -> str:
        """Of arms that nobody has calibrated, and of a safety filter that is off."""
        off = "" if self.config.gate.enabled else f" {FILTER_OFF}."
        nominal = [calibration.arm for calibration in self.calibrations if calibration.measured_unix_s == 0.0]
        words = _ZEROS if self.boards.have_encoders else _NOMINAL
        return off + (words.format(" and ".join(nominal)) if nominal else "")

    def _jump(self, commands: Sequence[JointCommand]) -> MoveRecord:
        """The first move of boards that know no position: they jump, whatever time they are given."""
        wanted, period_s = self.wiring.pulses(commands), self.config.stream.period_s
        with self._allowed(State.ARMING):
            lines = self.boards.first_move(wanted, round(1000 * period_s))
            for command in commands:
                self.safety_filter.refer(*command)
        self.wait(period_s + self.config.stream.settle_s)
        return MoveRecord(lines, self._stood_for(wanted, commands), period_s)

    def _drive_parked(self, commands: Sequence[JointCommand]) -> MoveRecord:
        """From where the boards hold the arms, in short moves that the safety filter sees, after a look at the whole ways.

        Each arm's against all of every other's: boards do not tell when a servo is stuck, and then one arm moves by itself.
        """
        self._restate()
        self.safety_filter.check_room(
            {command.arm: self.safety_filter.target(command) for command in commands}, self.clock.now_s(), together=False
        )
        sent = self._drive(commands, self.config.park_deg_s, State.ARMING)
        self.wait(self.config.stream.settle_s)
        return sent

    def _restate(self) -> None:
        """Send every channel where it is held, and take it for where the arms are. A joint at its limit is not sent past it."""
        pulses = self._still_pulses()
        stay = self._refer(pulses)
        wanted, within = readback_middles(pulses, self.config.unit), self.wiring.pulses(stay)
        for wiring in self.config.arms.values():
            wanted[wiring.board].update({channel: within[wiring.board][channel] for channel in wiring.channels})
        with self._allowed(State.ARMING):
            self.boards.first_move(wanted, round(1000 * _RESTATED_S))
        self.settle(_RESTATED_S + SETTLED_S)

    def _still_pulses(self) -> Pulses:
        """Where servos are; those that tell where they stand are waited for until they do, for what moves cannot be held where it is."""
        pulses = self.boards.pulses()
        end_s = self.clock.now_s() + _STILL_WITHIN_S
        while self.boards.have_encoders and self.clock.now_s() < end_s:
            self.wait(self.config.stream.period_s)
            before, pulses = pulses, self.boards.pulses()
            moved = (abs((pulses[name][channel] or 0) - (at or 0)) for name, found in before.items() for channel, at in found.items())
            if max(moved) <= _STILL_COUNTS:
                break
        return pulses

    def _leave(self, broken: bool) -> None:
        try:
            if broken:
                self.halt()
            if self.state is State.ARMED and self.config.on_disconnect == "park":
                self.park()
            elif self.state in (State.ARMED, State.STOPPED) and self.config.on_disconnect == "limp":
                self.torque_off()
        except BaseException:
            self.halt()
            raise
        finally:
            self.close()
