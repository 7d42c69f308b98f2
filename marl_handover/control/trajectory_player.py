"""Planned motions played on servo arms, backlash taken out, and what is done about whatever the electronics do meanwhile.

Every ``period_s`` each moving arm is sent where its motion will be one period later, with that time; so at most one period of motion is
ever on a board, and a host that dies leaves arms that hold a moment later. A host that is late does not make up for it: the rest of the
motion comes later, at its own speed.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.control.events import Event
from marl_handover.control.workcell import Workcell
from marl_handover.errors import InvalidSetting
from marl_handover.hardware.connection import State
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.errors import (
    ArmingLost,
    BadReply,
    ConnectionLost,
    DeviceError,
    NotConfirmed,
    PulseMismatch,
    ServoAstray,
    ServoFault,
    Stalled,
    Stopped,
    WrongState,
)
from marl_handover.hardware.safety_filter import CommandRejected, JointCommand
from marl_handover.motion.trajectory import LOADED_PHASES, Phase

START_RAD = math.radians(3.0)
"""How far from where an arm has been sent its motion may begin."""

SLACK_S = 0.01
"""A move may be written so long after it is due without the next one coming later: half a frame, and more than asking the boards takes."""


class PlaybackRecord(NamedTuple):
    """How a motion went: group moves sent, greatest lateness of one, and whether it was played to its end or called off."""

    moves: int
    late_s: float
    finished: bool


class _Track(NamedTuple):
    """One arm's motion on the common time axis."""

    arm: int
    t_s: Floats
    joints_rad: Floats
    gripper_mm: Floats

    def at(self, t_s: float) -> JointCommand:
        joints = np.array([np.interp(t_s, self.t_s, column) for column in self.joints_rad.T])
        return JointCommand(self.arm, joints, float(np.interp(t_s, self.t_s, self.gripper_mm)))


def stream(
    driver: ArmDriver,
    motions: Mapping[int, Sequence[Phase]],
    *,
    called_off: Callable[[], bool] | None = None,
    on_tick: Callable[[float], None] | None = None,
) -> PlaybackRecord:
    """Play motions, all on one time axis, and wait until the servos have arrived.

    Args:
        driver: armed.
        motions: arm -> phases, as planned; arms that are not named hold still.
        called_off: looked at before every group move; once it says True the arms hold where they were last sent.
        on_tick: called with the motion's time after every group move.

    Raises:
        InvalidSetting: a motion does not begin where its arm is.
        Stalled: the host fell behind by more than ``stream.late_s``; the arms hold.
        CommandRejected, Stopped, PulseMismatch, ArmingLost, ConnectionLost, BadReply: as :meth:`ArmDriver.move`.
    """
    settings, clock = driver.config.stream, driver.clock
    tracks = [_track(driver, arm, phases) for arm, phases in motions.items() if phases]
    if not tracks:
        return PlaybackRecord(0, 0.0, True)
    begin_s, end_s = min(float(track.t_s[0]) for track in tracks), max(float(track.t_s[-1]) for track in tracks)
    due_s, moves, latest_s = clock.now_s(), 0, 0.0
    count = max(1, math.ceil((end_s - begin_s) / settings.period_s - 1e-9))
    for number in range(count):
        driver.wait(due_s - clock.now_s())
        late_s = clock.now_s() - due_s
        latest_s = max(latest_s, late_s)
        if late_s > settings.late_s:
            raise Stalled(late_s, settings.late_s)
        if called_off is not None and called_off():
            driver.settle(settings.period_s + settings.settle_s)
            return PlaybackRecord(moves, latest_s, False)
        t_s = begin_s + (number + 1) * settings.period_s
        driver.move([track.at(t_s) for track in tracks if track.t_s[0] < t_s < track.t_s[-1] + settings.period_s], settings.period_s)
        sent_s = clock.now_s()
        due_s = (due_s if sent_s - due_s <= SLACK_S else sent_s) + settings.period_s
        moves += 1
        if on_tick is not None:
            on_tick(min(t_s, end_s))
    driver.settle(settings.period_s + settings.settle_s)
    return PlaybackRecord(moves, latest_s, True)


