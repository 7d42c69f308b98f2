"""The twin in numbers: plain episodes, episodes with a mishap each, and a soak; through bytes and pixels, calibrated by `calibrate`.

python bench/twin.py episodes=200 drills=200 soak=5000 robots=10 jobs=2 seed=0 noise=1 policy=pretrained_twin folder=runs/bench_twin
python bench/twin.py cell=triangle hardware=triangle_twin policy=exact episodes=0 drills=50 robots=5 folder=runs/bench_triangle

The episodes are spread over ``robots``: each has servos, camera, glue and paper of its own, drawn from ``seed``, and is calibrated by
itself. ``noise`` multiplies everything that is drawn: dead bands, resting noise, scales, zeros, the cards' glue, the boards' laying, the
camera's noise and blur. ``engine`` is the physics, bullet or mujoco. ``soak`` is a number of transfers of robot 0, in episodes in a row.

What is finished is in ``folder``, and is not done again: the same command goes on where it was killed. Other settings want another folder.
"""

from __future__ import annotations

import datetime
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
os.environ.setdefault("OMP_NUM_THREADS", "1")
import numpy as np
from common import ROOT, commit, machine, parse, table
from twin_work import Work, append, robot_changes, rows, usual, work

DEFAULTS = {
    "episodes": 200,
    "drills": 200,
    "soak": 0,
    "robots": 10,
    "jobs": 2,
    "seed": 0,
    "noise": 1.0,
    "policy": "pretrained_twin",
    "engine": "bullet",
    "cell": "paper",
    "hardware": "twin",
    "folder": "runs/bench_twin",
    "results": "bench/results",
}
BARS = {"first_time": 0.95, "in_the_end": 0.98, "drills": 0.95, "latency_ms": 150.0}
_SAME = ("episodes", "drills", "soak", "robots", "seed", "noise", "policy", "engine", "cell", "hardware")


def claim(root: Path, values: dict[str, Any]) -> None:
    """Make ``root`` the folder of these settings; ends the program if it is another's."""
    root.mkdir(parents=True, exist_ok=True)
    mine, path = {key: values[key] for key in _SAME}, root / "settings.json"
    if not path.exists():
        path.write_text(json.dumps(mine) + "\n")
    elif (found := json.loads(path.read_text())) != mine:
        sys.exit(f"{root} holds results of other settings: {found}; give another folder= or remove it")
    now = datetime.datetime.now().isoformat(timespec="seconds")
    append(root / "started.jsonl", {"at": now, "commit": commit(), **machine(values["jobs"])})


def tasks(root: Path, values: dict[str, Any]) -> list[Work]:
    """What is still to be done, the longest first; a robot's parts one after the other, as its calibration is."""
    found = [Work("soak", 0, (), values["soak"])] if values["soak"] else []
    for robot in range(values["robots"]):
        for part in ("episode", "drill"):
            count = values[f"{part}s"]
            done = {row["number"] for row in rows(root / f"robot_{robot:02d}" / f"{part}.jsonl")}
            left = tuple(number for number in range(robot, count, values["robots"]) if number not in done)
            if left:
                found.append(Work(part, robot, left, count))
    return found


def run(root: Path, values: dict[str, Any]) -> None:
    """Calibrate every robot, then do all tasks, in ``jobs`` processes."""
    left = tasks(root, values)
    first = [Work("calibration", robot, (), 0) for robot in sorted({task.robot for task in left})]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(values["jobs"], mp_context=context, max_tasks_per_child=1) as pool:
        for batch in (first, left):
            for done in [pool.submit(work, task, values, str(root)) for task in batch]:
                if (failure := done.exception()) is not None:
                    print(f"broken off: {type(failure).__name__}: {failure}", flush=True)


def quantiles(found: list[float]) -> dict[str, float | None]:
    """p50, p95, p99 and the greatest."""
    return {name: float(np.percentile(found, at)) if found else None for name, at in (("p50", 50), ("p95", 95), ("p99", 99), ("max", 100))}


