"""A film of episodes in the simulated cell: a picture whenever one is due while arms move, with words below it if wanted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marl_handover.simulation.backend import BulletBackend
from marl_handover.simulation.captions import Caption, band_px, captioned
from marl_handover.simulation.stage import dress
from marl_handover.simulation.video import FrameClock, Video
from marl_handover.simulation.world import CONTROL_S

Floats = NDArray[np.float64]
OrientationError = Callable[[float, float], float]
"""Signed error in rad of an orientation against the goal's."""

BEGIN_S, END_S = 1.0, 2.0
"""How long the first and the last picture of an episode stand still, so that one can see the problem and how it ended."""


def picture_size(size: tuple[int, int], captions: bool) -> tuple[int, int]:
    """Width and height of the camera's part of a video of ``size``."""
    return size[0], size[1] - (band_px(size) if captions else 0)


class Film:
    """What :meth:`begin`, :meth:`turn` and :meth:`end` tell it, and what happens in between, as a video.

    Args:
        video: takes the frames.
        fps: pictures a second of simulated time.
        backend: the cell; its pictures have the size of :func:`picture_size`.
        size: width and height of the video.
        captions: whether there are words, and the arms' reach on the table.
        error: how orientations differ.
    """

    def __init__(
        self, video: Video, fps: float, backend: BulletBackend, size: tuple[int, int], captions: bool, error: OrientationError
    ) -> None:
        self._video, self._fps, self._backend, self._size, self._captions = video, fps, backend, size, captions
        self._error = error
        self._clock = FrameClock(fps, CONTROL_S)
        self._goal: Floats = np.zeros(3)
        self._transfer, self._arm, self._final, self._outcome = 0, -1, False, ""

    def begin(self, goal: Floats) -> None:
        """An episode begins: show the problem."""
        self._goal = np.asarray(goal, float)
        self._transfer, self._arm, self._final, self._outcome = 0, -1, False, ""
        self._backend.cell.show_goal(self._goal)
        if self._captions:
            dress(self._backend.cell)
        self._add(self._still(BEGIN_S))

    def turn(self, arm: int, final: bool) -> None:
        """``arm`` is to move next."""
        self._transfer, self._arm, self._final = self._transfer + 1, arm, final

    def step(self) -> None:
        """A piece of simulated time, :data:`CONTROL_S`, has passed."""
        self._add(self._clock.due())

    def end(self, outcome: str) -> None:
        """The episode is over: show how it ended."""
        self._outcome = outcome
        self._add(self._still(END_S))

    def _still(self, seconds: float) -> int:
        return max(1, round(seconds * self._fps))

    def _add(self, count: int) -> None:
        """The cell as it is now, so many times."""
        if count == 0:
            return
        picture = self._backend.render()
        if self._captions:
            picture = captioned(picture, self._caption(), self._size)
        for _ in range(count):
            self._video.add(picture)

    def _caption(self) -> Caption:
        pose = self._backend.cell.object_pose()
        away_mm = math.dist(pose[:2], self._goal[:2])
        turned_rad = float(self._error(pose[2], self._goal[2]))
        return Caption(self._transfer, self._arm, self._final, away_mm, turned_rad, self._outcome)


@contextmanager
def filming(
    path: Path | str, fps: float, backend: BulletBackend, size: tuple[int, int], captions: bool, error: OrientationError
) -> Iterator[Film]:
    """A :class:`Film` that gets a picture whenever one is due while arms move; the file appears when the block ends without an error."""
    with Video(path, fps) as video:
        film = Film(video, fps, backend, size, captions, error)
        backend.on_step = film.step
        try:
            yield film
        finally:
            backend.on_step = None
