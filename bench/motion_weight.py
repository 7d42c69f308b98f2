"""What ``reward.motion_weight`` does to paths and steps: one short training a weight, then the same 2,000 problems for each.

python bench/motion_weight.py weights=0.0,0.3,1.0 steps=32000 seed=0 episodes=2000 out=runs/motion_weight results=bench/results

A finished run found in ``out`` is used again. Lengths are of all transfers of an episode: as tabulated, and as the exact planner plans
them, the other arm parked. ``exact`` is the plan with the fewest transfers, which knows no lengths.
"""

from __future__ import annotations

import datetime
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import numpy as np
from common import ROOT, commit, machine, parse, table
from tqdm import tqdm

from marl_handover.cell.arm import REACH_TOLERANCE_MM
from marl_handover.cell.build import build_cell, cell_config
from marl_handover.learning.evaluation import random_problems
from marl_handover.motion.path_length_table import path_length_table
from marl_handover.motion.path_optimizer import NoPath
from marl_handover.motion.planner import MotionPlanner
from marl_handover.policies import SupervisorPolicy, load
from marl_handover.task.episode import Decision, play
from marl_handover.task.rules import Outcome

DEFAULTS = {
    "weights": "0.0,0.3,1.0",
    "steps": 32_000,
    "seed": 0,
    "episodes": 2000,
    "out": "runs/motion_weight",
    "results": "bench/results",
}
EVALUATION_SEED = 100


def trained(weight: str, values: dict[str, Any]) -> Path:
    """The run of a weight, trained now unless it is there."""
    folder = Path(values["out"]) / weight
    if not (ROOT / folder / "summary.json").exists():
        settings = [f"steps={values['steps']}", f"seed={values['seed']}", f"task.reward.motion_weight={weight}", f"out={folder}"]
        subprocess.run([sys.executable, "-m", "marl_handover.cli", "train", *settings], cwd=ROOT, check=True)
    return ROOT / folder


def judged(policy: SupervisorPolicy, planner: MotionPlanner, episodes: int) -> dict[str, Any]:
    """Steps and lengths of a policy on the problems of evaluation seed 100."""
    costs, steps = path_length_table(planner.model.cell, planner.motion), []
    result = play(policy.rules, policy.act, *random_problems(policy.rules, episodes, EVALUATION_SEED), observer=steps.append)
    ways = [moved(decision) for decision in steps]
    episode, arm, start, end = (np.concatenate(column) for column in zip(*ways, strict=True))
    tabulated = costs(planner.model.cell, arm, start, end)
    planned, refused = planned_mm(planner, arm, start, end)
    solved = result.outcome == int(Outcome.SUCCESS)

    def an_episode(lengths: np.ndarray) -> float:
        return round(float(np.bincount(episode, lengths, minlength=episodes)[solved].mean()), 1)

    known = np.isfinite(planned)
    return {
        "policy": policy.name,
        "episodes": episodes,
        "success_rate": float(solved.mean()),
        "mean_steps_success": round(float(result.transfers[solved].mean()), 4),
        "path_mm_an_episode": {"tabulated": an_episode(tabulated), "planned": an_episode(np.where(known, planned, tabulated))},
        "straight_mm_an_episode": an_episode(np.linalg.norm(end - start, axis=-1)),
        "transfers": len(arm),
        "refused": refused,
        "error_of_the_table_mm": round(float(abs(tabulated - planned)[known].mean()), 2),
    }


def moved(decision: Decision) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The transfers of a decision that went somewhere: episode, arm, from, to."""
    result = decision.result
    far = np.linalg.norm(result.placed[:, :2] - decision.pose[:, :2], axis=-1) > REACH_TOLERANCE_MM
    return decision.episode[far], result.command.arm[far], decision.pose[far, :2], result.placed[far, :2]


def planned_mm(planner: MotionPlanner, arm: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, int]:
    """Lengths of the planner's paths, NaN where it refuses, and how often it does."""
    lengths = np.full(len(arm), np.nan)
    for row in tqdm(range(len(arm)), desc="planned", leave=False):
        try:
            lengths[row] = planner.transfer(int(arm[row]), start[row], end[row], planner.others_home_rad(int(arm[row]))).length_mm
        except NoPath:
            continue
    return lengths, int(np.isnan(lengths).sum())


def show(rows: list[dict[str, Any]]) -> str:
    """One line a policy."""
    header = ["policy", "success", "steps", "mm tabulated", "mm planned", "mm straight"]
    lines = [
        [
            row["name"],
            f"{100 * row['success_rate']:.2f} %",
            f"{row['mean_steps_success']:.3f}",
            *(f"{row['path_mm_an_episode'][kind]:.0f}" for kind in ("tabulated", "planned")),
            f"{row['straight_mm_an_episode']:.0f}",
        ]
        for row in rows
    ]
    return table(header, lines)


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    runs = {f"motion_weight={weight}": trained(weight, values) for weight in values["weights"].split(",")}
    planner = MotionPlanner(build_cell(cell_config("paper")))
    planner.warm_up()
    rows = [{"name": name, **judged(load(str(folder)), planner, values["episodes"])} for name, folder in runs.items()]
    rows.append({"name": "exact", **judged(load("exact"), planner, values["episodes"])})
    print(show(rows))
    folder = ROOT / values["results"] / datetime.date.today().isoformat()
    folder.mkdir(parents=True, exist_ok=True)
    about = {"settings": values, "commit": commit(), "machine": machine(1)}
    (folder / "motion_weight.json").write_text(json.dumps({**about, "rows": rows}, indent=1) + "\n")
    print(f"-> {folder / 'motion_weight.json'}")


if __name__ == "__main__":
    main(sys.argv[1:])
