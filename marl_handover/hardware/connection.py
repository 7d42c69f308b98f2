"""The connection under the arms: boards found, calibrations loaded, and the stop obeyed. Nothing here makes an arm move."""

from __future__ import annotations

import contextlib
import enum
import logging
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any
from weakref import WeakSet

from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.hardware.board_group import BoardGroup, Pulses, Wiring, readback_state, require_held
from marl_handover.hardware.calibration import ArmCalibration, calibrations, require_own_arms
from marl_handover.hardware.clock import Clock, RealClock
from marl_handover.hardware.errors import ArmingLost, ConnectionLost, DeviceError, PulseMismatch, Stopped, WrongState
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.safety_filter import JointCommand, SafetyFilter
from marl_handover.hardware.settings import HardwareConfig

LOG = logging.getLogger(__name__)
FILTER_OFF = (
    "WARNING: THE SAFETY FILTER IS OFF (hardware.gate.enabled=false): nothing keeps the arms from their limits, the table, themselves and "
    "each other"
)

_RETRY_S = 0.2

_PATIENCE_S = 0.15
"""A board that carries out a move later than it should is waited for: a busy computer may have kept its line back. Arms hold meanwhile."""


class State(enum.StrEnum):
    """Where a session is in its life."""

    DISCONNECTED = "not connected"
    CONNECTED = "connected"
    CONFIGURED = "configured"
    ARMING = "arming"
    ARMED = "armed"
    STOPPED = "stopped"
    LOST = "lost"


