"""What more arms cost: one decision in numpy and one gradient step, by the number of arms, and a model of what lies beyond.

python bench/growth.py policy=pretrained_any json=bench/results/2026-11-30/growth.json page=docs/concepts/many-arms.md

Cells are random, of N arms each. Times are of the processor, medians; a gradient step draws its batch and is not compiled. The model is
``a + b N + c N^2`` with no negative coefficient, the least squares of relative errors over all N that were measured: the same without the
two largest N tells how far such a model may be trusted one and two steps on. ``page`` is a page between whose marks the result is written.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import commit, machine, parse
from scipy.optimize import nnls

from marl_handover import policies
from marl_handover.config import MOST_ARMS, LayoutConfig, TaskConfig
from marl_handover.errors import HandoverError
from marl_handover.files import write_whole
from marl_handover.learning.evaluation import CellProblems, problems_in_cells
from marl_handover.learning.settings import GraphSacConfig, TrainConfig
from marl_handover.learning.trainer import Trainer
from marl_handover.policies import SupervisorPolicy

BEYOND = (16, 32)
"""Numbers of arms that no cell may have, for the model."""

COSTS = {"decision_ms": "one decision", "gradient_step_ms": "one gradient step"}
BEGIN, END = "<!-- growth:begin -->\n", "<!-- growth:end -->\n"

WARM = 3


def growth(arms: Sequence[int], cost_ms: Sequence[float]) -> list[float]:
    """Coefficients a, b, c of the model of costs (n,) that numbers of arms (n,) have."""
    count, cost = np.asarray(arms, float), np.asarray(cost_ms, float)
    basis = np.stack([np.ones_like(count), count, count**2], -1) / cost[:, None]
    return [float(value) for value in nnls(basis, np.ones_like(cost))[0]]


def modelled(coefficients: Sequence[float], arms: int) -> float:
    """What the model says of a number of arms."""
    a, b, c = coefficients
    return a + b * arms + c * arms**2


def cpu_ms(work: Callable[[int], object], count: int) -> float:
    """Median processor time of ``work``, called with 0 to ``count`` - 1 after a few calls that are not counted."""
    times = []
    for index in range(-WARM, count):
        begun = time.process_time_ns()
        work(max(index, 0))
        times.append(time.process_time_ns() - begun)
    return float(np.median(times[WARM:])) / 1e6


def decision_ms(policy: SupervisorPolicy, posed: CellProblems, count: int) -> float:
    """One decision at the start of a problem, in its cell alone."""
    acts = [(policy.under(rules), int(rows[0])) for rules, rows in posed.layouts()]

    def decide(index: int) -> None:
        own, row = acts[index % len(acts)]
        own.act(posed.start[row], posed.goal[row], np.int64(-1))

    return cpu_ms(decide, count)


def gradient_step_ms(arms: int, count: int) -> float:
    """One gradient step of the default recipe on memories of cells of that many arms, the draw of its batch included."""
    algorithm = GraphSacConfig(layouts_at_once=32)
    config = TrainConfig(layouts=[LayoutConfig(arms=[arms, arms])], algorithm=algorithm, compile="off", num_envs=64, progress=False)
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(config, Path(folder))
        with trainer.torch:
            while len(trainer.replay) < algorithm.batch_size:
                collected = trainer.collector.collect(trainer.algorithm.random_action)
                if collected.rows is not None:
                    trainer.replay.extend(collected.rows)
            return cpu_ms(lambda _: trainer.algorithm.update(trainer.replay.sample(algorithm.batch_size)), count)


def measured(policy: SupervisorPolicy, decisions: int, steps: int) -> dict[str, dict[str, float]]:
    """By the number of arms: pairs of arms that share something, and both costs."""
    found = {}
    for arms in range(2, MOST_ARMS + 1):
        (posed,) = problems_in_cells(LayoutConfig(arms=[arms, arms]), 20, TaskConfig(), 200, 0).values()
        pairs = float((posed.rules.cell.pool.number >= 0).sum((1, 2)).mean()) / 2
        costs = {"decision_ms": decision_ms(policy, posed, decisions), "gradient_step_ms": gradient_step_ms(arms, steps)}
        found[str(arms)] = {"pairs": pairs, **costs}
    return found


def models(rows: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, Any]]:
    """Of each cost: the model, what it says of more arms, and how far off it is for the two largest N if it does not know them."""
    arms, told = [int(key) for key in rows], {}
    for name in COSTS:
        costs = [row[name] for row in rows.values()]
        fitted, blind = growth(arms, costs), growth(arms[:-2], costs[:-2])
        off = [modelled(blind, count) / cost - 1 for count, cost in zip(arms[-2:], costs[-2:], strict=True)]
        told[name] = {
            "coefficients_ms": fitted,
            "worst_fit": max(abs(modelled(fitted, count) / cost - 1) for count, cost in zip(arms, costs, strict=True)),
            "blind_error": {str(count): error for count, error in zip(arms[-2:], off, strict=True)},
            "beyond_ms": {str(count): modelled(fitted, count) for count in BEYOND},
        }
    return told


def page_text(content: Mapping[str, Any]) -> str:
    """What stands between the marks of the page: the measured costs, the model's, and how good the model is."""
    lines = ["| arms | pairs that share a place | one decision, ms | one gradient step, ms |", "| --- | --- | --- | --- |"]
    for arms, row in content["arms"].items():
        lines.append(f"| {arms} | {row['pairs']:.1f} | {row['decision_ms']:.2f} | {row['gradient_step_ms']:.0f} |")
    told = [content["models"][name] for name in COSTS]
    for arms in map(str, BEYOND):
        decision, step = (about["beyond_ms"][arms] for about in told)
        lines.append(f"| {arms}, by the model | | {decision:.1f} | {step:,.0f} |")
    lines.append("")
    for (name, title), about in zip(COSTS.items(), told, strict=True):
        parts = zip(about["coefficients_ms"], ("", " N", " N²"), strict=True)
        model = " + ".join(f"{value:.3g}{power}" for value, power in parts if value > 0)
        blind = " and ".join(f"{100 * error:+.0f} % at {arms}" for arms, error in about["blind_error"].items())
        unit = name.removesuffix("_ms").replace("_", " ")
        lines.append(
            f"{title[0].upper()}{title[1:]} takes {model} ms; the fit is off by {100 * about['worst_fit']:.0f} % "
            f"at most. Of a {unit}, a fit that does not know the last two is off by {blind}."
        )
    load = content["machine"]["load"]
    lines.append(f"Measured on {content['machine']['cpu']}, one thread, beside other programs (a load of {load:.1f}).")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, fit, print, store, write the page."""
    values = parse(sys.argv[1:], {"policy": "pretrained_any", "decisions": 200, "steps": 12, "json": "", "page": ""})
    try:
        rows = measured(policies.load(values["policy"]), values["decisions"], values["steps"])
    except HandoverError as error:
        sys.exit(str(error))
    content = {"commit": commit(), "machine": machine(1), "arms": rows, "models": models(rows)}
    print(page_text(content))
    if values["json"]:
        write_whole(Path(values["json"]), json.dumps(content, indent=1) + "\n")
    if values["page"]:
        page = Path(values["page"])
        text = page.read_text(encoding="utf-8")
        write_whole(page, re.sub(f"{BEGIN}.*?{END}", lambda _: BEGIN + "\n" + page_text(content) + "\n" + END, text, flags=re.DOTALL))


if __name__ == "__main__":
    main()
