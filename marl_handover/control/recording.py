"""Recording of episodes: where the arms are and what the camera shows, at a fixed rate, for LeRobot.

    with Recorder("runs/data", fps=10) as recorder, make_loop(...) as loop:
        recorder.attach(loop)

The session sees and does nothing else than without it. On the twin's clock frames are taken between what happens, and pictures are drawn
besides those that the session looks at. On a real cell a thread of its own looks, as pages' telemetry does.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.control.hardware_backend import HardwareBackend
from marl_handover.control.lerobot_dataset import DatasetWriter, names_of, pyarrow, require_new_folder
from marl_handover.errors import InvalidSetting, counted
from marl_handover.geometry.urdf import JointSource
from marl_handover.hardware.clock import Clock, VirtualClock
from marl_handover.perception.calibration import Pixels

if TYPE_CHECKING:
    from marl_handover.control.closed_loop import ClosedLoop
    from marl_handover.control.workcell import Workcell

LOG = logging.getLogger(__name__)

CAMERA = "top"
"""What the camera over the table is called."""

OPEN_PERCENT = 100.0


class Playing(Protocol):
    """An episode while it goes on."""

    goal: Floats
    """Where the object is to go (3,) at present; not finite while nobody knows."""
    ended: str | None
    """``success``, or in what other way it ended."""


class Recorder:
    """A context manager around a session; see :class:`~marl_handover.control.lerobot_dataset.DatasetWriter` for what it leaves.

    Args:
        folder: of the dataset; must not exist.
        fps: frames a second.

    Raises:
        MissingExtra: pyarrow is not installed.
        InvalidSetting, MissingFile: the folder is there already, or the one that it is to be in is not.
    """

    def __init__(self, folder: Path | str, fps: int) -> None:
        pyarrow("record")
        self.folder, self.fps = require_new_folder("record", folder), fps
        self._writer: DatasetWriter | None = None
        self._arms: ArmReadings | None = None
        self._pace: Pace | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._writer is None:
            return
        self._forget()
        self._writer.__exit__(kind, error, trace)
        if kind is not None:
            LOG.warning("%s; an episode that was broken off is left out", self.told())

    def attach(self, loop: ClosedLoop) -> None:
        """Record what ``loop`` plays from now on.

        Raises:
            InvalidSetting: nothing moves, or no camera shows it at any time.
        """
        backend, told = loop.backend, str(self.folder)
        if not isinstance(backend, HardwareBackend) or backend.workcell.driver.dry_run:
            raise InvalidSetting("record", told, "left out where no arm moves, or no camera shows it")
        workcell = backend.workcell
        if workcell.twin is None and workcell.camera.newest() is None:
            raise InvalidSetting("record", told, "left out with a camera.source whose pictures are taken when they are read")
        self._arms = ArmReadings(workcell, backend.motion.finger_travel_mm)
        self._writer = DatasetWriter(self.folder, self.fps, self._arms.names, CAMERA, workcell.config.hardware.name).__enter__()
        loop.recorder = self

    @contextmanager
    def episode(self, run: Playing) -> Iterator[None]:
        """Record what goes on inside the block; it is an episode if that ends without an error.

        Raises :class:`CannotWrite` at the block's end.
        """
        assert self._writer is not None
        assert self._arms is not None
        self._forget()
        frames = _Frames(self._writer, self._arms, run)
        self._pace = Pace(self._arms.workcell.clock, 1 / self.fps, frames.take)
        try:
            yield
        finally:
            self._pace.stop()  # no more: arms may have to be stopped now
        self._pace.join()
        frames.save()

    def told(self) -> str:
        """What was recorded, in a line."""
        episodes, frames = (0, 0) if self._writer is None else (self._writer.episodes, self._writer.frames)
        where = f": {self.folder}" if episodes else ""
        return f"recorded {counted(episodes, 'episode')}, {counted(frames, 'frame')} at {self.fps} a second{where}"

    def _forget(self) -> None:
        """An episode that was broken off."""
        if self._pace is not None:
            self._pace.join()
        if self._writer is not None:
            self._writer.drop_episode()


def recording(folder: str, fps: int) -> AbstractContextManager[Recorder | None]:
    """A :class:`Recorder` for ``folder``; None if that is empty."""
    return Recorder(folder, fps) if folder else nullcontext()


class Pace:
    """Calls ``take`` every ``period_s`` of a clock, from now until it is stopped: at its very times on a virtual clock, else from a thread.

    A thread that is late makes up for it.
    """

    def __init__(self, clock: Clock, period_s: float, take: Callable[[], None]) -> None:
        self._begin_s, self._period_s, self._take, self._count = clock.now_s(), period_s, take, 0
        self._over, self._thread = threading.Event(), None
        if isinstance(clock, VirtualClock):
            self._schedule(clock)
        else:
            self._thread = threading.Thread(target=self._run, args=(clock,), name="recorder", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """No further call begins; waits for none."""
        self._over.set()

    def join(self) -> None:
        """Wait for the last call; again is fine."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()

    def _due_s(self) -> float:
        return self._begin_s + self._count * self._period_s

    def _schedule(self, clock: VirtualClock) -> None:
        def tick() -> None:
            if not self._over.is_set():
                self._take()
                self._count += 1
                clock.at(self._due_s(), tick)

        clock.at(self._due_s(), tick)

    def _run(self, clock: Clock) -> None:
        while not self._over.wait(max(self._due_s() - clock.now_s(), 0.0)):
            self._take()
            self._count += 1


