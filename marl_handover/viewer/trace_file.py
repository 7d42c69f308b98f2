"""Trace files, as ``evaluate trace=FILE`` and ``run log=FILE`` write them, in a form in which every moment is found at once."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.errors import CorruptFile, MissingFile

Floats = NDArray[np.float64]

WHAT = "trace"


class Recorded(NamedTuple):
    """What arms were sent while a transfer went on, of m moments: ``t_s`` (m,), ``joints_rad`` (m, n, 5), ``gripper_mm`` (m, n)."""

    t_s: Floats
    joints_rad: Floats
    gripper_mm: Floats


class Step(NamedTuple):
    """One transfer: poses (3,) in mm and rad, ``place_mm`` (2,). ``trouble``: why it was not done, or not as ordered; empty if it was."""

    state: Floats
    goal: Floats
    arm: int
    final: bool
    place_mm: Floats
    next_state: Floats
    outcome: str
    epsilon_rad: float
    trouble: str
    recorded: Recorded | None = None


class Moment(NamedTuple):
    """A place in a trace: ``episode``, ``done`` of its ``transfers``, and ``first``, the number of its first step."""

    episode: int
    done: int
    transfers: int
    first: int


class Trace:
    """All steps of a file, episode by episode.

    An episode of k transfers has k + 1 moments: its start, and one after each transfer.

    Args:
        steps: all of them.
        starts: (episodes + 1,) number of each episode's first step, and at last the number of steps.
        names: of the episodes, as the file has them.
        cell: settings of the cell, if the file says which.
    """

    def __init__(self, steps: list[Step], starts: list[int], names: list[int], cell: dict[str, Any] | None) -> None:
        self.steps, self.names, self.cell = steps, names, cell
        self.starts = np.asarray(starts)
        self._first_moments = self.starts + np.arange(len(starts))

    @property
    def episodes(self) -> int:
        """How many."""
        return len(self.names)

    @property
    def moments(self) -> int:
        """How many, over all episodes."""
        return len(self.steps) + self.episodes

    def moment(self, number: int) -> Moment:
        """Number ``number`` of all."""
        episode = int(np.searchsorted(self._first_moments, number, side="right")) - 1
        first = int(self.starts[episode])
        return Moment(episode, number - int(self._first_moments[episode]), int(self.starts[episode + 1]) - first, first)

    def start_of(self, episode: int) -> int:
        """Number of an episode's first moment."""
        return int(self._first_moments[episode])


def read_trace(path: Path) -> Trace:
    """The trace in ``path``: of ``evaluate``, or of a session's log.

    Raises:
        MissingFile, CorruptFile: with the number of the line.
    """
    if not path.is_file():
        raise MissingFile("trace file", path)
    steps: list[Step] = []
    starts: list[int] = []
    names: list[int] = []
    cell, session = None, _Session()
    for number, row in _rows(path):
        try:
            name = session.take(row) if "event" in row else int(row["episode"])
            if "event" in row and row["event"] == "session":
                cell = dict(row["cell"])
            if "event" in row and row["event"] != "transfer":
                continue
            step = _step(row, session.recorded())
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise CorruptFile(WHAT, path, f"line {number} is no transfer as 'evaluate trace=FILE' writes it: {_reason(error)}") from error
        if not names or name != names[-1]:
            names.append(name)
            starts.append(len(steps))
        steps.append(step)
    if not steps:
        raise CorruptFile(WHAT, path, "it holds no transfer")
    return Trace(steps, [*starts, len(steps)], names, cell)


class _Session:
    """What a session's log has told so far: the number of its episode, and what the arms were sent since the last transfer."""

    def __init__(self) -> None:
        self.episode = -1
        self._sent: list[tuple[float, Any, Any]] = []

    def take(self, row: dict[str, Any]) -> int:
        """Note a line; the number of the episode."""
        event = row["event"]
        if event == "episode":
            self.episode += 1
            self._sent = []
        if event == "state":
            self._sent.append((float(row["t_s"]), row["joints_rad"], row["gripper_mm"]))
        return self.episode

    def recorded(self) -> Recorded | None:
        """What was sent for this transfer; forgets it."""
        sent, self._sent = self._sent, []
        if len(sent) < 2:
            return None
        t_s = np.array([row[0] for row in sent])
        joints, gripper = (_numbers([row[index] for row in sent], None) for index in (1, 2))
        if joints.ndim != 3 or gripper.shape != joints.shape[:2]:
            raise ValueError("joints_rad and gripper_mm of its state lines do not fit")
        return Recorded(t_s - t_s[0], joints, gripper)


def _rows(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CorruptFile(WHAT, path, str(error)) from error
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise CorruptFile(WHAT, path, f"line {number} is not JSON") from error
        if not isinstance(row, dict):
            raise CorruptFile(WHAT, path, f"line {number} is not an object in braces")
        yield number, row


def _step(row: dict[str, Any], recorded: Recorded | None) -> Step:
    state, goal, next_state = (_numbers(row[key], (3,)) for key in ("state", "goal", "next_state"))
    outcome = row["outcome"]
    if outcome is not None and not isinstance(outcome, str):
        raise TypeError("outcome is neither a name nor null")
    if not isinstance(row["final"], bool):
        raise TypeError("final is neither true nor false")
    trouble = " ".join(str(row[key]) for key in ("refusal", "detail") if row.get(key))
    if not trouble and np.array_equal(state, next_state):
        trouble = "nothing moved"
    epsilon_rad = float(row["epsilon_rad"])
    if not math.isfinite(epsilon_rad):
        raise ValueError("epsilon_rad is not finite")
    arm, place = ARM_LETTERS.index(row["arm"]), _numbers(row["place"], (2,))
    return Step(state, goal, arm, row["final"], place, next_state, outcome or "", epsilon_rad, trouble, recorded)


def _numbers(value: Any, shape: tuple[int, ...] | None) -> Floats:
    array = np.asarray(value, dtype=float)
    if shape is not None and array.shape != shape:
        raise ValueError(f"{value!r} is not {shape[0]} numbers")
    if not np.isfinite(array).all():
        raise ValueError(f"{value!r} is not finite")
    return array


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)
