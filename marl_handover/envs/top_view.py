"""A small picture of the table from above, drawn on a grid of pixels with numpy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.cell import Cell

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


class TopView:
    """The cell's table, world x to the right and y up, from ``-half_mm`` to ``half_mm`` both ways; what does not move is drawn once.

    Args:
        cell: the cell.
    """

    def __init__(self, cell: Cell) -> None:
        self.side_mm = cell.config.block.side_mm
        self.half_mm = max(cell.r_max_mm, *(max(abs(base.x_mm), abs(base.y_mm)) + self.side_mm for base in cell.bases)) + MARGIN_MM
        ticks = np.linspace(-self.half_mm, self.half_mm, SIZE_PX)
        self._x, self._y = np.broadcast_to(ticks, (SIZE_PX, SIZE_PX)), np.broadcast_to(ticks[::-1, None], (SIZE_PX, SIZE_PX))
        self._line_mm = 2 * self.half_mm / SIZE_PX  # half of a line's width: lines are two pixels wide
        reach = cell.reaches(np.stack([self._x, self._y], -1))
        self._table = np.full((SIZE_PX, SIZE_PX, 3), TABLE, np.uint8)
        for arm, base in enumerate(cell.bases):
            self._table[reach[..., arm]] = REACH[arm % len(REACH)]
            self._table[np.hypot(self._x - base.x_mm, self._y - base.y_mm) < self.side_mm / 2] = INK
        self._table[reach.sum(-1) > 1] = SHARED

    def draw(self, pose: Floats, goal: Floats | None = None, place_mm: Floats | None = None) -> NDArray[np.uint8]:
        """The picture (height, width, 3) of the block at ``pose`` (3,), a square whose notch is its front.

        ``goal`` (3,) adds the outline of the block there, ``place_mm`` (2,) a cross.
        """
        picture = self._table.copy()
        if place_mm is not None:
            dx, dy = abs(self._x - place_mm[0]), abs(self._y - place_mm[1])
            picture[(np.minimum(dx, dy) < self._line_mm) & (np.maximum(dx, dy) < self.side_mm / 2)] = PLACE
        picture[self._square(pose, 0.0)] = BLOCK
        picture[self._front(pose)] = TABLE
        if goal is not None:
            outline = self._square(goal, self._line_mm) & ~self._square(goal, -self._line_mm)
            picture[outline | self._front(goal)] = GOAL
        return picture

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
