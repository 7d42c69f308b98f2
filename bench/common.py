"""What the bench scripts share: key=value arguments, milestones of a learning curve, the machine, tables."""

from __future__ import annotations

import csv
import math
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LEVELS = (50, 90, 95, 99)
"""Success rates, in per cent, whose cost is reported."""


def parse(arguments: Sequence[str], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """``key=value`` arguments over ``defaults``; a value gets its default's type. An unknown key or a bad value ends the program."""
    values = dict(defaults)
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals or key not in defaults:
            sys.exit(f"{Path(sys.argv[0]).name}: cannot use {argument!r}; keys: {', '.join(f'{k}={v}' for k, v in defaults.items())}")
        kind = type(defaults[key])
        try:
            values[key] = text.lower() in ("true", "1", "yes") if kind is bool else kind(text)
        except ValueError:
            sys.exit(f"{Path(sys.argv[0]).name}: {key}={text!r} is not {kind.__name__}")
    return values


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Rows of a metrics.csv as numbers; a half-written last line and cells without a finite number are left out."""
    rows: list[dict[str, float]] = []
    if not path.exists():
        return rows
    with path.open(newline="") as file:
        for record in csv.DictReader(file):
            row = {}
            for key, text in record.items():
                try:
                    value = float(text)
                except (TypeError, ValueError):
                    continue
                if math.isfinite(value):
                    row[str(key)] = value
            rows.append(row)
    return rows


def milestones(rows: Sequence[Mapping[str, float]], levels: Sequence[int] = LEVELS) -> dict[str, dict[str, float] | None]:
    """For each level the first evaluated row at or above it, as its steps, gradient steps and clocks; None if there is none."""
    found: dict[str, dict[str, float] | None] = {}
    for level in levels:
        hits = [row for row in rows if row.get("success_rate", -1.0) >= level / 100 - 1e-9]
        found[str(level)] = (
            {key: hits[0][key] for key in ("steps", "gradient_steps", "wall_s", "cpu_s") if key in hits[0]} if hits else None
        )
    return found


def machine(threads: int) -> dict[str, Any]:
    """What the numbers were measured on."""
    model = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    return {"cpu": model, "cores": os.cpu_count(), "threads": threads, "load": os.getloadavg()[0], "platform": platform.platform()}


def commit() -> str:
    """Short name of the checked-out commit, with ``+`` if files differ from it; ``none`` without one."""

    def git(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)

    try:
        name = git("rev-parse", "--short", "HEAD").stdout.strip()
        return name + ("+" if git("status", "--porcelain").stdout.strip() else "") if name else "none"
    except OSError:
        return "none"


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """An aligned text table; the first column to the left, the rest to the right."""
    cells = [[str(cell) for cell in row] for row in [header, *rows]]
    widths = [max(len(row[column]) for row in cells) for column in range(len(header))]
    lines = [
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width) for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])
