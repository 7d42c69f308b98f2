"""The table from above, as a picture, and a window that shows pictures."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.cell import Cell
from marl_handover.errors import NoWindow, first_line
from marl_handover.palette import arm_colour

Mask = NDArray[np.bool_]

SIZE_PX = 320
MARGIN_MM = 30.0
TABLE = (246, 244, 239)
REACH = ((214, 229, 245), (247, 222, 208))  # one colour an arm, repeated if there are more
SHARED = (214, 233, 208)
INK = (60, 60, 60)
BLOCK = (201, 74, 54)
GOAL = (34, 120, 70)
PLACE = (120, 60, 150)
HOME = 0.8
"""Of the inner radius: how far out an arm is drawn that does nothing."""
ARM_WIDTH, HAND = 0.22, 0.72
"""Half of an arm's width at its base, and the hand's radius, in sides of the block: the hand is seen around it."""


class TopView:
    """The cell's table, world x to the right and y up, from ``-half_mm`` to ``half_mm`` both ways; what does not move is drawn once.

    Args:
        cell: the cell.
    """

    def __init__(self, cell: Cell) -> None:
        self.side_mm, self.arms = cell.config.block.side_mm, cell.arms
        self.half_mm = (
            max(*(arm.r_max_mm for arm in cell.arms), *(max(abs(base.x_mm), abs(base.y_mm)) + self.side_mm for base in cell.bases))
            + MARGIN_MM
        )
        ticks = np.linspace(-self.half_mm, self.half_mm, SIZE_PX)
        self._x, self._y = np.broadcast_to(ticks, (SIZE_PX, SIZE_PX)), np.broadcast_to(ticks[::-1, None], (SIZE_PX, SIZE_PX))
        self._line_mm = 2 * self.half_mm / SIZE_PX  # half of a line's width: lines are two pixels wide
        reach = cell.reaches(np.stack([self._x, self._y], -1))
        self._table = np.full((SIZE_PX, SIZE_PX, 3), TABLE, np.uint8)
        for arm, base in enumerate(cell.bases):
            self._table[reach[..., arm]] = REACH[arm % len(REACH)]
            self._table[np.hypot(self._x - base.x_mm, self._y - base.y_mm) < self.side_mm / 2] = INK
        self._table[reach.sum(-1) > 1] = SHARED

    def draw(
        self, pose: Floats, goal: Floats | None = None, place_mm: Floats | None = None, hands_mm: Floats | None = None
    ) -> NDArray[np.uint8]:
        """The picture (height, width, 3) of the block at ``pose`` (3,), a square whose notch is its front.

        ``goal`` (3,) adds the outline of the block there, ``place_mm`` (2,) a cross, ``hands_mm`` (num_arms, 2) the arms.
        """
        picture = self._table.copy()
        for arm, hand in enumerate([] if hands_mm is None else hands_mm):
            self._draw_arm(picture, arm, hand)
        if place_mm is not None:
            dx, dy = abs(self._x - place_mm[0]), abs(self._y - place_mm[1])
            picture[(np.minimum(dx, dy) < self._line_mm) & (np.maximum(dx, dy) < self.side_mm / 2)] = PLACE
        picture[self._square(pose, 0.0)] = BLOCK
        picture[self._front(pose)] = TABLE
        if goal is not None:
            outline = self._square(goal, self._line_mm) & ~self._square(goal, -self._line_mm)
            picture[outline | self._front(goal)] = GOAL
        return picture

    def hands_mm(self, pose: Floats, holder: int) -> Floats:
        """Where hands (num_arms, 2) are while ``holder`` (-1: none) is at the block at ``pose`` (3,) and the others are drawn in."""
        home = [arm.at(HOME * arm.r_min_mm, sum(arm.yaw_rad) / 2) for arm in self.arms]
        return np.array([pose[:2] if index == holder else at[:2] for index, at in enumerate(home)])

    def _draw_arm(self, picture: NDArray[np.uint8], arm: int, hand_mm: Floats) -> None:
        """A link from the base to the hand, with a joint at either end: from above, an arm is straight."""
        base = np.array([self.arms[arm].base.x_mm, self.arms[arm].base.y_mm])
        along = hand_mm - base
        share = ((self._x - base[0]) * along[0] + (self._y - base[1]) * along[1]) / max(float(along @ along), 1.0)
        share = np.clip(share, 0.0, 1.0)
        off = np.hypot(self._x - base[0] - share * along[0], self._y - base[1] - share * along[1])
        width = self.side_mm * ARM_WIDTH * (1.0 - 0.4 * share)
        colour = rgb(arm_colour(arm))
        picture[off < width + self._line_mm] = TABLE
        picture[off < width] = colour
        for at in (base, base + 0.5 * along):
            picture[np.hypot(self._x - at[0], self._y - at[1]) < 0.5 * width] = TABLE
        picture[np.hypot(self._x - hand_mm[0], self._y - hand_mm[1]) < self.side_mm * HAND] = colour

    def _square(self, pose: Floats, grow_mm: float) -> Mask:
        along, across = self._local(pose)
        return np.maximum(abs(along), abs(across)) <= self.side_mm / 2 + grow_mm

    def _front(self, pose: Floats) -> Mask:
        """A stroke from the centre to the middle of the front side."""
        along, across = self._local(pose)
        return (along > 0) & (along <= self.side_mm / 2) & (abs(across) < self._line_mm)

    def _local(self, pose: Floats) -> tuple[Floats, Floats]:
        dx, dy, cosine, sine = self._x - pose[0], self._y - pose[1], np.cos(pose[2]), np.sin(pose[2])
        return cosine * dx + sine * dy, cosine * dy - sine * dx


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of ``#rrggbb``."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def no_window_because() -> str:
    """Why this machine shows no window; empty if it does."""
    if importlib.util.find_spec("tkinter") is None:
        return "this Python has no tkinter"
    return "there is no display (DISPLAY is not set)" if sys.platform == "linux" and not os.environ.get("DISPLAY") else ""


class Window:
    """A window for pictures, of the standard library's Tk.

    Args:
        fps: pictures a second, at most.

    Raises:
        NoWindow: it cannot be opened.
    """

    def __init__(self, fps: float) -> None:
        why = no_window_because()
        if not why:
            import tkinter

            try:
                self._root: Any = tkinter.Tk()
            except tkinter.TclError as error:
                why = first_line(error)
        if why:
            raise NoWindow("human", ["rgb_array"], why)
        self._root.title("marl_handover")
        self._label = tkinter.Label(self._root)
        self._label.pack()
        self._image, self._period_s, self._shown_s = tkinter.PhotoImage, 1.0 / fps, 0.0

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture (height, width, 3), no sooner than is due."""
        time.sleep(max(0.0, self._shown_s + self._period_s - time.monotonic()))
        height, width, _ = picture.shape
        self._photo = self._image(data=b"P6 %d %d 255 " % (width, height) + picture.tobytes())
        self._label.configure(image=self._photo)
        self._root.update()
        self._shown_s = time.monotonic()

    def close(self) -> None:
        """Close it."""
        self._root.destroy()
