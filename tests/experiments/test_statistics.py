"""Estimates against rliable's own and against enumeration, intervals that repeat, costs of runs that never got there."""

from __future__ import annotations

import itertools
import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rliable import library, metrics

from marl_handover.errors import HandoverError
from marl_handover.experiments import statistics
from marl_handover.experiments.statistics import band_of, first_reaching, improvement, mean, milestone, profile, true_coverage

SCORES = np.array([[0.2], [0.9], [0.6], [0.7], [0.65]])


def summarised(scores, estimator=statistics.interquartile_mean):
    """Of one measure."""
    (found,) = statistics.summarised(scores[..., None], estimator)
    return found


def exact_interval(scores, estimator):
    """The bootstrap's limits with all samples there are, each once."""
    samples = itertools.product(range(len(scores)), repeat=len(scores))
    values = np.array([float(estimator(scores[list(rows)][..., None])[0]) for rows in samples])
    return np.percentile(values, [2.5, 97.5])


def test_the_interquartile_mean_by_hand():
    # 5 runs: a quarter, rounded down to one run, is cut off at each end
    assert summarised(SCORES).value == pytest.approx((0.6 + 0.7 + 0.65) / 3)
    assert summarised(SCORES[:3]).value == pytest.approx((0.2 + 0.9 + 0.6) / 3)
    assert summarised(SCORES, mean).value == pytest.approx(SCORES.mean())


@given(st.integers(1, 12), st.integers(1, 4), st.integers(0, 99))
@settings(max_examples=30)
def test_the_estimates_are_rliables(runs, tasks, seed):
    scores = np.random.default_rng(seed).random((runs, tasks))
    assert statistics.interquartile_mean(scores[..., None])[0] == pytest.approx(metrics.aggregate_iqm(scores))
    assert mean(scores[..., None])[0] == pytest.approx(metrics.aggregate_mean(scores))


@pytest.mark.parametrize("estimator", [statistics.interquartile_mean, mean])
def test_intervals_are_those_of_all_samples(estimator):
    found = summarised(SCORES, estimator)
    np.testing.assert_allclose([found.low, found.high], exact_interval(SCORES, estimator), atol=0.03)


def test_the_same_numbers_at_every_call_and_nobody_elses_are_disturbed():
    np.random.seed(7)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    found = [summarised(SCORES), improvement(SCORES, SCORES - 0.1), milestone([3.0, 1.0, None])]
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(8)  # noqa: NPY002
    assert [summarised(SCORES), improvement(SCORES, SCORES - 0.1), milestone([3.0, 1.0, None])] == found


def test_one_run_has_no_interval():
    assert summarised(SCORES[:1]) == (0.2, None, None)
    assert improvement(SCORES[:1], SCORES)[1:] == (None, None)
    assert milestone([5.0]) == (5.0, None, None, 1, 1)
    np.testing.assert_array_equal(band_of(SCORES[:1, :, None]).high, [0.2])


def test_a_band_is_an_interval_at_each_point():
    points = np.stack([SCORES, SCORES + 1.0, 0 * SCORES], -1)
    band = band_of(points)
    np.testing.assert_allclose(band.value, [summarised(SCORES).value, summarised(SCORES).value + 1, 0])
    assert statistics.summarised(points) == [tuple(row) for row in np.stack(band).T]
    assert (band.low <= band.value).all()
    assert (band.value <= band.high).all()
    assert band.low[2] == band.high[2] == 0


def test_profiles_are_rliables_and_fall():
    scores = np.random.default_rng(1).random((5, 3))
    thresholds = np.linspace(0, 1, 21)
    found = profile(scores, thresholds)
    theirs, _ = library.create_performance_profile({"a": scores}, thresholds, reps=10)
    np.testing.assert_allclose(found.value, theirs["a"])
    assert (np.diff(found.value) <= 0).all()
    assert (found.low <= found.value + 1e-12).all()
    assert (found.value <= found.high + 1e-12).all()


