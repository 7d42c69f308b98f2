"""What a training run writes while it runs: metrics.csv, TensorBoard events, a progress bar; and metrics.csv read again."""

from __future__ import annotations

import csv
import math
import os
import platform
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_handover.arrays import Floats
from marl_handover.errors import CorruptFile, Diverged, MissingFile
from marl_handover.files import MEGABYTE, GrowingFile, read_bounded, write_whole
from marl_handover.parsing import LINES_BYTES
from marl_handover.progress import Bar

COLUMNS = (
    "step",
    "gradient_step",
    "wall_s",
    "episodes",
    "epsilon_low_deg",
    "epsilon_high_deg",
    "success_rate",
    "mean_steps",
    "steps_ratio",
    "training_success_rate",
    "training_mean_length",
    "learning_rate",
    "loss_critic",
    "loss_actor",
    "entropy_place",
    "entropy_branch",
    "temperature_place",
    "temperature_branch",
)

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


def machine() -> dict[str, Any]:
    """What numbers were made on. Runs of one seed differ by the processor: sums are rounded in its order."""
    model = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    return {"cpu": model, "cores": os.cpu_count(), "platform": platform.platform(), "torch": torch.__version__}


class Recorder:
    """Rows of ``metrics.csv`` and their TensorBoard twins, and a bar with ETA, success rate and epsilon.

    Args:
        folder: the run directory.
        total_steps: environment steps of the run.
        start_step: step the run continues from; later rows of an interrupted run are dropped.
        progress: show the bar.
    """

    def __init__(self, folder: Path, total_steps: int, start_step: int = 0, progress: bool = True) -> None:
        self.path = folder / "metrics.csv"
        self._keep_until(start_step)
        self.table = GrowingFile(self.path)
        self.board = Board(folder, start_step)
        self.bar = Bar(total=total_steps, initial=start_step, unit="step", shown=progress)

    def _keep_until(self, step: int) -> None:
        """Rewrite the table with its header and the rows up to ``step``."""
        rows: list[list[str]] = []
        if step and self.path.exists():
            text = read_bounded(self.path, 64 * MEGABYTE, "metrics").decode("utf-8", errors="replace")
            found = csv.reader(text.splitlines())
            rows = [row for row in found if len(row) == len(COLUMNS) and row[0].isdecimal() and int(row[0]) <= step]
        lines = [",".join(COLUMNS), *(",".join(row) for row in rows)]
        write_whole(self.path, "\n".join(lines) + "\n")

    def progress(self, step: int, **shown: Any) -> None:
        """Move the bar."""
        if shown:
            self.bar.set_postfix(shown, refresh=False)
        self.bar.update(min(step, self.bar.total) - self.bar.n)  # a batch may go beyond the end

    def record(self, row: dict[str, float]) -> None:
        """Append one row; values that a run does not have stay empty."""
        values = [_text(row.get(name)) for name in COLUMNS]
        self.table.write(",".join(values) + "\n")
        self.board.record(row)

    def close(self) -> None:
        """Close the files and end the bar."""
        self.table.close()
        self.board.close()
        self.bar.close()


class Board:
    """The same rows as TensorBoard events, written out at once. TensorBoard's own writer has a thread, which cannot tell of a full disk.

    Args:
        folder: the run directory.
        start_step: step the run continues from; TensorBoard leaves out what it knows of later ones.
    """

    def __init__(self, folder: Path, start_step: int = 0) -> None:
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._file = GrowingFile(folder / f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}.{os.getpid()}")
        self._records = RecordWriter(self._file)
        self._add(file_version="brain.Event:2")
        if start_step:
            self._add(step=start_step + 1, session_log={"status": "START"})

    def record(self, row: Mapping[str, float]) -> None:
        """Every finite number of a row at its ``step``."""
        values = [{"tag": name, "simple_value": value} for name, value in row.items() if name != "step" and math.isfinite(value)]
        self._add(step=int(row["step"]), summary={"value": values})

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _add(self, **content: Any) -> None:
        from tensorboard.compat.proto.event_pb2 import Event

        self._records.write(Event(wall_time=time.time(), **content).SerializeToString())


def check_finite(step: int, losses: Mapping[str, Tensor]) -> None:
    """Raise :class:`Diverged` if a loss is no number any more."""
    values = {name: float(loss) for name, loss in losses.items() if name.startswith("loss_")}
    bad = {name: value for name, value in values.items() if not math.isfinite(value)}
    if bad:
        raise Diverged(step, bad)


def _text(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return ""
    return str(int(value)) if float(value).is_integer() else f"{value:.6g}"


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
