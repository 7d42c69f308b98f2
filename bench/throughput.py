"""Speed of what a user waits for: environment steps, exact plans, one decision.

python bench/throughput.py seconds=2 cells=4096 json=throughput.json
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import commit, machine, parse, table

from marl_handover.cell import load_cell
from marl_handover.config import TaskConfig
from marl_handover.envs import handover_aec
from marl_handover.envs.goal_env import SupervisorGoalEnv
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules

DEFAULTS = {"seconds": 2.0, "cells": 4096, "plans": 100_000, "decisions": 2000, "json": ""}
POLICIES = ("exact", "pretrained_b")


def rate(work: Callable[[], Any], units: int, seconds: float) -> float:
    """Units of work a second: the best of the rounds of one call each within ``seconds``, since others share the machine."""
    work()
    best, started = 0.0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        began = time.perf_counter()
        work()
        best = max(best, units / (time.perf_counter() - began))
    return best


def batched_rate(cells: int, threads: int, seconds: float) -> float:
    """Environment steps a second of the batched environment: random actions, resets, observations included."""
    torch.set_num_threads(threads)
    env = SupervisorEnv(cells, seed=0)
    state = env.reset()

    def step() -> None:
        nonlocal state
        state["action"] = torch.rand(cells, 4) * 2 - 1
        _, state = env.step_and_maybe_reset(state)

    with torch.no_grad():
        found = rate(step, cells, seconds)
    torch.set_num_threads(1)
    return found


def gymnasium_rate(architecture: str, seconds: float, steps: int = 200) -> float:
    """Environment steps a second of the Gymnasium loop with random actions, resets included."""
    env, rng = SupervisorGoalEnv(architecture), np.random.default_rng(0)
    env.reset(seed=0)

    def loop() -> None:
        for _ in range(steps):
            *_, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 4).astype(np.float32))
            if terminated or truncated:
                env.reset()

    return rate(loop, steps, seconds)


def aec_rate(architecture: str, seconds: float, decisions: int = 100) -> float:
    """Supervisor decisions a second of the AEC environment, exact kinematics, all agents random, resets and observations included."""
    env = handover_aec.raw_env(architecture=architecture)
    env.reset(seed=0)
    for agent in env.possible_agents:
        env.action_space(agent).seed(0)

    def loop() -> None:
        left = decisions
        while left:
            if not env.agents:
                env.reset()
            agent = env.agent_selection
            _, _, terminated, truncated, _ = env.last()
            over = terminated or truncated
            left -= agent == "supervisor" and not over
            env.step(None if over else env.action_space(agent).sample())

    return rate(loop, decisions, seconds)


def planner_rate(count: int, seconds: float) -> float:
    """Problems a second solved exactly, in one batch."""
    cell = load_cell()
    planner = ExactPlanner(Rules(cell, TaskConfig()))
    starts, goals = sample_problems(cell, count, torch.Generator().manual_seed(0))
    return rate(lambda: planner.plan(starts, goals), count, seconds)


def latencies_ms(policy: Any, decisions: int) -> tuple[float, float]:
    """p50 and p99, in ms, of one decision on one problem."""
    starts, goals = sample_problems(load_cell(), decisions, torch.Generator().manual_seed(0))
    times = []
    for index, (pose, goal) in enumerate(zip(starts.numpy(), goals.numpy(), strict=True)):
        began = time.perf_counter()
        policy.act(pose, goal, np.int64(-1))
        if index >= min(50, decisions // 2):  # the first ones warm up
            times.append(1e3 * (time.perf_counter() - began))
    return float(np.percentile(times, 50)), float(np.percentile(times, 99))


def decision_latencies(decisions: int) -> dict[str, dict[str, float]]:
    """Latency of each policy that can be loaded; the others are named with the reason."""
    found: dict[str, dict[str, float]] = {}
    try:
        policies = importlib.import_module("marl_handover.policies")
    except ImportError as error:
        print(f"decision latency left out: {error}")
        return found
    for name in POLICIES:
        try:
            policy = policies.load(name)
        except Exception as error:
            print(f"decision latency of {name} left out: {type(error).__name__}: {error}")
            continue
        p50, p99 = latencies_ms(policy, decisions)
        found[name] = {"p50_ms": p50, "p99_ms": p99}
    return found


def measure(values: dict[str, Any]) -> dict[str, Any]:
    """All numbers, and ratios between numbers of this run."""
    torch.set_num_threads(1)
    cells, seconds = values["cells"], values["seconds"]
    batched = {str(threads): batched_rate(cells, threads, seconds) for threads in (1, 2)}
    loop = {architecture: gymnasium_rate(architecture, seconds) for architecture in ("A", "B")}
    return {
        "batched_cells": cells,
        "batched_steps_per_s": batched,
        "gymnasium_steps_per_s": loop,
        "aec_decisions_per_s": {architecture: aec_rate(architecture, seconds) for architecture in ("A", "B")},
        "exact_plans_per_s": planner_rate(values["plans"], seconds),
        "decision": decision_latencies(values["decisions"]),
        "batched_over_gymnasium": batched["1"] / loop["B"],
        "two_threads_over_one": batched["2"] / batched["1"],
    }


def show(found: dict[str, Any]) -> str:
    """The numbers as a table; the last column compares with the number named."""
    batched, loop = found["batched_steps_per_s"], found["gymnasium_steps_per_s"]
    rows = [
        [
            f"batched env, {found['batched_cells']} cells, 1 thread",
            f"{batched['1']:,.0f} steps/s",
            f"{found['batched_over_gymnasium']:.0f}x Gymnasium B",
        ],
        ["batched env, 2 threads", f"{batched['2']:,.0f} steps/s", f"{found['two_threads_over_one']:.2f}x 1 thread"],
        *[[f"Gymnasium loop, architecture {name}", f"{value:,.0f} steps/s", ""] for name, value in loop.items()],
        *[
            [f"AEC, architecture {name}, random agents", f"{value:,.0f} decisions/s", ""]
            for name, value in found["aec_decisions_per_s"].items()
        ],
        ["exact planner, one batch, 1 thread", f"{found['exact_plans_per_s']:,.0f} problems/s", ""],
        *[[f"decision of {name}, p50 / p99", f"{it['p50_ms']:.2f} / {it['p99_ms']:.2f} ms", ""] for name, it in found["decision"].items()],
    ]
    return table(["what", "measured", "ratio"], rows)


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    found = measure(values)
    print(show(found))
    if values["json"]:
        Path(values["json"]).parent.mkdir(parents=True, exist_ok=True)
        Path(values["json"]).write_text(json.dumps({**found, "machine": machine(1), "commit": commit()}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
