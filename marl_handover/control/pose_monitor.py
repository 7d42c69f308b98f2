"""Looking until it is certain where the block lies: steady sightings, frozen cameras and hidden markers told apart, never for ever."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats, wrap
from marl_handover.control.events import Event, EventLog
from marl_handover.control.settings import WatchConfig
from marl_handover.hardware.clock import Clock
from marl_handover.perception.camera import Camera, Frame, StaleFrame
from marl_handover.perception.tracker import Seen, Tracker


class View(NamedTuple):
    """What was seen: the block (3,), None if it did not show itself in time; the printed goal (3,) if there is one; if pictures came."""

    block: Floats | None
    goal: Floats | None
    camera_works: bool


class PoseMonitor:
    """Reads a camera through a tracker. ``clock`` is the camera's.

    The arms have to be out of the way: then a block that does not show itself is hidden by something else, or lies on its side.
    ``wait`` is what waiting is done with, the driver's where there is one: it looks at the latched stop all the while, and raises.
    """

    def __init__(
        self,
        camera: Camera,
        tracker: Tracker,
        clock: Clock,
        config: WatchConfig,
        log: EventLog,
        wait: Callable[[float], None] | None = None,
    ) -> None:
        self.camera, self.tracker, self.clock, self.config, self.log = camera, tracker, clock, config, log
        self._wait = wait or clock.sleep_s
        self.last_goal: Floats | None = None
        """Where the printed goal was seen last."""
        self.shown: Callable[[Frame, Seen], None] | None = None
        """Is shown every picture and what it told."""

    def forget(self) -> None:
        """Something new lies on the table: what was seen before says nothing about it."""
        self.tracker.reset()
        self.last_goal = None

    def wait_steady(self, patience_s: float | None = None) -> View:
        """Look until the block lies still in sight, for ``patience_s`` at most (None: as the settings have it).

        Raises whatever waiting does: :class:`Stopped`, if that is the driver's.
        """
        config = self.config
        begin_s = missing_s = news_s = self.clock.now_s()
        end_s = begin_s + (config.timeout_s if patience_s is None else patience_s)
        kept: list[Floats] = []
        trouble: Event | None = None
        while True:
            seen = self._read()
            works = seen is not None and not seen.frozen
            now_s = self.clock.now_s()
            if seen is None and now_s < min(news_s + config.picture_s, end_s):
                self._wait(config.frame_s)
                continue
            if seen is not None:
                news_s = now_s
            if seen is not None and works:
                self.last_goal = seen.goal.pose
            if seen is not None and works and seen.block.seen and seen.block.pose is not None:
                kept = [pose for pose in kept if self._agree(pose, seen.block.pose)] + [seen.block.pose]
            else:
                kept = []
            if not works or kept or (seen is not None and seen.block.doubted is not None):
                missing_s = now_s
            if len(kept) >= config.steady_frames:
                if trouble is not None:
                    self.log.add(Event.RECOVERED, what=trouble, after_s=now_s - begin_s)
                return View(_middle(kept), self.last_goal, True)
            problem = None if works else Event.CAMERA_FROZEN
            if now_s - missing_s > config.hidden_s:
                problem = Event.MARKER_HIDDEN
            if problem is not None and trouble is not problem:
                trouble = problem
                self.log.add(problem)
            if now_s >= end_s:
                return View(None, self.last_goal, works)
            self._wait(config.frame_s)

    def poll(self) -> Floats | None:
        """Where the block is in the newest picture (3,); None if it is not seen, or that is doubtful. Waits for nothing."""
        seen = self._read()
        return seen.block.pose if seen is not None and seen.block.seen else None

    def _read(self) -> Seen | None:
        """What the newest picture shows; None if there is no new one that is young enough. Waiting for one is the caller's."""
        try:
            frame = self.camera.read(wait_s=0.0)
        except StaleFrame:
            return None
        seen = self.tracker.update(frame)
        if self.shown is not None:
            self.shown(frame, seen)
        return seen

    def _agree(self, one: Floats, other: Floats) -> bool:
        turned_deg = abs(math.degrees(float(wrap(one[2] - other[2]))))
        return math.dist(one[:2], other[:2]) <= self.config.steady_mm and turned_deg <= self.config.steady_deg


def _middle(poses: list[Floats]) -> Floats:
    """The mean pose (3,)."""
    array = np.stack(poses)
    yaw = array[0, 2] + float(np.mean(wrap(array[:, 2] - array[0, 2])))
    return np.array([*array[:, :2].mean(axis=0), float(wrap(yaw))])
