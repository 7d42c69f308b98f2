"""Comparing costs of trainings of unequal length, and rows some of whose runs solved nothing."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from marl_handover.errors import UnknownChoice
from marl_handover.experiments.results import _paired, _sooner
from marl_handover.experiments.suite import PAIRED_MEASURES, TableSpec
from marl_handover.experiments.tables import PAIRED, csv_text, expected_lines, make_tables, markdown


def row(budget: int, *reached: int | None):
    """A row whose runs were at 95 % at these transfers."""
    runs = []
    for at in reached:
        rates = [1.0 if at is not None and step >= at else 0.0 for step in range(0, budget + 100, 100)]
        runs.append({"metrics": {"step": list(range(0, budget + 100, 100)), "success_rate": rates}})
    return {"settings": {"steps": budget}, "runs": runs}


@pytest.mark.parametrize(
    ("first", "second", "probability"),
    [
        (row(1000, 300, 400), row(1000, 500, None), 1.0),
        # The longer one got there after the shorter one's end: nobody knows when the shorter one would have.
        (row(400, None, None), row(1000, 700, 900), 0.5),
        (row(400, 300, 300), row(1000, 700, 900), 1.0),
        (row(1000, 700, 900), row(400, 300, None), 0.25),
        (row(1000, 400, 400), row(400, 400, 400), 0.5),
        (row(950, 1000, 1000), row(950, None, None), 1.0),
    ],
)
def test_a_run_is_not_called_slower_than_another_that_was_given_longer(first, second, probability):
    assert _sooner(first, second)["value"] == probability
    assert _sooner(second, first)["value"] == 1 - probability
    assert _sooner(first, second)["until_step"] == min(first["settings"]["steps"], second["settings"]["steps"])


RATES, RATIOS = (0.9985, 1.0, 0.9999), (1.03, 1.002, 1.01)


def ranged(ratios=RATIOS):
    runs = [
        {
            "trained": {"wall_s": 60.0 + number},
            "evaluations": {"k": {"episodes": 10000, "success_rate": rate, "steps_ratio": ratio, "machine": {"cpu": "a processor"}}},
        }
        for number, (rate, ratio) in enumerate(zip(RATES, ratios, strict=True))
    ]
    return {
        "tables": [{"name": "t", "kind": "range", "title": "", "rows": [], "evaluations": []}],
        "evaluations": [{"name": "k", "label": ""}],
        "rows": [{"name": "a", "label": "a", "evaluations": {"k": {}}, "runs": runs}],
    }


def test_a_range_is_the_worst_the_median_and_the_best_of_the_runs():
    (table,) = make_tables(ranged())
    assert "| a | k | 3 | 10,000 | 99.85 / 99.99 / 100.00 | 1.030 / 1.010 / 1.002 | 61 | a processor |" in markdown(table)
    assert "success_rate_worst,success_rate_median,success_rate_best,steps_ratio_worst" in csv_text(table)
    # A run that solved nothing has no ratio: no worst can be told.
    assert "| 99.85 / 99.99 / 100.00 | – |" in markdown(make_tables(ranged((1.03, None, 1.01)))[0])


def test_what_a_run_brought_stands_beside_what_was_to_be_expected():
    lines = "\n".join(expected_lines(ranged(), "a", {"success_rate": 0.9992, "steps_ratio": 1.012}))
    assert "worst / median / best of 3 seeds on a processor" in lines
    assert "99.92   to expect: 99.85 / 99.99 / 100.00" in lines
    assert "1.012   to expect: 1.030 / 1.010 / 1.002" in lines
    with pytest.raises(UnknownChoice):
        expected_lines(ranged(), "b", {})


def test_how_many_runs_have_solved_anything_is_told():
    interval = {"value": 0.5, "low": 0.4, "high": 0.6, "mean": 0.5}
    found = {"runs": 5, "true_coverage": 0.9, "episodes": 50, "success_rate": interval, "mean_steps": interval, "path_mm": interval}
    found |= {"steps_ratio": {**interval, "runs": 2}, "mean_steps_success": {**interval, "runs": 5}}
    spec = {"name": "t", "kind": "evaluation", "title": "", "rows": [], "evaluations": [], "paths": True}
    results = {
        "tables": [spec],
        "evaluations": [{"name": "k", "label": ""}],
        "rows": [{"name": "a", "label": "a|b", "evaluations": {"k": found}}],
    }
    (table,) = make_tables(results)
    text = markdown(table)
    assert "a\\|b" in text
    assert "| steps (solved) | steps ÷ optimum (solved) | path, mm |" in text
    assert "| 0.50 [0.40, 0.60] | 0.500 [0.400, 0.600] (2 of 5 runs) | 0 [0, 1] | – |" in text
    assert "| 5 (≈ 90 %) |" in text
    assert "\na|b," in csv_text(table)
    assert "steps_ratio_runs,path_mm,path_mm_low,path_mm_high" in csv_text(table)


def test_two_evaluations_of_the_same_problems_are_held_against_each_other():
    """The difference is of each seed for itself: its interval is narrower than those of the two sides; what no report has is left out."""
    errors = {"one": (1.0, 2.0, 3.0), "other": (1.5, 2.5, 3.5)}
    runs = [
        {
            "evaluations": {
                name: {"success_rate": 1.0, "transfer_error_mm": {"p50": at[seed], "bias": [0.1, -0.2]}} for name, at in errors.items()
            }
        }
        for seed in range(3)
    ]
    spec = TableSpec(name="t", kind="paired", evaluations=["one", "other"])
    rows = [{"name": "a", "label": "A", "runs": [*runs, {"evaluations": {"one": {"success_rate": 0.0}}}]}]
    found = {entry["measure"]: entry for entry in _paired({"rows": rows}, spec)}
    assert list(found) == ["success_rate", "transfer_error_mm.p50", "transfer_error_mm.bias.0", "transfer_error_mm.bias.1"]
    median = found["transfer_error_mm.p50"]
    assert median["runs"] == 3
    assert (median["first"]["value"], median["second"]["value"]) == (2.0, 2.5)
    assert median["difference"] == {"value": 0.5, "low": 0.5, "high": 0.5}
    assert median["first"]["low"] < 1.5
    asked = {"tables": [asdict(spec)], "evaluations": [{"name": "one", "label": ""}, {"name": "other", "label": "Other"}]}
    (table,) = make_tables({**asked, "rows": rows, "paired": list(found.values())})
    assert "| A | a transfer off, median, mm | 2.000 [" in markdown(table)
    assert "+0.500 [+0.500, +0.500] |" in markdown(table)
    assert set(PAIRED) == set(PAIRED_MEASURES)
