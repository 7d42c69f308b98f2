"""From a drag to the first sample of the re-planned motion, as the page would see it: one thread at 50 Hz, another that drags.

python bench/interactive.py changes=300 policies=exact,pretrained_b drags=10 speed=4 results=bench/results

``changes`` single ones at random moments, goal or block in turn, then ``drags`` of one second at 30 changes a second each. What is timed
is the wall clock from the call of ``set_goal`` or ``set_block`` to the return of the ``advance`` with the first sample of the new motion:
the wait for the next look, decision, rollout, motion planning and check. A stop that the new motion begins with is part of that motion;
how long stops last is told in simulated time. ``speed`` is simulated seconds in one second: at 1 so many changes would hardly ever let a
hand grasp the block.
"""

from __future__ import annotations

import datetime
import json
import math
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from marl_handover.motion.trajectory import LOADED_PHASES

sys.path.insert(0, str(Path(__file__).resolve().parent))
import numpy as np
from common import ROOT, commit, machine, parse, table

from marl_handover.cell.build import build_cell
from marl_handover.control.interactive.cell import InteractiveCell, Snapshot
from marl_handover.policies import load

DEFAULTS = {"changes": 300, "policies": "exact,pretrained_b", "drags": 10, "speed": 4.0, "seed": 0, "results": "bench/results"}
LIMIT_MS = 100.0
RATE_HZ, DRAG_HZ = 50.0, 30.0
EMPTY, HELD = ("approach", "grasp", "release", "retreat"), LOADED_PHASES


class Page:
    """Advances a cell at 50 Hz, and keeps what it took from each change to the new motion."""

    def __init__(self, cell: InteractiveCell, speed: float) -> None:
        self.cell, self.speed = cell, speed
        self.seen: Snapshot = cell.advance(0.0)
        self.found: list[tuple[str, float, float]] = []  # what was under way, wall ms, processor ms of that look
        self.longest_ms = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        """No more looks."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        last = due = time.perf_counter()
        while not self._over.is_set():
            now, due = time.perf_counter(), due + 1 / RATE_HZ
            before, known = self.seen.phase, self.cell.last_replan_ms
            cpu = time.thread_time()
            self.seen = self.cell.advance(self.speed * (now - last))
            cpu = 1e3 * (time.thread_time() - cpu)
            last = now
            self.longest_ms = max(self.longest_ms, 1e3 * (time.perf_counter() - now))
            if self.cell.last_replan_ms != known and not math.isnan(self.cell.last_replan_ms):
                self.found.append((before, self.cell.last_replan_ms, cpu))
            due = max(due, time.perf_counter())
            time.sleep(due - time.perf_counter() if due > time.perf_counter() else 0.0)


def some_pose(cell: InteractiveCell, random: np.random.Generator) -> np.ndarray:
    """A pose that an arm reaches."""
    while True:
        pose = np.array([random.uniform(-230, 230), random.uniform(-410, 410), random.uniform(-math.pi, math.pi)])
        if cell.model.cell.reaches(pose).any():
            return pose


def change(cell: InteractiveCell, random: np.random.Generator, goal: bool) -> None:
    """The goal or the block somewhere else."""
    (cell.set_goal if goal else cell.set_block)(some_pose(cell, random))


def drag(page: Page, random: np.random.Generator, goal: bool) -> None:
    """Goal or block pulled along a straight line for a second, as far as it is in reach."""
    cell = page.cell
    start = page.seen.goal if goal else page.seen.block
    end = some_pose(cell, random)
    for share in np.linspace(0.0, 1.0, round(DRAG_HZ)):
        pose = start + share * (end - start)
        if cell.model.cell.reaches(pose).any():
            (cell.set_goal if goal else cell.set_block)(pose)
        time.sleep(1 / DRAG_HZ)


def spread(values: list[float]) -> dict[str, float]:
    """p50, p95, p99 and the worst."""
    marks = np.percentile(values, [50, 95, 99, 100]) if values else [math.nan] * 4
    return {"count": len(values), **{name: round(float(mark), 1) for name, mark in zip(("p50", "p95", "p99", "worst"), marks, strict=True)}}


def measure(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Everything about one policy."""
    policy = load(name)
    cell = InteractiveCell(policy, build_cell(policy.rules.cell.config), seed=values["seed"])
    random, page = np.random.default_rng(values["seed"]), Page(cell, values["speed"])
    count = 0
    while len(page.found) < values["changes"]:
        time.sleep(random.uniform(0.05, 0.8))
        change(cell, random, goal=count % 2 == 0)
        count += 1
    time.sleep(0.5)
    single, page.found = page.found, []
    for number in range(values["drags"]):
        drag(page, random, goal=number % 2 == 0)
        time.sleep(random.uniform(0.2, 2.0))
    dragged = page.found
    page.close()
    under_way = defaultdict(list)
    for phase, ms, _ in single:
        under_way["empty hand" if phase in EMPTY else "block in the hand" if phase in HELD else "at rest"].append(ms)
    return {
        "single": spread([ms for _, ms, _ in single]),
        "cpu": spread([cpu for _, _, cpu in single]),
        "dragged": spread([ms for _, ms, _ in dragged]),
        "under_way": {key: spread(found) for key, found in sorted(under_way.items())},
        "longest_look_ms": round(page.longest_ms, 1),
        "stops_ms": stops(cell, random),
    }


def stops(cell: InteractiveCell, random: np.random.Generator, count: int = 200) -> dict[str, float]:
    """How long the quickest stop takes at random moments of motions, in simulated ms."""
    controller, found = cell._controller, []
    for _ in range(count):
        for _ in range(random.integers(20, 60)):
            seen = cell.advance(0.02)
        if seen.phase in ("approach", "retreat", *HELD):
            found.append(1e3 * controller.programs.stop(controller.world).duration_s)
        change(cell, random, goal=bool(random.random() < 0.5))
    return spread(found)


def show(found: dict[str, dict[str, Any]]) -> str:
    """The numbers as a table."""
    rows = []

    def row(what: str, it: dict[str, float], limited: bool = True) -> None:
        ratio = f"{it['p95'] / LIMIT_MS:.2f}" if limited else ""
        rows.append([what, it["count"], it["p50"], it["p95"], it["p99"], it["worst"], ratio])

    for name, it in found.items():
        row(f"{name}: single changes, ms", it["single"])
        for key, part in it["under_way"].items():
            row(f"  {key}", part)
        row("  of a processor", it["cpu"], False)
        row("  dragged at 30 Hz, ms", it["dragged"])
        row("  stops, simulated ms", it["stops_ms"], False)
    return table(["what", "n", "p50", "p95", "p99", "worst", f"p95 / {LIMIT_MS:.0f} ms"], rows)


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    about = {"settings": values, "commit": commit(), "machine": machine(1)}
    found = {name: measure(name, values) for name in values["policies"].split(",")}
    about["machine"]["load_at_end"] = machine(1)["load"]
    print(show(found))
    load_1, load_2, cores = about["machine"]["load"], about["machine"]["load_at_end"], about["machine"]["cores"]
    if max(load_1, load_2) > 1.5:
        print(f"others were at work: load {load_1:.1f} before, {load_2:.1f} after, on {cores} cores")
    folder = ROOT / values["results"] / datetime.date.today().isoformat()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "interactive.json").write_text(json.dumps({**about, **found}, indent=1) + "\n")
    print(f"-> {folder / 'interactive.json'}")


if __name__ == "__main__":
    main(sys.argv[1:])