@given(st.integers(0, 999))
@settings(max_examples=5)
def test_improvement_is_the_share_of_pairs(seed):
    random = np.random.default_rng(seed)
    ours, theirs = random.integers(0, 4, (4, 2)) / 4, random.integers(0, 4, (3, 2)) / 4
    pairs = [(1.0 if x > y else 0.5 if x == y else 0.0) for task in range(2) for x, y in itertools.product(ours[:, task], theirs[:, task])]
    found = improvement(ours, theirs)
    assert found.value == pytest.approx(sum(pairs) / len(pairs))
    assert found.low <= found.value <= found.high
    assert found.value + improvement(theirs, ours).value == pytest.approx(1.0)


def test_no_number_of_wins_is_certainty():
    for runs in (2, 3, 5, 50):
        ours, theirs = 1 + np.arange(runs)[:, None], np.zeros((runs, 1))
        found = improvement(ours, theirs)
        assert (found.value, found.high) == (1.0, pytest.approx(1.0))
        assert found.low == pytest.approx(runs / (runs + 1.959964**2))
        assert improvement(theirs, ours) == pytest.approx((0.0, 0.0, 1 - found.low))


@pytest.mark.parametrize("shift", [0.0, 0.8, 2.5])
@pytest.mark.parametrize("runs", [(3, 3), (5, 3), (5, 5)])
def test_the_interval_of_an_improvement_holds_the_truth_as_often_as_it_says(shift, runs):
    random = np.random.default_rng(3)
    truth = 0.5 * (1 + math.erf(shift / 2))  # of two normal scores, one shifted
    drawn = [(random.standard_normal((runs[0], 1)) + shift, random.standard_normal((runs[1], 1))) for _ in range(1500)]
    found = [improvement(ours, theirs) for ours, theirs in drawn]
    assert np.mean([interval.low <= truth <= interval.high for interval in found]) > 0.94


@pytest.mark.parametrize("runs", [2, 3, 5, 10])
def test_the_true_coverage_of_intervals_of_few_runs(runs):
    """Repeats the simulation, in its own vectorised bootstrap."""
    random = np.random.default_rng(4)
    held = []
    for scores in random.standard_normal((2000, runs)):
        drawn = scores[random.integers(0, runs, (400, runs))]
        ordered, cut = np.sort(drawn, -1), runs // 4
        low, high = np.percentile(ordered[:, cut : runs - cut].mean(-1), [2.5, 97.5])
        held.append(low <= 0 <= high)
    assert np.mean(held) == pytest.approx(true_coverage(runs), abs=0.03)
    assert true_coverage(1) is None


def test_improvement_without_ties_is_rliables():
    ours, theirs = SCORES, SCORES * 0.9 - 0.001
    assert improvement(ours, theirs).value == pytest.approx(metrics.probability_of_improvement(ours, theirs))


@pytest.mark.parametrize(
    ("costs", "median", "reached"),
    [([4, 2, 9], 4, 3), ([4, None, 9], 9, 2), ([4, None, None], None, 1), ([None, None], None, 0), ([1, 2, 3, None], 3, 3)],
)
def test_a_run_that_never_got_there_counts_as_never(costs, median, reached):
    found = milestone(costs)
    assert (found.median, found.reached, found.runs) == (median, reached, len(costs))


def test_the_interval_of_a_median_is_that_of_all_samples():
    costs = [10.0, 20.0, 30.0, 40.0, None]
    values = [math.inf if cost is None else cost for cost in costs]
    medians = sorted(sorted(sample)[2] for sample in itertools.product(values, repeat=5))
    low, high = medians[int(0.025 * len(medians))], medians[math.ceil(0.975 * len(medians)) - 1]
    found = milestone(costs)
    assert found.low == low == 10.0
    assert (found.high is None) == math.isinf(high)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=20), st.sampled_from(statistics.LEVELS))
def test_the_first_step_at_a_level(values, level):
    steps = np.arange(len(values)) * 10.0
    found = first_reaching(steps, np.array(values), level)
    below = [step for step, value in zip(steps, values, strict=True) if value >= level - 1e-9]
    assert found == (below[0] if below else None)


def test_without_rliable_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rliable", None)
    with pytest.raises(HandoverError, match=r"pip install .*rliable"):
        summarised(SCORES)
