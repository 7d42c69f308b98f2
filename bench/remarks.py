"""Two remarks of the paper on architecture A, measured: the length of random episodes, and hindsight on episodes of 20 and of 5 steps.

python bench/remarks.py out=runs/remarks seed=0
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from common import ROOT, commit, parse, table

TRAINED = [(limit, strategy) for limit in (20, 5) for strategy in ("none", "final")]
MEASURES = ("success_rate", "mean_steps", "mean_steps_success")


def marl_handover(*arguments: str) -> None:
    """Run a command of ours; stop here if it fails."""
    subprocess.run([sys.executable, "-m", "marl_handover.cli", *arguments], cwd=ROOT, check=True)


def evaluated(folder: Path, name: str, *arguments: str) -> dict[str, object]:
    """Result of one evaluation."""
    file = folder / f"{name}.json"
    marl_handover("evaluate", "episodes=2000", "progress=false", f"json={file}", *arguments)
    return json.loads(file.read_text())


def main() -> None:
    """Train what is not there yet, evaluate all, print the table."""
    values = parse(sys.argv[1:], {"out": "runs/remarks", "seed": 0})
    folder = Path(values["out"]).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    random = evaluated(folder, "random", "policy=random", "architecture=A", f"seed={values['seed']}")
    rows = [["random policy, episodes of 20", *(random[key] for key in MEASURES)]]
    for limit, strategy in TRAINED:
        run = folder / f"steps{limit}_{strategy}"
        if not (run / "summary.json").exists():
            settings = [f"task.max_steps={limit}", f"replay.hindsight.strategy={strategy}", f"seed={values['seed']}"]
            if strategy != "none":
                settings += ["replay.hindsight.ratio=0.8", "replay.hindsight.near_miss_ratio=0", "replay.hindsight.random_ratio=0"]
            marl_handover("train", "preset=paper_a", "progress=false", f"out={run}", *settings)
        result = evaluated(folder, run.name, f"policy={run}", "max_steps=20", f"seed={values['seed']}")
        rows.append([f"paper_a, episodes of {limit}, hindsight {strategy}", *(result[key] for key in MEASURES)])
    header = ["architecture A, epsilon 5 deg, judged on 20 steps", "success", "mean steps", "mean steps of a success"]
    text = table(header, [[str(row[0]), *(f"{value:.3f}" if isinstance(value, float) else "none" for value in row[1:])] for row in rows])
    print(f"{text}\npaper: a random policy takes about 10 steps an episode\ncommit {commit()}")


if __name__ == "__main__":
    main()
