"""Judging a policy on the batched rules: the numbers, file formats, traces and confidence intervals of ``evaluate``."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from marl_handover.arrays import Floats, one_where
from marl_handover.cell.batch import CellBatch, LayoutPool, random_layouts
from marl_handover.cell.cell import Cell
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.config import LayoutConfig, TaskConfig
from marl_handover.task.episode import Act, Decision, Episodes, Noise, Observer, conclude, play
from marl_handover.task.planner import ExactPlanner, optimal_transfers
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Command, Outcome, Rules, carried

EVALUATION_SEED = 1_000_000_000
"""Problems of reports come from seeds from here on; training and its validation use others, so these are never seen."""

TIMED_DECISIONS = 1000
TIMED_CELLS, TIMED_IN_EACH = 10, 20
"""Of a batch of cells, so many are timed in at most, and so many decisions in each."""

CHUNK = 1000


def random_problems(rules: Rules, count: int, seed: int) -> tuple[Floats, Floats]:
    """Starts and goals (count, 3) of evaluation seed ``seed``."""
    generator = torch.Generator().manual_seed(EVALUATION_SEED + seed)
    start, goal = sample_problems(rules.cell, count, generator)
    return start.numpy(), goal.numpy()


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a proportion, 95 % by default."""
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    # At the ends the bound is the share itself; rounding must not put it on the wrong side.
    return (0.0 if successes == 0 else centre - half), (1.0 if successes == trials else centre + half)


@dataclass
class Evaluation:
    """A policy's result on a set of problems.

    Attributes:
        episodes: how each ended.
        optimal: (n,) fewest transfers, 0 where no plan exists within the step limit.
        decisions_us: (k,) processor time of single decisions.
        wall_s: all in all.
    """

    episodes: Episodes
    optimal: NDArray[np.int64]
    decisions_us: Floats
    wall_s: float

    def report(self) -> dict[str, Any]:
        """The counts and statistics of ``evaluate json=FILE``."""
        outcome, steps = self.episodes.outcome, self.episodes.transfers
        solved = outcome == int(Outcome.SUCCESS)
        count, successes = len(outcome), int(solved.sum())
        low, high = wilson_interval(successes, count)
        known = solved & (self.optimal > 0)
        p50, p99 = np.percentile(self.decisions_us, [50, 99])
        return {
            "episodes": count,
            "success_rate": successes / count,
            "success_ci95": [low, high],
            "mean_steps": float(steps.mean()),
            "mean_steps_success": float(steps[solved].mean()) if successes else None,
            "optimal_mean_steps": float(self.optimal[self.optimal > 0].mean()) if (self.optimal > 0).any() else None,
            "steps_ratio": float((steps[known] / self.optimal[known]).mean()) if known.any() else None,
            "outcomes": {kind.name.lower(): int((outcome == int(kind)).sum()) for kind in Outcome if kind is not Outcome.NONE},
            "decision_us": {"p50": float(p50), "p99": float(p99)},
            "wall_s": self.wall_s,
        }


def evaluate(
    rules: Rules,
    act: Act,
    problems: tuple[Floats, Floats],
    seed: int = 0,
    observer: Observer | None = None,
    progress: Callable[[int], object] = lambda done: None,
    timed: Act | None = None,
    timings: int = TIMED_DECISIONS,
) -> Evaluation:
    """Play all problems (n, 3), (n, 3) with a batched numpy policy, in chunks, and time single decisions.

    Args:
        rules: the rule book to be judged by.
        act: the policy.
        problems: starts and goals.
        seed: of noise.
        observer: sees every decision, with episode numbers over all problems.
        progress: called with the number of problems a chunk finished.
        timed: what is timed instead of ``act``, for one that counts its decisions.
        timings: how many decisions are timed at most.
    """
    started = time.perf_counter()
    noise, seeing = placement_noise(rules, seed), mistaken(rules, seed)(act)
    parts = []
    for first in range(0, len(problems[0]), CHUNK):
        start, goal = problems[0][first : first + CHUNK], problems[1][first : first + CHUNK]
        shifted = None if observer is None else _shifted(observer, first)
        parts.append(play(rules, seeing, start, goal, noise=noise, observer=shifted))
        progress(len(start))
    optimal = ExactPlanner(rules).plan(*problems).transfers
    return Evaluation(_in_a_row(parts), optimal, decision_times_us(timed or act, problems, timings), time.perf_counter() - started)