class ArmConnection:
    """Boards of a cell, from not connected to configured. Arguments: see :class:`~marl_handover.hardware.driver.ArmDriver`."""

    def __init__(
        self,
        config: HardwareConfig,
        model: CellModel,
        motion: MotionConfig | None = None,
        *,
        clock: Clock | None = None,
        latch: StopLatch | None = None,
        dry_run: bool = False,
    ) -> None:
        config.validate()
        config = config.for_arms(model.cell.names)
        config.require_grip(model.cell.config.block.pin_diameter_mm)
        self.config, self.model, self.motion = config, model, motion or MotionConfig()
        model.cell.require_grip(self.motion.finger_travel_mm)
        self.clock: Clock = clock or RealClock()
        self.latch = latch or StopLatch(config.stop_path())
        self.dry_run, self.state = dry_run, State.DISCONNECTED
        self.boards = BoardGroup(config, self.clock, dry_run=dry_run, on_wait=self.check_stop)
        self.calibrations: tuple[ArmCalibration, ...] = ()
        self._safety_filter: SafetyFilter | None = None
        self._wiring: Wiring | None = None
        self._signals = TerminationSignals()
        # Held from the last look at state and stop until the line is written and noted, so that no stop can come in between.
        self._writing, self._halts = threading.RLock(), 0

    @property
    def safety_filter(self) -> SafetyFilter:
        """The safety filter. Raises :class:`WrongState` before :meth:`configure`."""
        if self._safety_filter is None:
            raise WrongState("use the safety filter", self.state, State.CONFIGURED)
        return self._safety_filter

    @property
    def wiring(self) -> Wiring:
        """Joints to pulses and back. Raises :class:`WrongState` before :meth:`configure`."""
        if self._wiring is None:
            raise WrongState("use the wiring", self.state, State.CONFIGURED)
        return self._wiring

    def connect(self) -> None:
        """Find every board. Raises as :meth:`BoardGroup.connect`; then no port is left open.

        Until :meth:`close`, SIGTERM and SIGHUP are :class:`KeyboardInterrupt`, as Ctrl-C is, in programs that had nothing else in mind.
        """
        self.close()
        self.latch.join()
        try:
            self.boards.connect()
        except BaseException:
            self.latch.leave()
            raise
        self._signals.begin()
        self.state = State.CONNECTED

    def configure(self) -> None:
        """Load the calibrations; warn of a safety filter that is off. Raises as :func:`load_calibration`."""
        if self.state is State.DISCONNECTED:
            raise WrongState("configure", self.state, State.CONNECTED)
        if not self.config.gate.enabled:
            LOG.warning(FILTER_OFF)
        self.calibrations = calibrations(self.config, self.model.arm)
        require_own_arms(self.calibrations, self.boards.marks(self.config))
        self._safety_filter = SafetyFilter(self.model, self.config, self.calibrations)
        pin_mm = self.model.cell.config.block.pin_diameter_mm
        hand = self.model.arm.description.gripper
        self._wiring = Wiring(self.config, self.calibrations, hand, pin_mm, self._safety_filter.speed_rad_s)
        self.state = State.CONFIGURED

    def reconnect(self) -> None:
        """After a lost port: wait for it to come back and connect afresh. Every channel then waits for its first move.

        Raises :class:`Stopped`, or :class:`PortNotFound` or :class:`BoardSilent` if it does not come back in time.
        """
        end_s = self.clock.now_s() + self.config.timeouts.reconnect_s
        while True:
            try:
                self.connect()
                break
            except DeviceError:
                if self.clock.now_s() >= end_s:
                    raise
            self.latch.join()
            self.wait(_RETRY_S)
        self.configure()

    def close(self) -> None:
        """Let all ports go; servos keep their last pulse. Again is fine."""
        with deferred_signals():
            self.boards.close()
            if self._safety_filter is not None:
                self._safety_filter.forget()
            self.state = State.DISCONNECTED
            self.latch.leave()
        self._signals.end()

    def wait(self, duration_s: float) -> None:
        """Wait, looking at the stop all the while. Raises :class:`Stopped`."""
        end_s = self.clock.now_s() + duration_s
        while True:
            self.check_stop()
            left_s = end_s - self.clock.now_s()
            if left_s <= 0:
                return
            self.clock.sleep_s(min(self.config.stream.poll_s, left_s))

    def check_pulses(self) -> None:
        """Ask whether every channel puts out what it was sent by now, and wait a little for boards that are late.

        Raises:
            PulseMismatch: one does not; every channel was told to stop, and moves are refused until :meth:`resume`.
            ArmingLost, ConnectionLost, BadReply: the electronics failed.
            Stopped: the stop is latched.
        """
        end_s = self.clock.now_s() + _PATIENCE_S
        with self._watched():
            while True:
                try:
                    return self.boards.require_pulses()
                except PulseMismatch:
                    if self.clock.now_s() >= end_s:
                        raise
                self.wait(self.config.stream.poll_s)

    def settle(self, duration_s: float) -> None:
        """Wait until moves are over, and see that they were carried out; servos with encoders are brought nearer to where they were sent.

        Raises as :meth:`check_pulses`.
        """
        end_s = self.clock.now_s() + duration_s
        while self.config.stream.check_reset and self.boards.have_encoders and self.clock.now_s() + self.config.stream.period_s < end_s:
            self.wait(self.config.stream.period_s)
            self.check_pulses()
            with self._writing:
                self.check_stop()
                if self.state in (State.ARMING, State.ARMED):
                    self.boards.correct()
        self.wait(end_s - self.clock.now_s())
        if self.config.stream.check_reset:
            self.check_pulses()

    def check_stop(self) -> None:
        """If the stop is latched, stop every channel and raise :class:`Stopped`."""
        if self.latch.is_set():
            if self.halt():
                self.latch.obeyed()
            raise Stopped(self.latch.reason())

    def stop(self, reason: str) -> None:
        """Latch the stop, for every session, and stop every channel. It stays until ``latch.clear()`` and :meth:`resume`."""
        try:
            self.latch.latch(reason)
        finally:
            self.halt()

    def halt(self) -> bool:
        """Stop every channel where it is and refuse moves until :meth:`resume`. Whether every board was reached; lost ones do not raise.

        From any thread: once it returns, no move follows. Ctrl-C while it goes on waits for its end.
        """
        with deferred_signals(), self._writing:
            self._halts += 1
            reached = self.boards.stop()
            if self._safety_filter is not None:
                self._safety_filter.freeze(self.clock.now_s())
            if self.state in (State.ARMING, State.ARMED):
                self.state = State.STOPPED
            return reached

    def resume(self) -> None:
        """After the stop was cleared: read back where the channels are, to 10 us, and allow moves from there.

        Raises :class:`Stopped` while the stop is latched, :class:`ArmingLost` if a board has forgotten any channel, and
        :class:`CommandRejected` if it holds one outside its limits.
        """
        if self.state is not State.STOPPED:
            raise WrongState("resume", self.state, State.STOPPED)
        if self.latch.is_set():
            raise Stopped(self.latch.reason())
        halts = self._halts
        if not self.dry_run:
            with self._watched():
                self.boards.require_holding()
                self._refer(self.boards.pulses())
        with self._allowed(State.STOPPED):
            if halts != self._halts:
                raise Stopped("again, meanwhile")
            self.state = State.ARMED

    def torque_off(self) -> None:
        """No more pulses: the arms sink. They have to be put into the parked pose and armed again. In a dry run nothing sinks.

        Raises :class:`ConnectionLost` if a board was not reached; the others' arms sink all the same.
        """
        try:
            with self._writing, self._watched():
                self.boards.torque_off()
        finally:
            self.safety_filter.forget()
            if self.state is not State.LOST:
                self.state = State.CONFIGURED

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        """Keep the state true when electronics fail."""
        try:
            yield
        except ConnectionLost:
            self.state = State.LOST
            raise
        except ArmingLost:
            if self.boards.have_encoders:
                self.boards.stop()  # those that hold are in the middle of a motion that nobody goes on with
            self.safety_filter.forget()
            self.state = State.CONFIGURED
            raise
        except PulseMismatch:
            self.halt()
            raise

    @contextlib.contextmanager
    def _allowed(self, needs: State) -> Iterator[None]:
        """Inside, state and stop are as they were found, and no other thread can stop the arms.

        Raises :class:`Stopped` or :class:`WrongState` if the arms must not be sent anything.
        """
        with self._writing:
            self._require(needs)
            self.check_stop()
            yield

    def _require(self, needs: State) -> None:
        if self.state is State.STOPPED and needs is not State.STOPPED:
            raise Stopped(self.latch.reason() or "earlier")
        if self.state is not needs:
            raise WrongState("move", self.state, needs)

    def _refer(self, pulses: Pulses) -> list[JointCommand]:
        """Take what the boards put out for where the arms are, and return that: commands to stay there, within every joint's limits.

        Raises :class:`BoardReset` if a channel has no pulse, and :class:`CommandRejected` if an arm is held outside its limits.
        """
        require_held(pulses)
        self.boards.note_readback(pulses)
        held = [readback_state(self.config, self.calibrations, self.model.arm, pulses, arm) for arm in range(len(self.config.arms))]
        stay = [JointCommand(arm, joints, fingers) for arm, (joints, fingers) in enumerate(held)]
        for command in stay:
            self.safety_filter.refer(*command)
        return stay


