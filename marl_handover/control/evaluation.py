"""Playing problems with a policy and judging it: what ``evaluate`` prints and what ``compare`` collects."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover import policies
from marl_handover.arrays import Floats, one_where, wrap
from marl_handover.cell import Cell
from marl_handover.config import (
    BACKENDS,
    ENGINES,
    PHYSICS,
    CellConfig,
    LayoutConfig,
    LoopConfig,
    MotionConfig,
    OutageConfig,
    TaskChanges,
    bounded,
    changed,
    check_bounds,
    chosen,
    path_field,
    seed_field,
)
from marl_handover.control.outage import Outage, OutageRun, Outages, Struck, draw_outages, policy_without, total
from marl_handover.envs.centralised import CentralisedRules, MotionCommand
from marl_handover.envs.cycle_check import Refusal
from marl_handover.errors import InvalidSetting, WorkFailed
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.learning.evaluation import (
    TIMED_DECISIONS,
    CellProblems,
    Evaluation,
    Trace,
    decision_times_us,
    evaluate,
    evaluate_in_cells,
    joined,
    problems_in_cells,
    random_problems,
    trace_text,
)
from marl_handover.motion.path_length_table import known_table
from marl_handover.policies import ResigningPolicy, ShieldedPolicy, SupervisorPolicy
from marl_handover.progress import Bar
from marl_handover.task.episode import Decision, Episodes, Observer
from marl_handover.task.ladder import rung
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problem_file import PosedProblems, read_problems
from marl_handover.task.problems import regret
from marl_handover.task.rules import Outcome, Rules

if TYPE_CHECKING:
    from marl_handover.control.closed_loop import ClosedLoop
    from marl_handover.control.recording import Recorder
    from marl_handover.control.transfers import Episode, Transfer


CONTACT = frozenset({Refusal.MISSED_GRASP, Refusal.DROPPED, Refusal.TIPPED, Refusal.COLLISION})
"""What went wrong where bodies touch."""


@dataclass
class UnseenConfig(LayoutConfig):
    """Random cells to judge a policy in, as those that it may be trained in, and how many of them."""

    count: int = bounded(1000, 1, 10**5)  # cells; the episodes are spread evenly over them


@dataclass
class AssessmentConfig:
    """Who is judged, where, on which problems. What is not given is the policy's own, or the default."""

    policy: str = path_field("exact")  # exact, random, greedy, pretrained_a or _b or _twin, a run directory or a policy file
    backend: str = chosen("kinematic", BACKENDS.without("hardware"))  # kinematic; in closed loop with planned motions: the others
    episodes: int = bounded(1000, 1, 10**6)  # random problems
    seed: int = seed_field()  # of the problems, and of execution noise but for the twin, whose servos go on as they are
    cell: CellConfig | None = None  # single keys change the paper cell
    layouts: UnseenConfig | None = None  # random cells instead of the one cell; what no plan solves there is left out and counted
    task: TaskChanges = field(default_factory=TaskChanges)  # task.noise left out: of noisy, 1 mm and 0.5 deg
    grasp: str | None = chosen(None, ("friction", "constraint"))  # of bullet and mujoco; null: friction where that holds
    engine: str | None = chosen(None, ENGINES)  # of twin: its physics, bullet or mujoco; null: bullet where it is installed
    missed_grasps: float | None = bounded(None, 0.0, 1.0)  # of noisy: probability that the fingers close on nothing; null: 0.01
    loop: LoopConfig = field(default_factory=LoopConfig)  # of all but kinematic
    motion: MotionConfig = field(default_factory=MotionConfig)  # of all but kinematic
    calibration: str | None = path_field(None)  # of twin: folder of its calibration; null: runs/calibration/twin
    hardware: HardwareConfig | None = None  # of twin: single keys change its electronics; ports are always the emulated ones
    problems: str = path_field()  # JSON Lines of problems instead of random ones
    ladder: str = ""  # a rung of the ladder: its cell, its task and the first `episodes` of its problems; pair, triangle, scattered8 ...
    outage: OutageConfig | None = None  # an arm that goes out of order in mid-episode; null: none does

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on what can be refused without playing."""
        check_bounds(self)
        if self.ladder:
            _check_ladder(self)
        backend_options(self)
        if self.layouts is not None:
            self.layouts.validate()
            for key, value, usual in (("cell", self.cell, None), ("problems", self.problems, ""), ("backend", self.backend, "kinematic")):
                if value != usual:
                    raise InvalidSetting(key, value, f"{usual or 'left out'} with layouts, which are random cells under the rules alone")


class Assessment(NamedTuple):
    """What came of it.

    ``report``: the content of ``evaluate json=FILE``; ``result``: each episode beside its optimum; ``trace_text``: makes the text of
    ``trace=FILE``; ``rules``: what the episodes were judged by.
    """

    report: dict[str, Any]
    result: Evaluation
    trace_text: Callable[[], str]
    rules: Rules


def assess(config: AssessmentConfig, traced: bool = False, progress: bool = False, recorder: Recorder | None = None) -> Assessment:
    """Load the policy, play every problem, judge.

    Args:
        config: see there.
        traced: keep what ``trace_text`` needs.
        progress: show a bar.
        recorder: of the twin's episodes.

    Raises:
        InvalidSetting, UnknownChoice, MissingFile, CorruptFile, CheckpointMismatch: on bad input.
    """
    config.validate()
    config = _on_rung(config)
    policy = policies.adapted(config.policy, config.cell, config.seed, motion=config.motion, **vars(config.task))
    in_loop = partial(_play_loop, recorder=recorder)
    play = in_loop if config.backend != "kinematic" else _play_kinematic if config.layouts is None else _play_layouts
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
        **_regret(config, result, rules),
    }
    return Assessment(report, result, trace_text, rules)


def _check_ladder(config: AssessmentConfig) -> None:
    """Refuse what a rung says itself, and a backend that cannot have its noise."""
    of = rung(config.ladder)
    said = {f"task.{key}": value for key, value in vars(config.task).items() if key != "architecture"}
    said |= {
        "cell": config.cell and config.cell.name,
        "layouts": config.layouts,
        "problems": config.problems or None,
        "outage": config.outage,
    }
    for key, value in said.items():
        if value is not None:
            raise InvalidSetting(key, value, f"left out with ladder={of.name}, which says it")
    if of.is_noisy and config.backend not in ("kinematic", "noisy"):
        raise InvalidSetting("backend", config.backend, f"kinematic or noisy for ladder={of.name}, whose arms have a noise of their own")


def _on_rung(config: AssessmentConfig) -> AssessmentConfig:
    """The settings with the cell and the task of the rung that is asked for, if one is."""
    if not config.ladder:
        return config
    of = rung(config.ladder)
    said = {key: value for key, value in vars(of.task()).items() if key in vars(config.task)} | {"architecture": config.task.architecture}
    if config.backend != "kinematic" and not of.is_noisy:
        said["noise"] = None  # the backend's own
    return replace(config, cell=of.cell_config, task=TaskChanges(**said))


def _regret(config: AssessmentConfig, result: Evaluation, rules: Rules) -> dict[str, Any]:
    """On a rung: which one, the mean regret of a problem, and its 95 % interval over the problems."""
    if not config.ladder:
        return {}
    of, ended = rung(config.ladder), result.episodes
    optimum = of.fixed.optimum[: len(ended.outcome)]
    each = np.asarray(regret(ended.outcome, ended.transfers, optimum, rules.config.max_steps), float)
    mean, half = float(each.mean()), 1.959964 * float(each.std()) / math.sqrt(len(each))
    about = {"rung": of.name, "id": of.id, "sha256": of.sha256, "max_steps": rules.config.max_steps}
    return {"ladder": about, "regret": mean, "regret_ci95": [mean - half, mean + half]}


Played = tuple[Evaluation, Callable[[], str], Rules, dict[str, Any]]
"""What came of the problems: the common figures, the text of the trace, the rules they were judged by, and the backend's own figures."""


