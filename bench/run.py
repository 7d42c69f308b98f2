"""``make bench``: throughput, our trainer and Stable-Baselines3 on the same problem, one after the other, in one table.

python bench/run.py seed=0 variants=relative_done_g1,paper_g1 max_wall_s=1500 steps=650000 out=runs/bench fresh=false

A finished run found in ``out`` is used again unless ``fresh=true``. The peers need the extra ``peers``; without it only our
own trainer runs.
"""

from __future__ import annotations

import datetime
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from common import LEVELS, ROOT, commit, machine, milestones, parse, read_metrics, table

VARIANTS = "relative_done_g1,paper_g1,paper_done_g1,relative_done_g-1,paper_g-1,paper_done_g-1"
DEFAULTS = {
    "variants": VARIANTS,
    "seed": 0,
    "steps": 650_000,
    "max_wall_s": 1500.0,
    "out": "",
    "results": "bench/results",
    "throughput": True,
    "fresh": False,
}
MEASURES = {"wall_s": "wall clock", "steps": "environment steps", "gradient_steps": "gradient steps"}
Result = dict[str, Any]


def call(*arguments: str) -> int:
    """Run a Python of our own environment from the repository, which is importable whether installed or not."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run([sys.executable, *arguments], cwd=ROOT, env={**os.environ, "PYTHONPATH": path}, check=False).returncode


def load(path: Path) -> Result | None:
    """A JSON file, or None if it is missing or half written."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def finished(folder: Path, values: Mapping[str, Any]) -> Result | None:
    """The result of an earlier run of the same seed, if it may be used again."""
    result = None if values["fresh"] else load(folder / "result.json")
    if result and result["seed"] != values["seed"]:
        sys.exit(f"run.py: {folder} holds seed {result['seed']}, not {values['seed']}; choose another out=, or fresh=true")
    if result:
        print(f"== {result['variant']}: used again from {folder} (commit {result['commit']})", flush=True)
    return result


def run_ours(folder: Path, values: Mapping[str, Any]) -> Result:
    """Our trainer with its defaults, on one thread like the peer."""
    if earlier := finished(folder, values):
        return earlier
    print("== ours", flush=True)
    run, arguments = folder / "train", [f"seed={values['seed']}", "threads=1"]
    shutil.rmtree(run, ignore_errors=True)
    status = call("-m", "marl_handover.cli", "train", *arguments, f"out={run}")
    rows = [
        {**row, "steps": row["step"], "gradient_steps": row["gradient_step"]}
        for row in read_metrics(run / "metrics.csv")
        if "success_rate" in row and "step" in row
    ]
    if status or not rows:
        return {"variant": "ours", "failed": f"exit status {status}, {len(rows)} evaluations"}
    result = {
        "variant": "ours",
        "seed": values["seed"],
        "ended": "steps",
        "to": milestones(rows),
        "final": rows[-1],
        "best_success_rate": max(row["success_rate"] for row in rows),
        "config": {"command": ["marl-handover", "train", *arguments]},
        "machine": machine(1),
        "commit": commit(),
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "result.json").write_text(json.dumps(result, indent=1) + "\n")
    return result


def run_peer(variant: str, folder: Path, values: Mapping[str, Any]) -> Result:
    """One SB3 variant."""
    if earlier := finished(folder, values):
        return earlier
    print(f"== SB3 {variant}", flush=True)
    limits = [f"{key}={values[key]}" for key in ("seed", "steps", "max_wall_s")]
    status = call("bench/peers.py", f"variant={variant}", *limits, f"out={folder}")
    result = load(folder / "result.json") if status == 0 else None
    return result or {"variant": variant, "failed": f"exit status {status}"}


def cost(result: Result, level: int, measure: str) -> tuple[float, bool]:
    """What a level cost, and whether that is only a lower bound: the whole run, which did not get there."""
    hit = result["to"][str(level)]
    return (hit[measure], False) if hit else (result["final"][measure], True)


