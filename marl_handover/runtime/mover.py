"""Playing motions on servo arms, and getting over whatever the electronics do meanwhile."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import InvalidSetting
from marl_handover.hardware.connection import State
from marl_handover.hardware.errors import (
    BadReply,
    BoardReset,
    DeviceError,
    NotConfirmed,
    PortLost,
    PulseMismatch,
    Stalled,
    Stopped,
    WrongState,
)
from marl_handover.hardware.safety_filter import CommandRejected
from marl_handover.hardware.streaming import stream
from marl_handover.motion.trajectory import LOADED_PHASES, Phase
from marl_handover.runtime.events import Event
from marl_handover.runtime.lab import Lab

Floats = NDArray[np.float64]

_RESUMED = 6
"""How often one motion is taken up again."""

_ASTRAY_S = 0.2
"""Boards may be so far before or behind the host's idea of a motion: a move may have been written and lost, or done and not noted."""

_RETRY_S = 0.5
_COMMITTED_S = 0.25
"""So long before the hand is at the pin it goes on, whatever is seen: it hides the block."""

_FINAL = (Stopped, PulseMismatch)
"""Every channel was told to stop, and this session moves nothing any more."""


class Mover:
    """Plays motions through the driver of ``lab``."""

    def __init__(self, lab: Lab) -> None:
        self.lab, self.log, self.driver, self.play_out = lab, lab.log, lab.driver, lab.play
        self.reached_s = 0.0
        """How far into the motion the arm was sent."""

    def ready(self) -> None:
        """Connect, configure and arm, as far as that is due.

        Raises:
            NotConfirmed: nobody confirmed that the arms may move.
            DeviceError: the electronics cannot be brought up within the settings' patience.
        """
        with self._noting():
            self._ready()

    @contextlib.contextmanager
    def _noting(self) -> Iterator[None]:
        """Log a board that does not do what it is told: it ends the session."""
        try:
            yield
        except PulseMismatch as failure:
            self.log.add(Event.PULSE_MISMATCH, text=failure)
            raise

    def _ready(self) -> None:
        if self.driver.state is State.DISCONNECTED:
            self.driver.connect()
        if self.driver.state is State.CONNECTED:
            self.driver.configure()
        if self.driver.state is State.LOST:
            self._reconnect()
        if self.driver.state is State.CONFIGURED:
            self._arm()

    def joints_rad(self) -> Floats:
        """Where the arms are wanted (num_arms, 5), the servos' play taken out; NaN for one whose position is not known."""
        return self.driver.joints_rad() - self.play_out.lead_rad

    def play(self, arm: int, phases: Sequence[Phase], called_off: Callable[[float], bool] | None = None) -> bool:
        """Play the motion of ``arm`` to its end; False if it was broken off and the arms are parked.

        ``called_off`` is asked during the approach, with the motion's time, whether to turn back.

        Raises:
            Stopped: the stop is latched.
            PulseMismatch: a board does not do what it is told.
            DeviceError: the electronics cannot be brought up again.
        """
        with self._noting():
            return self._play(arm, phases, called_off)

    def _play(self, arm: int, phases: Sequence[Phase], called_off: Callable[[float], bool] | None) -> bool:
        try:
            self._ready()
        except (BoardReset, PortLost):
            return self._start_over()
        aimed = self.play_out.led(arm, phases)
        self.reached_s = float(aimed[0].t_s[0])
        rest: Sequence[Phase] = aimed
        for _ in range(_RESUMED):
            try:
                turned = stream(self.driver, {arm: rest}, on_tick=self._tick, called_off=self._turning(aimed, called_off))
                if not turned.finished:
                    return self._turn_back(arm, aimed[0])
                self.play_out.done(arm, phases[-1].joints_rad[-1], aimed[-1].joints_rad[-1])
                return True
            except _FINAL:
                raise
            except BoardReset as failure:
                self.log.add(Event.CONTROLLER_RESET, text=failure)
                return self._start_over()
            except PortLost as failure:
                self.log.add(Event.SERIAL_LOST, text=failure)
                if not self._reconnect():
                    return self._start_over()
            except (BadReply, Stalled) as failure:
                self.log.add(Event.BAD_REPLY if isinstance(failure, BadReply) else Event.HOST_LATE, text=failure)
            except (CommandRejected, InvalidSetting) as refusal:
                self.log.add(Event.GATE_REFUSED, text=refusal)
                return self._go_home(arm, aimed)
            rest = [_rest(aimed, self.reached_s, self.driver.joints_rad()[arm])]
        return self._go_home(arm, aimed)

    def _tick(self, t_s: float) -> None:
        self.reached_s = t_s
        if self.log.verbose:
            fingers = [self.driver.gripper_mm(arm) for arm in range(len(self.play_out.lead_rad))]
            self.log.add(Event.STATE, joints_rad=np.round(self.driver.joints_rad(), 4), gripper_mm=np.round(fingers, 2))

    def _turning(self, phases: Sequence[Phase], called_off: Callable[[float], bool] | None) -> Callable[[], bool] | None:
        """``called_off`` for as long as the hand is far from the block."""
        if called_off is None or phases[0].name != "approach":
            return None
        far_s = float(phases[0].t_s[-1]) - _COMMITTED_S
        return lambda: self.reached_s < far_s and called_off(self.reached_s)

    def _turn_back(self, arm: int, approach: Phase) -> bool:
        """Home by the way the arm came. Always False: the motion was broken off."""
        gone = approach.t_s <= self.reached_s + 1e-6
        if gone.sum() < 2:
            return False
        t_s = (self.reached_s - approach.t_s[gone])[::-1]
        back = Phase("back", t_s - t_s[0], approach.joints_rad[gone][::-1], approach.gripper_mm[gone][::-1])
        try:
            stream(self.driver, {arm: [back]}, on_tick=lambda t_s: None)
        except _FINAL:
            raise
        except (CommandRejected, DeviceError):
            return self._start_over() if self.driver.state is not State.ARMED else self._go_home(arm, [approach])
        return False

    def _arm(self) -> None:
        """Make the first moves, once whoever is asked has seen to it that they are safe; a board may still be booting."""
        end_s = self.lab.clock.now_s() + self.lab.config.watch.timeout_s
        while True:
            try:
                if self.driver.state in (State.LOST, State.DISCONNECTED):
                    self.driver.reconnect()
                self.driver.arm()
                break
            except (NotConfirmed, CommandRejected, *_FINAL):
                raise
            except DeviceError:
                if self.lab.clock.now_s() >= end_s:
                    raise
                self.driver.wait(_RETRY_S)
        self.play_out.reset()
        self.log.add(Event.ARMED, joints_rad=self.driver.joints_rad())

    def _reconnect(self) -> bool:
        """After a lost port: connect again and take the arms where the boards hold them; False if a board has forgotten them.

        Raises :class:`DeviceError` if the port does not come back.
        """
        begun_s = self.lab.clock.now_s()
        self.driver.reconnect()
        try:
            self.driver.resync()
        except (BoardReset, BadReply, PortLost, CommandRejected):
            self.log.add(Event.CONTROLLER_RESET, text="after the port was lost")
            return False
        self.log.add(Event.RECOVERED, what=Event.SERIAL_LOST, after_s=self.lab.clock.now_s() - begun_s)
        return True

    def _start_over(self) -> bool:
        """From the parked pose, into which somebody has put the arms. Always False: the motion was broken off."""
        begun_s = self.lab.clock.now_s()
        if self.driver.state is State.LOST and self._reconnect():
            self.driver.torque_off()
        self._arm()
        self.log.add(Event.RECOVERED, what=Event.CONTROLLER_RESET, after_s=self.lab.clock.now_s() - begun_s)
        return False

    def _go_home(self, arm: int, phases: Sequence[Phase]) -> bool:
        """An arm that must not go on goes straight home, if the way is clear and its hand empty; else somebody has to help. False."""
        holding = any(phase.name in LOADED_PHASES and phase.t_s[0] <= self.reached_s <= phase.t_s[-1] for phase in phases)
        try:
            if holding:
                raise WrongState("drive home", "holding the block", "an empty hand")
            self.driver.drive(arm, self.driver.parked_rad, self.driver.gripper_mm(arm), self.driver.config.park_deg_s)
            self.play_out.lead_rad[arm] = 0.0
        except _FINAL:
            raise
        except (CommandRejected, DeviceError):
            if self.driver.state is State.ARMED:
                self.driver.torque_off()
            self._start_over()
        return False


def _rest(phases: Sequence[Phase], reached_s: float, joints_rad: Floats) -> Phase:
    """What is left of a motion, from where its arm is: near what it was last sent to."""
    t_s = np.concatenate([phase.t_s for phase in phases])
    joints = np.concatenate([phase.joints_rad for phase in phases])
    fingers = np.concatenate([phase.gripper_mm for phase in phases])
    near = np.abs(t_s - reached_s) <= _ASTRAY_S
    away = np.where(near, np.abs(joints - joints_rad).max(axis=1), np.inf) if near.any() else np.abs(t_s - reached_s)
    first = min(int(np.argmin(away)), len(t_s) - 2)
    return Phase("rest", t_s[first:], joints[first:], fingers[first:])