class _Frames:
    """The frames of an episode."""

    def __init__(self, writer: DatasetWriter, arms: ArmReadings, run: Playing) -> None:
        self._writer, self._arms, self._run = writer, arms, run
        self._rows: list[Floats] = []
        self._tasks: list[str] = []
        self._limp = 0
        self._failure: Exception | None = None

    def take(self) -> None:
        """Take one now, unless the goal is not known yet. What goes wrong is kept for the end: arms may be moving."""
        if self._failure is not None or not np.isfinite(self._run.goal).all():
            return
        try:
            joints = self._arms.joints()
            unknown = np.isnan(joints)
            if unknown.any():
                if not self._rows:
                    return
                self._limp += 1
                joints = np.where(unknown, self._rows[-1], joints)
            self._writer.add_picture(self._arms.picture())
        except Exception as failure:
            self._failure = failure
            return
        self._rows.append(joints)
        self._tasks.append(task_text(self._run.goal))

    def save(self) -> None:
        """Make an episode of them. What is commanded at a frame is where the arms are sent for the next one. Raises what went wrong."""
        if self._failure is not None:
            raise self._failure
        if not self._rows:
            return
        if self._limp:
            told = "record: in %d of %d frames of episode %d an arm was limp; they have its joints as they were known last"
            LOG.warning(told, self._limp, len(self._rows), self._writer.episodes)
        self._writer.save_episode(self._rows, [*self._rows[1:], self._rows[-1]], self._tasks, self._run.ended == "success")


def task_text(goal: Floats) -> str:
    """What is to be done, in words; ``goal`` (3,) in mm and rad."""
    x_mm, y_mm, turned_deg = goal[0], goal[1], np.degrees(goal[2])
    return f"Bring the block to ({x_mm:z.0f}, {y_mm:z.0f}) mm, turned to {turned_deg:z.0f} degrees, from arm to arm where one alone cannot."


class ArmReadings:
    """What the driver and the camera of a workcell say, in the words of LeRobot.

    Attributes:
        names: of the numbers of a reading: the joints of each arm that the robot has, then its gripper.
    """

    def __init__(self, workcell: Workcell, finger_travel_mm: float) -> None:
        self.workcell, self._travel_mm = workcell, finger_travel_mm
        self._sources = workcell.driver.model.arm.description.sources
        joints = [source.joint for source in self._sources]
        self.names = [name for arm in workcell.driver.config.arms for name in names_of(arm, joints)]

    def joints(self) -> Floats:
        """Where the arms are by now (names,), as far as the driver knows, NaN where it does not.

        Joints in degrees, as the robot's own file counts them; hands in percent, 0 closed and 100 open.
        """
        driver, arms = self.workcell.driver, []
        for arm, joints_rad in enumerate(driver.joints_rad()):
            arms += [*own_degrees(self._sources, joints_rad), OPEN_PERCENT * driver.gripper_mm(arm) / self._travel_mm]
        return np.array(arms)

    def picture(self) -> Pixels:
        """What the camera shows, RGB (height, width, 3)."""
        if self.workcell.twin is not None:
            image = self.workcell.twin.watched()
        else:
            frame = self.workcell.camera.newest()
            assert frame is not None
            image = frame.image
        return np.ascontiguousarray(image[..., ::-1])


def own_degrees(sources: tuple[JointSource, ...], joints_rad: Floats) -> list[float]:
    """Joints (5,) of the canonical arm as the robot's URDF names and counts them, in degrees; those that it has."""
    pairs = zip(sources, joints_rad, strict=True)
    return [float(np.degrees(source.sign * q + source.offset_rad)) for source, q in pairs if source.joint is not None]