def limits(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Violations by name, and the worst values."""
    violations, worst = Counter[str](), dict[str, float]()
    for row in found:
        violations.update(row.get("limits", {}).get("violations", {}))
        for name, value in row.get("limits", {}).get("worst", {}).items():
            worst[name] = max(value, worst.get(name, value))
    return {"violations": dict(violations), "worst": worst}


def common(found: list[dict[str, Any]]) -> dict[str, Any]:
    """What plain episodes and drills have both."""
    events = Counter[str]()
    for row in found:
        events.update(row.get("events", {}))
    return {
        "count": len(found),
        "in_the_end": sum(row["end"] for row in found) / len(found),
        "hangs": sum(row["hang"] for row in found),
        "exceptions": [f"{row['number']}: {row['error']}" for row in found if "error" in row],
        "failed": [row["number"] for row in found if not row["end"]],
        "events": dict(events),
        **limits(found),
        "virtual_s": quantiles([row["virtual_s"] for row in found if "virtual_s" in row]),
        "wall_s": quantiles([row["wall_s"] for row in found if "wall_s" in row]),
        "cpu_s": quantiles([row["cpu_s"] for row in found if "cpu_s" in row]),
    }


def plain(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Plain episodes."""
    off = [pair for row in found for pair in row.get("transfer_off", [])]
    final = [row["final_off"] for row in found if row.get("final_off")]
    robots = {
        str(robot): [sum(row["first"] for row in found if row["robot"] == robot), sum(row["robot"] == robot for row in found)]
        for robot in sorted({row["robot"] for row in found})
    }
    return common(found) | {
        "first_time": sum(row["first"] for row in found) / len(found),
        "first_time_by_robot": robots,
        "transfer_mm": quantiles([mm for mm, _ in off]),
        "transfer_deg": quantiles([deg for _, deg in off]),
        "final_mm": quantiles([mm for mm, _ in final]),
        "final_deg": quantiles([deg for _, deg in final]),
    }


def drilled(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Drills; ``happened``: in the episode; ``felt``: and left a sign in the log; ``reached``: of those that happened."""
    kinds: dict[str, dict[str, int]] = {}
    for row in found:
        it = kinds.setdefault(row.get("kind", "broken off"), {"drills": 0, "happened": 0, "felt": 0, "reached": 0})
        happened = row.get("happened", True)
        for key, value in (
            ("drills", True),
            ("happened", happened),
            ("felt", row.get("felt", False)),
            ("reached", happened and row["end"]),
        ):
            it[key] += int(value)
    happened = [row for row in found if row.get("happened", True)]
    share = sum(row["end"] for row in happened) / len(happened) if happened else None
    latency = quantiles([value for row in found for value in row.get("latency_ms", [])])
    return common(found) | {"happened": len(happened), "reached": share, "kinds": kinds, "goal_to_wire_ms": latency}


def soaked(found: list[dict[str, Any]]) -> dict[str, Any]:
    """The soak in four parts, and its totals."""
    parts = [
        {
            **{key: sum(row[key] for row in some) for key in ("transfers", "episodes", "solved", "first", "violations", "hangs")},
            **{"rss_mb": [some[0]["rss_mb"], some[-1]["rss_mb"]], "files": some[-1]["files"]},
        }
        for some in (list(part) for part in np.array_split(np.array(found, dtype=object), min(4, len(found))))
    ]
    return {"transfers": sum(row["transfers"] for row in found), "processes": len({row["process"] for row in found}), "parts": parts}


def gathered(root: Path, values: dict[str, Any]) -> dict[str, Any]:
    """All results there are in ``root``."""
    found: dict[str, Any] = {"robots": [robot_changes(values["seed"], n, values["noise"], usual(values)) for n in range(values["robots"])]}
    for part, summed in (("episode", plain), ("drill", drilled), ("soak", soaked)):
        every = [row for path in sorted(root.glob(f"robot_*/{part}.jsonl")) for row in rows(path)]
        if every:
            found[{"episode": "episodes", "drill": "drills", "soak": "soak"}[part]] = summed(every)
    return found


def shown(found: dict[str, Any]) -> str:
    """The results as a table."""
    lines: list[list[str]] = []

    def spread(it: dict[str, Any], unit: str) -> str:
        return " / ".join("-" if it[key] is None else f"{it[key]:.2f}" for key in ("p50", "p95", "p99")) + f" {unit}"

    def both(it: dict[str, Any]) -> None:
        lines.extend(
            [["  limit violations", json.dumps(it["violations"])], ["  hangs, exceptions", f"{it['hangs']}, {len(it['exceptions'])}"]]
        )

    if it := found.get("episodes"):
        lines += [[f"{it['count']} episodes: first final placement (95)", f"{100 * it['first_time']:.1f} %"]]
        lines += [["  in the end (98)", f"{100 * it['in_the_end']:.1f} %"]]
        lines += [["  a transfer, p50 / p95 / p99", spread(it["transfer_mm"], "mm") + ", " + spread(it["transfer_deg"], "deg")]]
        lines += [["  first final placement", spread(it["final_mm"], "mm") + ", " + spread(it["final_deg"], "deg")]]
        both(it)
    if it := found.get("drills"):
        reached = "-" if it["reached"] is None else f"{100 * it['reached']:.1f} %"
        lines += [[f"{it['count']} drills, {it['happened']} happened: in the end (95)", reached]]
        words = ("reached", "happened", "felt", "drills")
        lines += [[f"  {kind}", ", ".join(f"{row[word]} {word}" for word in words)] for kind, row in it["kinds"].items()]
        lines += [["  goal changed to a move on the wire (150)", spread(it["goal_to_wire_ms"], "ms")]]
        both(it)
    for part in found.get("soak", {}).get("parts", []):
        memory = f"{part['rss_mb'][0]} to {part['rss_mb'][1]} MB, {part['files']} files"
        lines.append([f"soak, {part['transfers']} transfers", f"{part['first']} / {part['solved']} of {part['episodes']}, {memory}"])
    return table(["what (bar)", "result"], lines)


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    root, begun = ROOT / values["folder"], time.perf_counter()
    claim(root, values)
    run(root, values)
    found = gathered(root, values)
    print("\n" + shown(found))
    target = ROOT / values["results"] / datetime.date.today().isoformat()
    target.mkdir(parents=True, exist_ok=True)
    about = {"settings": values, "commit": commit(), "machine": machine(values["jobs"]), "started": rows(root / "started.jsonl")}
    other = {"noise": f"noise{values['noise']:g}", "engine": values["engine"], "cell": values["cell"]}
    name = "_".join(["twin", *(word for key, word in other.items() if values[key] != DEFAULTS[key])]) + ".json"
    (target / name).write_text(json.dumps({**about, "wall_s": time.perf_counter() - begun, "bars": BARS, **found}, indent=1) + "\n")
    print(f"-> {target / name}")


if __name__ == "__main__":
    main(sys.argv[1:])