def _play_kinematic(config: AssessmentConfig, policy: SupervisorPolicy, traced: bool, progress: bool) -> Played:
    """All problems at once, on the batched rules."""
    rules = policy.rules
    posed = _posed(config, rules, "" if policy.any_cell else f"policy={policy.name}")
    supervisors = [policy.under(_rules_in(each.cell, rules)) if each.own else policy for each in posed]
    traces = [Trace(supervisor.rules, each.numbers) for supervisor, each in zip(supervisors, posed, strict=True)]
    paths, timings = PathLengths(rules), math.ceil(TIMED_DECISIONS / len(posed))
    runs: list[OutageRun] = []
    if config.outage is not None:
        rows = zip(supervisors, posed, traces, strict=True)
        runs = [OutageRun(each, of, config.outage, _seed_of(config.seed, of), trace if traced else None) for each, of, trace in rows]
    with _bar(posed, progress) as bar:
        parts = [run.evaluate(bar.update, timings) for run in runs]
        for each, supervisor, trace in zip(posed, supervisors, traces, strict=True) if not runs else ():
            observers: list[Observer] = [*([] if each.own else [paths]), *([trace] if traced else [])]
            # What is timed is a copy, which counts its repairs by itself.
            timed = supervisor if each.own and not isinstance(supervisor, ShieldedPolicy) else supervisor.under(supervisor.rules)
            seed = _seed_of(config.seed, each)
            problems = each.start, each.goal
            parts.append(evaluate(supervisor.rules, supervisor.act, problems, seed, _all_of(observers), bar.update, timed.act, timings))
    result = joined(parts, [each.numbers for each in posed])
    shown: dict[str, Any] = {}
    if config.outage is not None:
        shown["outage"] = total(run.struck for run in runs).report(config.outage)
        supervisors += [rest.inner for run in runs for rest in run.rest.values()]
    return result, lambda: trace_text(traces), rules, {**_noise(rules), **shown, **paths.report(), **_repaired(supervisors)}


