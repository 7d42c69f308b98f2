"""Where an environment for one cell takes its problems from: random ones, or those that are given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from marl_handover.arrays import wrap
from marl_handover.cell import Cell
from marl_handover.errors import NotFinite, OutOfReach
from marl_handover.task.problems import sample_problems

Floats = NDArray[np.float64]

FIRST_DRAW, LARGEST_DRAW = 16, 1024
"""Problems are drawn in blocks, since one batched draw costs as much as one single draw: small ones first, for who seeds every episode."""


class ProblemSource:
    """Starts and goals of one cell; the generator it is given decides them."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.clear()

    def clear(self) -> None:
        """Forget what is drawn already, because the generator was seeded anew."""
        self._drawn: list[tuple[Floats, Floats]] = []
        self._block = FIRST_DRAW

    def next(self, generator: np.random.Generator, options: Mapping[str, Any] | None = None) -> tuple[Floats, Floats]:
        """Start and goal, each (3,): random, or as ``options`` say under ``state`` and ``goal``.

        Raises:
            NotFinite, OutOfReach: for a state or goal that cannot be.
        """
        if not self._drawn:
            drawn = sample_problems(self.cell, self._block, torch.Generator().manual_seed(int(generator.integers(2**62))))
            self._drawn = list(zip(*(poses.numpy() for poses in drawn), strict=True))
            self._block = min(8 * self._block, LARGEST_DRAW)
        start, goal = self._drawn.pop()
        options = options or {}
        return (
            self._checked("state", options["state"]) if "state" in options else start,
            self._checked("goal", options["goal"]) if "goal" in options else goal,
        )

    def _checked(self, what: str, pose: Sequence[float]) -> Floats:
        array = np.asarray(pose, np.float64)
        if array.shape != (3,) or not np.isfinite(array).all():
            raise NotFinite(what, list(pose))
        if not self.cell.reaches(array).any():
            raise OutOfReach(what, (float(array[0]), float(array[1])), self.cell.r_min_mm, self.cell.r_max_mm)
        return np.array([array[0], array[1], wrap(array[2])])
