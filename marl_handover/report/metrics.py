"""Reading the ``metrics.csv`` of training runs."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.files import read_bounded
from marl_handover.parsing import LINES_BYTES

Floats = NDArray[np.float64]
Metrics = Mapping[str, Floats]
"""Column name -> values (n,), NaN where a row has none."""

NEEDED = ("step", "success_rate")
OPTIONAL = (
    "gradient_step",
    "mean_steps",
    "steps_ratio",
    "epsilon_low_deg",
    "epsilon_high_deg",
    "training_success_rate",
    "training_mean_length",
)


def read_metrics(run: Path) -> Metrics:
    """The table of a run directory. A last line that is still being written is left out.

    Raises:
        MissingFile, CorruptFile: with the line's number.
    """
    if not run.exists():
        raise MissingFile("run directory", run)
    path = run / "metrics.csv" if run.is_dir() else run
    if not path.exists():
        raise MissingFile("metrics", path, "name a run directory that `train` wrote")
    try:
        text = read_bounded(path, LINES_BYTES, "metrics").decode("utf-8")
        lines = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    except (ValueError, csv.Error) as error:
        raise CorruptFile("metrics", path, str(error)) from error
    header = lines[0] if lines else []
    lacking = [name for name in NEEDED if name not in header]
    if lacking:
        raise CorruptFile("metrics", path, f"its first line lacks: {', '.join(lacking)}")
    rows = [_numbers(path, number, line, len(header)) for number, line in enumerate(lines[1:], start=2)]
    if not rows:
        raise CorruptFile("metrics", path, "it holds no row yet; training writes one at each evaluation")
    table = np.array(rows)
    step = table[:, header.index("step")]
    if not np.isfinite(step).all() or (np.diff(step) < 0).any():
        raise CorruptFile("metrics", path, "its steps do not rise")
    empty = np.full(len(rows), math.nan)
    return {name: table[:, header.index(name)] if name in header else empty for name in (*NEEDED, *OPTIONAL)}


def _numbers(path: Path, number: int, line: list[str], width: int) -> list[float]:
    if len(line) != width:
        raise CorruptFile("metrics", path, f"line {number} has {len(line)} values, the first line {width}")
    try:
        return [float(value) if value else math.nan for value in line]
    except ValueError as error:
        raise CorruptFile("metrics", path, f"line {number}: {error}") from error


def common_curve(runs: list[Metrics], column: str) -> tuple[Floats, Floats]:
    """Steps (n,) and values (runs, n), interpolated, over the steps that every run with such values covers; empty if there are none."""
    curves = []
    for run in runs:
        known = np.isfinite(run[column])
        if known.any():
            curves.append((run["step"][known], run[column][known]))
    if not curves:
        return np.empty(0), np.empty((0, 0))
    low, high = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    steps = np.unique(np.concatenate([steps for steps, _ in curves]))
    steps = steps[(steps >= low) & (steps <= high)]
    return steps, np.stack([np.interp(steps, *curve) for curve in curves])