class CellProblems(NamedTuple):
    """Problems in random cells of one number of arms that can be solved.

    Attributes:
        rules: a batch of cells, one a problem.
        numbers: (n,) which of all problems that were drawn these are.
        start: (n, 3) mm, mm, rad.
        goal: (n, 3).
        optimal: (n,) fewest transfers.
        unsolvable: how many problems of such cells were drawn that no plan solves.
    """

    rules: Rules
    numbers: NDArray[np.int64]
    start: Floats
    goal: Floats
    optimal: NDArray[np.int64]
    unsolvable: int

    def layouts(self) -> Iterator[tuple[Rules, NDArray[np.int64]]]:
        """The rules of each cell by itself, and the rows (k,) of its problems."""
        cells = self.rules.cell
        for layout in np.unique(cells.layout):
            yield Rules(cells.pool.cell(int(layout)), self.rules.config), np.nonzero(cells.layout == layout)[0]


def problems_in_cells(
    config: LayoutConfig, layouts: int, task: TaskConfig, count: int, seed: int, on_layout: Callable[[int], None] = lambda made: None
) -> dict[int, CellProblems]:
    """``count`` random problems of evaluation seed ``seed``, spread evenly over random cells, by the number of arms.

    Args:
        config: of the cells.
        layouts: how many cells; one without a problem is drawn in vain.
        task: what the problems are judged by.
        count: of problems, those that no plan solves included.
        seed: of cells and problems; trainings draw other ones.
        on_layout: told how many cells are drawn.
    """
    drawn = random_layouts(config, layouts, np.random.default_rng(EVALUATION_SEED + seed), on_layout)
    generator = torch.Generator().manual_seed(EVALUATION_SEED + seed)
    layout = np.arange(count) * layouts // count
    n_arms = np.array([len(arms) for arms, _ in drawn])
    found = {}
    for size in np.unique(n_arms[layout]).tolist():
        own = np.nonzero(n_arms == size)[0]
        numbers = np.nonzero(n_arms[layout] == size)[0]
        pool = LayoutPool([drawn[index] for index in own], room=size)
        rules = Rules(CellBatch(pool, np.searchsorted(own, layout[numbers])), task)
        start, goal = (poses.numpy() for poses in sample_problems(rules.cell, len(numbers), generator))
        optimal = optimal_transfers(rules, start, goal)
        kept = optimal > 0
        found[size] = CellProblems(rules.of_rows(kept), numbers[kept], start[kept], goal[kept], optimal[kept], int((~kept).sum()))
    return found


def evaluate_in_cells(
    posed: CellProblems, under: Callable[[Rules], Act], seed: int = 0, progress: Callable[[int], object] = lambda done: None
) -> Evaluation:
    """Play problems in cells of their own, all at once, and time single decisions in single cells.

    Args:
        posed: the problems, at least one.
        under: takes the rules of a batch of cells, or of one, and returns the policy that acts under them.
        seed: of noise.
        progress: called with the number of problems a chunk finished.
    """
    started = time.perf_counter()
    noise, seeing = placement_noise(posed.rules, seed), mistaken(posed.rules, seed)
    parts = []
    for first in range(0, len(posed.numbers), CHUNK):
        rows = slice(first, first + CHUNK)
        start, goal = posed.start[rows], posed.goal[rows]
        parts.append(play(posed.rules.of_rows(rows), lambda rules: seeing(under(rules)), start, goal, noise=noise))
        progress(len(start))
    cells = list(islice(posed.layouts(), TIMED_CELLS))
    times = [decision_times_us(under(rules), (posed.start[rows], posed.goal[rows]), TIMED_IN_EACH) for rules, rows in cells]
    return Evaluation(_in_a_row(parts), posed.optimal, np.concatenate(times), time.perf_counter() - started)


