"""Motion planning in numbers, on the committed transfers: ours, the paper's program, OMPL, toppra, cycles, the first plan.

python bench/motion.py rows=1000 every=50 cycles=200 starts=true costs=1000 many=200 results=bench/results

``rows`` of bench/data/transfers.jsonl; the peers get every ``every``-th of them. Times are of the public call, one thread, after a warm-up.
"""

from __future__ import annotations

import datetime
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import numpy as np
from common import ROOT, commit, machine, parse, table
from continuous_collision import certify
from motion_peers import against_ompl, against_paper, against_toppra, arguments, spread, timed
from tqdm import tqdm
from transfers import FILE, read

from marl_handover.cell.build import build_cell, cell_config
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.commands.plan import solve
from marl_handover.learning.evaluation import random_problems
from marl_handover.motion.coordination import coordinate
from marl_handover.motion.path_length_table import path_length_table
from marl_handover.motion.path_optimizer import FoundPath, NoPath
from marl_handover.motion.planner import MotionPlanner
from marl_handover.policies import load
from marl_handover.report.motion import plan_motions

DEFAULTS = {"rows": 1000, "every": 50, "cycles": 200, "starts": True, "costs": 1000, "many": 200, "seed": 0, "results": "bench/results"}
FIRST_PLAN = """
import time
import numpy as np
from marl_handover.cell.build import build_cell, cell_config
from marl_handover.motion.planner import MotionPlanner
planner = MotionPlanner(build_cell(cell_config("paper")))
began = time.perf_counter()
planner.transfer(1, np.array([-110.0, -50.0]), np.array([90.0, -10.0]), planner.home_rad)
first = time.perf_counter() - began
began = time.perf_counter()
planner.pick_place(1, [-110.0, -50.0], [90.0, -10.0], planner.home_rad, planner.home_rad)
print(first, time.perf_counter() - began)
"""


def transfers(planner: MotionPlanner, rows: Sequence[dict[str, Any]]) -> tuple[dict[str, Any], list[FoundPath]]:
    """Our planner over rows; what it found."""
    planner.transfer(*arguments(rows[0]))
    times, cpu, ratios, found, refused = [], [], [], [], Counter[str]()
    for row in tqdm(rows, desc="transfers", leave=False):
        result, taken, taken_cpu = timed(lambda row=row: planner.transfer(*arguments(row)))
        times.append(taken)
        cpu.append(taken_cpu)
        if isinstance(result, NoPath):
            refused[f"{result.reason}: {result.what}"] += 1
            continue
        found.append(result)
        if row["best_mm"] is not None:
            ratios.append(result.length_mm / row["best_mm"])
    clearance = planner.motion.arm_clearance_mm + min(path.margins.arm for path in found)
    ground = planner.motion.ground_clearance_mm + min(path.margins.ground for path in found)
    summary = {
        "rows": len(rows),
        "ms": spread(times, 2),
        "cpu_ms": spread(cpu, 2),
        "success": len(found) / len(rows),
        "refused": dict(refused),
        "length_over_best": {**spread(ratios), "least": round(min(ratios, default=np.nan), 4), "rows": len(ratios)},
        "least_clearance_mm": {"arm": round(clearance, 3), "ground": round(ground, 3)},
        "starts": spread([path.starts for path in found], 1),
    }
    return summary, found


def proofs(planner: MotionPlanner, rows: Sequence[dict[str, Any]], found: Sequence[FoundPath]) -> dict[str, Any]:
    """For how many paths the clearances are proved at every tau, not only at samples, and what that takes."""
    results = []
    for row, path in zip(rows, found, strict=True):
        segment, _ = planner.carrying(*arguments(row))
        results.append(timed(lambda segment=segment, path=path: certify(segment, path.points, planner.motion.degree)))
    return {"proved": float(np.mean([it.found.proved for it in results])), "ms": spread([it.ms for it in results], 2)}


def hopeless(planner: MotionPlanner) -> dict[str, int]:
    """What becomes of the problems for which no way is known."""
    rows = read(FILE.with_name("no_way.jsonl"))
    results = [timed(lambda row=row: planner.transfer(*arguments(row))).found for row in rows]
    return {"rows": len(rows), "refused_by_name": sum(isinstance(result, NoPath) for result in results)}


def overlaps(planner: MotionPlanner, count: int) -> dict[str, Any]:
    """Time saved by starting each cycle as early as the clearance allows, over the exact plans of random problems."""
    policy, saved = load("exact"), []
    for start, goal in zip(*random_problems(policy.rules, count, 0), strict=True):
        way = solve(policy, start, goal)["transfers"]
        orders = [(ARM_LETTERS.index(step["arm"]), np.array(step["from"][:2]), np.array(step["to"][:2])) for step in way]
        saved.append(coordinate(planner, plan_motions(planner, orders)))
    whole = sum(it.sequential_s for it in saved)
    return {"sequences": count, "sequential_s": round(whole, 1), "saved": round(1 - sum(it.overlapped_s for it in saved) / whole, 4)}


