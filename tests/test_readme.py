"""The README's code runs as it stands, and its commands are ones that exist."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from marl_handover.cli import COMMANDS, main

README = Path(__file__).resolve().parents[1] / "README.md"
TEXT = README.read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
COMMAND_LINES = re.findall(r"^marl-handover ([^#\n]+)", TEXT, re.MULTILINE)


def test_readme_has_examples():
    assert len(EXAMPLES) >= 2
    assert len(COMMAND_LINES) >= 5


@pytest.mark.parametrize("code", EXAMPLES)
def test_examples_run(code, capsys):
    exec(compile(code, str(README), "exec"), {"__name__": "readme"})
    assert capsys.readouterr().out.strip()


def test_the_pretrained_policy_of_the_example_succeeds(capsys):
    exec(compile(EXAMPLES[0], str(README), "exec"), {"__name__": "readme"})
    assert "success after" in capsys.readouterr().out


@pytest.mark.parametrize("line", COMMAND_LINES)
def test_commands_exist_and_know_their_keys(line, capsys):
    command, *arguments = shlex.split(line)
    assert command in COMMANDS
    if "--help" in arguments:
        return
    assert main([command, "--help"]) == 0
    known = capsys.readouterr().out
    for argument in arguments:
        assert argument.partition("=")[0].partition(".")[0] in known


@pytest.mark.parametrize("line", [line for line in COMMAND_LINES if line.startswith(("plan", "workspace", "evaluate policy=pretrained"))])
def test_quick_commands_succeed(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(line)) == 0


RESULTS = README.parent / "bench" / "results" / "2026-11-22"


@pytest.mark.parametrize("run", ["b0", "b1", "b2", "e1", "a0", "pretrained_a", "pretrained_b"])
def test_the_result_table_says_what_the_runs_say(run):
    result = json.loads((RESULTS / run / "evaluation.json").read_text())
    summary = json.loads((RESULTS / run / "summary.json").read_text())
    assert (result["episodes"], result["seed"]) == (10000, 100)
    table = TEXT[TEXT.index("| run | success |") : TEXT.index("Beside it,")]
    rows = [
        row
        for row in table.splitlines()
        if f"{100 * result['success_rate']:.2f}" in row
        and f"{result['steps_ratio']:.3f}" in row
        and f"{summary['step']:,} | {summary['gradient_step']:,}" in row
        and f"{summary['wall_s']:.0f}" in row
    ]
    assert len(rows) == 1


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
        assert expected in TEXT
    assert (ours["success"], ours["rows"], found["proofs"]["proved"]) == (1, 1000, 1)


@pytest.mark.parametrize(("name", "label"), [("exact", "exact planner"), ("pretrained_b", "`pretrained_b`")])
def test_the_bullet_table_says_what_the_runs_say(name, label):
    result = json.loads((RESULTS / "bullet" / f"{name}.json").read_text())
    assert (result["backend"], result["episodes"], result["seed"], result["epsilon_deg"]) == ("bullet", 500, 100, 5.0)
    first, end = (round(500 * result[key]) for key in ("success_rate", "success_in_the_end"))
    errors = f"{result['transfer_error_mm']['p95']:.2f} mm, {result['transfer_error_deg']['p95']:.2f}°"
    assert f"| {label} | {first} of 500 | {end} of 500 | {result['steps_ratio']:.3f} | {errors} |" in TEXT