def speed_up(results: Sequence[Result], level: int = 90) -> dict[str, Any]:
    """Ours against the cheapest peer at ``level`` per cent, for each measure."""
    ours = [it for it in results if it["variant"] == "ours" and "failed" not in it]
    peers = [it for it in results if it["variant"] != "ours" and "failed" not in it]
    if not ours or not peers or not ours[0]["to"][str(level)]:
        return {}
    found = {}
    for measure in MEASURES:
        (value, bound), name = min((cost(it, level, measure), it["variant"]) for it in peers)
        found[measure] = {"ratio": value / max(ours[0]["to"][str(level)][measure], 1e-9), "at_least": bound, "peer": name}
    return found


def _cell(result: Result, level: int) -> str:
    wall, bound = cost(result, level, "wall_s")
    mark = ">" if bound else ""
    numbers = [cost(result, level, measure)[0] for measure in ("steps", "gradient_steps")]
    return f"{mark}{wall:,.0f} s / {mark}{numbers[0]:,.0f} / {mark}{numbers[1]:,.0f}"


def show(results: Sequence[Result]) -> str:
    """Table of all runs, and the speed-up."""
    header = ["variant", *[f"to {level} %" for level in LEVELS], "best", "final", "ended by"]
    rows = []
    for result in results:
        if "failed" in result:
            rows.append([result["variant"], *["-"] * (len(LEVELS) + 2), f"failed: {result['failed']}"])
            continue
        cells = [_cell(result, level) for level in LEVELS]
        rows.append(
            [result["variant"], *cells, f"{result['best_success_rate']:.1%}", f"{result['final']['success_rate']:.1%}", result["ended"]]
        )
    lines = [
        "wall clock / environment steps / gradient steps to a success rate at 5 degrees; > the whole run did not reach it",
        table(header, rows),
    ]
    for measure, it in speed_up(results).items():
        sign = "≥ " if it["at_least"] else ""
        lines.append(f"ours over the best SB3 variant at 90 %, {MEASURES[measure]}: {sign}{it['ratio']:.1f}x ({it['peer']})")
    return "\n".join(lines)


def measure_throughput(out: Path) -> Result | None:
    """Throughput in a process of its own."""
    print("== throughput", flush=True)
    path = out / "throughput.json"
    return load(path) if call("bench/throughput.py", f"json={path}") == 0 else None


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    variants = [name for name in values["variants"].split(",") if name]
    if unknown := sorted(set(variants) - set(VARIANTS.split(","))):
        sys.exit(f"run.py: unknown variants {', '.join(unknown)}; variants: {VARIANTS}")
    out = (ROOT / (values["out"] or f"runs/bench/seed{values['seed']}")).resolve()
    out.mkdir(parents=True, exist_ok=True)
    if variants and importlib.util.find_spec("stable_baselines3") is None:
        print(
            'run.py: stable_baselines3 is missing, so no peers; install it with: .venv/bin/python -m pip install -e ".[peers]"',
            file=sys.stderr,
        )
        variants = []
    print(
        f"{len(variants)} SB3 variants, at most {values['max_wall_s'] * len(variants) / 60:.0f} minutes of training; runs in {out}",
        flush=True,
    )
    throughput = measure_throughput(out) if values["throughput"] else None
    results = [run_ours(out / "ours", values)]
    results += [run_peer(variant, out / variant, values) for variant in variants]
    print("\n" + show(results))
    report = {
        "date": datetime.date.today().isoformat(),
        "commit": commit(),
        "seed": values["seed"],
        "machine": machine(1),
        "config": values,
        "throughput": throughput,
        "speed_up_at_90": speed_up(results),
        "results": results,
    }
    folder = ROOT / values["results"]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{report['date']}-{report['commit']}.json"
    path.write_text(json.dumps(report, indent=1) + "\n")
    print(path)
    if any("failed" in result for result in results):
        sys.exit(1)


if __name__ == "__main__":
    main(sys.argv[1:])