def _play_layouts(config: AssessmentConfig, policy: SupervisorPolicy, traced: bool, progress: bool) -> Played:
    """Problems in random cells, all cells of one number of arms at once, or one after the other if the policy acts in one cell only."""
    wanted, rules = config.layouts, policy.rules
    assert wanted is not None
    if not policy.any_cell:
        raise InvalidSetting(
            "layouts", f"of {wanted.arms} arms", f"left out for policy={policy.name}, which acts in the one cell it is for"
        )
    if traced:
        raise InvalidSetting("trace", "a file", "left out with layouts, whose cells no line could name")
    _require_unpriced(rules, "random cells")
    with Bar(total=wanted.count, unit="cell", shown=progress, leave=False) as bar:
        found = problems_in_cells(wanted, wanted.count, rules.config, config.episodes, config.seed, lambda made: bar.update(1))
    parts, unsolvable = {}, {arms: posed.unsolvable for arms, posed in found.items()}
    solvable = {arms: posed for arms, posed in found.items() if len(posed.numbers)}
    if not solvable:
        raise WorkFailed(f"layouts: no plan solves any of {config.episodes} random problems; other layouts, or more episodes")
    struck: list[Struck] = []
    with Bar(total=sum(len(posed.numbers) for posed in solvable.values()), unit="episode", shown=progress, leave=False) as bar:
        for arms, posed in solvable.items():
            if policy.batch_of_cells and config.outage is None:
                parts[arms] = evaluate_in_cells(posed, lambda rules: policy.under(rules).act, config.seed, bar.update)
            else:
                parts[arms] = _one_by_one(config, policy, posed, bar, struck)
    by_arms = {str(arms): {**part.report(), "unsolvable": unsolvable[arms]} for arms, part in parts.items()}
    result = joined(list(parts.values()), [posed.numbers for posed in solvable.values()])
    shown = _noise(rules) if config.outage is None else {**_noise(rules), "outage": total(struck).report(config.outage)}
    return result, str, rules, {**shown, "layouts": wanted.count, "unsolvable": sum(unsolvable.values()), "by_arms": by_arms}


