"""Where an environment for one cell takes its problems from: random ones, or those that are given."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from marl_handover.arrays import Floats, wrap
from marl_handover.cell import Cell
from marl_handover.errors import InvalidSetting, NotFinite, OutOfReach, UnknownKey
from marl_handover.task.problems import sample_problems

KEYS = ("state", "goal")
"""Of the options that set a problem."""

IGNORED = "options"
"""A key that PettingZoo's own API test sends."""

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
            UnknownKey: for another key.
            InvalidSetting: for a state or goal that is not three numbers.
            NotFinite, OutOfReach: for one that cannot be.
        """
        given = self._given({} if options is None else options)
        if not self._drawn:
            drawn = sample_problems(self.cell, self._block, torch.Generator().manual_seed(int(generator.integers(2**62))))
            self._drawn = list(zip(*(poses.numpy() for poses in drawn), strict=True))
            self._block = min(8 * self._block, LARGEST_DRAW)
        start, goal = self._drawn.pop()
        return given.get("state", start), given.get("goal", goal)

    def _given(self, options: Mapping[str, Any]) -> dict[str, Floats]:
        if not isinstance(options, Mapping):
            raise InvalidSetting("options", options, "a mapping with the keys state and goal, or None")
        for key in options:
            if key not in (*KEYS, IGNORED):
                raise UnknownKey(str(key), KEYS)
        return {key: self._checked(key, options[key]) for key in KEYS if key in options}

    def _checked(self, what: str, pose: Any) -> Floats:
        expected = "three numbers: [x_mm, y_mm, theta_rad]"
        try:
            array = np.asarray(pose, np.float64)
        except (TypeError, ValueError, ArithmeticError, RuntimeError) as error:  # what numpy and torch find wrong with it
            raise InvalidSetting(what, pose, expected) from error
        if array.shape != (3,):
            raise InvalidSetting(what, pose, expected)
        if not np.isfinite(array).all():
            raise NotFinite(what, array.tolist())
        if not self.cell.reaches(array).any():
            raise OutOfReach(what, (float(array[0]), float(array[1])), self.cell.r_min_mm, self.cell.r_max_mm)
        return np.array([array[0], array[1], wrap(array[2])])
