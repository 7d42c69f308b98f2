"""What the interactive cell foresees is what the rule book says, by the command that solves a problem from end to end."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.cell.build import build_cell, cell_config
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.commands.plan import solve
from marl_handover.config import MotionConfig, TaskConfig
from marl_handover.control.interactive.controller import PolicyAdapter, Score
from marl_handover.errors import InvalidSetting
from marl_handover.learning.evaluation import random_problems
from marl_handover.task.planner import ExactPlanner


def adapter_of(model, name):
    return PolicyAdapter(policies.load(name), model, MotionConfig())


@pytest.mark.parametrize("name", ["exact", "greedy", "pretrained_a", "pretrained_b"])
def test_the_rollout_is_what_the_rule_book_makes_of_the_policy(model, name):
    adapter = adapter_of(model, name)
    for start, goal in zip(*random_problems(adapter.rules, 30, 0), strict=True):
        rolled = adapter.rollout(start, goal, -1, adapter.command(start, goal, -1))
        solved = solve(adapter.policy, start, goal)
        if solved["outcome"] != "success":
            continue
        assert [(ARM_LETTERS[it.arm], it.final) for it in rolled] == [(it["arm"], it["final"]) for it in solved["transfers"]]
        assert np.allclose([it.pose for it in rolled], [it["to"] for it in solved["transfers"]], atol=1e-9)
        assert adapter.there(rolled[-1].pose, goal)


def test_the_optimum_is_the_exact_planners_and_none_at_the_goal(model):
    adapter = adapter_of(model, "pretrained_b")
    starts, goals = random_problems(adapter.rules, 30, 1)
    wanted = ExactPlanner(adapter.rules).plan(starts, goals).transfers
    assert [adapter.optimum(start, goal) for start, goal in zip(starts, goals, strict=True)] == wanted.tolist()
    assert adapter.optimum(goals[0], goals[0]) == 0


def test_a_block_is_at_the_goal_within_epsilon_of_its_turn(model):
    adapter = adapter_of(model, "exact")
    goal = random_problems(adapter.rules, 1, 2)[1][0]
    for off_deg, there in ((0.0, True), (4.9, True), (-4.9, True), (5.1, False), (180.0, False)):
        assert adapter.there(goal + (0.0, 0.0, math.radians(off_deg)), goal) is there
    assert not adapter.there(goal + (0.1, 0.0, 0.0), goal)


def test_a_rollout_that_leads_nowhere_ends(model):
    adapter = adapter_of(model, "random")
    for start, goal in zip(*random_problems(adapter.rules, 20, 3), strict=True):
        first = adapter.command(start, goal, -1)
        assert len(adapter.rollout(start, goal, -1, first)) <= TaskConfig().max_steps
    assert adapter.rollout(start, goal, -1, None) == ()


def test_a_policy_for_another_cell_is_refused(model):
    with pytest.raises(InvalidSetting, match="al5a"):
        PolicyAdapter(policies.load("exact", build_cell(cell_config("al5a")).cell), model, MotionConfig())


def test_another_part_of_the_chart_is_the_same_cell(model):
    policy = policies.load("exact", model.cell.with_inset(0.9))
    assert PolicyAdapter(policy, model, MotionConfig()).rules.cell.config.chart_inset == 0.9


def test_the_score_by_hand():
    score = Score()
    assert math.isnan(score.ratio)
    score.add(True, 4, 2)
    score.add(False, 30, 3)
    score.add(True, 3, 3)
    assert (score.episodes, score.solved, score.ratio) == (3, 2, 1.5)
