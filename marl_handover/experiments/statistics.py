"""Statistics over seeds, with rliable: interquartile means and their bootstrap intervals, profiles, improvement, what a level cost.

Scores are arrays (runs, tasks) or (runs, tasks, points); runs are the seeds of a row, tasks what they were judged on. Intervals are the
2.5th and 97.5th percentile of :data:`REPETITIONS` stratified bootstrap samples over the runs (Agarwal et al., "Deep reinforcement
learning at the edge of the statistical precipice", 2021), the same ones at every call. One run has no interval, and that of a few runs is
too narrow: :data:`TRUE_COVERAGE` says by how much. Probabilities of improvement have an interval of another kind, see :func:`improvement`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

from marl_handover.arrays import Floats
from marl_handover.errors import MissingExtra
from marl_handover.learning.evaluation import wilson_interval

REPETITIONS = 2000
COVERAGE = 0.95
BOOTSTRAP_SEED = 0
TRUE_COVERAGE = {2: 0.50, 3: 0.74, 4: 0.88, 5: 0.90, 6: 0.91, 7: 0.91, 8: 0.93, 9: 0.93, 10: 0.94}
"""How often such an interval of the interquartile mean of so many runs holds the truth, of normal scores; of more runs: 0.94 to 0.95.
Simulated; a test does it again."""

NORMAL_QUANTILE = 1.959964
"""Half the width of the middle 95 % of the normal distribution, in standard deviations."""

LEVELS = (0.90, 0.95, 0.99)
"""Success rates whose cost in transfers is told."""


class Interval(NamedTuple):
    """An estimate and its 95 % interval, whose ends are None where one run is all there is."""

    value: float
    low: float | None
    high: float | None


class Band(NamedTuple):
    """An estimate at each of n points, with the ends of its interval: three arrays (n,). One run's ends are its values."""

    value: Floats
    low: Floats
    high: Floats


class Milestone(NamedTuple):
    """What a level cost: the median over all runs, those that never got there counted as infinite, which is None here.

    ``reached`` of ``runs`` got there.
    """

    median: float | None
    low: float | None
    high: float | None
    reached: int
    runs: int


def require_statistics() -> Any:
    """The package rliable. Raises :class:`MissingExtra` with the line that installs it."""
    try:
        from rliable import library
    except ImportError as error:
        raise MissingExtra("compare", "rliable", "compare") from error
    return library


def interquartile_mean(scores: Floats) -> Floats:
    """Mean of the middle half of all scores, over runs and tasks, at each point: (runs, tasks, n) -> (n,)."""
    # What scipy's trim_mean does, which rliable calls, without its overhead: a bootstrap calls this thousands of times.
    ordered = np.sort(scores.reshape(-1, scores.shape[-1]), 0)
    cut = len(ordered) // 4
    return np.asarray(ordered[cut : len(ordered) - cut].mean(0))


def mean(scores: Floats) -> Floats:
    """Plain mean over runs and tasks: (runs, tasks, n) -> (n,)."""
    return np.asarray(scores.mean((0, 1)))


def summarised(scores: Floats, estimator: Callable[[Floats], Floats] = interquartile_mean) -> list[Interval]:
    """An estimate of each of n measures of scores (runs, tasks, n)."""
    band = band_of(scores, estimator)
    known = len(scores) > 1
    return [Interval(value, low if known else None, high if known else None) for value, low, high in np.stack(band).T.tolist()]


def band_of(scores: Floats, estimator: Callable[[Floats], Floats] = interquartile_mean) -> Band:
    """An estimate at each of n points of scores (runs, tasks, n), or, by other estimators, (runs, tasks)."""
    library = require_statistics()
    value = estimator(scores)
    if len(scores) == 1:
        return Band(value, value, value)
    with _repeatable():
        _, intervals = library.get_interval_estimates({"": scores}, estimator, reps=REPETITIONS, confidence_interval_size=COVERAGE)
    return Band(value, *intervals[""])


def profile(scores: Floats, thresholds: Floats) -> Band:
    """Performance profile of scores (runs, tasks): at each threshold the share of them that lies above it."""
    return band_of(scores, lambda drawn: (drawn[..., None] > thresholds).mean((0, 1)))


