"""The ladder: a benchmark of rungs, from two arms to eight, whose problems are fixed and whose optima are known.

A rung is a cell, a task of architecture B, and a file of problems with the fewest transfers of each. What is measured is the regret of a
problem (:func:`marl_handover.task.problems.regret`): the transfers that a policy takes more than those, or, if it fails, all that it was
allowed more than those.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.cell import Cell, cell_config, load_cell
from marl_handover.compose import from_mapping
from marl_handover.config import (
    CHARTS,
    EPSILON_DEG,
    CellConfig,
    NoiseConfig,
    TaskConfig,
    bounded,
    check_bounds,
    chosen,
    name_field,
    require_choice,
    seed_field,
)
from marl_handover.errors import ChecksumMismatch, InvalidSetting
from marl_handover.files import read_bounded, resource_path
from marl_handover.parsing import JSON_BYTES, parse_object, read_yaml
from marl_handover.task.problems import ProblemSource, sample_problems
from marl_handover.task.rules import Rules

if TYPE_CHECKING:
    from marl_handover.task.planner import ExactPlanner

FOLDER, RUNGS = "configs/ladder", "rungs.yaml"
EVALUATION, TRAINING = SPLITS = ("evaluation", "training")

STEP_MM, STEP_RAD = 1 / 16, 1 / 4096
"""Poses of problems are multiples of these, which float32 holds as they are: every library shows the same numbers."""

CLEAR_MM, CLEAR_DEG = 0.05, 0.15
"""A problem is left out if its optimum would be another with object or goal so far away, or with so much less or more of epsilon."""

FILE_SEED, TRAINING_SEED = 2_000_000_000, 3_000_000_000
"""Problems of files and of the training split come from seeds from here on; other trainings and evaluations use others."""

_BLOCK = 256


class RungProblems(NamedTuple):
    """Problems with their optima: ``start`` and ``goal`` (n, 3) in mm, mm, rad, ``optimum`` (n,), fewest transfers on exact arms."""

    start: Floats
    goal: Floats
    optimum: NDArray[np.int64]

    def take(self, rows: Any) -> RungProblems:
        """Some of them, by number or by a slice."""
        return RungProblems(*(column[rows] for column in self))


@dataclass
class Rung:
    """One rung, as ``configs/ladder/rungs.yaml`` has it."""

    name: str = name_field()  # in commands
    id: str = ""  # of Gymnasium, in the namespace marl_handover; its number goes up when the problems change
    title: str = ""
    cell: str = name_field()  # one of configs/cell
    chart: str | None = chosen(None, CHARTS)  # as cell.chart
    epsilon_deg: float = bounded(5.0, *EPSILON_DEG)
    noise: NoiseConfig = field(default_factory=NoiseConfig)  # of placements
    problems: int = bounded(1000, 1, 100_000)  # in the file
    seed: int = seed_field()  # that the file is made with; environments begin with it, too, if they are given none
    sha256: str = ""  # of the file

    @property
    def is_noisy(self) -> bool:
        """Whether its arms place a little beside where they are to."""
        return self.noise.position_mm > 0 or self.noise.yaw_deg > 0

    @property
    def path(self) -> Path:
        """The file of problems: JSON Lines of ``state``, ``goal`` and ``optimum``, which ``problems=FILE`` takes as well."""
        return resource_path(FOLDER) / f"{self.name}.jsonl"

    @cached_property
    def cell_config(self) -> CellConfig:
        """Settings of the cell."""
        return replace(cell_config(self.cell), chart=self.chart)

    def load_cell(self) -> Cell:
        """The cell, computed once."""
        return load_cell(self.cell_config)

    def task(self, layout: str = "raw") -> TaskConfig:
        """Settings of the task, with an observation layout."""
        return TaskConfig(architecture="B", epsilon_deg=self.epsilon_deg, noise=replace(self.noise), layout=layout)

    @cached_property
    def fixed(self) -> RungProblems:
        """The problems of the file, which do not change.

        Raises:
            MissingFile: it is not there.
            ChecksumMismatch: it is another one than the rung's.
        """
        content = read_bounded(self.path, JSON_BYTES, "ladder's problems")
        found = hashlib.sha256(content).hexdigest()
        if found != self.sha256:
            raise ChecksumMismatch(self.path, found, self.sha256)
        rows = [parse_object(line) for line in content.decode().splitlines()]
        start, goal = (np.array([row[name] for row in rows], float) for name in ("state", "goal"))
        optimum = np.array([row["optimum"] for row in rows])
        for column in (start, goal, optimum):
            column.setflags(write=False)
        return RungProblems(start, goal, optimum)

    def drawn(self, count: int, seed: int) -> RungProblems:
        """``count`` random problems, of the kind that the file has: solvable, and clearly so."""
        parts, have, generator = [], 0, torch.Generator().manual_seed(seed)
        while have < count:
            part = _clear_problems(Rules(self.load_cell(), self.task()), generator)
            parts.append(part)
            have += len(part.optimum)
        return _joined(parts).take(slice(count))

    def file_text(self) -> str:
        """What the file has to hold."""
        made = self.drawn(self.problems, FILE_SEED + self.seed)
        rows = zip(made.start.tolist(), made.goal.tolist(), made.optimum.tolist(), strict=True)
        return "".join(json.dumps({"state": state, "goal": goal, "optimum": optimum}) + "\n" for state, goal, optimum in rows)


def rungs() -> tuple[Rung, ...]:
    """All rungs, the lowest first."""
    return _rungs(resource_path(FOLDER) / RUNGS)


@cache
def _rungs(path: Path) -> tuple[Rung, ...]:
    found = tuple(from_mapping(Rung, row, path) for row in read_yaml(path, "ladder")["rungs"])
    for each in found:
        check_bounds(each)
    return found


def rung(name: str) -> Rung:
    """The rung of that name. Raises :class:`UnknownChoice`."""
    known = {each.name: each for each in rungs()}
    require_choice("ladder", name, tuple(known))
    return known[name]


class RungSource(ProblemSource):
    """The problems of a rung, one after another: those of its file in order, beginning again after the last, or random ones like them.

    Args:
        of: the rung.
        split: ``evaluation``, the file, or ``training``, random ones; other seeds than the file's make them.
    """

    def __init__(self, of: Rung, split: str = EVALUATION) -> None:
        require_choice("split", split, SPLITS)
        self.rung, self.split = of, split
        super().__init__(of.load_cell())
        self.seed = of.seed

    def clear(self) -> None:
        """Begin anew, because the generator was seeded anew."""
        super().clear()
        self._next = 0
        self._waiting: RungProblems | None = None

    def take(self, count: int, draw_seed: Callable[[], int]) -> RungProblems:
        """The next ``count`` problems; ``draw_seed`` is asked for a number below 2^31 where random ones are to be drawn."""
        if self.split == EVALUATION:
            fixed = self.rung.fixed
            rows = (self._next + np.arange(count)) % len(fixed.optimum)
            self._next += count
            return fixed.take(rows)
        while self._waiting is None or len(self._waiting.optimum) < count:
            more = self.rung.drawn(_BLOCK, TRAINING_SEED + draw_seed())
            self._waiting = more if self._waiting is None else _joined([self._waiting, more])
        taken, self._waiting = self._waiting.take(slice(count)), self._waiting.take(slice(count, None))
        return taken

    def next(self, generator: np.random.Generator, options: Mapping[str, Any] | None = None) -> tuple[Floats, Floats]:
        """As the base class; ``options={"problem": k}`` goes to problem k of the file, from which those after it follow.

        Raises:
            InvalidSetting: for a number that the file does not have, besides what the base class raises.
        """
        if isinstance(options, Mapping) and "problem" in options:
            self._next = self._numbered(options["problem"])
            options = {key: value for key, value in options.items() if key != "problem"}
        given = self._given({} if options is None else options)
        (start,), (goal,), (optimum,) = self.take(1, lambda: int(generator.integers(2**31)))
        self.optimum = int(optimum)
        if given:
            start, goal = given.get("state", start), given.get("goal", goal)
            self.optimum = int(_planner(Rules(self.cell, self.rung.task())).plan(start, goal).transfers)
        return np.array(start), np.array(goal)

    def _numbered(self, number: Any) -> int:
        count = len(self.rung.fixed.optimum)
        if self.split != EVALUATION or isinstance(number, bool) or not isinstance(number, (int, np.integer)) or not 0 <= number < count:
            raise InvalidSetting("problem", number, f"a number from 0 to {count - 1}, in the split {EVALUATION}")
        return int(number)


def _joined(parts: Sequence[RungProblems]) -> RungProblems:
    start, goal, optimum = zip(*parts, strict=True)
    return RungProblems(np.concatenate(start), np.concatenate(goal), np.concatenate(optimum))


def _planner(rules: Rules) -> ExactPlanner:
    """The planner of rules. It is compiled: who only reads problems does without."""
    from marl_handover.task.planner import ExactPlanner

    return ExactPlanner(rules)


def _clear_problems(rules: Rules, generator: torch.Generator) -> RungProblems:
    """Of some random problems those whose optimum is not on an edge, on the grid of poses."""
    step = np.array([STEP_MM, STEP_MM, STEP_RAD])
    start, goal = (np.trunc(poses.numpy() / step) * step for poses in sample_problems(rules.cell, _BLOCK, generator))
    planner, epsilon_rad = _planner(rules), rules.epsilon_rad
    optimum, *beside = (
        np.asarray(planner.plan(start, goal, epsilon_rad + change).transfers) for change in np.radians([0.0, -CLEAR_DEG, CLEAR_DEG])
    )
    clear = (optimum > 0) & np.logical_and.reduce([other == optimum for other in beside])
    for poses in (start, goal):
        clear &= _clearly_reached(rules.cell, poses)
    return RungProblems(start[clear], goal[clear], optimum[clear])


def _clearly_reached(cell: Cell, poses: Floats) -> NDArray[np.bool_]:
    """Whether the arms that reach poses (n, 3) are some, and those that reach places a little beside them: bool (n,)."""
    corners = np.array([(x, y, 0.0) for x in (-CLEAR_MM, CLEAR_MM) for y in (-CLEAR_MM, CLEAR_MM)])
    reached = cell.reaches(poses)
    there: NDArray[np.bool_] = reached.any(-1) & (cell.reaches(poses[:, None] + corners) == reached[:, None]).all((-1, -2))
    return there
