"""Planned motions as group moves at the boards' pace.

Every ``period_s`` each moving arm is sent where its motion will be one period later, with that time; so at most one period of motion is
ever on a board, and a host that dies leaves arms that hold a moment later. A host that is late does not make up for it: the rest of the
motion comes later, at its own speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import InvalidSetting
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.errors import Stalled
from marl_handover.hardware.safety_filter import JointCommand
from marl_handover.motion.trajectory import Phase

Floats = NDArray[np.float64]

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
        CommandRejected, Stopped, PulseMismatch, BoardReset, PortLost, BadReply: as :meth:`ArmDriver.move`.
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
