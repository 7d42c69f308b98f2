"""``marl-handover evaluate``: episodes of a policy against the exact optimum."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from marl_handover import policies
from marl_handover.config import CellConfig, TaskChanges, require_at_least, require_choice, require_seed
from marl_handover.errors import InvalidSetting, MissingFile
from marl_handover.learning.evaluation import Evaluation, evaluate, random_problems, read_problems
from marl_handover.learning.recorder import write_whole
from marl_handover.learning.trace import Trace
from marl_handover.task.rules import Outcome

BACKENDS = ("kinematic",)


@dataclass
class EvaluateCommand:
    """Settings of ``evaluate``. What is not given is the policy's own, or the default."""

    policy: str = "exact"  # exact, random, greedy, pretrained_a, pretrained_b, a run directory or a policy file
    backend: str = "kinematic"  # where transfers are executed
    episodes: int = 1000  # random problems
    seed: int = 0  # of the problems and of execution noise
    cell: CellConfig | None = None  # single keys change the paper cell
    task: TaskChanges = field(default_factory=TaskChanges)
    problems: str = ""  # JSON Lines of problems instead of random ones
    json: str = ""  # file for the result
    trace: str = ""  # file for every transfer
    progress: bool = True


SCHEMA = EvaluateCommand
ALIASES = {key: f"task.{key}" for key in ("epsilon_deg", "architecture", "max_steps")}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: EvaluateCommand) -> int:
    """Play, print the table, write the files."""
    require_choice("backend", config.backend, BACKENDS)
    require_at_least("episodes", config.episodes, 1)
    require_seed(config.seed)
    for name, path in (("json", config.json), ("trace", config.trace)):
        if path and not Path(path).parent.is_dir():
            raise MissingFile("folder", Path(path).parent, "make it first")
        if path and Path(path).is_dir():
            raise InvalidSetting(name, path, "a file, not a folder")
    policy = policies.adapted(config.policy, config.cell, config.seed, **vars(config.task))
    rules = policy.rules
    problems = read_problems(rules, Path(config.problems)) if config.problems else random_problems(rules, config.episodes, config.seed)
    trace = Trace(rules) if config.trace else None
    with tqdm(total=len(problems[0]), unit="episode", disable=not config.progress, leave=False) as bar:
        result = evaluate(rules, policy.act, problems, config.seed, trace, bar.update)
    report = {
        "policy": config.policy,
        "architecture": rules.config.architecture,
        "variant": policy.variant,
        "backend": config.backend,
        "epsilon_deg": rules.config.epsilon_deg,
        "symmetry_order": rules.config.symmetry_order,
        "seed": config.seed,
        **result.report(),
    }
    if rules.noisy:
        report["noise"] = asdict(rules.config.noise)
    print(table(report, result))
    if config.json:
        write_whole(Path(config.json), json.dumps(report, indent=2) + "\n")
    if trace is not None:
        write_whole(Path(config.trace), trace.text())
    return 0


def table(report: dict[str, Any], result: Evaluation) -> str:
    """The result beside the optimum, for people."""
    low, high = report["success_ci95"]
    outcomes = "  ".join(f"{name} {count}" for name, count in report["outcomes"].items())
    lines = [
        f"{report['policy']}: architecture {report['architecture']}, backend {report['backend']}, "
        f"epsilon {report['epsilon_deg']:g} deg, {report['episodes']} episodes, seed {report['seed']}",
        "",
        f"{'':22}{'policy':>12}{'optimum':>12}",
        f"{'success':22}{100 * report['success_rate']:>11.2f}%{100 * (result.optimal > 0).mean():>11.2f}%",
        f"{'  95 % interval':22}{100 * low:>11.2f}%{100 * high:>11.2f}%",
        f"{'mean steps':22}{report['mean_steps']:>12.3f}{_number(report['optimal_mean_steps'], 3)}",
        f"{'mean steps, success':22}{_number(report['mean_steps_success'], 3)}",
        f"{'steps / optimum':22}{_number(report['steps_ratio'], 4)}",
        "",
        f"{'optimal steps':22}{'episodes':>12}{'success':>12}{'mean steps':>12}",
    ]
    solved = result.episodes.outcome == int(Outcome.SUCCESS)
    for steps in np.unique(result.optimal[result.optimal > 0]):
        rows = result.optimal == steps
        lines.append(f"{steps:<22}{rows.sum():>12}{100 * solved[rows].mean():>11.2f}%{result.episodes.transfers[rows].mean():>12.3f}")
    lines += ["", outcomes, f"one decision: p50 {report['decision_us']['p50']:.0f} us, p99 {report['decision_us']['p99']:.0f} us"]
    return "\n".join(lines)


def _number(value: float | None, digits: int) -> str:
    return f"{'none' if value is None else f'{value:.{digits}f}':>12}"
