"""An arm goes out of order in the middle of an episode: from the next decision on, rules and policy are those of the other arms.

The transfer under way is finished, and the object lies where it lies. What the other arms cannot solve any more ends there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell import Cell
from marl_handover.config import OutageConfig, require_choice
from marl_handover.errors import InvalidSetting
from marl_handover.learning.evaluation import (
    CHUNK,
    TIMED_DECISIONS,
    Evaluation,
    Trace,
    decision_times_us,
    mistaken,
    placement_noise,
    wilson_interval,
)
from marl_handover.policies import ResigningPolicy, SupervisorPolicy
from marl_handover.task.episode import Decision, Episodes, Observer, Underway, begin, go_on
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problem_file import PosedProblems
from marl_handover.task.rules import Outcome, Rules

RANDOM = "random"
"""Any arm."""


class Outage(NamedTuple):
    """Which arm fails, its index, and after how many transfers."""

    arm: int
    after: int


class Outages(NamedTuple):
    """Which arm fails in each episode, its index (n,), and after how many transfers (n,)."""

    arm: NDArray[np.int64]
    after: NDArray[np.int64]


class Struck(NamedTuple):
    """What became of the episodes in which an arm failed before the end: how many they are, how many could be solved then, and were."""

    episodes: int
    solvable: int
    solved: int

    def report(self, config: OutageConfig) -> dict[str, Any]:
        """As ``evaluate json=FILE`` has it under ``outage``."""
        return {
            "arm": config.arm,
            "after": config.after,
            "seed": config.seed,
            **self._asdict(),
            "unreachable": self.episodes - self.solvable,
            "solved_share": self.solved / self.solvable if self.solvable else None,
            "solved_ci95": list(wilson_interval(self.solved, self.solvable)),
        }


def draw_outages(config: OutageConfig, cell: Cell, optimal: NDArray[np.int64], numbers: NDArray[np.int64]) -> Outages:
    """The outages of the problems ``numbers`` (n,), which need ``optimal`` (n,) transfers.

    A random arm is any of the cell's. It fails after the first transfer at the earliest and, if no number is given, before the last one of
    a shortest plan; where that is the first one, after it: then only who needs more notices.

    Raises:
        UnknownChoice: no arm of the cell has the name.
    """
    chances = np.random.default_rng(config.seed).random((int(numbers.max()) + 1, 2))[numbers]
    if config.arm == RANDOM:
        arm = (chances[:, 0] * cell.num_arms).astype(np.int64)
    else:
        require_choice("outage.arm", config.arm, (*cell.names, RANDOM))
        arm = np.full(len(numbers), cell.names.index(config.arm))
    if config.after is not None:
        return Outages(arm, np.full(len(numbers), config.after))
    return Outages(arm, 1 + (chances[:, 1] * np.maximum(optimal - 1, 1)).astype(np.int64))


def policy_without(policy: SupervisorPolicy, arm: int) -> ResigningPolicy:
    """The policy in its own cell once ``arm`` is out of order.

    Raises:
        InvalidSetting: it acts in one cell only, or is paid for lengths of paths, or there is no other arm.
    """
    cell, rules = policy.rules.cell, policy.rules
    if cell.num_arms == 1:
        raise InvalidSetting("outage.arm", cell.names[0], "left out in a cell with one arm that is in order")
    if not policy.any_cell:
        raise InvalidSetting("policy", policy.name, "one that acts in any cell under an outage: pretrained_any, exact, greedy or random")
    if rules.config.reward.motion_weight:
        limit = "0 where an arm goes out of order: no lengths of paths are known without it"
        raise InvalidSetting("task.reward.motion_weight", rules.config.reward.motion_weight, limit)
    rest = cell.with_arms([name for name in cell.names if name != cell.names[arm]])
    other = Rules(rest, rules.config, physical=rules.measured)
    return ResigningPolicy(policy.under(other))


class OutageRun:
    """Episodes of a policy on the batched rules, in each of which an arm fails; all that fail alike are played together.

    Args:
        policy: the policy, while all arms are in order.
        posed: the problems.
        config: which arm fails, and when.
        seed: of noise.
        trace: where every decision goes; None: nowhere.

    Attributes:
        outages: of all problems.
        rest: the policy without each of the arms that fail, by its index.
        struck: what came of it, of the problems that have been played.

    Raises:
        UnknownChoice, InvalidSetting: as :func:`draw_outages` and :func:`policy_without`.
    """

    def __init__(
        self, policy: SupervisorPolicy, posed: PosedProblems, config: OutageConfig, seed: int = 0, trace: Trace | None = None
    ) -> None:
        self.policy, self.problems = policy, (posed.start, posed.goal)
        self.optimal = ExactPlanner(policy.rules).plan(*self.problems).transfers
        self.outages = outages = draw_outages(config, policy.rules.cell, self.optimal, posed.numbers)
        self.rest = {int(arm): policy_without(policy, int(arm)) for arm in np.unique(outages.arm)}
        self.struck = Struck(0, 0, 0)
        self._noise = placement_noise(policy.rules, seed)
        seeing = mistaken(policy.rules, seed)
        self._act, self._acts = seeing(policy.act), {arm: seeing(each.act) for arm, each in self.rest.items()}
        self._trace = trace
        self._traces = {} if trace is None else {arm: _continued(trace, each.rules) for arm, each in self.rest.items()}

    def evaluate(self, progress: Callable[[int], object] = lambda done: None, timings: int = TIMED_DECISIONS) -> Evaluation:
        """Play all problems; the optimum is that of the whole cell."""
        started, (start, goal) = time.perf_counter(), self.problems
        parts = []
        for first in range(0, len(start), CHUNK):
            rows = slice(first, first + CHUNK)
            parts.append(self._play(begin(start[rows], goal[rows]), Outages(*(each[rows] for each in self.outages)), first))
            progress(len(parts[-1].outcome))
        episodes = Episodes(*(np.concatenate([part[index] for part in parts]) for index in range(3)))
        timed = self.policy.under(self.policy.rules)  # a copy, which counts its repairs by itself
        return Evaluation(episodes, self.optimal, decision_times_us(timed.act, self.problems, timings), time.perf_counter() - started)

    def _play(self, episodes: Underway, outages: Outages, first: int) -> Underway:
        """Play a chunk, in which episode 0 is number ``first``."""
        rules, cell = self.policy.rules, self.policy.rules.cell
        shown = _shown(self._trace, first)
        episodes = go_on(rules, self._act, episodes, noise=self._noise, observer=shown, until=outages.after)
        struck = episodes.outcome == int(Outcome.NONE)
        solvable = np.zeros_like(struck)
        for arm, policy in self.rest.items():
            rows = struck & (outages.arm == arm)
            left = rules.config.max_steps - episodes.transfers[rows]
            needed = policy.planner.plan(episodes.pose[rows], episodes.goal[rows]).transfers
            solvable[rows] = (needed > 0) & (needed <= left)
            there = policy.rules.cell
            before = episodes._replace(previous_arm=there.numbered(episodes.previous_arm, cell))
            shown = _shown(self._traces.get(arm), first)
            after = go_on(policy.rules, self._acts[arm], before, noise=self._noise, observer=shown, rows=rows)
            episodes = after._replace(previous_arm=episodes.previous_arm)
        solved = solvable & (episodes.outcome == int(Outcome.SUCCESS))
        self.struck = Struck(*(int(had + each.sum()) for had, each in zip(self.struck, (struck, solvable, solved), strict=True)))
        return episodes


def total(struck: Iterable[Struck]) -> Struck:
    """Of all together."""
    return Struck(*(sum(column) for column in zip(*struck, strict=True)))


def _continued(trace: Trace, rules: Rules) -> Trace:
    """A trace whose lines go on with those of another, under other rules."""
    other = Trace(rules, trace.numbers)
    other.episodes = trace.episodes
    return other


def _shown(trace: Trace | None, first: int) -> Observer | None:
    """Shows a trace the decisions of a chunk that begins with episode ``first``."""
    if trace is None:
        return None
    seen = trace

    def observe(decision: Decision) -> None:
        seen(decision._replace(episode=decision.episode + first))

    return observe
