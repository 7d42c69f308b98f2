"""Reading the traces that ``evaluate trace=FILE`` writes, of every backend, and what exact arms would have made of them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.cell import Cell
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.config import LoopConfig
from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.runtime.reach import drawn_in
from marl_handover.task.rules import ROUNDING_RAD, Command, Outcome, Rules

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Trace(NamedTuple):
    """Episodes of a trace (n), in order, each up to its first verdict. Poses (n, 3) in mm and rad.

    ``before`` and ``end`` are the object's poses around the last transfer, which ``arm`` made, as a ``final`` one or not. ``outcome`` holds
    values of :class:`Outcome`, as the trace judged. ``looped``: it is one of the closed loop, where poses are measured ones.
    """

    episode: Integers
    start: Floats
    goal: Floats
    before: Floats
    end: Floats
    arm: Integers
    final: NDArray[np.bool_]
    outcome: Integers
    transfers: Integers
    epsilon_rad: Floats
    looped: NDArray[np.bool_]

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Which episodes succeeded."""
        return np.asarray(self.outcome == int(Outcome.SUCCESS))

    def take(self, rows: NDArray[Any]) -> Trace:
        """Some of the episodes."""
        return Trace(*(column[rows] for column in self))


def read_trace(path: Path) -> Trace:
    """The episodes of a trace. What came after an episode's first verdict is left out; one without a verdict is a time-out: nobody moved.

    Raises:
        MissingFile, CorruptFile: with the line's number.
    """
    if not path.is_file():
        raise MissingFile("trace", path)
    first: dict[int, dict[str, Any]] = {}
    last: dict[int, dict[str, Any]] = {}
    count: dict[int, int] = {}
    for step in _steps(path):
        episode = step["episode"]
        first.setdefault(episode, step)
        last[episode] = step
        count[episode] = count.get(episode, 0) + 1
    if not first:
        raise CorruptFile("trace", path, "it holds no step")
    numbers = sorted(first)
    ends = [last[number] for number in numbers]
    return Trace(
        episode=np.array(numbers, int),
        start=np.array([first[number]["state"] for number in numbers], float),
        goal=np.array([end["goal"] for end in ends], float),
        before=np.array([end["state"] for end in ends], float),
        end=np.array([end["next_state"] for end in ends], float),
        arm=np.array([end["arm"] for end in ends], int),
        final=np.array([end["final"] for end in ends], bool),
        outcome=np.array([end["outcome"] or int(Outcome.TIMEOUT) for end in ends], int),
        transfers=np.array([count[number] for number in numbers], int),
        epsilon_rad=np.array([end["epsilon_rad"] for end in ends], float),
        looped=np.array([end["looped"] for end in ends], bool),
    )


def _steps(path: Path) -> Iterator[dict[str, Any]]:
    """Every step of a first attempt."""
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            row = json.loads(line)
            if int(row.get("attempt", 0)) > 0:
                continue
            step = _step(row)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise CorruptFile("trace", path, f"line {number} is no step of an episode") from error
        yield step


def _step(row: dict[str, Any]) -> dict[str, Any]:
    """A line's values, checked; outcome and arm as numbers."""
    verdict = row["outcome"]
    return {
        "episode": int(row["episode"]),
        **{key: _pose(row[key]) for key in ("state", "goal", "next_state")},
        "arm": ARM_LETTERS.index(row["arm"]),
        "final": bool(row["final"]),
        "outcome": 0 if verdict is None else int(Outcome[str(verdict).upper()]),
        "epsilon_rad": float(row["epsilon_rad"]),
        "looped": "attempt" in row,
    }


def _pose(value: Any) -> list[float]:
    x_mm, y_mm, theta_rad = (float(number) for number in value)
    if not all(map(math.isfinite, (x_mm, y_mm, theta_rad))):
        raise ValueError
    return [x_mm, y_mm, theta_rad]


def errors_at_end(trace: Trace, symmetry_order: int) -> tuple[Floats, Floats]:
    """How far from the goal each episode (n,) left the object: mm, and rad modulo the block's symmetry."""
    away_mm = np.hypot(*(trace.end[:, :2] - trace.goal[:, :2]).T)
    turn = (trace.end[:, 2] - trace.goal[:, 2]) * symmetry_order
    return away_mm, np.abs(np.arctan2(np.sin(turn), np.cos(turn))) / symmetry_order


def as_seen(cell: Cell, poses: Floats) -> Floats:
    """Measured poses (n, 3) as the closed loop shows them to a policy: those just out of reach at the edge of it."""
    edge_mm = LoopConfig().edge_mm
    return np.stack([drawn_in(cell, pose, edge_mm) for pose in poses]) if len(poses) else poses


def foreseen(trace: Trace, rules: Rules) -> Integers:
    """What exact arms would have made of each episode's last transfer (n,): an :class:`Outcome`; NONE for a hand-over.

    ``rules`` are those of architecture B.
    """
    seen = np.where(trace.looped[:, None], as_seen(rules.cell, trace.before), trace.before)
    placed, feasible = rules.transfer(seen, trace.goal, Command(trace.final, trace.arm, trace.goal[:, :2]))
    verdict = rules.judge(placed, trace.goal, trace.final, feasible, trace.epsilon_rad + ROUNDING_RAD)
    return np.where(trace.final, verdict.outcome, int(Outcome.NONE))
