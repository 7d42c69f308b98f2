"""How near the edge of the shared space the trained rows of a suite put their hand-overs: why some bear noise worse than others.

python bench/places.py out=runs/compare/variants json=runs/places.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from common import commit, parse, table
from numpy.typing import NDArray

from marl_handover import policies
from marl_handover.cell import Cell
from marl_handover.errors import HandoverError
from marl_handover.files import write_whole
from marl_handover.learning.evaluation import evaluate, random_problems
from marl_handover.task.episode import Decision

NEAR_MM = 4.0
"""Two standard deviations of the noise that the suites judge with."""


def edge_mm(cell: Cell, place_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far places (n, 2) of the shared space lie from the nearest circle that bounds an arm's reach, (n,)."""
    bases = np.array([(base.x_mm, base.y_mm) for base in cell.bases])
    radius = np.linalg.norm(place_mm[:, None] - bases, axis=-1)
    return np.minimum(radius - cell.chart.r_min_mm, cell.chart.r_max_mm - radius).min(-1)


def edges_of(run: Path, seed: int, episodes: int) -> NDArray[np.float64]:
    """Of every hand-over that a run's policy makes on the problems of a seed."""
    policy, found = policies.load(str(run)), []

    def watch(decision: Decision) -> None:
        command = decision.result.command
        handed = decision.result.feasible & ~command.final
        found.append(edge_mm(policy.rules.cell, np.asarray(command.place_mm)[handed]))

    evaluate(policy.rules, policy.act, random_problems(policy.rules, episodes, seed), seed, watch)
    return np.concatenate(found)


def main() -> None:
    """Play, print the table, store it."""
    values = parse(sys.argv[1:], {"out": "runs/compare/variants", "episodes": 2000, "json": ""})
    rows: dict[str, dict[str, float]] = {}
    for run in sorted(Path(values["out"]).glob("*/seed*/run")):
        edges = edges_of(run, 100 + int(run.parent.name.removeprefix("seed")), values["episodes"])
        row = rows.setdefault(run.parents[1].name, {"runs": 0, "handovers": 0, "near": 0})
        row["runs"] += 1
        row["handovers"] += len(edges)
        row["near"] += int((edges < NEAR_MM).sum())
    if not rows:
        sys.exit(f"{values['out']}: no trained runs in it")
    for row in rows.values():
        row["share_near"] = row["near"] / row["handovers"]
    print(
        table(
            ["row", "runs", "hand-overs", f"nearer than {NEAR_MM:g} mm"],
            [[name, str(row["runs"]), f"{row['handovers']:,}", f"{100 * row['share_near']:.1f} %"] for name, row in rows.items()],
        )
    )
    if values["json"]:
        about = {"near_mm": NEAR_MM, "episodes": values["episodes"], "seeds": "100 plus the run's", "commit": commit()}
        write_whole(Path(values["json"]), json.dumps({**about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    try:
        main()
    except HandoverError as error:
        sys.exit(str(error))
