"""The pages of results say what the stored results say, and nothing where there are none."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest

from marl_handover.experiments.suite import load_suite, suite_folder
from marl_handover.experiments.tables import NOT_RUN, blocks, filled, make_tables, markdown, partial_line, read_evidence

ROOT = Path(__file__).resolve().parents[1]
PAGE, ENGINES, LADDER = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("results.md", "engines.md", "benchmark.md"))
BLOCKS = blocks(PAGE) + blocks(ENGINES) + blocks(LADDER)
EVIDENCE = read_evidence(ROOT / "bench" / "results" / "compare")
SINGLE = ROOT / "bench" / "results" / "2026-11-22"
"""Runs outside the suites."""
LATER = ROOT / "bench" / "results" / "2026-11-30"
SUITES = sorted(path.stem for path in suite_folder().glob("*.yaml"))


def test_the_pages_have_a_block_for_every_table_and_figure_of_every_suite():
    wanted = {
        (kind, name, spec.name)
        for name in SUITES
        for kind, specs in (("table", load_suite(name).tables), ("figure", load_suite(name).figures))
        for spec in specs
    }
    assert {(block.kind, block.suite, block.name) for block in BLOCKS} == wanted
    assert len(BLOCKS) == len(wanted)


def test_every_mark_is_closed():
    assert (
        len(re.findall(r"<!-- (?:table|figure):", PAGE + ENGINES + LADDER))
        == len(re.findall(r"<!-- end -->", PAGE + ENGINES + LADDER))
        == len(BLOCKS)
    )


def said_first(block) -> str:
    """The line that partial results cannot do without; checks that it is there."""
    results = EVIDENCE[block.suite]
    line = f"\n{partial_line(results)}\n" if results["partial"] else ""
    assert block.content.startswith(line)
    assert ("seeds so far" in block.content) == results["partial"]
    return line


@pytest.mark.parametrize("block", [block for block in BLOCKS if block.kind == "table"], ids=lambda block: f"{block.suite}/{block.name}")
def test_a_table_is_the_stored_results_or_none(block):
    if block.suite not in EVIDENCE:
        assert "|" not in block.content, "numbers without evidence"
        return
    tables = {table.name: markdown(table) for table in make_tables(EVIDENCE[block.suite])}
    assert block.content.removeprefix(said_first(block)).strip() == tables.get(block.name, NOT_RUN).strip()
    assert block.name in tables or EVIDENCE[block.suite]["partial"]


@pytest.mark.parametrize("block", [block for block in BLOCKS if block.kind == "figure"], ids=lambda block: f"{block.suite}/{block.name}")
def test_a_picture_is_there_or_not_promised(block):
    shown = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", block.content)
    drawn = block.suite in EVIDENCE and block.name not in EVIDENCE[block.suite]["empty_figures"]
    assert len(shown) == (1 if drawn else 0)
    if block.suite in EVIDENCE:
        said_first(block)
        assert drawn or EVIDENCE[block.suite]["partial"]
    for path in shown:
        assert (ROOT / "docs" / path).is_file()


def test_no_table_of_numbers_stands_outside_the_blocks():
    outside = PAGE
    for block in BLOCKS:
        outside = outside.replace(block.content, "")
    assert not re.findall(r"^\|", outside, re.MULTILINE)
    assert "![" not in outside


def test_filling_the_page_again_changes_nothing():
    for page in (PAGE, ENGINES, LADDER):
        assert filled(page, EVIDENCE, "../bench/results/compare") == page


@pytest.mark.parametrize("suite", sorted(EVIDENCE))
def test_evidence_names_settings_seeds_and_commits(suite):
    found = EVIDENCE[suite]
    assert (found["suite"], found["size"], found["failures"]) == (suite, "full", {})
    short = {part["row"]: part["done"] < part["of"] for part in found["progress"]}
    assert found["partial"] == any(short.values())
    assert set(short) == {row.name for row in load_suite(suite).rows}
    for row in found["rows"]:
        assert row["seeds"] or short[row["name"]]
        for run in row["runs"]:
            parts = [*run["evaluations"].values(), *([run["trained"]] if run["trained"] else [])]
            assert parts
            assert all(part["commit"] != "none" and part["machine"]["cpu"] for part in parts)
        assert (row["config_hash"] is None) == (row["settings"] is None)


def test_what_the_page_says_of_failures_costs_and_places_is_what_the_runs_say():
    said = " ".join(PAGE.split())
    rows = {(suite, row["name"]): row for suite in EVIDENCE for row in EVIDENCE[suite]["rows"]}
    ours = rows["paper", "ours_b"]["evaluations"]["kinematic"]
    fails = ours["outcomes"]
    lost = ours["episodes"] - fails["success"]
    assert f"{100 * ours['success_rate']['value']:.2f} % over five runs after 48,000 transfers" in said
    assert f"50,000 episodes {lost} fail: {fails['timeout']} run out of transfers, {fails['wrong_position']} ends off the goal" in said
    assert (ours["episodes"], fails["wrong_orientation"]) == (50_000, 0)
    settings = {name: rows["paper", name]["settings"] for name in ("paper_a", "dqn_a", "dqn_b")}
    assert [kind["replay.hindsight.strategy"] for kind in settings.values()] == ["none", "none", "future"]
    assert [kind["algorithm.layout"] for kind in settings.values()] == ["raw", "relative", "relative"]
    cost = {name: rows["variants", name]["milestones"]["90"]["median"] for name in ("hierarchical", "decentralised_independent")}
    assert int(cost["decentralised_independent"] / cost["hierarchical"]) == 5
    near = {name: round(100 * row["share_near"]) for name, row in json.loads((SINGLE / "places.json").read_text())["rows"].items()}
    assert f"{near.pop('decentralised_shared')} % of their hand-overs lie within 4 mm of the edge" in said
    assert (
        f"Of independent arms' {near.pop('decentralised_independent')} % do, of all others' {min(near.values())} to {max(near.values())} %"
        in said
    )


def test_what_the_page_says_of_ablations_is_what_the_runs_say():
    said = " ".join(PAGE.split())
    rows = {row["name"]: row for row in EVIDENCE["ablations"]["rows"]}
    planner = next(row for row in EVIDENCE["paper"]["rows"] if row["name"] == "exact_b")
    rate = {name: 100 * row["evaluations"]["kinematic"]["success_rate"]["value"] for name, row in rows.items()}
    more = {name: 100 * (row["evaluations"]["kinematic"]["steps_ratio"]["value"] - 1) for name, row in rows.items()}
    judged = {name: row["evaluations"] for name, row in rows.items() if "execution" in row["evaluations"]}
    noisy = {name: 100 * found["execution"]["success_rate"]["value"] for name, found in judged.items()}
    seen = [100 * found["observation"]["success_rate"]["value"] for found in judged.values()]
    steps = {name: found["execution"]["mean_steps"]["value"] for name, found in judged.items()}
    cost = {(name, level): row["milestones"][level]["median"] for name, row in rows.items() for level in ("95", "99")}
    for words in (
        f"with our features, solves {rate['box_sac']:.0f} %, TD3 {rate['td3']:.0f} %; "
        f"with the paper's raw features it is {rate['box_raw']:.0f} %",
        f"makes {rows['ppo']['runs'][0]['trained']['gradient_step']} gradient steps of them, solves {rate['ppo']:.0f} %",
        f"without it {cost['her_none', '95']:,.0f} instead of {cost['base', '95']:,.0f} to 95 %, "
        f"and {more['her_none']:.0f} % more transfers than are needed instead of {more['base']:.0f} %",
        f"solves {rate['base']:.1f} %, mirrored samples {rate['symmetry_data']:.1f} %, none {rate['symmetry_none']:.1f} %",
        f"{cost['base', '95']:,.0f}, {cost['symmetry_data', '95']:,.0f} and {cost['symmetry_none', '95']:,.0f} transfers",
        f"5° throughout is at 99 % after {cost['curriculum_none', '99']:,.0f} transfers; the default",
        f"serves 0.7° to 12°, after {cost['base', '99']:,.0f}.",
        f"solves {rate['epsilon_1']:.1f} %, at 10° {rate['epsilon_10']:.2f} %",
        f"At d = 330 mm {rate['distance_330']:.1f} % with {more['distance_330']:.0f} % more transfers",
        f"at 420 mm {rate['distance_420']:.2f} % and half a per cent more",
        f"solves {noisy['noise_execution']:.1f} % under it, more than the exact planner, which knows of none "
        f"({100 * planner['evaluations']['noise']['success_rate']['value']:.1f} %)",
        f"(inset 0.9) is worth {noisy['inset_90']:.1f} %",
        f"all solve {min(seen):.0f} to {max(seen):.0f} %",
    ):
        assert words in said
    assert round(more["distance_420"], 1) == 0.5
    assert f"it takes {100 * (steps['noise_execution'] / steps['base'] - 1):.0f} % more transfers for that" in said
    assert round(rate["base"] - rate["noise_execution"]) == 1
    assert min(rate[name] for name in ("her_final", "her_episode", "her_2", "her_4", "her_5")) > 99.8
    assert min(rate["no_previous"], rate["explore_area"]) > 99.9


def test_what_the_page_says_of_single_runs_is_what_they_say():
    said = " ".join(PAGE.split())
    random = json.loads((SINGLE / "random_a_30deg.json").read_text())
    assert (random["policy"], random["architecture"], random["epsilon_deg"]) == ("random", "A", 30.0)
    assert f"even with 30° it takes {random['mean_steps']:.1f} " in said
    judged = json.loads((LATER / "actor_and_critic.json").read_text())["rows"]
    ratio = {(row["branch"], row["place"]): f"{row['steps_ratio']:.3f}" for row in judged}
    for words in (
        f"that took {ratio['actor', 'actor']} times the optimum",
        f"solved all of them in {ratio['critic', 'critic']} times",
        f"the critic's places it was {ratio['actor', 'critic']}, with the critic's choice",
        f"choice and the actor's places {ratio['critic', 'actor']}",
    ):
        assert words in said
    short = [json.loads(path.read_text())["evaluation"] for path in sorted((LATER / "default_24k").glob("*.json"))]
    rates, ratios = [100 * found["success_rate"] for found in short], [found["steps_ratio"] for found in short]
    assert len(short) == 4
    assert f"brought {min(rates):.2f} to {max(rates):.2f} % at {min(ratios):.3f} to {max(ratios):.3f} times the optimum" in said
    at_once = json.loads((LATER / "default_3_to_0.7.json").read_text())["runs"]
    worst = min(at_once, key=lambda run: run["success_rate"])
    assert f"({100 * worst['success_rate']:.2f} % at {worst['steps_ratio']:.3f} the worst)" in said
    wide = json.loads((LATER / "random_a_40deg.json").read_text())
    assert (wide["policy"], wide["architecture"], wide["epsilon_deg"]) == ("random", "A", 40.0)
    assert f"and with 40° {wide['mean_steps']:.1f}." in said
    with open(LATER / "paper_b_40deg" / "metrics.csv", newline="", encoding="utf-8") as lines:
        last = list(csv.DictReader(lines))[-1]
    reached = f"{100 * float(last['success_rate']):.0f} % of its 1,000 validation problems after {int(last['step']):,} transfers"
    assert f"one run of B solves {reached} and {int(last['gradient_step']):,} gradient steps" in said
    raw = json.loads((SINGLE / "dqn_raw" / "evaluation.json").read_text())
    steps = json.loads((SINGLE / "dqn_raw" / "summary.json").read_text())["step"]
    assert f"Without both B's solves {100 * raw['success_rate']:.2f} % after {steps:,} transfers (one seed)" in said
    solved = []
    for seed in range(3):
        with open(SINGLE / "paper_b_training" / f"seed{seed}.csv", newline="", encoding="utf-8") as lines:
            solved += [float(row["training_success_rate"]) for row in csv.DictReader(lines) if row["step"] == "150000"]
    assert f"the same runs solve {100 * min(solved):.0f} to {100 * max(solved):.0f} % after 150,000 transfers" in said
    second = [json.loads((SINGLE / "twin_second" / f"ours_{name}.json").read_text()) for name in "ba"]
    of_50 = [f"{round(50 * report['success_rate'])} of 50" for report in second]
    assert f"a second run of ours, left out of the table: {of_50[0]} in B, {of_50[1]} in A" in said