def random_places(planner: MotionPlanner, count: int, seed: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Arms, and two places each reaches, uniform over its manipulation space."""
    cell, random, found = planner.model.cell, np.random.default_rng(seed), []
    for _ in range(count):
        arm = int(random.integers(cell.num_arms))
        base = cell.bases[arm]
        r = np.sqrt(random.uniform(cell.r_min_mm**2, cell.r_max_mm**2, 2))
        angle = base.facing_rad + random.uniform(*cell.yaw_rad, 2)
        places = np.stack([base.x_mm + r * np.cos(angle), base.y_mm + r * np.sin(angle)], axis=1)
        found.append((arm, places[0], places[1]))
    return found


def cycles(planner: MotionPlanner, count: int, seed: int) -> dict[str, Any]:
    """All seven phases, planned, checked and timed, from parked to parked, the other arm parked."""
    parked = planner.home_rad
    planner.warm_up()
    results = [timed(lambda it=it: planner.pick_place(*it, parked, parked)) for it in random_places(planner, count, seed)]
    refused = Counter(f"{it.found.reason}: {it.found.what}" for it in results if isinstance(it.found, NoPath))
    times = {"ms": spread([it.ms for it in results], 2), "cpu_ms": spread([it.cpu_ms for it in results], 2)}
    return {"cycles": count, **times, "refused": dict(refused)}


CELLS = ("al5a", "triangle", "ring6")
"""A pair of one robot, three and six of it."""


def cells(count: int, seed: int) -> dict[str, Any]:
    """Paths of one cycle, all other arms parked: ``count`` in each of :data:`CELLS`, by turns, so that load hits all alike."""
    planners = {name: MotionPlanner(build_cell(cell_config(name))) for name in CELLS}
    places, results = {}, {name: [] for name in CELLS}
    for name, planner in planners.items():
        planner.warm_up()
        places[name] = random_places(planner, count, seed)
    for number in range(count):
        for name, planner in planners.items():
            arm, *ends = places[name][number]
            parked, others = planner.homes_rad[arm], planner.others_home_rad(arm)
            results[name].append(timed(partial(planner.plan_paths, arm, *ends, parked, others)))
    found: dict[str, Any] = {"cycles": count}
    for name, taken in results.items():
        times = {"ms": spread([it.ms for it in taken], 2), "cpu_ms": spread([it.cpu_ms for it in taken], 2)}
        found[name] = {"arms": planners[name].model.cell.num_arms, **times, "refused": sum(isinstance(it.found, NoPath) for it in taken)}
    for name in CELLS[1:]:
        found[name]["times_the_pair"] = round(found[name]["cpu_ms"]["median"] / found[CELLS[0]]["cpu_ms"]["median"], 3)
    return found


def first_plans() -> dict[str, Any]:
    """Seconds of a fresh process: of its first transfer, of its first cycle after that, and of all its life, twice with one cache."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("cold", "warm"):
            environment = {**os.environ, "NUMBA_CACHE_DIR": folder, "OMP_NUM_THREADS": "1"}
            began = time.perf_counter()
            done = subprocess.run([sys.executable, "-c", FIRST_PLAN], cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
            whole = time.perf_counter() - began
            transfer, cycle = (round(float(word), 3) for word in done.stdout.split())
            found[name] = {"transfer_s": transfer, "cycle_after_it_s": cycle, "process_s": round(whole, 3)}
    return found


def path_costs(planner: MotionPlanner, count: int, seed: int) -> dict[str, Any]:
    """The interpolated path cost against the planner, and its speed."""
    cell, costs = planner.model.cell, path_length_table(planner.model.cell, planner.motion)
    places, lengths = random_places(planner, count, seed), []
    for it in tqdm(places, desc="path costs", leave=False):
        result = timed(lambda it=it: planner.transfer(*it, planner.home_rad)).found
        lengths.append(result.length_mm if isinstance(result, FoundPath) else np.nan)
    arm, start, end = (np.array(column) for column in zip(*places, strict=True))
    known = np.isfinite(lengths)
    error = (costs(cell, arm, start, end) - lengths)[known]
    many = [np.tile(array, (10, 1)[: array.ndim]) for array in (arm, start, end)]
    taken = min(timed(lambda: costs(cell, *many)).ms for _ in range(5))
    return {
        "transfers": int(known.sum()),
        "refused": int((~known).sum()),
        "error_mm": {**spread(abs(error), 2), "mean": round(float(error.mean()), 2)},
        "error_percent": spread(100 * abs(error) / np.array(lengths)[known], 2),
        "us_each_in_batches": round(1e3 * taken / len(many[0]), 3),
    }


def measure(values: dict[str, Any]) -> dict[str, Any]:
    """Everything, one after the other."""
    planner, rows = MotionPlanner(build_cell(cell_config("paper"))), read(FILE)[: values["rows"]]
    some = rows[:: values["every"]]
    planner.warm_up()
    summary, found = transfers(planner, rows)
    return {
        "transfers": summary,
        "proofs": proofs(planner, rows, found) if len(found) == len(rows) else None,
        "no_way": hopeless(planner),
        "overlap": overlaps(planner, 60),
        "paper": against_paper(planner, some),
        "ompl": against_ompl(planner, some),
        "timing": against_toppra(planner, [path.points for path in found[:: values["every"]]]),
        "cycles": cycles(planner, values["cycles"], values["seed"]),
        "cells": cells(values["many"], values["seed"]) if values["many"] else None,
        "first_plan": first_plans() if values["starts"] else None,
        "path_costs": path_costs(planner, values["costs"], values["seed"]),
    }


def words(it: dict[str, float], form: str = "{:.3g}") -> str:
    """Median, 95th percentile and worst of a spread."""
    return " / ".join(form.format(it[key]) for key in ("median", "p95", "worst"))


def show(found: dict[str, Any]) -> str:
    """The numbers as a table."""
    ours, paper, ompl, timing = (found[key] for key in ("transfers", "paper", "ompl", "timing"))
    cycle, first, costs = (found[key] for key in ("cycles", "first_plan", "path_costs"))
    rows = [
        [f"transfer, {ours['rows']} rows, ms", words(ours["ms"])],
        ["  of a processor, ms", words(ours["cpu_ms"])],
        ["  found, all demands kept at 1001 samples", f"{100 * ours['success']:.2f} %"],
        *[[f"  refused: {reason}", str(count)] for reason, count in ours["refused"].items()],
        ["  length / best known", words(ours["length_over_best"], "{:.4f}")],
        ["  least clearance to the other arm, to the table, mm", "{arm:.2f}, {ground:.2f}".format(**ours["least_clearance_mm"])],
        ["  clearances proved at every tau", f"{100 * found['proofs']['proved']:.1f} %" if found["proofs"] else "not all found"],
        ["  problems without a known way, refused by name", "{refused_by_name} of {rows}".format(**found["no_way"])],
        [f"the paper's program, {paper['rows']} rows, ms", words(paper["paper_ms"], "{:.0f}")],
        ["  ours on the same rows, ms", words(paper["ours_ms"])],
        ["  ours is faster by, medians", f"{paper['times_faster']:.0f} x"],
        ["  the same, of a processor", f"{paper['times_faster_cpu']:.0f} x"],
        ["  its paths within 1 mm, without tolerance", f"{paper['paper_found_within_1_mm']}, {paper['paper_found_without_tolerance']}"],
        ["  its length / ours", words(paper["paper_length_over_ours"], "{:.4f}")],
    ]
    if ompl:
        rows += [
            [f"OMPL RRTConnect + simplify, {ompl['rows']} rows, ms", words(ompl["ompl_ms"])],
            ["  ours on the same rows, ms", words(ompl["ours_ms"])],
            [f"  its length / ours, {ompl['found']} found", words(ompl["ompl_length_over_ours"], "{:.2f}")],
        ]
    rows.append([f"timing of {timing['paths']} paths, ms", words(timing["ours_ms"])])
    for grid in (100, 500):
        if f"toppra_{grid}_ms" in timing:
            rows.append([f"  toppra, {grid} intervals, ms", words(timing[f"toppra_{grid}_ms"])])
            rows.append(["  our duration / toppra's", words(timing[f"duration_over_toppra_{grid}"], "{:.4f}")])
    rows.append([f"whole cycle, {cycle['cycles']} random ones, ms", words(cycle["ms"])])
    rows.append(["  of a processor, ms", words(cycle["cpu_ms"])])
    rows += [[f"  refused: {reason}", str(count)] for reason, count in cycle["refused"].items()]
    for name in CELLS if found["cells"] else ():
        it = found["cells"][name]
        rows.append([f"paths of a cycle among {it['arms']} arms, {name}, of a processor, ms", words(it["cpu_ms"])])
        rows += [["  median over that of the pair", f"{it['times_the_pair']:.2f}"]] if "times_the_pair" in it else []
    rows.append(["time saved by overlapping cycles of exact plans", f"{100 * found['overlap']['saved']:.1f} %"])
    for name, it in (first or {}).items():
        rows.append([f"first transfer of a process, {name} cache, s", f"{it['transfer_s']:.2f}"])
        rows.append(["  the process from start to end, with a cycle, s", f"{it['process_s']:.2f}"])
    rows.append([f"tabulated path cost, error over {costs['transfers']} transfers, mm", words(costs["error_mm"])])
    rows.append(["  error, %", words(costs["error_percent"])])
    return table(["what", "median / p95 / worst"], rows)


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    found = measure(values)
    print(show(found))
    folder = ROOT / values["results"] / datetime.date.today().isoformat()
    folder.mkdir(parents=True, exist_ok=True)
    about = {"settings": values, "commit": commit(), "machine": machine(1)}
    (folder / "motion.json").write_text(json.dumps({**about, **found}, indent=1) + "\n")
    print(f"-> {folder / 'motion.json'}")


if __name__ == "__main__":
    main(sys.argv[1:])