def _track(driver: ArmDriver, arm: int, phases: Sequence[Phase]) -> _Track:
    """The phases joined, each one's first sample being the last of the one before."""
    kept = [slice(0 if index == 0 else 1, None) for index in range(len(phases))]
    track = _Track(
        arm,
        np.concatenate([phase.t_s[part] for phase, part in zip(phases, kept, strict=True)]),
        np.concatenate([phase.joints_rad[part] for phase, part in zip(phases, kept, strict=True)]),
        np.concatenate([phase.gripper_mm[part] for phase, part in zip(phases, kept, strict=True)]),
    )
    away_rad = float(np.abs(track.joints_rad[0] - driver.joints_rad()[arm]).max())
    if not away_rad <= START_RAD:
        raise InvalidSetting(
            f"the motion of arm {arm}", f"begins {math.degrees(away_rad):.1f} degrees from where the arm is", "a start there"
        )
    return track


_STILL_RAD = 1e-6


class Backlash:
    """Takes the backlash out of the motions of all arms, remembering which way each joint came last.

    A servo rests half its dead band short of where it is sent, on the side it came from: 4 us, or 0.4 degrees, that put a hand 2 mm off.
    That has an exact inverse: aim half the band further in the direction of motion, and let the aim jump by the whole band where the
    direction turns. ``calibrate what=servos`` finds the width of each servo's band.

    Args:
        half_band_rad: (num_arms, 5) half the dead band of each joint's servo.
        lower_rad: (5,) lower limits that the aims keep to.
        upper_rad: (5,) upper ones.
    """

    def __init__(self, half_band_rad: Floats, lower_rad: Floats, upper_rad: Floats) -> None:
        self._half, self._lower, self._upper = half_band_rad, lower_rad, upper_rad
        self.compensation_rad = np.zeros_like(half_band_rad)
        """(num_arms, 5): how far beyond where it is wanted each joint was aimed last."""

    def reset(self) -> None:
        """The arms were moved by something else: nobody knows on which side of its band a servo rests."""
        self.compensation_rad[:] = 0.0

    def compensated(self, arm: int, phases: Sequence[Phase]) -> tuple[Phase, ...]:
        """``phases`` of ``arm`` as they have to be aimed; each begins with the last sample of the one before, as it was."""
        joined = np.concatenate([phase.joints_rad for phase in phases])
        aims = np.clip(joined + self._compensations(arm, joined), self._lower, self._upper)
        ends = np.cumsum([len(phase.t_s) for phase in phases])[:-1]
        return tuple(replace(phase, joints_rad=part) for phase, part in zip(phases, np.split(aims, ends), strict=True))

    def note_reached(self, arm: int, wanted_rad: Floats, aimed_rad: Floats) -> None:
        """The arm stands where it was aimed, which is where it was wanted."""
        self.compensation_rad[arm] = aimed_rad - wanted_rad

    def _compensations(self, arm: int, joints_rad: Floats) -> Floats:
        """(n, 5): half a band in the direction of the last motion up to each sample."""
        steps = np.diff(joints_rad, axis=0)
        way = np.zeros_like(joints_rad)
        way[0] = np.sign(self.compensation_rad[arm])
        for index, step in enumerate(steps):
            way[index + 1] = np.where(np.abs(step) > _STILL_RAD, np.sign(step), way[index])
        return way * self._half[arm]


_RESUMED = 6
"""How often one motion is taken up again."""

_ASTRAY_S = 0.2
"""Boards may be so far before or behind the host's idea of a motion: a move may have been written and lost, or done and not noted."""

_RETRY_S = 0.5
_COMMITTED_S = 0.25
"""So long before the hand is at the pin it goes on, whatever is seen: it hides the block."""

_FINAL = (Stopped, PulseMismatch)
"""Every channel was told to stop, and this session moves nothing any more."""