def share_interval(shares: Sequence[float], episodes: Sequence[int]) -> Interval:
    """The mean of each run's share of ``episodes`` that were solved, and its 95 % interval, also of one run.

    It is the wider of two, end by end: what the runs tell (Student's t), which knows nothing where all runs agree, and what their episodes
    tell (Wilson's of all of them), which knows nothing of how runs differ.
    """
    found = mean_interval(shares)
    of_all = sum(share * count for share, count in zip(shares, episodes, strict=True))
    low, high = wilson_interval(round(of_all), sum(episodes))
    ends = (low, high) if found.low is None or found.high is None else (max(0.0, min(low, found.low)), min(1.0, max(high, found.high)))
    return Interval(found.value, min(ends[0], found.value), max(ends[1], found.value))


def mean_interval(values: Sequence[float]) -> Interval:
    """The mean of each run's value, with Student's 95 % interval."""
    value, count = float(np.mean(values)), len(values)
    if count == 1:
        return Interval(value, None, None)
    half = float(student.ppf((1 + COVERAGE) / 2, count - 1) * np.std(values, ddof=1) / math.sqrt(count))
    return Interval(value, value - half, value + half)


def true_coverage(runs: int) -> float | None:
    """How often the bootstrap interval of so many runs holds the truth; None of one, which has no interval."""
    return TRUE_COVERAGE.get(runs, max(TRUE_COVERAGE.values())) if runs > 1 else None


def improvement(ours: Floats, theirs: Floats) -> Interval:
    """Probability that a run of ``ours`` (runs, tasks) beats one of ``theirs`` on the same task; a tie counts half.

    A bootstrap of rows that do not overlap would be sure of what a handful of runs cannot tell. The interval holds every probability P that
    the estimate lies within 1.96 standard deviations of, these taken at their greatest: whatever the scores' distributions, the variance is
    at most P (1 - P) / n with n runs of the smaller row, as the estimate is a mean over pairings of the rows, each of n independent pairs.
    That is Wilson's interval (1927) of n trials; n of n wins leave a lower end of n / (n + 3.84).
    """
    ahead = ours[:, None] - theirs[None]
    value = float(((ahead > 0) + 0.5 * (ahead == 0)).mean())
    count = min(len(ours), len(theirs))
    if count == 1:
        return Interval(value, None, None)
    spread = NORMAL_QUANTILE**2 / count
    centre = (value + spread / 2) / (1 + spread)
    half = math.sqrt(spread * value * (1 - value) + spread**2 / 4) / (1 + spread)
    return Interval(value, max(0.0, centre - half), min(1.0, centre + half))


def milestone(costs: Sequence[float | None]) -> Milestone:
    """What a level cost; None for a run that never got there, which stays in the count.

    The bootstrap here takes order statistics, never a value between two, as one of them may be infinite.
    """
    values = np.array([math.inf if cost is None else cost for cost in costs])
    reached = int(np.isfinite(values).sum())
    if len(values) == 1:
        return Milestone(_finite(values[0]), None, None, reached, 1)
    drawn = np.random.default_rng(BOOTSTRAP_SEED).choice(values, (REPETITIONS, len(values)))
    medians = np.sort(_median(drawn))
    tail = (1 - COVERAGE) / 2
    low, high = medians[math.floor(tail * REPETITIONS)], medians[math.ceil((1 - tail) * REPETITIONS) - 1]
    return Milestone(_finite(_median(values)), _finite(low), _finite(high), reached, len(values))


def first_reaching(steps: Floats, values: Floats, level: float) -> float | None:
    """The first of ``steps`` (n,) at which ``values`` (n,) are at or above ``level``; None if none is."""
    hits = np.flatnonzero(values >= level - 1e-9)
    return float(steps[hits[0]]) if len(hits) else None


def _median(values: Floats) -> Any:
    """The middle value along the last axis, the upper one of an even number: a cost that half of the runs keep to."""
    return np.sort(values, -1)[..., values.shape[-1] // 2]


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


@contextmanager
def _repeatable() -> Iterator[None]:
    """The random state that rliable 1.2 takes has no effect, it draws from numpy's global one: seed that, and give it back as it was."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(BOOTSTRAP_SEED)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002
