"""The committed set of transfers that motion planning is measured on, and the best paths known for them.

    python bench/transfers.py make=true            writes bench/data/transfers.jsonl: 1,000 problems of the paper cell, seed 7
    python bench/transfers.py best=true            searches long for each and keeps the shortest path ever found (resumes)
    python bench/transfers.py settle=true          moves problems for which no way is known to no_way.jsonl, and draws others for them

In each problem one arm carries the block while the other holds still in a random grasp (60 %) or lifted pose over the table. Half of the
problems are *blocked*: the plainest guess, lifted and around the base, runs into the other arm. Both ends keep the demanded clearances.

10 of the first 1,000 drawn were replaced: the other arm hangs over an end, so that the block cannot be lifted as the lift-over demands, and
neither the long search nor RRT-Connect in 15 s (extra [ompl]) found any way. They are kept in no_way.jsonl: the planner must refuse them
by name.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from common import parse
from tqdm import tqdm

from marl_handover.cell.build import build_cell, cell_config
from marl_handover.motion.initial_guesses import carrying_guesses, fit_control_points, random_bend
from marl_handover.motion.path_optimizer import NoPath, SolverOptions, require_free_ends, solve_from
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import evaluate

FILE = Path(__file__).parent / "data" / "transfers.jsonl"
COUNT, SEED, GRASPING, LIFTED_MM = 1000, 7, 0.6, (60.0, 88.0)
THOROUGH = SolverOptions(penalty=0.3, growth=4.0, rounds=8, steps=80, gain=1e-6, slack_mm=0.2)


def main(arguments: list[str]) -> None:
    """Make the set, or improve the best known lengths."""
    values = parse(arguments, {"make": False, "best": False, "settle": False, "file": str(FILE)})
    planner, path = MotionPlanner(build_cell(cell_config("paper"))), Path(values["file"])
    if values["make"]:
        write(path, list(problems(planner, COUNT, SEED)))
    if values["best"]:
        improve(planner, path)
    if values["settle"]:
        settle(planner, path)


def read(path: Path = FILE) -> list[dict[str, Any]]:
    """Rows: arm, pick_mm, place_mm, other_rad, blocked, best_mm (null: none is known)."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write whole, then rename."""
    temporary = path.with_suffix(".part")
    temporary.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    os.replace(temporary, path)


def problems(planner: MotionPlanner, count: int, seed: int) -> Iterator[dict[str, Any]]:
    """Random problems, half of them blocked."""
    generator = np.random.default_rng(seed)
    left = {False: count - count // 2, True: count // 2}
    while any(left.values()):
        arm = int(generator.integers(len(planner.model.cell.bases)))
        pick, place = (_place(planner, generator, arm) for _ in range(2))
        other = _posture(planner, generator, 1 - arm)
        if other is None:
            continue
        try:
            segment, _ = planner.carrying(arm, pick, place, other)
            require_free_ends(segment)
        except NoPath:
            continue
        plain = list(
            carrying_guesses(
                segment.collision_model, segment.ends, segment.scene.profile[:4].reshape(2, 2), segment.scene.pick_height, 40.0
            )
        )[1]
        points = fit_control_points(plain, segment.collision_model.limits, 9, 5)
        margins, _ = segment.check(evaluate(points, np.linspace(0, 1, 201), 5))
        blocked = margins.arm < 0.0
        if left[blocked]:
            left[blocked] -= 1
            yield {
                "arm": arm, "pick_mm": pick.tolist(), "place_mm": place.tolist(), "other_rad": other.tolist(), "blocked": blocked,
                "best_mm": None,
            }  # fmt: skip


def _place(planner: MotionPlanner, generator: np.random.Generator, arm: int) -> Any:
    """A point of the arm's manipulation space, in the world, uniform over its area."""
    cell, base = planner.model.cell, planner.model.cell.bases[arm]
    r = np.sqrt(generator.uniform(cell.r_min_mm**2, cell.r_max_mm**2))
    return base.around(r, generator.uniform(*cell.yaw_rad))


def _posture(planner: MotionPlanner, generator: np.random.Generator, arm: int) -> Any:
    """Joints (5,) of an arm that grasps somewhere, or is a little above; None where it cannot be."""
    at = planner.in_base(arm, _place(planner, generator, arm))
    height = planner.pick_height_mm if generator.uniform() < GRASPING else generator.uniform(*LIFTED_MM)
    q = planner.model.arm.ik(np.array([*at, height]))[0]
    return q if planner.model.arm.within_limits(q) else None


def improve(planner: MotionPlanner, path: Path) -> None:
    """Search each problem thoroughly, N = 9, 11, 13 and 15, many starts, small steps; keep what is shorter than before."""
    table = read(path)
    for number, row in enumerate(tqdm(table, unit="transfer")):
        pick, place, other = (np.array(row[key]) for key in ("pick_mm", "place_mm", "other_rad"))
        segment, _ = planner.carrying(row["arm"], pick, place, other)
        ends = segment.scene.profile[:4].reshape(2, 2)
        for count in (9, 11, 13, 15):
            guesses = [
                fit_control_points(guess, segment.collision_model.limits, count, 5)
                for guess in carrying_guesses(segment.collision_model, segment.ends, ends, segment.scene.pick_height, 40.0)
            ]
            bends = [random_bend(guess, segment.collision_model.limits, 5, 1000 * count + k) for k, guess in enumerate(guesses)]
            for points in guesses + bends:
                found, _, _ = solve_from(segment, points, 5, THOROUGH)
                if found is not None and (row["best_mm"] is None or found.length_mm < row["best_mm"]):
                    row["best_mm"] = found.length_mm
        if number % 50 == 49:
            write(path, table)
    write(path, table)


def settle(planner: MotionPlanner, path: Path) -> None:
    """Replace the problems without a known way by others of their kind."""
    from ompl_planner import rrt_connect

    rows, out = read(path), []
    spare = iter(list(problems(planner, 200, SEED + 1)))
    for index, row in enumerate(tqdm(rows, unit="transfer")):
        if row["best_mm"] is not None:
            continue
        pick, place, other = (np.array(row[key]) for key in ("pick_mm", "place_mm", "other_rad"))
        segment, _ = planner.carrying(row["arm"], pick, place, other)

        def free(q: Any, segment: Any = segment) -> bool:
            return bool(segment.check(q[None])[0].worst >= 0.0)

        limits = planner.collision_model.limits
        if rrt_connect(segment.ends[0], segment.ends[1], free, limits[:, 0], limits[:, 1], seconds=15, seed=SEED) is None:
            out.append(row)
            rows[index] = next(other for other in spare if other["blocked"] == row["blocked"])
    write(path.with_name("no_way.jsonl"), out)
    write(path, rows)


if __name__ == "__main__":
    main(sys.argv[1:])