class TrajectoryPlayer:
    """Plays motions through the driver of ``workcell``."""

    def __init__(self, workcell: Workcell) -> None:
        self.workcell, self.log, self.driver = workcell, workcell.log, workcell.driver
        arm = workcell.driver.model.arm
        self.backlash = Backlash(workcell.half_band_rad, arm.lower_rad, arm.upper_rad)
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
        """Where the arms are wanted (num_arms, 5), the servos' backlash taken out; NaN for one whose position is not known."""
        return self.driver.joints_rad() - self.backlash.compensation_rad

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
        except (ArmingLost, ConnectionLost):
            return self._start_over()
        aimed = self.backlash.compensated(arm, phases)
        self.reached_s = float(aimed[0].t_s[0])
        rest: Sequence[Phase] = aimed
        held_once = False
        for _ in range(_RESUMED):
            try:
                turned = stream(self.driver, {arm: rest}, on_tick=self._tick, called_off=self._turning(aimed, called_off))
                if not turned.finished:
                    return self._turn_back(arm, aimed[0])
                self.backlash.note_reached(arm, phases[-1].joints_rad[-1], aimed[-1].joints_rad[-1])
                return True
            except ServoAstray as failure:
                if held_once:
                    raise
                held_once = True
                self.log.add(Event.PULSE_MISMATCH, text=failure)
                self.driver.wait(_RETRY_S)
                self.driver.recover()
            except _FINAL:
                raise
            except ArmingLost as failure:
                self.log.add(Event.CONTROLLER_RESET, text=failure)
                if not (isinstance(failure, ServoFault) and self._resynced()):
                    return self._start_over()
            except ConnectionLost as failure:
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
            fingers = [self.driver.gripper_mm(arm) for arm in range(len(self.backlash.compensation_rad))]
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
        end_s = self.workcell.clock.now_s() + self.workcell.config.watch.timeout_s
        while True:
            try:
                if self.driver.state in (State.LOST, State.DISCONNECTED):
                    self.driver.reconnect()
                self.driver.arm()
                break
            except (NotConfirmed, CommandRejected, *_FINAL):
                raise
            except DeviceError:
                if self.workcell.clock.now_s() >= end_s:
                    raise
                self.driver.wait(_RETRY_S)
        self.backlash.reset()
        self.log.add(Event.ARMED, joints_rad=self.driver.joints_rad())

    def _reconnect(self) -> bool:
        """After a lost port: connect again and take the arms where the boards hold them; False if a board has forgotten them.

        Raises :class:`DeviceError` if the port does not come back.
        """
        begun_s = self.workcell.clock.now_s()
        self.driver.reconnect()
        if not self._resynced():
            self.log.add(Event.CONTROLLER_RESET, text="after the port was lost")
            return False
        self.log.add(Event.RECOVERED, what=Event.SERIAL_LOST, after_s=self.workcell.clock.now_s() - begun_s)
        return True

    def _resynced(self) -> bool:
        """Whether the arms could be taken where they are held, for the motion to go on from there. An overload that passes ends with it."""
        end_s = self.workcell.clock.now_s() + self.driver.config.timeouts.reconnect_s
        while True:
            try:
                self.driver.resync()
                return True
            except (ArmingLost, CommandRejected):
                return False
            except (BadReply, ConnectionLost):
                if self.workcell.clock.now_s() >= end_s:
                    return False
                self.driver.reconnect()

    def _start_over(self) -> bool:
        """From the parked pose, into which somebody has put the arms. Always False: the motion was broken off."""
        begun_s = self.workcell.clock.now_s()
        if self.driver.state is State.LOST and self._reconnect():
            self.driver.torque_off()
        self._arm()
        self.log.add(Event.RECOVERED, what=Event.CONTROLLER_RESET, after_s=self.workcell.clock.now_s() - begun_s)
        return False

    def _go_home(self, arm: int, phases: Sequence[Phase]) -> bool:
        """An arm that must not go on goes straight home, if the way is clear and its hand empty; else somebody has to help. False."""
        holding = any(phase.name in LOADED_PHASES and phase.t_s[0] <= self.reached_s <= phase.t_s[-1] for phase in phases)
        try:
            if holding:
                raise WrongState("drive home", "holding the block", "an empty hand")
            self.driver.drive(arm, self.driver.parked_rad, self.driver.gripper_mm(arm), self.driver.config.park_deg_s)
            self.backlash.compensation_rad[arm] = 0.0
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
