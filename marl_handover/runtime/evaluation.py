"""Many problems in closed loop, and the figures that only measured placements have."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import wrap
from marl_handover.runtime.episode import Episode, Transfer
from marl_handover.runtime.loop import ClosedLoop
from marl_handover.task.rules import Outcome, Rules

Floats = NDArray[np.float64]


def play_problems(
    loop: ClosedLoop, problems: tuple[Floats, Floats], seed: int, progress: Callable[[int], object] = lambda done: None
) -> list[Episode]:
    """Play all problems, starts and goals (n, 3), in order; ``seed`` and the episode's number decide all that is random in it."""
    episodes = []
    for number, (start, goal) in enumerate(zip(*problems, strict=True)):
        episode_seed = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        episodes.append(loop.play(start, goal, episode_seed))
        progress(1)
    return episodes


def loop_report(episodes: Sequence[Episode], rules: Rules) -> dict[str, Any]:
    """What the closed loop adds to ``evaluate json=FILE``; null where there is nothing to take it from.

    Poses are the true ones where the backend knows them. ``position_error_mm`` and ``orientation_error_deg`` are of the first final
    placements that were carried out; ``transfer_error_mm`` and ``transfer_error_deg`` of every single transfer, against what exact arms
    would have done. Their ``bias`` is the mean error: in mm along and across (to the left of) the ray from the arm's base to the place; in
    deg counter-clockwise.
    """
    every = [transfer for episode in episodes for transfer in episode.transfers]
    carried = [transfer for transfer in every if transfer.done.refusal is None]
    ends = [episode.first[-1] for episode in episodes if episode.first[-1].order.final and episode.first[-1].done.refusal is None]
    away = [math.dist(transfer.done.true[:2], transfer.goal[:2]) for transfer in ends]
    turned = [abs(math.degrees(rules.orientation_error(transfer.done.true[2], transfer.goal[2]))) for transfer in ends]
    offsets, turns = _errors(carried, rules)
    return {
        "success_in_the_end": sum(truly_solved(episode, rules) for episode in episodes) / len(episodes),
        "ended": dict(sorted(Counter(episode.ended for episode in episodes).items())),
        "position_error_mm": _quantiles(away, 50, 99),
        "orientation_error_deg": _quantiles(turned, 50, 99),
        "refusals": dict(sorted(Counter(str(transfer.done.refusal) for transfer in every if transfer.done.refusal).items())),
        "transfers": len(every),
        "transfer_error_mm": {**_quantiles(np.hypot(*offsets.T), 50, 95), "bias": offsets.mean(0).tolist() if carried else None},
        "transfer_error_deg": {**_quantiles(abs(turns), 50, 95), "bias": float(turns.mean()) if carried else None},
        "planning_ms": _quantiles([transfer.done.planning_ms for transfer in carried], 50, 99),
        "cycle_s": _quantiles([transfer.done.duration_s for transfer in carried], 50, 99),
        "episode_s": _quantiles([episode.wall_s for episode in episodes], 50, 99),
    }


def true_outcome(episode: Episode, rules: Rules) -> Outcome:
    """The first verdict, by where the object truly was then; where nobody knows better than the loop, the loop's own."""
    last = episode.first[-1]
    if last.done.truth is None or last.truncated or not last.done.tried:
        return episode.outcome
    if rules.external_finish:
        return Outcome(int(rules.external_verdict(last.done.truth, last.goal, np.int64(last.order.arm)).outcome))
    return Outcome(int(rules.judge(last.done.truth, last.goal, np.bool_(last.order.final), np.bool_(True)).outcome))


def truly_solved(episode: Episode, rules: Rules) -> bool:
    """Whether the loop ended with the object at the goal, and it truly was there."""
    last = episode.transfers[-1]
    if last.done.truth is None or not episode.solved:
        return episode.solved
    verdict = rules.external_verdict(last.done.truth, last.goal, np.int64(last.order.arm))
    return int(verdict.outcome) == Outcome.SUCCESS


def _errors(transfers: Sequence[Transfer], rules: Rules) -> tuple[Floats, Floats]:
    """Of each transfer: the offset (n, 2) in mm along and across the arm's ray, and the turn (n,) in deg, from what was predicted."""
    if not transfers:
        return np.zeros((0, 2)), np.zeros(0)
    arms = np.array([transfer.order.arm for transfer in transfers])
    reached = np.stack([transfer.done.true for transfer in transfers])
    predicted = np.stack([transfer.order.predicted for transfer in transfers])
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