def _one_by_one(config: AssessmentConfig, policy: SupervisorPolicy, posed: CellProblems, bar: Bar, struck: list[Struck]) -> Evaluation:
    """As :func:`evaluate_in_cells`, cell after cell; under an outage, what became of each cell's episodes is added to ``struck``."""
    parts, numbers, timings = [], [], math.ceil(TIMED_DECISIONS / len(np.unique(posed.rules.cell.layout)))
    for rules, rows in posed.layouts():
        here = PosedProblems(rules.cell, True, posed.numbers[rows], posed.start[rows], posed.goal[rows])
        supervisor, seed = policy.under(rules), _seed_of(config.seed, here)
        if config.outage is not None:
            run = OutageRun(supervisor, here, config.outage, seed)
            parts.append(run.evaluate(bar.update, timings))
            struck.append(run.struck)
        else:
            problems = here.start, here.goal
            parts.append(evaluate(rules, supervisor.act, problems, seed, progress=bar.update, timings=timings))
        numbers.append(rows)
    return joined(parts, numbers)


def _noise(rules: Rules) -> dict[str, Any]:
    """What a report says of the noise that there is."""
    return {"noise": rules.config.noise.report()} if rules.noisy or rules.config.noise.observed else {}


def _rules_in(cell: Cell, rules: Rules) -> Rules:
    """The rule book of a cell that a problem brings."""
    _require_unpriced(rules, "problems with arms or obstacles of their own")
    return Rules(cell, rules.config)


def _require_unpriced(rules: Rules, what: str) -> None:
    weight = rules.config.reward.motion_weight
    if weight:
        raise InvalidSetting("task.reward.motion_weight", weight, f"0 for {what}: no lengths of paths are known there")


def _seed_of(seed: int, posed: PosedProblems) -> int:
    """Of noise: cells that problems bring draw others than the command's."""
    return int(np.random.SeedSequence([seed, int(posed.numbers[0])]).generate_state(1)[0]) if posed.own else seed


def _all_of(observers: Sequence[Observer]) -> Observer | None:
    def each(decision: Decision) -> None:
        for observer in observers:
            observer(decision)

    return each if observers else None


def _play_loop(config: AssessmentConfig, policy: SupervisorPolicy, traced: bool, progress: bool, recorder: Recorder | None) -> Played:
    """One problem after the other, in closed loop."""
    # Planner and simulator are imported where they are needed: the kinematic evaluation starts without them.
    from marl_handover.control.closed_loop import make_loop
    from marl_handover.control.transfers import trace_text as loop_trace_text
    from marl_handover.envs.backends import NoisyBackend

    started = time.perf_counter()
    options = backend_options(config)
    with make_loop(policy, config.backend, config.motion, config.loop, **options) as loop:
        if recorder is not None:
            recorder.attach(loop)
        rules, decides, backend = loop.rules, loop.policy.rules, loop.backend
        for note in getattr(backend, "notes", ()):
            print(note, file=sys.stderr)
        posed = _posed(config, decides, f"backend={config.backend}")
        problems = posed[0].start, posed[0].goal
        optimal = ExactPlanner(decides).plan(*problems).transfers
        outages = None if config.outage is None else draw_outages(config.outage, decides.cell, optimal, posed[0].numbers)
        without = {} if outages is None else {int(arm): policy_without(loop.policy, int(arm)) for arm in np.unique(outages.arm)}
        with _bar(posed, progress) as bar:
            played = play_problems(loop, problems, config.seed, bar.update, outages)
    outcomes, steps = (np.array(values) for values in zip(*((int(true_outcome(e, rules)), len(e.first)) for e in played), strict=True))
    episodes = Episodes(outcomes, steps, np.stack([episode.first[-1].result.pose for episode in played]))
    result = Evaluation(episodes, optimal, decision_times_us(loop.policy.under(decides).act, problems), time.perf_counter() - started)
    own = (
        {"noise": backend.noise.report(), "missed_grasps": backend.missed_grasps} if isinstance(backend, NoisyBackend) else _shown(options)
    )
    settings = {"chart_inset": rules.cell.config.chart_inset, "position_tolerance_mm": rules.config.position_tolerance_mm, **own}
    if config.outage is not None and outages is not None:
        settings["outage"] = _struck(played, outages, without, rules).report(config.outage)
    return result, lambda: loop_trace_text(played, rules), rules, {**loop_report(played, rules), **settings, **_repaired([loop.policy])}