_ENDINGS = (signal.SIGTERM, signal.SIGHUP)


class TerminationSignals:
    """One session's wish that SIGTERM and SIGHUP be :class:`KeyboardInterrupt`, as Ctrl-C is: Python ends at them without another line of
    its code, so nobody would stop the arms. Handlers that somebody has set are left alone, as is ``nohup``.

    Signals reach the main thread only; in another one nothing here does anything.
    """

    def begin(self) -> None:
        """From now on. Again is fine."""
        if _is_main():
            _wishes.add(self)
            for number in _ENDINGS:
                if signal.getsignal(number) is signal.SIG_DFL:
                    signal.signal(number, _interrupt)

    def end(self) -> None:
        """No more, unless another session wishes it. Again is fine."""
        _wishes.discard(self)
        if _is_main() and not _wishes:
            for number in _ENDINGS:
                if signal.getsignal(number) is _interrupt:
                    signal.signal(number, signal.SIG_DFL)


_wishes: WeakSet[TerminationSignals] = WeakSet()


@contextlib.contextmanager
def deferred_signals() -> Iterator[None]:
    """Inside, a signal that would be an exception waits; the first of them comes at the end, after an exception of the block's own too.

    Handlers must not be changed inside: they are put back as they were.
    """
    if not _is_main():
        yield
        return
    arrived: list[int] = []
    before: dict[int, Callable[[int, FrameType | None], Any]] = {}
    for deferrable in (signal.SIGINT, *_ENDINGS):
        handler = signal.getsignal(deferrable)
        if callable(handler):
            before[deferrable] = handler
            signal.signal(deferrable, lambda number, _: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if arrived:
            before[arrived[0]](arrived[0], None)


def _interrupt(number: int, _: FrameType | None) -> None:
    raise KeyboardInterrupt(signal.Signals(number).name)


def _is_main() -> bool:
    return threading.current_thread() is threading.main_thread()
