"""The twin in numbers: plain episodes, episodes with a mishap each, and a soak; through bytes and pixels, calibrated by `calibrate`.

python bench/twin.py episodes=200 drills=200 soak=0 policy=pretrained_twin seed=0 noise=1 results=bench/results

`noise` multiplies dead band, resting noise, scale and zero errors of the servos. `soak` is a number of transfers, in episodes one after the
other; memory and open files are looked at along the way.
"""

from __future__ import annotations

import datetime
import json
import math
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import numpy as np
from common import ROOT, commit, machine, parse, table

from marl_handover import policies
from marl_handover.cli import main as command_line
from marl_handover.learning.evaluation import random_problems
from marl_handover.runtime.episode import Episode
from marl_handover.runtime.evaluation import loop_report, true_outcome, truly_solved
from marl_handover.runtime.events import FAULTS
from marl_handover.runtime.loop import ClosedLoop, make_loop
from marl_handover.runtime.mishaps import Mishaps
from marl_handover.runtime.session import GivenGoal, Session
from marl_handover.runtime.settings import LabConfig, twin_lab
from marl_handover.task.rules import Outcome

DEFAULTS = {"episodes": 200, "drills": 200, "soak": 0, "policy": "pretrained_twin", "seed": 0, "noise": 1.0, "results": "bench/results"}
MISHAP_S = (0.3, 7.0)
NOISES = ("dead_band_us", "settle_sd_us", "scale_sd", "offset_sd_us")


def calibrated_lab(folder: str, noise: float) -> LabConfig:
    """The twin with its servos' errors multiplied, after `calibrate` has been run on it."""
    config = twin_lab()
    emulator = config.hardware.emulator
    for name in NOISES:
        setattr(emulator, name, noise * getattr(emulator, name))
    changes = [f"hardware.emulator.{name}={getattr(emulator, name)}" for name in NOISES]
    config.calibration, config.hardware.stop_file = folder, f"{folder}/stop"
    if command_line(["calibrate", "hardware=twin", f"calibration={folder}", f"hardware.stop_file={folder}/stop", *changes]) != 0:
        raise SystemExit("calibration failed")
    return config


def opened(config: LabConfig, policy: str) -> tuple[ClosedLoop, Session]:
    """A fresh twin with a policy at work."""
    loop = make_loop(policies.adapted(policy), "hardware", config=config)
    return loop, Session(loop, {"policy": policy})


def plain(config: LabConfig, policy: str, count: int, seed: int) -> dict[str, Any]:
    """Random episodes."""
    loop, session = opened(config, policy)
    with loop:
        played: list[Episode] = []
        for number, (start, goal) in enumerate(zip(*random_problems(loop.rules, count, seed), strict=True)):
            played.append(session.play(start, GivenGoal(goal), seed + number))
            progress("episode", number, count)
        first = sum(true_outcome(episode, loop.rules) is Outcome.SUCCESS for episode in played)
        faults = {str(event): number for event, number in session.log.counts.items() if event in FAULTS}
        touches = sorted(session.backend.lab.twin.follower.collisions) if session.backend.lab.twin else []
        return {"episodes": count, "first_time": first / count, **loop_report(played, loop.rules), "events": faults, "collisions": touches}


def drilled(config: LabConfig, policy: str, count: int, seed: int) -> dict[str, Any]:
    """Random episodes with a mishap each, the kinds in turn, at random times."""
    loop, session = opened(config, policy)
    with loop:
        twin = session.backend.lab.twin
        assert twin is not None
        mishaps, random, reached, longest_s = Mishaps(twin, loop.rules, seed), np.random.default_rng(seed), Counter(), 0.0
        for number, (start, goal) in enumerate(zip(*random_problems(loop.rules, count, seed), strict=True)):
            kind, given, begun_s = mishaps.kinds[number % len(mishaps.kinds)], GivenGoal(goal), twin.clock.now_s()
            mishaps.arrange(kind, float(random.uniform(*MISHAP_S)), given)
            reached[kind, truly_solved(session.play(start, given, seed + number), loop.rules)] += 1
            longest_s = max(longest_s, twin.clock.now_s() - begun_s)
            progress("drill", number, count)
        kinds = {kind: {"reached": reached[kind, True], "of": reached[kind, True] + reached[kind, False]} for kind in mishaps.kinds}
        share = sum(row["reached"] for row in kinds.values()) / count
        return {"drills": count, "reached": share, "kinds": kinds, "longest_s": longest_s, "collisions": sorted(twin.follower.collisions)}


def soaked(config: LabConfig, policy: str, transfers: int, seed: int) -> dict[str, Any]:
    """Episodes until so many transfers are done; memory, open files and success in four parts."""
    loop, session = opened(config, policy)
    with loop:
        parts, done, solved, count = [], 0, 0, 0
        starts, goals = random_problems(loop.rules, transfers, seed)
        for start, goal in zip(starts, goals, strict=True):
            episode = session.play(start, GivenGoal(goal), seed + count)
            done, solved, count = done + len(episode.transfers), solved + truly_solved(episode, loop.rules), count + 1
            if done >= transfers * (len(parts) + 1) / 4:
                parts.append(
                    {"transfers": done, "solved": solved, "episodes": count, "rss_mb": rss_mb(), "files": len(os.listdir("/proc/self/fd"))}
                )
                solved = count = 0
            if len(parts) == 4:
                break
        twin = session.backend.lab.twin
        return {"parts": parts, "virtual_s": twin.clock.now_s() if twin else math.nan}


def rss_mb() -> float:
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)


def progress(what: str, number: int, count: int) -> None:
    """One line that stays one line."""
    print(f"\r{what} {number + 1}/{count}", end="", file=sys.stderr, flush=True)


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    begun, found = time.perf_counter(), dict[str, Any]()
    with tempfile.TemporaryDirectory() as folder:
        config = calibrated_lab(folder, float(values["noise"]))
        for key, work in (("episodes", plain), ("drills", drilled), ("soak", soaked)):
            if values[key]:
                found[key] = work(config, values["policy"], int(values[key]), int(values["seed"]))
    rows = []
    if "episodes" in found:
        it = found["episodes"]
        error = f"{it['transfer_error_mm']['p50']:.2f} / {it['transfer_error_mm']['p95']:.2f} mm"
        rows += [["first final placement", f"{100 * it['first_time']:.1f} %"], ["in the end", f"{100 * it['success_in_the_end']:.1f} %"]]
        rows += [["one transfer, p50 / p95", error], ["an episode, wall", f"{it['episode_s']['p50']:.1f} s"]]
    if "drills" in found:
        rows += [["with a mishap: in the end", f"{100 * found['drills']['reached']:.1f} %"]]
        rows += [[f"  {kind}", f"{row['reached']} of {row['of']}"] for kind, row in found["drills"]["kinds"].items()]
    for part in found.get("soak", {}).get("parts", []):
        rows.append(
            [f"soak, {part['transfers']} transfers", f"{part['solved']} of {part['episodes']}, {part['rss_mb']} MB, {part['files']} files"]
        )
    print("\n" + table(["what", "result"], rows))
    target = ROOT / values["results"] / datetime.date.today().isoformat()
    target.mkdir(parents=True, exist_ok=True)
    about = {"settings": values, "commit": commit(), "machine": machine(1), "wall_s": time.perf_counter() - begun}
    name = "twin.json" if float(values["noise"]) == 1.0 else f"twin_noise{values['noise']:g}.json"
    (target / name).write_text(json.dumps({**about, **found}, indent=1) + "\n")
    print(f"-> {target / name}")


if __name__ == "__main__":
    main(sys.argv[1:])
