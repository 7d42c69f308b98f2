"""Figures of a suite: they show the stored numbers, and no text is cut off or covers another."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from marl_handover.report.compare import KINDS, bars_figure, curves_figure, endings_figure, kind_of, make_figures, profiles_figure
from marl_handover.report.figure_style import SERIES, SERIES_LINES, series_style

OUTCOMES = ("success", "wrong_orientation", "wrong_position", "timeout")


def row(name, label, seed, algorithm="sac", evaluations=("kinematic", "bullet"), runs=5):
    """A row as ``results.json`` has it, of random numbers."""
    random = np.random.default_rng(seed)
    learned = algorithm is not None
    steps = [float(step) for step in range(4000, 48001, 4000)]
    value = np.sort(random.random(len(steps)))
    content = {
        "name": name,
        "label": label,
        "settings": {
            "steps": 48000,
            "algorithm.name": algorithm,
            "curriculum": [{"until_step": 16000}, {"until_step": 90000}, {"until_step": 0}],
        }
        if learned
        else None,
        "curves": {
            "success_rate": {"step": steps, "runs": runs, "value": value.tolist(), "low": (0.9 * value).tolist(), "high": value.tolist()}
        }
        if learned
        else {},
        "evaluations": {},
        "runs": [{"evaluations": {}} for _ in range(runs)],
    }
    for evaluation in evaluations:
        scores = random.random(runs)
        steps_taken = 1 + 19 * random.random(runs)
        for run, score, taken in zip(content["runs"], scores, steps_taken, strict=True):
            run["evaluations"][evaluation] = {"success_rate": score, "mean_steps_success": taken, "steps_ratio": 1 + taken / 100}
        counts = random.multinomial(1000, [0.25] * 4)
        content["evaluations"][evaluation] = {
            "episodes": 1000,
            "outcomes": dict(zip(OUTCOMES, counts.tolist(), strict=True)),
            **{
                measure: {"value": float(np.mean(values)), "low": float(min(values)), "high": float(max(values))}
                for measure, values in (
                    ("success_rate", scores),
                    ("mean_steps_success", steps_taken),
                    ("steps_ratio", 1 + steps_taken / 100),
                )
            },
        }
    return content


def suite(rows):
    return {
        "rows": rows,
        "evaluations": [{"name": "kinematic", "label": "kinematic"}, {"name": "bullet", "label": "PyBullet"}],
        "profiles": {
            "profiles": {
                "thresholds": np.linspace(0.2, 1, 101).tolist(),
                "rows": {
                    item["name"]: {
                        "value": np.linspace(1, 0, 101).tolist(),
                        "low": np.linspace(0.9, 0, 101).tolist(),
                        "high": np.linspace(1, 0.1, 101).tolist(),
                    }
                    for item in rows
                    if item["settings"]
                },
            }
        },
        "figures": [],
    }


def spec(kind, **changes):
    plain = {"name": "profiles", "kind": kind, "title": "A title", "rows": [], "evaluations": [], "measure": "success_rate", "x": "step"}
    return plain | changes


MANY = suite([row(f"r{index}", f"row {index} with a label that is rather long", index) for index in range(13)])
FEW = suite([row("a", "A", 0), row("b", "grid", 1, algorithm="dqn"), row("c", "exact", 2, algorithm=None, evaluations=("kinematic",))])
ALONE = suite([row("a", "one", 0, runs=1)])


@pytest.mark.parametrize("results", [MANY, FEW, ALONE], ids=["many", "few", "alone"])
@pytest.mark.parametrize("x", ["step", "share"])
def test_curves_are_tidy(results, x, assert_tidy):
    assert_tidy(curves_figure(results, spec("curves", x=x)))


@pytest.mark.parametrize("results", [MANY, FEW, ALONE], ids=["many", "few", "alone"])
@pytest.mark.parametrize("measure", ["success_rate", "mean_steps_success", "steps_ratio"])
def test_bars_are_tidy(results, measure, assert_tidy):
    assert_tidy(bars_figure(results, spec("bars", measure=measure)))


@pytest.mark.parametrize("results", [MANY, FEW, ALONE], ids=["many", "few", "alone"])
def test_endings_and_profiles_are_tidy(results, assert_tidy):
    assert_tidy(endings_figure(results, spec("end_states", evaluations=["kinematic"])))
    assert_tidy(endings_figure(results, spec("end_states")))
    assert_tidy(profiles_figure(results, spec("profiles")))


def test_a_curve_is_the_stored_one_and_a_share_is_of_the_runs_own_length():
    stored = FEW["rows"][0]["curves"]["success_rate"]
    for x, scale in (("step", 1), ("share", 1 / 48000)):
        axes = curves_figure(FEW, spec("curves", rows=["a"], x=x)).axes[0]
        line = next(line for line in axes.lines if line.get_label().startswith("A "))
        np.testing.assert_allclose(line.get_xdata(), scale * np.array(stored["step"]))
        np.testing.assert_allclose(line.get_ydata(), stored["value"])
        assert line.get_label() == "A (5 seeds)"
        changes = [line.get_xdata()[0] for line in axes.lines if len(line.get_xdata()) == 2]
        np.testing.assert_allclose(changes, [scale * 16000])  # the stage that lies beyond the run's end is not drawn


def test_a_bar_is_the_stored_value_with_its_interval_and_runs():
    axes = bars_figure(FEW, spec("bars")).axes[0]
    for line, item in enumerate(FEW["rows"]):
        found = item["evaluations"]["kinematic"]["success_rate"]
        bar = axes.patches[line]
        assert bar.get_width() == pytest.approx(100 * found["value"])
        assert f"{100 * found['value']:.2f} %" in [text.get_text() for text in axes.texts]
    dots = sorted(value for line in axes.lines if line.get_marker() == "o" for value in line.get_xdata())
    runs = sorted(100 * run["evaluations"]["kinematic"]["success_rate"] for item in FEW["rows"] for run in item["runs"])
    np.testing.assert_allclose(dots, runs)


def test_what_was_not_run_is_said():
    axes = bars_figure(FEW, spec("bars")).axes[1]
    assert [text.get_text() for text in axes.texts].count("not run") == 1


def test_endings_fill_the_line():
    axes = endings_figure(FEW, spec("end_states", evaluations=["kinematic"])).axes[0]
    pieces = [(round(bar.get_y(), 3), bar.get_width()) for bar in axes.patches]
    for line in {place for place, _ in pieces}:
        assert sum(width for place, width in pieces if place == line) == pytest.approx(100)
    assert len(pieces) == 4 * len(FEW["rows"])


def test_without_values_there_is_no_figure():
    empty = suite([row("c", "exact", 2, algorithm=None, evaluations=())])
    for maker, kind in ((curves_figure, "curves"), (bars_figure, "bars"), (endings_figure, "end_states"), (profiles_figure, "profiles")):
        assert maker(empty, spec(kind)) is None
    empty["figures"] = [spec("curves", name="none"), spec("workspace", name="cell")]
    drawn = dict(make_figures(empty))
    assert drawn["none"] is None
    assert drawn["cell"] is not None


def test_rows_are_told_apart_without_colour():
    assert [kind_of(item) for item in FEW["rows"]] == ["continuous", "discretised", "not learned"]
    assert len({hatch for _, hatch in KINDS.values()}) == len(KINDS)
    styles = [(style["color"], style["linestyle"]) for style in map(series_style, range(len(SERIES) * len(SERIES_LINES)))]
    assert len(set(styles)) == len(styles)
    for first, second in itertools.pairwise(styles):
        assert first[0] != second[0]
        assert first[1] != second[1]
