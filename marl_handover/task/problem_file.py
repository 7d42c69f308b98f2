"""Problems files: JSON Lines of starts and goals, each in the command's own cell or in a cell that its line brings.

A line is ``{"state": [x_mm, y_mm, theta_rad], "goal": [...]}``. It may bring ``"arms"``, records as ``workspace.json`` has them, and
``"obstacles"``; other keys are ignored. Lines that bring the same cell are posed in one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats, wrap
from marl_handover.cell import Cell, layout_cell
from marl_handover.cell.layouts import obstacle_configs
from marl_handover.errors import BadLine, CorruptFile, HandoverError, InvalidSetting, NotFinite
from marl_handover.files import read_bounded
from marl_handover.parsing import LINES_BYTES, parse_object

WHAT = "problems file"
ARMS, OBSTACLES = "arms", "obstacles"


class PosedProblems(NamedTuple):
    """Problems of one cell.

    Attributes:
        cell: where they are posed.
        own: whether their lines bring it; else it is the command's.
        numbers: (n,) which of all problems these are, from 0.
        start: (n, 3) mm, mm, rad.
        goal: (n, 3).
    """

    cell: Cell
    own: bool
    numbers: NDArray[np.int64]
    start: Floats
    goal: Floats


def read_problems(cell: Cell, path: Path, fixed_for: str = "") -> list[PosedProblems]:
    """All problems of a file, in the order in which their cells first come.

    Args:
        cell: of lines that bring none.
        path: the file.
        fixed_for: what needs all problems in ``cell``; empty: lines may bring cells of their own.

    Raises:
        MissingFile, CorruptFile: there is none, or a line is no problem.
        BadLine: a line brings a cell that cannot be.
        NotFinite, OutOfReach: a pose that cannot be, with the line's number.
        InvalidSetting: a line brings a cell, and ``fixed_for`` needs one for all.
    """
    groups: dict[str, tuple[Cell, list[int], list[Floats]]] = {}
    for number, (line, row) in enumerate(_rows(path)):
        own = {key: row[key] for key in (ARMS, OBSTACLES) if row.get(key) is not None and (key == ARMS or row[key] != [])}
        if own and fixed_for:
            limit = f"without arms and obstacles, which line {line} has, for {fixed_for}; policy=exact, greedy and random take them"
            raise InvalidSetting("problems", str(path), limit)
        key = json.dumps(own) if own else ""
        if key not in groups:
            groups[key] = (_cell(cell, own, path, line) if own else cell, [], [])
        there, numbers, poses = groups[key]
        numbers.append(number)
        poses.append(np.stack([_pose(there, row, name, path, line) for name in ("state", "goal")]))
    if not groups:
        raise CorruptFile(WHAT, path, "it holds no problem")
    return [PosedProblems(there, bool(key), np.array(numbers), *np.stack(poses, 1)) for key, (there, numbers, poses) in groups.items()]


def _rows(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The object of each line, with the line's number from 1."""
    try:
        text = read_bounded(path, LINES_BYTES, WHAT).decode("utf-8")
    except UnicodeDecodeError as error:
        raise CorruptFile(WHAT, path, str(error)) from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            yield number, parse_object(line, finite=False)
        except ValueError as error:
            raise _no_problem(path, number) from error


def _no_problem(path: Path, line: int) -> CorruptFile:
    return CorruptFile(WHAT, path, f"line {line} is not {{'state': [3 numbers], 'goal': [3 numbers]}}")


def _pose(cell: Cell, row: Mapping[str, Any], name: str, path: Path, line: int) -> Floats:
    """A start or goal (3,) of a line, its angle wrapped."""
    try:
        pose = np.array(row[name], float).reshape(3)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise _no_problem(path, line) from error
    what = f"{name} in line {line} of {path}"
    if not np.isfinite(pose).all():
        raise NotFinite(what, pose.tolist())
    cell.require_reached(what, pose)
    return np.concatenate([pose[:2], np.atleast_1d(wrap(pose[2]))])


def _cell(cell: Cell, own: Mapping[str, Any], path: Path, line: int) -> Cell:
    """The cell that a line brings; one that brings obstacles alone puts them into ``cell``."""
    try:
        if ARMS in own:
            return layout_cell(own[ARMS], own.get(OBSTACLES, ()), cell.config)
        return replace(cell, config=replace(cell.config, obstacles=obstacle_configs(own[OBSTACLES])))
    except HandoverError as error:
        raise BadLine(WHAT, path, line, error) from error