def _shown(options: dict[str, Any]) -> dict[str, Any]:
    """Options as a report has them."""
    return {name: asdict(value) if isinstance(value, HardwareConfig) else value for name, value in options.items()}


def _repaired(supervisors: Sequence[SupervisorPolicy]) -> dict[str, Any]:
    """Of a shielded policy: how many of its decisions the shield repaired."""
    shields = [each for each in supervisors if isinstance(each, ShieldedPolicy)]
    return {"repaired_decisions": sum(shield.repaired for shield in shields)} if shields else {}


def _posed(config: AssessmentConfig, rules: Rules, fixed_for: str) -> list[PosedProblems]:
    """Problems of a file, or random ones of the cell of ``rules``; ``fixed_for`` is what takes no other cell."""
    if config.problems:
        return read_problems(rules.cell, Path(config.problems), fixed_for)
    if config.ladder:
        start, goal, optimum = rung(config.ladder).fixed.take(slice(config.episodes))
        return [PosedProblems(rules.cell, False, np.arange(len(optimum)), start, goal)]
    return [PosedProblems(rules.cell, False, np.arange(config.episodes), *random_problems(rules, config.episodes, config.seed))]


def _bar(posed: Sequence[PosedProblems], progress: bool) -> Bar:
    return Bar(total=sum(len(each.numbers) for each in posed), unit="episode", shown=progress, leave=False)


def backend_options(config: AssessmentConfig) -> dict[str, Any]:
    """What was asked of the backend. Raises :class:`InvalidSetting` for what another one would take."""
    if config.backend == "kinematic":
        for key, value in changed("loop", config.loop) + changed("motion", config.motion):
            raise InvalidSetting(key, value, "left out with backend=kinematic, which plans no motions; or backend=noisy, bullet or mujoco")
    owners = {"grasp": PHYSICS, "missed_grasps": ("noisy",), "calibration": ("twin",), "hardware": ("twin",), "engine": ("twin",)}
    given = {name: getattr(config, name) for name in owners if getattr(config, name) is not None}
    for name, value in given.items():
        if config.backend not in owners[name]:
            raise InvalidSetting(name, value, f"left out, or backend={' or '.join(owners[name])}")
    if config.backend in (*PHYSICS, "twin") and config.task.noise is not None:
        raise InvalidSetting("task.noise", asdict(config.task.noise), f"left out with backend={config.backend}, where physics decides")
    if config.backend == "noisy" and config.task.noise is not None:
        if config.task.noise.observed:
            raise InvalidSetting("task.noise", asdict(config.task.noise), "without observed_mm and observed_deg, or backend=kinematic")
        given["noise"] = config.task.noise  # as typed, also if that is none at all
    return given


