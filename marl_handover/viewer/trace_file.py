"""Trace files, as ``evaluate trace=FILE`` and ``run log=FILE`` write them, in a form in which every moment is found at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.envs.cycle_check import Refusal
from marl_handover.errors import CorruptFile, InvalidSetting, listed
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.parsing import read_rows
from marl_handover.task.rules import Outcome

WHAT = "trace file"
OUTCOMES = tuple(outcome.name.lower() for outcome in Outcome if outcome is not Outcome.NONE)


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

    @property
    def nobody(self) -> bool:
        """Whether it is none: the policy wanted no arm to move, which sessions log as an order to leave the block where it is."""
        declined = self.outcome == "timeout" and self.trouble.startswith(Refusal.DECLINED)
        return declined and not self.final and np.array_equal(self.place_mm, self.state[:2])


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
        symmetry_order: of the block, if the file says so.
    """

    def __init__(
        self, steps: list[Step], starts: list[int], names: list[int], cell: dict[str, Any] | None, symmetry_order: int | None = None
    ) -> None:
        self.steps, self.names, self.cell, self.symmetry_order = steps, names, cell, symmetry_order
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

    def symmetry(self, asked: int | None) -> int:
        """Symmetry order of the block: as the file says, else ``asked``, else 1. Raises :class:`InvalidSetting` if they differ."""
        if asked is not None and self.symmetry_order not in (None, asked):
            raise InvalidSetting("task.symmetry_order", asked, f"{self.symmetry_order}, as the trace says, or left out")
        return self.symmetry_order or asked or 1

    def start_of(self, episode: int) -> int:
        """Number of an episode's first moment."""
        return int(self._first_moments[episode])


def recorded_cell(path: Path) -> dict[str, Any] | None:
    """Settings of the cell that a session's log says it is of; None: it is a trace of ``evaluate``. Raises as :func:`read_trace`."""
    for _, row in read_rows(path, WHAT):
        if "event" not in row:
            break
        if row["event"] == "session" and isinstance(row.get("cell"), dict):
            return dict(row["cell"])
    return None


def read_trace(path: Path, labels: Sequence[str] = ARM_LETTERS) -> Trace:
    """The trace in ``path``: of ``evaluate``, or of a session's log.

    Args:
        path: of the file.
        labels: what it calls the cell's arms.

    Raises:
        MissingFile, CorruptFile: with the number of the line.
    """
    steps: list[Step] = []
    starts: list[int] = []
    names: list[int] = []
    cell, order, session = None, None, _Session(len(labels))
    for number, row in read_rows(path, WHAT):
        try:
            name = session.take(row) if "event" in row else int(row["episode"])
            if "event" in row and row["event"] == "session":
                cell = dict(row["cell"])
            order = _order(row, order)
            if "event" in row and row["event"] != "transfer":
                continue
            step = _step(row, session.recorded(), labels)
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise CorruptFile(WHAT, path, f"line {number} is no transfer as 'evaluate trace=FILE' writes it: {_reason(error)}") from error
        if not names or name != names[-1]:
            names.append(name)
            starts.append(len(steps))
        steps.append(step)
    if not steps:
        raise CorruptFile(WHAT, path, "it holds no transfer")
    return Trace(steps, [*starts, len(steps)], names, cell, order)


class _Session:
    """What a session's log has told so far: the number of its episode, and what the arms were sent since the last transfer."""

    def __init__(self, arms: int) -> None:
        self.episode, self._arms = -1, arms
        self._sent: list[tuple[float, Floats, Floats]] = []

    def take(self, row: dict[str, Any]) -> int:
        """Note a line; the number of the episode."""
        event = row["event"]
        if event == "episode":
            self.episode += 1
            self._sent = []
        if event == "state":
            arms = self._arms
            t_s = float(_numbers(row["t_s"], ()))
            if self._sent and t_s < self._sent[-1][0]:
                raise ValueError(f"t_s = {t_s} goes back")
            self._sent.append((t_s, _numbers(row["joints_rad"], (arms, len(ARM_JOINTS))), _numbers(row["gripper_mm"], (arms,))))
        return self.episode

    def recorded(self) -> Recorded | None:
        """What was sent for this transfer; forgets it."""
        sent, self._sent = self._sent, []
        if len(sent) < 2:
            return None
        t_s, joints, gripper = (np.array(column) for column in zip(*sent, strict=True))
        return Recorded(t_s - t_s[0], joints, gripper)


def _step(row: dict[str, Any], recorded: Recorded | None, labels: Sequence[str]) -> Step:
    state, goal, next_state = (_numbers(row[key], (3,)) for key in ("state", "goal", "next_state"))
    outcome = row["outcome"]
    if outcome is not None and outcome not in OUTCOMES:
        raise ValueError(f"outcome is neither null nor one of {', '.join(OUTCOMES)}")
    if not isinstance(row["final"], bool):
        raise TypeError("final is neither true nor false")
    trouble = " ".join(str(row[key]) for key in ("refusal", "detail") if row.get(key))
    if not trouble and np.array_equal(state, next_state):
        trouble = "nothing moved"
    epsilon_rad = float(row["epsilon_rad"])
    if not math.isfinite(epsilon_rad):
        raise ValueError("epsilon_rad is not finite")
    if row["arm"] not in labels:
        said = f"its arm is {str(row['arm'])[:40]!r}, and those of the cell are {listed(labels)}"
        raise ValueError(f"{said}; say in which cell it was recorded: cell=NAME or cell=FILE.yaml")
    arm, place = labels.index(row["arm"]), _numbers(row["place"], (2,))
    return Step(state, goal, arm, row["final"], place, next_state, outcome or "", epsilon_rad, trouble, recorded)


def _order(row: dict[str, Any], before: int | None) -> int | None:
    """The symmetry order that a line says; that of the lines ``before`` if it says none."""
    order = row.get("symmetry_order", before)
    if order is not None and (isinstance(order, bool) or not isinstance(order, int) or order < 1):
        raise ValueError("symmetry_order is no number from 1")
    if before not in (None, order):
        raise ValueError(f"symmetry_order was {before} before")
    return order


def _numbers(value: Any, shape: tuple[int, ...]) -> Floats:
    array = np.asarray(value, dtype=float)
    if array.shape != shape:
        raise ValueError(f"{value!r} is not {' x '.join(map(str, shape)) or 'a'} number{'s' * bool(shape)}")
    if not np.isfinite(array).all():
        raise ValueError(f"{value!r} is not finite")
    return array


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)
