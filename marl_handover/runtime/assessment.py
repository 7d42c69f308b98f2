"""Playing problems with a policy and judging it: what ``evaluate`` prints and what ``compare`` collects."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover import policies
from marl_handover.config import (
    CellConfig,
    LoopConfig,
    MotionConfig,
    TaskChanges,
    bounded,
    changed,
    check_bounds,
    chosen,
    path_field,
    seed_field,
)
from marl_handover.errors import InvalidSetting
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.learning.evaluation import Evaluation, Trace, decision_time, evaluate, random_problems, read_problems
from marl_handover.policies import SupervisorPolicy
from marl_handover.progress import Bar
from marl_handover.runtime.paths import PathLengths
from marl_handover.task.episode import Decision, Episodes
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Rules

Floats = NDArray[np.float64]

BACKENDS = ("kinematic", "noisy", "bullet", "twin")


@dataclass
class AssessmentConfig:
    """Who is judged, where, on which problems. What is not given is the policy's own, or the default."""

    policy: str = path_field("exact")  # exact, random, greedy, pretrained_a or _b or _twin, a run directory or a policy file
    backend: str = chosen("kinematic", BACKENDS)  # kinematic; in closed loop with planned motions: noisy, bullet or twin
    episodes: int = bounded(1000, 1, 10**6)  # random problems
    seed: int = seed_field()  # of the problems, and of execution noise but for the twin, whose servos go on as they are
    cell: CellConfig | None = None  # single keys change the paper cell
    task: TaskChanges = field(default_factory=TaskChanges)  # task.noise left out: of noisy, 1 mm and 0.5 deg
    grasp: str | None = chosen(None, ("friction", "constraint"))  # of bullet: friction or constraint; null: friction
    missed_grasps: float | None = bounded(None, 0.0, 1.0)  # of noisy: probability that the fingers close on nothing; null: 0.01
    loop: LoopConfig = field(default_factory=LoopConfig)  # of all but kinematic
    motion: MotionConfig = field(default_factory=MotionConfig)  # of all but kinematic
    calibration: str | None = path_field(None)  # of twin: folder of its calibration; null: runs/calibration/twin
    hardware: HardwareConfig | None = None  # of twin: single keys change its electronics; ports are always the emulated ones
    problems: str = path_field()  # JSON Lines of problems instead of random ones

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on what can be refused without playing."""
        check_bounds(self)
        backend_options(self)


class Assessment(NamedTuple):
    """What came of it.

    ``report``: the content of ``evaluate json=FILE``; ``result``: each episode beside its optimum; ``trace_text``: makes the text of
    ``trace=FILE``; ``rules``: what the episodes were judged by.
    """

    report: dict[str, Any]
    result: Evaluation
    trace_text: Callable[[], str]
    rules: Rules


def assess(config: AssessmentConfig, traced: bool = False, progress: bool = False) -> Assessment:
    """Load the policy, play every problem, judge.

    Args:
        config: see there.
        traced: keep what ``trace_text`` needs.
        progress: show a bar.

    Raises:
        InvalidSetting, UnknownChoice, MissingFile, CorruptFile, CheckpointMismatch: on bad input.
    """
    config.validate()
    policy = policies.adapted(config.policy, config.cell, config.seed, motion=config.motion, **vars(config.task))
    play = _play_kinematic if config.backend == "kinematic" else _play_loop
    result, trace_text, rules, added = play(config, policy, traced, progress)
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
    return Assessment(report, result, trace_text, rules)


Played = tuple[Evaluation, Callable[[], str], Rules, dict[str, Any]]
"""What came of the problems: the common figures, the text of the trace, the rules they were judged by, and the backend's own figures."""


def _play_kinematic(config: AssessmentConfig, policy: SupervisorPolicy, traced: bool, progress: bool) -> Played:
    """All problems at once, on the batched rules."""
    rules = policy.rules
    problems, noise = _problems(config, rules), rules.config.noise
    trace, paths = Trace(rules), PathLengths(rules)

    def observer(decision: Decision) -> None:
        paths(decision)
        if traced:
            trace(decision)

    with _bar(problems, progress) as bar:
        result = evaluate(rules, policy.act, problems, config.seed, observer, bar.update, policy.under(rules).act)
    shown = {"noise": noise.report()} if rules.noisy or noise.observed else {}
    return result, trace.text, rules, {**shown, **paths.report(), **_repaired(policy)}


