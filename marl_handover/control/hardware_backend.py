"""Transfers carried out by servo arms and seen by a camera, real ones or the twin's: a backend of the closed loop.

Whatever goes wrong becomes an :class:`~marl_handover.control.events.Event` and has its reaction here; the loop only sees where the block
lies then. Nothing waits without a limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats, wrap
from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.control.events import Event
from marl_handover.control.settings import WorkcellConfig, twin_workcell
from marl_handover.control.trajectory_player import TrajectoryPlayer
from marl_handover.control.workcell import open_workcell
from marl_handover.envs.backends import Execution
from marl_handover.envs.cycle_check import CycleCheck, Refusal, welded
from marl_handover.errors import WorkFailed
from marl_handover.hardware.estop import PrivateStop, StopLatch
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.motion.pick_place import timed_phases
from marl_handover.motion.trajectory import LOADED_PHASES, Phase, PickPlacePaths
from marl_handover.perception.calibration import Pixels
from marl_handover.task.rules import carried

FRESH_S = 0.5
"""A look that is no older than this need not be taken again."""

_EDGE_MM = 1.0


class BlockNotSeen(WorkFailed):
    """The block does not show itself, or the camera gives no pictures."""

    def __init__(self, camera_works: bool, patience_s: float) -> None:
        what = "the block was not seen lying still" if camera_works else "the camera gave no new picture"
        super().__init__(f"{what} for {patience_s:g} s; is it on the table, its marker up, nothing over it, in the camera's picture?")
        self.camera_works = camera_works


class _SeenPose(NamedTuple):
    pose: Floats
    t_s: float


class HardwareBackend:
    """Arms, camera and block of one cell. See :class:`~marl_handover.envs.backends.Backend`.

    Args:
        model: the cell.
        motion: degree, limits and times of the motions, the parked pose.
        config: electronics, camera, calibration.
        confirm: is asked before first moves of a real cell; see :class:`~marl_handover.hardware.driver.ArmDriver`.
        dry_run: do all but the last write. Nothing moves, and the block is taken to be where exact arms would have put it.
        log_path: of the session's log; empty: there is none.
        grippers: take the hands as ``calibrate what=grippers`` found them, if it did; else as the settings say.
        latch: the stop; the one of the settings unless given.

    Raises:
        MissingFile, CorruptFile, CalibrationProblem: it was not calibrated.
        NoCamera: the camera is not there.
    """

    exact = False

    def __init__(
        self,
        model: CellModel,
        motion: MotionConfig,
        *,
        config: WorkcellConfig,
        confirm: Callable[[str], bool] | None = None,
        dry_run: bool = False,
        log_path: str = "",
        grippers: bool = True,
        latch: StopLatch | None = None,
    ) -> None:
        self.workcell = workcell = open_workcell(
            config, model, motion, confirm=confirm, dry_run=dry_run, log_path=log_path, grippers=grippers, latch=latch
        )
        self.model, self.motion, self.log = model, motion, workcell.log
        self.config, self.clock = workcell.config.watch, workcell.clock
        self.chart_inset = config.chart_inset
        self.same = (self.config.moved_mm, math.radians(self.config.moved_deg))
        self.check = CycleCheck(model, motion)
        self.player = TrajectoryPlayer(workcell)
        self.hold: Callable[[], bool] = lambda: False
        """Called before arms are made to move; waits for as long as they must not, and says whether it had to."""
        self._last = _SeenPose(np.zeros(3), -math.inf)
        self._idle = [0] * model.cell.num_arms
        self._unseen = False

    def reset(self, pose: Floats, seed: int) -> Floats:
        """Arm if that is due and look; its measured pose (3,). On the twin somebody puts the block at ``pose`` first.

        Raises:
            Stopped: the stop is latched; whatever waits here looks at it.
            BlockNotSeen: it does not show itself.
            DeviceError: the electronics cannot be brought up.
        """
        self._unseen = False
        self.hold()
        self.player.ready()
        if self.workcell.twin is not None:
            self.workcell.twin.set_object_pose(pose)
        self._idle = [0] * self.model.cell.num_arms
        self._last = _SeenPose(np.zeros(3), -math.inf)
        self.workcell.pose_monitor.forget()
        return self._look()

    def joints_rad(self) -> Floats:
        """Where the arms were sent: (num_arms, 5). Servos say nothing."""
        return self.player.joints_rad()

    def goal(self) -> Floats | None:
        """Where the printed goal lies (3,), as it was seen last; None if it never was."""
        return self.workcell.pose_monitor.last_goal

    def true_pose(self) -> Floats:
        """Of the twin: where the block truly is (3,). Of a real cell: where it was seen last."""
        return self._last.pose.copy() if self.workcell.twin is None else self.workcell.twin.true_pose()

    def watch(self) -> Floats | None:
        """Where the block lies (3,). One that no arm reaches is waited for, as long as there is patience.

        So is one that was out of sight after the last transfer; None if it still is.

        Raises as :meth:`execute`.
        """
        before, last_s = self._last
        if self.workcell.driver.dry_run:
            return before.copy()
        if self.clock.now_s() - last_s > FRESH_S:
            try:
                self._moved_since(before)
            except BlockNotSeen as lost:
                if not (self._unseen and lost.camera_works):
                    raise
                return None
        if not self._reached():
            self._wait_for_reach()
        return self._last.pose.copy()

    def execute(self, arm: int, paths: PickPlacePaths) -> Execution:
        """Time one cycle of ``arm``, play it, park, look; the other arms hold still.

        Raises:
            Stopped: the stop is latched.
            DeviceError, BlockNotSeen: what is wrong did not pass within the settings' patience.
        """
        before = self._last.pose
        refusal = self.check(arm, paths, self.joints_rad()[arm], before[:2])
        if refusal is not None:
            return Execution(before.copy(), self.joints_rad(), 0.0, refusal)
        if self.hold() and self._moved_since(before):
            return Execution(self._last.pose.copy(), self.joints_rad(), 0.0, Refusal.MISSED_GRASP)
        phases = timed_phases(welded(paths), self.model.arms[arm], self.motion, self.model.cell.pick_heights_mm[arm])
        place = self.check.grip_mm(arm, paths.transfer[-1])[:2]
        self.log.add(Event.MOTION, arm=arm, phases=[[phase.name, float(phase.t_s[0]), float(phase.t_s[-1])] for phase in phases])
        played = self.player.play(arm, phases, None if self.workcell.driver.dry_run else self._block_watch(before))
        path_mm = self._length_mm(arm, phases)
        if self.workcell.driver.dry_run:
            moved = carried(before, place, paths.transfer[-1, 0] - paths.transfer[0, 0])
            self._last = _SeenPose(np.asarray(moved, float), self.clock.now_s())
            return Execution(self._last.pose.copy(), self.joints_rad(), path_mm, None)
        try:
            pose = self._look()
        except BlockNotSeen as lost:
            if not lost.camera_works:
                raise
            self._unseen = True
            return Execution(before.copy(), self.joints_rad(), path_mm, Refusal.UNSEEN)
        failure = self._failure(arm, before, pose, place) if played else self._unplayed(before, pose, phases)
        return Execution(pose, self.joints_rad(), path_mm, failure, float(phases[-1].t_s[-1]))

    def render(self) -> Pixels:
        """The camera's picture, RGB (height, width, 3)."""
        return np.ascontiguousarray(self.workcell.camera.read().image[..., ::-1])

    def halt(self) -> None:
        """Stop every channel where it is."""
        self.workcell.driver.halt()

    def close(self) -> None:
        """Park if the settings say so, and let everything go."""
        self.workcell.close()

    def _block_watch(self, before: Floats) -> Callable[[float], bool]:
        """Says, once in a while during an approach, whether the block is no longer where it was."""
        next_s = self.config.poll_period_s

        def moved(t_s: float) -> bool:
            """Whether it was seen elsewhere, at a time of the motion."""
            nonlocal next_s
            if t_s < next_s:
                return False
            next_s = t_s + self.config.poll_period_s
            now = self.workcell.pose_monitor.poll()
            if now is None or not self._apart(before, now):
                return False
            self.log.add(Event.BLOCK_MOVED, was=before, pose=now)
            return True

        return moved

    def _look(self) -> Floats:
        """Look until the block lies still."""
        view = self.workcell.pose_monitor.wait_steady()
        if view.block is None:
            raise BlockNotSeen(view.camera_works, self.config.timeout_s)
        self._last, self._unseen = _SeenPose(view.block, self.clock.now_s()), False
        self.log.add(Event.SEEN, pose=view.block, goal=view.goal)
        return view.block.copy()

    def _moved_since(self, before: Floats) -> bool:
        """Look; whether somebody moved the block from ``before`` (3,). In a dry run nobody looks."""
        if self.workcell.driver.dry_run:
            return False
        now = self._look()
        if not self._apart(before, now):
            return False
        self.log.add(Event.BLOCK_MOVED, was=before, pose=now)
        return True

    def _failure(self, arm: int, before: Floats, after: Floats, place_mm: Floats) -> Refusal | None:
        """What came of a motion that was played to its end."""
        if not self._apart(before, after) and math.dist(before[:2], place_mm) > self.config.moved_mm:
            self._idle[arm] += 1
            self.log.add(Event.FAILED_GRASP, arm=arm, pose=after)
            if self._idle[arm] >= self.config.failures:
                self.log.add(Event.ARM_STALLED, arm=arm)
                return Refusal.STALLED
            return Refusal.MISSED_GRASP
        self._idle[arm] = 0
        if math.dist(after[:2], place_mm) > self.config.lost_threshold_mm:
            self.log.add(Event.DROPPED, arm=arm, pose=after, place=place_mm)
            return Refusal.DROPPED
        return None

    def _unplayed(self, before: Floats, after: Floats, phases: Sequence[Phase]) -> Refusal:
        """What came of a motion that was broken off: before the hand had closed, the block was not in it."""
        closed_s = next(float(phase.t_s[-1]) for phase in phases if phase.name == "grasp")
        return Refusal.DROPPED if self.player.reached_s > closed_s and self._apart(before, after) else Refusal.MISSED_GRASP

    def _apart(self, one: Floats, other: Floats) -> bool:
        turned_deg = abs(math.degrees(float(wrap(one[2] - other[2]))))
        return math.dist(one[:2], other[:2]) > self.config.moved_mm or turned_deg > self.config.moved_deg

    def _reached(self) -> bool:
        return bool(self.model.cell.reaches(self.model.cell.clamp_to_workspace(self._last.pose, _EDGE_MM)[:2]).any())

    def _wait_for_reach(self) -> None:
        """Somebody has to put the block back."""
        self.log.add(Event.BLOCK_OUTSIDE, pose=self._last.pose)
        end_s = self.clock.now_s() + self.config.timeout_s
        while not self._reached() and self.clock.now_s() < end_s:
            self.workcell.driver.wait(10 * self.config.frame_s)
            self._look()
        if self._reached():
            self.log.add(Event.RECOVERED, what=Event.BLOCK_OUTSIDE)

    def _length_mm(self, arm: int, phases: Sequence[Phase]) -> float:
        """Of the grip's path while it holds the block."""
        carrying = [phase.joints_rad for phase in phases if phase.name in LOADED_PHASES]
        steps = np.diff(self.check.grip_mm(arm, np.concatenate(carrying)), axis=0)
        return float(np.sqrt((steps**2).sum(-1)).sum())


class TwinBackend(HardwareBackend):
    """The twin, calibrated. Unless ``hardware`` names a stop file, no stop of anybody else concerns it, and its own none of theirs.

    Args:
        model: the cell.
        motion: how the arms move.
        calibration: folder of what ``calibrate`` wrote; None: the usual one.
        hardware: its electronics; None: as they are shipped.
        engine: its physics, by name; None: PyBullet where it is installed, else MuJoCo.

    Raises:
        MissingExtra: the engine is not installed.
        MissingFile: it was not calibrated.
    """

    def __init__(
        self,
        model: CellModel,
        motion: MotionConfig,
        *,
        calibration: str | None = None,
        hardware: HardwareConfig | None = None,
        engine: str | None = None,
    ) -> None:
        config = twin_workcell(hardware)
        config.twin.engine = engine
        config.calibration = calibration or ""
        super().__init__(model, motion, config=config, latch=None if config.hardware.stop_file else PrivateStop())
