"""``evaluate layouts=...``: many random cells at once give what each gives alone, and what cannot be meant is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.cli import main
from marl_handover.config import LayoutConfig, NoiseConfig, TaskConfig
from marl_handover.learning.evaluation import evaluate, evaluate_in_cells, problems_in_cells
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Outcome

FEW = ["layouts.count=6", "episodes=30", "progress=false"]


def report_of(folder, *arguments):
    assert main(["evaluate", *FEW, f"json={folder / 'report.json'}", *arguments]) == 0
    return json.loads((folder / "report.json").read_text())


@pytest.fixture(scope="module")
def posed():
    """Problems of cells of 2 to 4 arms with discs, by number of arms."""
    return problems_in_cells(LayoutConfig(arms=[2, 4], obstacles=[0, 2]), 12, TaskConfig(), 60, 3)


def test_what_is_drawn_can_be_solved_in_a_cell_with_that_many_arms(posed):
    numbers = np.concatenate([each.numbers for each in posed.values()])
    assert len(set(numbers)) == len(numbers) == 60 - sum(each.unsolvable for each in posed.values())
    for size, each in posed.items():
        rows_seen = []
        for rules, rows in each.layouts():
            assert rules.cell.num_arms == size
            plan = ExactPlanner(rules).plan(each.start[rows], each.goal[rows])
            assert plan.transfers.tolist() == each.optimal[rows].tolist()
            assert (each.optimal[rows] > 0).all()
            rows_seen += rows.tolist()
        assert sorted(rows_seen) == list(range(len(each.numbers)))


def test_a_batch_of_cells_gives_what_each_cell_gives_alone(posed):
    policy = policies.load("pretrained_any")
    for each in posed.values():
        together = evaluate_in_cells(each, lambda rules: policy.under(rules).act).episodes
        for rules, rows in each.layouts():
            alone = evaluate(rules, policy.under(rules).act, (each.start[rows], each.goal[rows])).episodes
            assert alone.outcome.tolist() == together.outcome[rows].tolist()
            assert alone.transfers.tolist() == together.transfers[rows].tolist()
            np.testing.assert_allclose(alone.pose, together.pose[rows], atol=1e-3)


def test_noise_reaches_a_batch_of_cells(posed):
    noisy = TaskConfig(noise=NoiseConfig(position_mm=20.0, observed_deg=20.0))
    policy, (size, each) = policies.load("pretrained_any"), next(iter(posed.items()))
    shaken = each._replace(rules=type(each.rules)(each.rules.cell, noisy))
    runs = [evaluate_in_cells(shaken, lambda rules: policy.under(rules).act, seed).episodes for seed in (0, 0, 1)]
    assert size == 2
    np.testing.assert_array_equal(runs[0].pose, runs[1].pose)
    assert not np.array_equal(runs[0].pose, runs[2].pose)
    assert (runs[0].outcome == int(Outcome.WRONG_POSITION)).any()


@pytest.mark.parametrize("policy", ["exact", "greedy", "random", "pretrained_any", "shielded:pretrained_any"])
def test_every_policy_of_any_cell_is_judged(tmp_path, policy):
    report = report_of(tmp_path, f"policy={policy}", "layouts.arms=[2,4]")
    assert report["episodes"] + report["unsolvable"] == 30
    assert report["layouts"] == 6
    assert set(report["by_arms"]) <= {"2", "3", "4"}
    for key in ("episodes", "unsolvable"):
        assert sum(part[key] for part in report["by_arms"].values()) == report[key]
    mean = sum(part["episodes"] * part["success_rate"] for part in report["by_arms"].values()) / report["episodes"]
    assert mean == pytest.approx(report["success_rate"])
    if policy == "exact":
        assert report["success_rate"] == report["steps_ratio"] == 1.0


def test_a_seed_decides_and_another_is_another(tmp_path):
    def timeless(report):
        return {key: value for key, value in report.items() if key not in ("decision_us", "wall_s", "by_arms")}

    first, again, other = (timeless(report_of(tmp_path, "policy=exact", f"seed={seed}")) for seed in (1, 1, 2))
    assert first == again
    assert first["mean_steps"] != other["mean_steps"]


def test_architecture_a_is_judged_too(tmp_path):
    report = report_of(tmp_path, "policy=exact", "architecture=A", "layouts.arms=[3,3]")
    assert report["architecture"] == "A"
    assert report["success_rate"] == report["steps_ratio"] == 1.0


@pytest.mark.parametrize("policy", ["exact", "pretrained_any"])
def test_an_arm_goes_out_of_order_in_random_cells(tmp_path, policy):
    report = report_of(tmp_path, f"policy={policy}", "layouts.arms=[3,4]", "outage.arm=random")
    outage = report["outage"]
    assert 0 < outage["solvable"] < outage["episodes"] <= report["episodes"]
    assert outage["solved"] == outage["solvable"] if policy == "exact" else outage["solved"] > 0


def test_the_table_has_a_line_for_each_number_of_arms(capsys):
    assert main(["evaluate", *FEW, "policy=exact", "layouts.arms=[3,3]"]) == 0
    shown = capsys.readouterr().out
    assert "6 random cells; problems that no plan solves, left out: " in shown
    assert any(line.split()[:1] == ["3"] and "100.00%" in line for line in shown.splitlines())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["layouts.arms=[2,9]"], "layouts.arms"),
        (["layouts.arms=[4,3]"], "layouts.arms = [4, 3]: must be the least first"),
        (["layouts.count=0"], "layouts.count"),
        (["layouts.legs=4"], "legs"),
        (["layouts.arms=[2,3]", "backend=noisy"], "backend = 'noisy': must be kinematic with layouts"),
        (["layouts.arms=[2,3]", "cell=triangle"], "left out with layouts"),
        (["layouts.arms=[2,3]", "problems=some.jsonl"], "problems = 'some.jsonl': must be left out with layouts"),
        (["layouts.arms=[2,3]", "trace=t.jsonl"], "left out with layouts"),
        (["layouts.arms=[2,3]", "policy=pretrained_b"], "left out for policy=pretrained_b"),
        (["layouts.arms=[2,3]", "task.reward.motion_weight=1"], "task.reward.motion_weight = 1.0: must be 0 for random cells"),
        (["layouts.spacing_mm=[900,950]"], "such that arms can pass to each other"),
    ],
)
def test_what_cannot_be_meant_is_named_in_one_line(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "policy=exact", "progress=false", "episodes=5", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert len(error) <= 301


def test_no_problem_to_judge_is_failed_work(capsys):
    arguments = ["policy=exact", "progress=false", "layouts.arms=[5,5]", "layouts.count=1", "episodes=1", "max_steps=1", "epsilon_deg=0.1"]
    assert main(["evaluate", *arguments]) == 1
    assert "no plan solves any of 1 random problems" in capsys.readouterr().err
