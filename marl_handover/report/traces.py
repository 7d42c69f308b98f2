"""Reading the traces that ``evaluate trace=FILE`` writes, of every backend, and what exact arms would have made of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.cell.cell import Cell
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.config import LoopConfig
from marl_handover.errors import CorruptFile, InvalidSetting
from marl_handover.files import read_lines
from marl_handover.parsing import LINES_BYTES, parse_object
from marl_handover.report.arm_labels import arm_index
from marl_handover.task.rules import ROUNDING_RAD, Command, Outcome, Rules

Integers = NDArray[np.int64]


class Trace(NamedTuple):
    """Episodes of a trace (n), in order, each up to its first verdict. Poses (n, 3) in mm and rad.

    ``before`` and ``end`` are the object's poses around the last transfer, which ``arm``, by its label, made, as a ``final`` one or not.
    ``outcome`` holds values of :class:`Outcome`, as the trace judged. ``looped``: it is one of the closed loop, where poses are measured
    ones. ``place`` (n, 2): where the last transfer was to put the object, in mm; NaN if that was no place. ``external``: it is of
    architecture A, in which a refusal ends nothing. ``symmetry_order``: of the block, 0 where the file does not say, as those of older
    versions.
    """

    episode: Integers
    start: Floats
    goal: Floats
    before: Floats
    end: Floats
    arm: NDArray[np.str_]
    final: NDArray[np.bool_]
    outcome: Integers
    transfers: Integers
    epsilon_rad: Floats
    looped: NDArray[np.bool_]
    place: Floats
    external: NDArray[np.bool_]
    symmetry_order: Integers

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
        arm=np.array([end["arm"] for end in ends], str),
        final=np.array([end["final"] for end in ends], bool),
        outcome=np.array([end["outcome"] or int(Outcome.TIMEOUT) for end in ends], int),
        transfers=np.array([count[number] for number in numbers], int),
        epsilon_rad=np.array([end["epsilon_rad"] for end in ends], float),
        looped=np.array([end["looped"] for end in ends], bool),
        place=np.array([end["place"] for end in ends], float),
        external=np.array([end["external"] for end in ends], bool),
        symmetry_order=np.array([end["symmetry_order"] for end in ends], int),
    )


def _steps(path: Path) -> Iterator[dict[str, Any]]:
    """Every step of a first attempt."""
    return (step for _, step in read_lines(path, LINES_BYTES, "trace", _parsed) if step is not None)


def _parsed(line: bytes) -> dict[str, Any] | None:
    """A line's step; None if it is of a later attempt."""
    try:
        row = parse_object(line)
        return None if int(row.get("attempt", 0)) > 0 else _step(row)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError("is no step of an episode") from error


def _step(row: dict[str, Any]) -> dict[str, Any]:
    """A line's values, checked; the outcome as a number."""
    verdict = row["outcome"]
    return {
        "episode": int(row["episode"]),
        **{key: _numbers(row[key], 3) for key in ("state", "goal", "next_state")},
        "place": [math.nan, math.nan] if row["place"] is None else _numbers(row["place"], 2),
        "arm": _arm(row),
        "final": bool(row["final"]),
        "outcome": 0 if verdict is None else int(Outcome[str(verdict).upper()]),
        "epsilon_rad": float(row["epsilon_rad"]),
        "looped": "attempt" in row,
        "external": row.get("architecture", "B") == "A",
        "symmetry_order": _order(row["symmetry_order"]) if "symmetry_order" in row else 0,
    }


def _numbers(value: Any, count: int) -> list[float]:
    numbers = [float(number) for number in value]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError
    return numbers


def _arm(row: dict[str, Any]) -> str:
    """The arm's label: a letter of a mirrored pair; lines of other cells say a receiver, too."""
    label = row["arm"]
    if not isinstance(label, str) or not ("receiver" in row or label in ARM_LETTERS):
        raise ValueError
    return label


def _order(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError
    return value


def symmetry_of(trace: Trace, asked: int | None = None) -> int:
    """Symmetry order of the trace's block: as the file says, else ``asked``, else 1.

    Raises:
        InvalidSetting: if the file says another one than ``asked``, or several.
    """
    said = sorted({int(order) for order in trace.symmetry_order if order > 0})
    if len(said) > 1:
        raise InvalidSetting("trace", f"symmetry_order {said}", "of one block")
    if said and asked is not None and asked != said[0]:
        raise InvalidSetting("symmetry_order", asked, f"{said[0]}, as the trace says, or left out")
    return said[0] if said else asked or 1


def errors_at_end(trace: Trace, symmetry_order: int) -> tuple[Floats, Floats]:
    """How far from the goal each episode (n,) left the object: mm, and rad modulo the block's symmetry."""
    away_mm = np.hypot(*(trace.end[:, :2] - trace.goal[:, :2]).T)
    turn = (trace.end[:, 2] - trace.goal[:, 2]) * symmetry_order
    return away_mm, np.abs(np.arctan2(np.sin(turn), np.cos(turn))) / symmetry_order


def as_seen(cell: Cell, poses: Floats) -> Floats:
    """Measured poses (n, 3) as the closed loop shows them to a policy: those just out of reach at the edge of it."""
    slack_mm = LoopConfig().reach_slack_mm
    return np.stack([cell.clamp_to_workspace(pose, slack_mm) for pose in poses]) if len(poses) else poses


def foreseen(trace: Trace, rules: Rules) -> Integers:
    """What exact arms would have made of each episode's last transfer (n,): an :class:`Outcome`; NONE for a hand-over that can be done.

    ``rules`` are those of architecture B. A hand-over that they refuse ends as a wrong position, but in architecture A, where it goes on.
    """
    seen = np.where(trace.looped[:, None], as_seen(rules.cell, trace.before), trace.before)
    arms = np.array([arm_index(rules.cell, label) for label in trace.arm.tolist()], int)
    placed, feasible = rules.transfer(seen, trace.goal, Command(trace.final, arms, trace.place))
    verdict = rules.judge(placed, trace.goal, trace.final, feasible, trace.epsilon_rad + ROUNDING_RAD)
    return np.where(trace.external & ~trace.final, int(Outcome.NONE), verdict.outcome)
