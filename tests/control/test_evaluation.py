"""The figures of a closed-loop evaluation, against ones worked out by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from marl_handover.config import TaskConfig
from marl_handover.control.evaluation import loop_report, true_outcome, truly_solved
from marl_handover.control.transfers import Episode, Transfer, TransferCommand, TransferResult, trace_text
from marl_handover.envs.cycle_check import Refusal
from marl_handover.task.rules import Outcome, Rules

GOAL = np.array([100.0, 0.0, 0.5])


@pytest.fixture(scope="module")
def rules(model):
    return Rules(model.cell, TaskConfig(), physical=True)


def transfer(pose, predicted=GOAL, *, attempt=0, arm=0, final=True, refusal=None, outcome=Outcome.NONE, planning_ms=10.0, truth=None):
    result = TransferResult(np.array(pose, float), refusal, "", planning_ms, 4.0, 200.0, None if truth is None else np.array(truth, float))
    command = TransferCommand(arm, final, np.zeros(2), predicted[:2], np.array(predicted, float), True)
    over = outcome != Outcome.NONE
    return Transfer(attempt, GOAL, command, np.zeros(3), -1, result, -1.0, over, False, outcome)


def episode(*transfers, ended="success"):
    return Episode(GOAL, transfers, ended, 0.5)


def test_errors_are_of_the_first_final_placements(rules):
    report = loop_report(
        [
            episode(transfer([20.0, 0.0, 0.0], [20.0, 0.0, 0.0], final=False), transfer([103.0, 4.0, 0.5], outcome=Outcome.SUCCESS)),
            episode(
                transfer([100.0, 1.0, 0.6], outcome=Outcome.WRONG_ORIENTATION),
                transfer([100.0, 0.0, 0.5], attempt=1, outcome=Outcome.SUCCESS),
            ),
            episode(
                transfer([0.0, 0.0, 0.0], final=True, refusal=Refusal.MISSED_GRASP, outcome=Outcome.WRONG_POSITION),
                transfer([100.0, 0.0, 0.5], attempt=1, outcome=Outcome.SUCCESS),
            ),
            episode(transfer([0.0, 0.0, 0.0], refusal=Refusal.DECLINED, outcome=Outcome.WRONG_POSITION), ended="stuck"),
        ],
        rules,
    )
    assert report["success_in_the_end"] == 0.75
    assert report["ended"] == {"stuck": 1, "success": 3}
    assert report["position_error_mm"] == pytest.approx({"p50": 3.0, "p99": 4.96})
    assert report["orientation_error_deg"]["p50"] == pytest.approx(math.degrees(0.1) / 2)
    assert report["refusals"] == {"declined": 1, "missed_grasp": 1}
    assert report["transfers"] == 7
    assert report["episode_s"]["p50"] == 0.5


OFF = [
    ((0.0, 0.0, 0.0), Outcome.SUCCESS),
    ((6.0, 0.0, 0.0), Outcome.WRONG_POSITION),
    ((0.0, -6.0, 0.0), Outcome.WRONG_POSITION),
    ((0.0, 0.0, math.radians(6.0)), Outcome.WRONG_ORIENTATION),
    ((0.0, 0.0, math.radians(-6.0)), Outcome.WRONG_ORIENTATION),
    ((4.0, 0.0, math.radians(4.0)), Outcome.SUCCESS),
]
"""How far from the goal an object is, and what the rules, 5 mm and 5 degrees, say of it."""


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize(("seen_off", "seen_as"), OFF)
@pytest.mark.parametrize(("true_off", "truly"), OFF)
def test_the_verdict_goes_by_where_the_object_truly_is(model, architecture, seen_off, seen_as, true_off, truly):
    """Whatever the camera said, better or worse."""
    rules = Rules(model.cell, TaskConfig(architecture=architecture), physical=True)
    last = transfer(GOAL + seen_off, outcome=seen_as, truth=GOAL + true_off)
    played = episode(last, ended="success" if seen_as is Outcome.SUCCESS else "transfers")
    assert true_outcome(played, rules) is truly
    assert truly_solved(played, rules) is (seen_as is Outcome.SUCCESS and truly is Outcome.SUCCESS)
    assert loop_report([played], rules)["success_in_the_end"] == float(truly_solved(played, rules))
    assert loop_report([played], rules)["position_error_mm"]["p50"] == pytest.approx(math.hypot(*true_off[:2]))


def test_without_a_truth_the_loop_is_believed_and_no_truth_excuses_what_was_not_done(rules):
    seen = episode(transfer(GOAL + (6.0, 0.0, 0.0), outcome=Outcome.SUCCESS))
    assert true_outcome(seen, rules) is Outcome.SUCCESS
    assert truly_solved(seen, rules)
    for refusal, outcome in ((Refusal.DECLINED, Outcome.WRONG_POSITION), (Refusal.UNSEEN, Outcome.WRONG_POSITION)):
        refused = episode(transfer(GOAL, refusal=refusal, outcome=outcome, truth=GOAL), ended="stuck")
        assert true_outcome(refused, rules) is outcome
        assert not truly_solved(refused, rules)


def test_the_first_verdict_and_the_end_are_judged_each_at_its_own_transfer(rules):
    first = transfer(GOAL, outcome=Outcome.SUCCESS, truth=GOAL + (6.0, 0.0, 0.0))
    later = transfer(GOAL, attempt=1, outcome=Outcome.SUCCESS, truth=GOAL)
    assert (true_outcome(episode(first, later), rules), truly_solved(episode(first, later), rules)) == (Outcome.WRONG_POSITION, True)
    first, later = (one.result._replace(truth=other.result.truth) for one, other in ((first, later), (later, first)))
    swapped = episode(replace(transfer(GOAL, outcome=Outcome.SUCCESS), result=first), replace(transfer(GOAL, attempt=1), result=later))
    assert (true_outcome(swapped, rules), truly_solved(swapped, rules)) == (Outcome.SUCCESS, False)


def test_the_bias_is_along_and_across_the_arms_ray(rules):
    """Both arms place 2 mm too far out, and 1 mm to the left as seen from the base; that is nothing in common in world axes."""
    carried = []
    for arm, place in ((0, (0.0, 0.0)), (1, (0.0, 0.0)), (0, (180.0, 180.0)), (1, (-170.0, -180.0))):
        base = rules.cell.bases[arm]
        ray = np.array(place) - (base.x_mm, base.y_mm)
        ray /= np.linalg.norm(ray)
        reached = np.array(place) + 2 * ray + 1 * np.array([-ray[1], ray[0]])
        carried.append(episode(transfer([*reached, -3.14], [*place, 3.14], arm=arm, outcome=Outcome.SUCCESS)))
    report = loop_report(carried, rules)
    np.testing.assert_allclose(report["transfer_error_mm"]["bias"], [2.0, 1.0], atol=1e-9)
    assert report["transfer_error_mm"]["p95"] == pytest.approx(math.sqrt(5))
    turn = math.degrees(2 * math.pi - 6.28)  # the short way round
    assert report["transfer_error_deg"] == pytest.approx({"p50": turn, "p95": turn, "bias": turn})


def test_nothing_to_take_a_figure_from_is_null(rules):
    report = loop_report(
        [episode(transfer([0.0, 0.0, 0.0], refusal=Refusal.OUT_OF_REACH, outcome=Outcome.WRONG_POSITION), ended="stuck")], rules
    )
    assert report["position_error_mm"] == {"p50": None, "p99": None}
    assert report["transfer_error_mm"] == {"p50": None, "p95": None, "bias": None}
    json.dumps(report, allow_nan=False)


def test_the_trace_has_a_line_for_every_transfer(rules):
    lines = [
        json.loads(line)
        for line in trace_text(
            [
                episode(transfer([1.0, 2.0, 0.3], refusal=Refusal.MISSED_GRASP, outcome=Outcome.WRONG_POSITION), transfer(GOAL, attempt=1)),
                episode(transfer(GOAL, outcome=Outcome.SUCCESS)),
            ],
            rules,
        ).splitlines()
    ]
    assert [(line["episode"], line["step"], line["attempt"]) for line in lines] == [(0, 0, 0), (0, 1, 1), (1, 0, 0)]
    assert [line["refusal"] for line in lines] == ["missed_grasp", None, None]
    assert [line["outcome"] for line in lines] == ["wrong_position", None, "success"]
    assert lines[0]["next_state"] == [1.0, 2.0, 0.3]
