"""``marl-handover evaluate``: episodes of a policy against the exact optimum."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from marl_handover import policies
from marl_handover.commands.plan import changed
from marl_handover.config import CellConfig, LoopConfig, MotionConfig, TaskChanges, require_at_least, require_choice, require_seed
from marl_handover.errors import InvalidSetting, MissingFile
from marl_handover.learning.evaluation import Evaluation, decision_time, evaluate, random_problems, read_problems
from marl_handover.learning.recorder import write_whole
from marl_handover.learning.rollout import Episodes
from marl_handover.learning.trace import Trace
from marl_handover.policies import SupervisorPolicy
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Outcome, Rules

Floats = NDArray[np.float64]

BACKENDS = ("kinematic", "noisy", "bullet")


@dataclass
class EvaluateCommand:
    """Settings of ``evaluate``. What is not given is the policy's own, or the default."""

    policy: str = "exact"  # exact, random, greedy, pretrained_a, pretrained_b, a run directory or a policy file
    backend: str = "kinematic"  # where transfers are executed: kinematic, or in closed loop with planned motions noisy or bullet
    episodes: int = 1000  # random problems
    seed: int = 0  # of the problems and of execution noise
    cell: CellConfig | None = None  # single keys change the paper cell
    task: TaskChanges = field(default_factory=TaskChanges)  # task.noise left out: of noisy, 1 mm and 0.5 deg
    grasp: str | None = None  # of bullet: friction or constraint; null: friction
    missed_grasps: float | None = None  # of noisy: probability that the fingers close on nothing; null: 0.01
    loop: LoopConfig = field(default_factory=LoopConfig)  # of noisy and bullet
    motion: MotionConfig = field(default_factory=MotionConfig)  # of noisy and bullet
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
    options = _backend_options(config)
    policy = policies.adapted(config.policy, config.cell, config.seed, motion=config.motion, **vars(config.task))
    play = _play_kinematic if config.backend == "kinematic" else _play_loop
    result, trace_text, rules, added = play(config, policy, options)
    report = {
        "policy": config.policy,
        "architecture": rules.config.architecture,
        "variant": policy.variant,
        "backend": config.backend,
        "epsilon_deg": rules.config.epsilon_deg,
        "symmetry_order": rules.config.symmetry_order,
        "seed": config.seed,
        **result.report(),
        **added,
    }
    print(table(report, result))
    if config.json:
        write_whole(Path(config.json), json.dumps(report, indent=2) + "\n")
    if config.trace:
        write_whole(Path(config.trace), trace_text())
    return 0


Played = tuple[Evaluation, Callable[[], str], Rules, dict[str, Any]]
"""What came of the problems: the common figures, the text of the trace, the rules they were judged by, and the backend's own figures."""


def _play_kinematic(config: EvaluateCommand, policy: SupervisorPolicy, options: dict[str, Any]) -> Played:
    """All problems at once, on the batched rules."""
    rules = policy.rules
    problems = _problems(config, rules)
    trace = Trace(rules)
    with _bar(config, problems) as bar:
        result = evaluate(rules, policy.act, problems, config.seed, trace if config.trace else None, bar.update)
    return result, trace.text, rules, {"noise": asdict(rules.config.noise)} if rules.noisy else {}


def _play_loop(config: EvaluateCommand, policy: SupervisorPolicy, options: dict[str, Any]) -> Played:
    """One problem after the other, in closed loop."""
    # Planner and simulator are imported where they are needed: the kinematic evaluation starts without them.
    from marl_handover.envs.backends import NoisyBackend
    from marl_handover.runtime.evaluation import loop_report, play_problems
    from marl_handover.runtime.loop import make_loop
    from marl_handover.runtime.trace import trace_text

    started = time.perf_counter()
    with make_loop(policy, config.backend, config.motion, config.loop, **options) as loop:
        rules, backend = loop.rules, loop.backend
        problems = _problems(config, rules)
        with _bar(config, problems) as bar:
            played = play_problems(loop, problems, config.seed, bar.update)
    outcomes, steps = (np.array(values) for values in zip(*((int(e.outcome), len(e.first)) for e in played), strict=True))
    episodes = Episodes(outcomes, steps, np.stack([episode.first[-1].done.pose for episode in played]))
    optimal = ExactPlanner(rules).plan(*problems).transfers
    result = Evaluation(episodes, optimal, decision_time(loop.policy.act, problems), time.perf_counter() - started)
    own = {"noise": asdict(backend.noise), "missed_grasps": backend.missed_grasps} if isinstance(backend, NoisyBackend) else options
    settings = {"chart_inset": rules.cell.config.chart_inset, "position_tolerance_mm": rules.config.position_tolerance_mm, **own}
    return result, lambda: trace_text(played, rules), rules, {**loop_report(played, rules), **settings}


def _problems(config: EvaluateCommand, rules: Rules) -> tuple[Floats, Floats]:
    return read_problems(rules, Path(config.problems)) if config.problems else random_problems(rules, config.episodes, config.seed)


def _bar(config: EvaluateCommand, problems: tuple[Floats, Floats]) -> tqdm[Any]:
    return tqdm(total=len(problems[0]), unit="episode", disable=not config.progress, leave=False)


def _backend_options(config: EvaluateCommand) -> dict[str, Any]:
    """What was asked of the backend. Raises :class:`InvalidSetting` for what another one would take."""
    if config.backend == "kinematic":
        for key, value in changed("loop", config.loop) + changed("motion", config.motion):
            raise InvalidSetting(key, value, "left out with backend=kinematic, which plans no motions; or backend=noisy or bullet")
    owners = {"grasp": "bullet", "missed_grasps": "noisy"}
    given = {name: getattr(config, name) for name in owners if getattr(config, name) is not None}
    for name, value in given.items():
        if owners[name] != config.backend:
            raise InvalidSetting(name, value, f"left out, or backend={owners[name]}")
    if config.backend == "bullet" and config.task.noise is not None:
        raise InvalidSetting("task.noise", asdict(config.task.noise), "left out with backend=bullet, where physics decides")
    if config.backend == "noisy" and config.task.noise is not None:
        given["noise"] = config.task.noise  # as typed, also if that is none at all
    return given


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
    return "\n".join(lines + (_loop_lines(report) if "success_in_the_end" in report else []))


def _loop_lines(report: dict[str, Any]) -> list[str]:
    """What only the closed loop has."""

    def pair(key: str, unit: str) -> str:
        (low, p), (high, q) = list(report[key].items())[:2]
        return f"{low} {_number(p, 2).strip()} {unit}, {high} {_number(q, 2).strip()} {unit}"

    refused = "  ".join(f"{name} {count}" for name, count in report["refusals"].items()) or "none"
    return [
        "",
        f"success in the end: {100 * report['success_in_the_end']:.2f} %, after {report['transfers']} transfers in all",
        f"at the goal:  {pair('position_error_mm', 'mm')}; {pair('orientation_error_deg', 'deg')}",
        f"one transfer: {pair('transfer_error_mm', 'mm')}; {pair('transfer_error_deg', 'deg')}",
        f"refused or failed: {refused}",
        f"one motion: planned in {pair('planning_ms', 'ms')}; an episode: {pair('episode_s', 's')}",
    ]


def _number(value: float | None, digits: int) -> str:
    return f"{'none' if value is None else f'{value:.{digits}f}':>12}"