def _in_a_row(parts: Sequence[Episodes]) -> Episodes:
    return Episodes(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def joined(parts: Sequence[Evaluation], numbers: Sequence[NDArray[np.int64]]) -> Evaluation:
    """One result of several, whose episodes have the ``numbers`` (n,) among all."""
    order = np.argsort(np.concatenate(numbers))
    episodes = Episodes(*(np.concatenate(columns)[order] for columns in zip(*(part.episodes for part in parts), strict=True)))
    optimal = np.concatenate([part.optimal for part in parts])[order]
    return Evaluation(episodes, optimal, np.concatenate([part.decisions_us for part in parts]), sum(part.wall_s for part in parts))


def _shifted(observer: Observer, first: int) -> Observer:
    return lambda decision: observer(decision._replace(episode=decision.episode + first))


def placement_noise(rules: Rules, seed: int) -> Noise | None:
    """Gaussian placement noise as the task's settings say, or None on exact hardware."""
    if not rules.noisy:
        return None
    settings = rules.config.noise
    scale = np.array([settings.position_mm, settings.position_mm, math.radians(settings.yaw_deg)])
    generator = np.random.default_rng(seed)
    return lambda count: generator.normal(size=(count, 3)) * scale


def mistaken(rules: Rules, seed: int) -> Callable[[Act], Act]:
    """What makes a policy decide about an object that it sees displaced, as the task's settings say; or leaves it as it is."""
    settings = rules.config.noise
    if not settings.observed:
        return lambda act: act
    scale = np.array([settings.observed_mm, settings.observed_mm, math.radians(settings.observed_deg)])
    generator = np.random.default_rng([seed, 1])  # other draws than those of placements

    def misled(act: Act) -> Act:
        """``act`` of somebody who sees the object a little beside where it is."""

        def seeing(pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
            offset = generator.normal(size=pose.shape) * scale
            seen: Floats = act(carried(pose, pose[..., :2] + offset[..., :2], offset[..., 2]), goal, previous_arm)
            return seen

        return seeing

    return misled


def decision_times_us(act: Act, problems: tuple[Floats, Floats], most: int = TIMED_DECISIONS) -> Floats:
    """Processor time of single decisions, pose in, action out: (k,) in microseconds, ``most`` of them at most; waiting does not count."""
    elapsed = []
    none = np.int64(-1)
    for index in range(-min(20, most), min(most, max(len(problems[0]), 100))):
        row = index % len(problems[0])
        begun = time.process_time_ns()
        act(problems[0][row], problems[1][row], none)
        if index >= 0:  # the first ones warm up
            elapsed.append(time.process_time_ns() - begun)
    return np.array(elapsed) / 1e3


def judged_by(rules: Rules) -> dict[str, Any]:
    """What a line says of the rules that its transfer was judged by."""
    return {
        "epsilon_rad": rules.epsilon_rad,
        "symmetry_order": rules.config.symmetry_order,
        "architecture": rules.config.architecture,
    }


class Trace:
    """An observer of roll-outs. Architecture A's external last transfer becomes a line of its own, with ``"final": true``.

    Arms have their labels in the cell: of a mirrored pair L and R, else their names, and then lines say the receiver, too. A command to
    arms that share no place has none: null, and so are alpha and beta.

    Args:
        rules: what the episodes are judged by.
        numbers: (n,) which of all episodes these are; all, in order, if None.
    """

    def __init__(self, rules: Rules, numbers: NDArray[np.int64] | None = None) -> None:
        self.rules, self.numbers = rules, numbers
        self.episodes: dict[int, list[dict[str, Any]]] = {}
        self._labels = rules.cell.labels
        self._says_receiver = self._labels != ARM_LETTERS

    def __call__(self, decision: Decision) -> None:
        """Take in one decision of the running episodes."""
        points = chart_points(self.rules.cell, decision.result.command)
        for row, index in enumerate(decision.episode):
            episode = int(index if self.numbers is None else self.numbers[index])
            lines = self.episodes.setdefault(episode, [])
            for line in (self._commanded(decision, row, points[row]), self._external(decision, row)):
                if line is not None:
                    lines.append({"episode": episode, "step": len(lines), **line})

    def _commanded(self, decision: Decision, row: int, point: Floats) -> dict[str, Any] | None:
        """The policy's own transfer; None where it was ignored because the episode was solved at its start."""
        result = decision.result
        external = int(result.external_arm[row]) >= 0
        if int(result.transfers[row]) == external:
            return None
        final = bool(result.command.final[row])
        place = decision.goal[row, :2] if final else result.command.place_mm[row]
        if final and np.isnan(point).any():
            point = np.zeros(2)  # it goes to the goal, whatever was said besides
        terminated, made = bool(result.terminated[row]), decision.made[row] + result.transfers[row]
        truncated, ended = conclude(result.terminated[row], result.outcome[row], made, self.rules.config.max_steps)
        outcome = Outcome(int(ended))
        return {
            **self._problem(decision, row, decision.pose[row], int(decision.previous_arm[row])),
            **self._who(int(result.command.arm[row]), None if final else int(result.command.receiver[row])),
            "final": final,
            "place": _listed(place),
            "alpha": _listed(point[0]),
            "beta": _listed(point[1]),
            "next_state": result.placed[row].tolist(),
            "reward": float(result.reward[row]),
            "terminated": terminated and not external,
            "truncated": bool(truncated),
            "outcome": None if external or outcome is Outcome.NONE else outcome.name.lower(),
            **judged_by(self.rules),
        }

    def _external(self, decision: Decision, row: int) -> dict[str, Any] | None:
        """The external final transfer of architecture A; None where there was none. The reward stands with the command, if
        there was one.
        """
        result = decision.result
        arm = int(result.external_arm[row])
        if arm < 0:
            return None
        commanded = int(result.transfers[row]) > 1
        previous = int(result.command.arm[row]) if commanded and bool(result.feasible[row]) else int(decision.previous_arm[row])
        return {
            **self._problem(decision, row, result.placed[row], previous),
            **self._who(arm, None),
            "final": True,
            "place": decision.goal[row, :2].tolist(),
            "alpha": 0.0,
            "beta": 0.0,
            "next_state": result.pose[row].tolist(),
            "reward": 0.0 if commanded else float(result.reward[row]),
            "terminated": True,
            "truncated": False,
            "outcome": Outcome(int(result.outcome[row])).name.lower(),
            **judged_by(self.rules),
        }

    def _who(self, arm: int, receiver: int | None) -> dict[str, Any]:
        said: dict[str, Any] = {"arm": self._labels[arm]}
        if self._says_receiver:
            said["receiver"] = None if receiver is None else self._labels[receiver]
        return said

    def _problem(self, decision: Decision, row: int, pose: Any, previous: int) -> dict[str, Any]:
        return {
            "state": pose.tolist(),
            "goal": decision.goal[row].tolist(),
            "previous_arm": self._labels[previous] if previous >= 0 else None,
        }


def trace_text(traces: Iterable[Trace]) -> str:
    """All lines, episode by episode."""
    episodes = {number: lines for trace in traces for number, lines in trace.episodes.items()}
    return "".join(json.dumps(line) + "\n" for _, lines in sorted(episodes.items()) for line in lines)


def chart_points(cell: Cell, command: Command) -> Floats:
    """Alpha and beta (n, 2) of the places that commands (n,) name; NaN where arm and receiver share none."""
    place, points = command.place_mm, np.full(command.place_mm.shape, math.nan)
    with np.errstate(invalid="ignore"):
        for (i, j), space in cell.graph.edges.items():
            asked = ((command.arm == i) & (command.receiver == j)) | ((command.arm == j) & (command.receiver == i))
            points = one_where(asked, np.stack(space.from_table(place), -1), points)
    return np.clip(points, -1.0, 1.0)  # rounding may put the edge of a chart beyond it


def _listed(values: Any) -> Any:
    """Numbers as JSON has them: null for what is none."""
    return None if np.isnan(values).any() else values.tolist()
