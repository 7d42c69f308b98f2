"""What the README and the pages it leads to say is what the stored runs say. Its code blocks are run by test_docs.py."""

from __future__ import annotations

import json
import re
import statistics
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
LEARNING = (ROOT / "docs" / "concepts" / "learning.md").read_text(encoding="utf-8")
MOTION = (ROOT / "docs" / "concepts" / "motion.md").read_text(encoding="utf-8")
RESULTS = ROOT / "bench" / "results" / "2026-11-22"
SEEDS = ROOT / "bench" / "results" / "compare" / "seeds" / "results.json"


def test_a_picture_comes_first_and_then_the_two_commands():
    assert TEXT.index("docs/img/handover.gif") < TEXT.index("make demo") < TEXT.index("| run | success |")


def test_the_pretrained_policy_of_the_example_succeeds(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    exec(compile(code, "README.md", "exec"), {"__name__": "readme"})
    assert "success after" in capsys.readouterr().out


@pytest.mark.parametrize("run", ["2026-11-22/a0", "2026-11-22/pretrained_a", "2026-11-30/pretrained_b"])
def test_the_result_table_says_what_the_runs_say(run):
    result = json.loads((RESULTS.parent / run / "evaluation.json").read_text())
    summary = json.loads((RESULTS.parent / run / "summary.json").read_text())
    assert (result["episodes"], result["seed"]) == (10000, 100)
    table = TEXT[TEXT.index("| run | success |") : TEXT.index("`steps / optimum` is")]
    rows = [
        row
        for row in table.splitlines()
        if f"{100 * result['success_rate']:.2f}" in row
        and f"{result['steps_ratio']:.3f}" in row
        and f"{summary['step']:,} | {summary['gradient_step']:,}" in row
        and f"{summary['wall_s']:.0f}" in row
    ]
    assert len(rows) == 1


@pytest.mark.parametrize(
    ("name", "label"),
    [("default", "default"), ("epsilon_5deg", "`preset=epsilon_5deg` (`make demo`)"), ("epsilon_1deg", "`preset=epsilon_1deg`")],
)
def test_a_range_is_that_of_the_stored_seeds(name, label):
    (row,) = [row for row in json.loads(SEEDS.read_text())["rows"] if row["name"] == name]
    reports = [run["evaluations"]["kinematic"] for run in row["runs"]]
    rates, ratios = (
        sorted(report["success_rate"] for report in reports),
        sorted((report["steps_ratio"] for report in reports), reverse=True),
    )
    success = " / ".join(f"{100 * rate:.2f}" for rate in (rates[0], statistics.median(rates), rates[-1]))
    ratio = " / ".join(f"{ratio:.3f}" for ratio in (ratios[0], statistics.median(ratios), ratios[-1]))
    assert f"°, {label}, {len(reports)} seeds: worst / median / best | {success} % | {ratio} |" in TEXT
    assert all(report["episodes"] == 10_000 for report in reports)


def test_the_page_on_learning_says_what_one_accuracy_alone_is_worth():
    names = ("evaluation.json", "evaluation_3deg.json", "evaluation_1deg.json")
    runs = [json.loads((RESULTS / "f0" / name).read_text()) for name in names]
    assert [run["epsilon_deg"] for run in runs] == [5.0, 3.0, 1.0]
    five, three, one = (f"{100 * run['success_rate']:.2f} %" for run in runs)
    for said in (f"seed 0 solves {five} after a quarter", f"and {three} judged at 3°, but {one} at 1°"):
        assert said in LEARNING
    fixed = json.loads((RESULTS / "fixed_1deg" / "evaluation.json").read_text())
    steps = json.loads((RESULTS / "fixed_1deg" / "summary.json").read_text())["step"]
    assert f"at 1° alone, {steps:,} transfers led to {100 * fixed['success_rate']:.2f} %" in LEARNING


def test_the_summary_of_the_papers_suite_says_what_the_suite_says():
    rows = json.loads((RESULTS.parent / "compare" / "paper" / "results.json").read_text())["rows"]
    found = {row["name"]: row["evaluations"]["kinematic"] for row in rows}
    rate = {name: 100 * judged["success_rate"]["value"] for name, judged in found.items()}
    more = 100 * (found["dqn_b"]["steps_ratio"]["value"] - 1)
    for said in (
        f"{rate['ours_b']:.2f} % in B and {rate['ours_a']:.2f} % in A",
        f"{rate['paper_b']:.0f} – {rate['paper_b_fixed']:.0f} % in B",
        f"{rate['dqn_b']:.2f} % with {more:.0f} % more transfers",
    ):
        assert said in TEXT


def words(spread, *forms):
    """A spread's median, 95th percentile and worst as a row of the table has them."""
    return " | ".join(form.format(spread[key]) for key, form in zip(("median", "p95", "worst"), forms, strict=True))


def test_the_motion_table_says_what_the_bench_says():
    found = json.loads((RESULTS / "motion.json").read_text())
    ours, paper, ompl = found["transfers"], found["paper"], found["ompl"]
    for expected in (
        "one transfer planned, ms | " + words(ours["ms"], "{:.2f}", "{:.1f}", "{:.0f}"),
        "path length ÷ best known | " + words(ours["length_over_best"], "{:.4f}", "{:.4f}", "{:.2f}"),
        "on every 50th, ms | " + words(paper["paper_ms"], "{:.0f}", "{:.0f}", "{:,.0f}"),
        f"({ompl['ompl_length_over_ours']['median']:.2f} × our length) | " + words(ompl["ompl_ms"], "{:.1f}", "{:.0f}", "{:,.0f}"),
        f"({found['timing']['duration_over_toppra_500']['median']:.4f} × toppra's duration) | "
        + words(found["timing"]["ours_ms"], "{:.3f}", "{:.3f}", "{:.3f}"),
        "seven phases, ms | " + words(found["cycles"]["ms"], "{:.2f}", "{:.1f}", "{:.1f}"),
        f"program is {paper['times_faster']:.0f} times slower; {paper['paper_found_within_1_mm']} of its 20 paths hold within 1 mm "
        f"({paper['paper_found_without_tolerance']} without tolerance)",
        f"saves {100 * found['overlap']['saved']:.1f} % of the time",
    ):
        assert expected in MOTION
    assert (ours["success"], ours["rows"], found["proofs"]["proved"]) == (1, 1000, 1)


@pytest.mark.parametrize(("name", "label"), [("exact", "exact planner"), ("pretrained_b", "`pretrained_b`")])
def test_the_bullet_table_says_what_the_runs_say(name, label):
    result = json.loads((RESULTS / "bullet" / f"{name}.json").read_text())
    assert (result["backend"], result["episodes"], result["seed"], result["epsilon_deg"]) == ("bullet", 500, 100, 5.0)
    first, end = (round(500 * result[key]) for key in ("success_rate", "success_in_the_end"))
    errors = f"{result['transfer_error_mm']['p95']:.2f} mm, {result['transfer_error_deg']['p95']:.2f}°"
    assert f"| {label} | {first} of 500 | {end} of 500 | {result['steps_ratio']:.3f} | {errors} |" in MOTION


@pytest.mark.parametrize(
    "run", ["sb3_paper_g1", "sb3_paper_done_g1", "sb3_relative_done_g1", "sb3_paper_g-1", "sb3_relative_done_g-1"], ids=lambda run: run
)
def test_the_table_of_peers_says_what_the_runs_say(run):
    result = json.loads((RESULTS / run / "result.json").read_text())
    final = result["final"]
    assert result["to"]["90"] is None
    rate = f"{100 * final['success_rate']:.1f}".removesuffix(".0")
    assert f"| {rate} %" in LEARNING
    assert f"| {final['steps']:,} steps, {final['wall_s']:,.0f} s | not reached |" in LEARNING


def test_the_speeds_are_the_measured_ones():
    found = json.loads((RESULTS / "throughput.json").read_text())
    batched, loop, decision = found["batched_steps_per_s"]["1"], found["gymnasium_steps_per_s"], found["decision"]["pretrained_b"]
    assert f"{round(batched, -3):,.0f} steps/s" in LEARNING
    assert f"{loop['B']:,.0f} (B) and {loop['A']:,.0f} (A) steps/s" in LEARNING
    assert f"{decision['p50_ms']:.2f} ms (p50) and {decision['p99_ms']:.2f} ms (p99)" in LEARNING
    optimum = (ROOT / "docs" / "concepts" / "optimum.md").read_text(encoding="utf-8")
    assert f"{found['exact_plans_per_s'] / 1e6:.1f} million problems a second" in optimum