def play_problems(
    loop: ClosedLoop,
    problems: tuple[Floats, Floats],
    seed: int,
    progress: Callable[[int], object] = lambda result: None,
    outages: Outages | None = None,
) -> list[Episode]:
    """Play all problems, starts and goals (n, 3), in order; ``seed`` and the episode's number decide all that is random in it."""
    episodes = []
    for number, (start, goal) in enumerate(zip(*problems, strict=True)):
        episode_seed = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        outage = None if outages is None else Outage(int(outages.arm[number]), int(outages.after[number]))
        episodes.append(loop.play(start, goal, episode_seed, outage=outage))
        progress(1)
    return episodes


def _struck(episodes: Sequence[Episode], outages: Outages, without: Mapping[int, ResigningPolicy], rules: Rules) -> Struck:
    """What became of the loop's episodes in which an arm failed; what could be solved then is told by where the object was measured."""
    struck = solvable = solved = 0
    for episode, arm in zip(episodes, outages.arm, strict=True):
        if episode.lost_at is None:
            continue
        struck, left, begun = struck + 1, without[int(arm)], episode.transfers[episode.lost_at]
        if not left.unsolvable_because(left.rules.cell.clamp_to_workspace(begun.before, LoopConfig.reach_slack_mm), begun.goal):
            solvable, solved = solvable + 1, solved + truly_solved(episode, rules)
    return Struck(struck, solvable, solved)


def loop_report(episodes: Sequence[Episode], rules: Rules) -> dict[str, Any]:
    """What the closed loop adds to ``evaluate json=FILE``; null where there is nothing to take it from.

    Poses are the true ones where the backend knows them. ``position_error_mm`` and ``orientation_error_deg`` are of the first final
    placements that were carried out; ``transfer_error_mm`` and ``transfer_error_deg`` of every single transfer, against what exact arms
    would have done. Their ``bias`` is the mean error: in mm along and across (to the left of) the ray from the arm's base to the place; in
    deg counter-clockwise. ``contact_events``: how many of 100 transfers failed where bodies touch (:data:`CONTACT`). ``mean_time_s``: of an
    episode, on the cell's clock, its motions alone.
    """
    every = [transfer for episode in episodes for transfer in episode.transfers]
    carried = [transfer for transfer in every if transfer.result.refusal is None]
    ends = [episode.first[-1] for episode in episodes if episode.first[-1].command.final and episode.first[-1].result.refusal is None]
    away = [math.dist(transfer.result.true[:2], transfer.goal[:2]) for transfer in ends]
    turned = [abs(math.degrees(rules.orientation_error(transfer.result.true[2], transfer.goal[2]))) for transfer in ends]
    offsets, turns = _errors(carried, rules)
    return {
        "success_in_the_end": sum(truly_solved(episode, rules) for episode in episodes) / len(episodes),
        "ended": dict(sorted(Counter(episode.ended for episode in episodes).items())),
        "position_error_mm": _quantiles(away, 50, 99),
        "orientation_error_deg": _quantiles(turned, 50, 99),
        "refusals": dict(sorted(Counter(str(transfer.result.refusal) for transfer in every if transfer.result.refusal).items())),
        "transfers": len(every),
        "contact_events": 100 * sum(transfer.result.refusal in CONTACT for transfer in every) / len(every),
        "transfer_error_mm": {**_quantiles(np.hypot(*offsets.T), 50, 95), "bias": offsets.mean(0).tolist() if carried else None},
        "transfer_error_deg": {**_quantiles(abs(turns), 50, 95), "bias": float(turns.mean()) if carried else None},
        "mean_time_s": float(np.mean([sum(transfer.result.duration_s for transfer in episode.transfers) for episode in episodes])),
        "planning_ms": _quantiles([transfer.result.planning_ms for transfer in carried], 50, 99),
        "cycle_s": _quantiles([transfer.result.duration_s for transfer in carried], 50, 99),
        "episode_s": _quantiles([episode.wall_s for episode in episodes], 50, 99),
    }