def _play_loop(config: AssessmentConfig, policy: SupervisorPolicy, traced: bool, progress: bool) -> Played:
    """One problem after the other, in closed loop."""
    # Planner and simulator are imported where they are needed: the kinematic evaluation starts without them.
    from marl_handover.envs.backends import NoisyBackend
    from marl_handover.runtime.evaluation import loop_report, play_problems, true_outcome
    from marl_handover.runtime.loop import make_loop
    from marl_handover.runtime.trace import trace_text

    started = time.perf_counter()
    options = backend_options(config)
    with make_loop(policy, config.backend, config.motion, config.loop, **options) as loop:
        rules, backend = loop.rules, loop.backend
        problems = _problems(config, rules)
        with _bar(problems, progress) as bar:
            played = play_problems(loop, problems, config.seed, bar.update)
    outcomes, steps = (np.array(values) for values in zip(*((int(true_outcome(e, rules)), len(e.first)) for e in played), strict=True))
    episodes = Episodes(outcomes, steps, np.stack([episode.first[-1].done.pose for episode in played]))
    optimal = ExactPlanner(rules).plan(*problems).transfers
    result = Evaluation(episodes, optimal, decision_time(loop.policy.under(rules).act, problems), time.perf_counter() - started)
    own = (
        {"noise": backend.noise.report(), "missed_grasps": backend.missed_grasps} if isinstance(backend, NoisyBackend) else _shown(options)
    )
    settings = {"chart_inset": rules.cell.config.chart_inset, "position_tolerance_mm": rules.config.position_tolerance_mm, **own}
    return result, lambda: trace_text(played, rules), rules, {**loop_report(played, rules), **settings, **_repaired(loop.policy)}


def _shown(options: dict[str, Any]) -> dict[str, Any]:
    """Options as a report has them."""
    return {name: asdict(value) if isinstance(value, HardwareConfig) else value for name, value in options.items()}


def _repaired(policy: SupervisorPolicy) -> dict[str, Any]:
    """Of a shielded policy: how many of its decisions the shield repaired."""
    return {"repaired_decisions": policy.repaired} if isinstance(policy, policies.ShieldedPolicy) else {}


def _problems(config: AssessmentConfig, rules: Rules) -> tuple[Floats, Floats]:
    return read_problems(rules, Path(config.problems)) if config.problems else random_problems(rules, config.episodes, config.seed)


def _bar(problems: tuple[Floats, Floats], progress: bool) -> Bar:
    return Bar(total=len(problems[0]), unit="episode", shown=progress, leave=False)


def backend_options(config: AssessmentConfig) -> dict[str, Any]:
    """What was asked of the backend. Raises :class:`InvalidSetting` for what another one would take."""
    if config.backend == "kinematic":
        for key, value in changed("loop", config.loop) + changed("motion", config.motion):
            raise InvalidSetting(key, value, "left out with backend=kinematic, which plans no motions; or backend=noisy or bullet")
    owners = {"grasp": "bullet", "missed_grasps": "noisy", "calibration": "twin", "hardware": "twin"}
    given = {name: getattr(config, name) for name in owners if getattr(config, name) is not None}
    for name, value in given.items():
        if owners[name] != config.backend:
            raise InvalidSetting(name, value, f"left out, or backend={owners[name]}")
    if config.backend in ("bullet", "twin") and config.task.noise is not None:
        raise InvalidSetting("task.noise", asdict(config.task.noise), f"left out with backend={config.backend}, where physics decides")
    if config.backend == "noisy" and config.task.noise is not None:
        if config.task.noise.observed:
            raise InvalidSetting("task.noise", asdict(config.task.noise), "without observed_mm and observed_deg, or backend=kinematic")
        given["noise"] = config.task.noise  # as typed, also if that is none at all
    return given
