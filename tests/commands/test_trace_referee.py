"""Traces of ``evaluate`` before a referee that knows the rules only from their definitions."""

from __future__ import annotations

import copy
import json
import math

import numpy as np
import pytest

from marl_handover.cli import main
from tests.oracles.layouts import Layout, random_layout
from tests.oracles.trace_referee import judged_exact, referee

SECTOR = {"r_min_mm": 150.0, "r_max_mm": 230.0, "yaw_range_rad": [-math.pi / 2, math.pi / 2]}
PAIR = Layout(
    [
        {"name": "L", "x_mm": 0.0, "y_mm": 180.0, "facing_rad": -math.pi / 2, **SECTOR},
        {"name": "R", "x_mm": 0.0, "y_mm": -180.0, "facing_rad": math.pi / 2, **SECTOR},
    ],
    [],
)


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def played(folder, *arguments):
    trace = folder / "trace.jsonl"
    assert main(["evaluate", "progress=false", f"trace={trace}", *arguments]) == 0
    return lines(trace)


def posed(trace):
    return [{"state": row["state"], "goal": row["goal"]} for row in trace if row["step"] == 0]


@pytest.fixture(scope="module")
def trace(tmp_path_factory):
    """Twenty exact episodes of the shipped pair."""
    return played(tmp_path_factory.mktemp("exact"), "policy=exact", "episodes=20")


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_the_pair_is_played_by_the_rules_and_in_the_fewest_transfers(tmp_path, architecture):
    trace = played(tmp_path, "policy=exact", "episodes=300", f"architecture={architecture}")
    verdicts = referee(posed(trace), trace, pair=PAIR)
    assert judged_exact(verdicts) == []
    assert verdicts.steps == len(trace) > 600
    assert verdicts.ratio == 1.0


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize("policy", ["random", "greedy"])
def test_other_policies_play_by_the_rules_too(tmp_path, policy, architecture):
    trace = played(tmp_path, f"policy={policy}", "episodes=100", f"architecture={architecture}")
    verdicts = referee(posed(trace), trace, pair=PAIR)
    assert verdicts.wrong == []
    assert judged_exact(verdicts)  # they are not optimal


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda row: row.update(arm="R" if row["arm"] == "L" else "L"), "cannot do this|too far"),
        (lambda row: row["next_state"].__setitem__(2, row["next_state"][2] + 1e-4), "too far"),
        (lambda row: row["place"].__setitem__(0, row["place"][0] + 0.01), "leaves the object|final, but to"),
        (lambda row: row.update(reward=row["reward"] + 1), "reward"),
        (lambda row: row.update(outcome="timeout"), "outcome timeout"),
        (lambda row: row.update(terminated=not row["terminated"]), "terminated"),
        (lambda row: row.update(truncated=True), "truncated"),
        (lambda row: row.update(previous_arm=row["arm"]), "previous_arm"),
        (lambda row: row.update(final=not row["final"]), "outcome|terminated|final"),
        (lambda row: row["state"].__setitem__(1, row["state"][1] + 0.01), "the object is at"),
        (lambda row: row["goal"].__setitem__(2, row["goal"][2] + 0.01), "not the problem's"),
        (lambda row: row.update(alpha=1.5), "chart point"),
    ],
)
def test_the_referee_sees_what_is_wrong(trace, change, words):
    for number in (0, 7, len(trace) - 1):
        forged = copy.deepcopy(trace)
        change(forged[number])
        said = referee(posed(trace), forged, pair=PAIR).wrong
        assert any(word in line for line in said for word in words.split("|"))


def test_the_referee_sees_a_detour_and_a_missing_step(trace, tmp_path):
    shortened = [row for row in trace if not (row["episode"] == 0 and row["step"] == 0)]
    assert referee(posed(trace), shortened, pair=PAIR).wrong
    greedy = played(tmp_path, "policy=greedy", "episodes=100")
    assert any("are enough" in line for line in judged_exact(referee(posed(greedy), greedy, pair=PAIR)))


def problems_in_many_layouts(layouts, each, seed, counts=range(2, 9)):
    """Lines of a problems file: 2 to 8 arms, equal and mixed rings, near and far, 0 to 4 discs; a few problems in each layout."""
    draw, rows = np.random.default_rng(seed), []
    for index in range(layouts):
        count = counts[index % len(counts)]
        layout = random_layout(draw, count, mixed=draw.random() < 0.7, close=draw.random() < 0.4, discs=draw.choice([0, 1, 2, 4]))
        for start, goal in zip(*layout.sample_problems(each, draw), strict=True):
            row = {"state": start.tolist(), "goal": goal.tolist(), "arms": layout.arms, "note": "other keys are ignored"}
            rows.append(row | ({"obstacles": layout.obstacles} if layout.obstacles else {}))
    return [rows[index] for index in draw.permutation(len(rows))]


def judge_exact_policy(folder, problems, architecture):
    """Play the problems with the exact policy; the referee, and the command's own report, must find nothing wrong."""
    given, report = folder / "problems.jsonl", folder / "report.json"
    given.write_text("".join(json.dumps(problem) + "\n" for problem in problems))
    trace = played(folder, "policy=exact", f"problems={given}", f"architecture={architecture}", f"json={report}")
    verdicts, told = referee(problems, trace), json.loads(report.read_text())
    assert judged_exact(verdicts) == []
    assert verdicts.ratio == told["steps_ratio"] == 1.0
    assert told["episodes"] == len(problems)
    assert told["outcomes"]["success"] == np.count_nonzero(verdicts.transfers) > 0.9 * len(problems)
    solved = [made for made in verdicts.transfers if made]
    assert told["mean_steps_success"] == pytest.approx(np.mean(solved), abs=1e-6)
    return verdicts


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_problems_with_cells_of_their_own_are_played_in_the_fewest_transfers(tmp_path, architecture):
    judge_exact_policy(tmp_path, problems_in_many_layouts(7, 8, 0), architecture)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7, 8])
def test_two_thousand_problems_are_played_in_the_fewest_transfers(tmp_path, count, architecture):
    problems = problems_in_many_layouts(100, 20, count, [count])
    verdicts = judge_exact_policy(tmp_path, problems, architecture)
    print(f"{count} arms, {architecture}: {verdicts.steps} steps, mean {np.mean(verdicts.transfers):.3f} transfers")