def true_outcome(episode: Episode, rules: Rules) -> Outcome:
    """The first verdict, by where the object truly was then; where nobody knows better than the loop, the loop's own."""
    last = episode.first[-1]
    if last.result.truth is None or last.truncated or not last.result.tried:
        return episode.outcome
    if rules.external_finish:
        return Outcome(int(rules.external_verdict(last.result.truth, last.goal, np.int64(last.command.arm)).outcome))
    return Outcome(int(rules.judge(last.result.truth, last.goal, np.bool_(last.command.final), np.bool_(True)).outcome))


def truly_solved(episode: Episode, rules: Rules) -> bool:
    """Whether the loop ended with the object at the goal, and it truly was there."""
    last = episode.transfers[-1]
    if last.result.truth is None or not episode.solved:
        return episode.solved
    verdict = rules.external_verdict(last.result.truth, last.goal, np.int64(last.command.arm))
    return int(verdict.outcome) == Outcome.SUCCESS


def _errors(transfers: Sequence[Transfer], rules: Rules) -> tuple[Floats, Floats]:
    """Of each transfer: the offset (n, 2) in mm along and across the arm's ray, and the turn (n,) in deg, from what was predicted."""
    if not transfers:
        return np.zeros((0, 2)), np.zeros(0)
    arms = np.array([transfer.command.arm for transfer in transfers])
    reached = np.stack([transfer.result.true for transfer in transfers])
    predicted = np.stack([transfer.command.predicted for transfer in transfers])
    bases = np.array([base.position_mm for base in rules.cell.bases])[arms]
    ray = predicted[:, :2] - bases
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    left = np.stack([-ray[:, 1], ray[:, 0]], -1)
    offset = reached[:, :2] - predicted[:, :2]
    along, across = (offset * ray).sum(-1), (offset * left).sum(-1)
    return np.stack([along, across], -1), np.degrees(wrap(reached[:, 2] - predicted[:, 2]))


def _quantiles(values: ArrayLike, *percents: int) -> dict[str, float | None]:
    """``{"p50": ...}``; null of nothing."""
    array = np.asarray(values, float)
    if not array.size:
        return {f"p{percent}": None for percent in percents}
    return {f"p{percent}": float(np.percentile(array, percent)) for percent in percents}


CHUNK = 2000


class PathLengths:
    """An observer of roll-outs that remembers every commanded transfer that was carried out.

    The executors' lengths come from :mod:`marl_handover.motion.path_length_table`, 0.1 mm off in the median, for cells that have a
    table; nothing is computed for others. Architecture A's external transfers are not counted.
    """

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self.table = known_table(rules.cell, MotionConfig())
        self._ways: list[tuple[NDArray[Any], ...]] = []

    def __call__(self, decision: Decision) -> None:
        """Take in one decision of the running episodes."""
        result, command = decision.result.feasible, decision.result.command
        to = one_where(command.final, decision.goal[..., :2], command.place_mm)
        motion = command.motion if isinstance(command, MotionCommand) else np.zeros((len(to), 0))
        self._ways.append(tuple(part[result] for part in (command.arm, decision.pose[..., :2], to, motion)))

    def report(self) -> dict[str, float]:
        """``path_mm``: mean length of a transfer; ``executor_path_mm``: what executors would travel on the same ways."""
        if self.table is None or not self._ways:
            return {}
        arm, start, end, motion = (np.concatenate(parts) for parts in zip(*self._ways, strict=True))
        if not len(arm):
            return {}
        executors = self.table(self.rules.cell, arm, start, end)
        if not isinstance(self.rules, CentralisedRules):
            return {"path_mm": float(executors.mean()), "executor_path_mm": float(executors.mean())}
        chunks = (slice(first, first + CHUNK) for first in range(0, len(arm), CHUNK))
        own = np.concatenate([self.rules.path_mm(arm[rows], start[rows], end[rows], motion[rows]) for rows in chunks])
        return {"path_mm": float(own.mean()), "executor_path_mm": float(executors.mean())}
