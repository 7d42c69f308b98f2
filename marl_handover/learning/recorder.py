"""What a training run writes while it runs: metrics.csv, TensorBoard events, a progress bar."""

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

import torch
from torch import Tensor

from marl_handover.errors import Diverged
from marl_handover.files import MEGABYTE, GrowingFile, read_bounded, write_whole
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
