"""A student drags goal and block at any time: each change is taken up as it should be."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from interactive_fuzz import (
    DT_S,
    EXACT_MM,
    Seen,
    fuzz,
    joints_of,
    least_gaps_mm,
    make,
    one_transfer,
    place,
    settle,
    some_pose,
    until,
)

from marl_handover import policies
from marl_handover.cell.build import build_cell, cell_config
from marl_handover.errors import InvalidSetting, NotFinite, OutOfReach


@pytest.fixture
def cell(model):
    return make(model)


def test_the_plan_is_what_then_happens(cell):
    first = cell.advance(DT_S)
    assert len(first.plan) == first.optimal
    assert first.plan[-1].final
    assert cell._controller.adapter.there(first.plan[-1].pose, first.goal)
    lain = [it.block for it in settle(cell) if it.phase == "retreat"]
    found = [pose for before, pose in pairwise(lain) if abs(pose - before).max() > 1e-6]
    assert np.allclose([lain[0], *found], [placement.pose for placement in first.plan], atol=1e-9)


def test_the_same_calls_give_the_same_motions(model):
    one, other = (fuzz(make(model, seed=4), 6, seed=5) for _ in range(2))
    assert np.array_equal(joints_of(one), joints_of(other))
    assert [it.message for it in one.snapshots] == [it.message for it in other.snapshots]


def test_the_goal_dragged_to_where_it_is_disturbs_nothing(model):
    quiet, asked = make(model), make(model)
    for step in range(700):
        if step % 20 == 10:
            asked.set_goal(asked.advance(0.0).goal)
        one, other = quiet.advance(DT_S), asked.advance(DT_S)
        assert np.allclose(one.joints_rad, other.joints_rad, atol=1e-6), step


@pytest.mark.parametrize("phase", ["approach", "grasp"])
def test_a_new_goal_for_the_same_arm_leaves_its_approach_alone(cell, phase):
    one_transfer(cell)
    before = until(cell, phase, steps=5)
    cell.set_goal(place(cell, 200.0, 30.0, turn_deg=100.0))
    after = cell.advance(DT_S)
    assert after.phase == phase
    assert after.arm == before.arm == 0
    assert np.allclose(after.plan[-1].pose, after.goal, atol=0.1)
    assert settle(cell)[-1].transfers == after.optimal == 1


def test_a_new_goal_in_mid_air_is_gone_for_at_once(cell):
    one_transfer(cell)
    until(cell, "transfer", steps=8)
    cell.set_goal(goal := place(cell, 210.0, 30.0, turn_deg=100.0))
    seen = settle(cell)
    assert all(it.T_world_block[2, 3] > 1.0 for it in seen if it.phase == "transfer")
    assert [it.phase for it in seen].count("grasp") == 0
    assert seen[-1].transfers == 1
    assert np.allclose(seen[-1].block, goal, atol=EXACT_MM)


def test_a_goal_dragged_to_where_the_block_was_picked_up_has_it_put_back(cell):
    start, _ = one_transfer(cell)
    until(cell, "transfer", steps=8)
    cell.set_goal(start)
    last = settle(cell)[-1]
    assert last.state == "done"
    assert np.allclose(last.block, start, atol=EXACT_MM)
    assert (last.transfers, last.optimal, last.episodes) == (1, 0, 0)


def test_a_goal_for_the_other_arm_makes_the_hand_put_the_block_down(cell):
    one_transfer(cell)
    until(cell, "transfer", steps=8)
    cell.set_goal(place(cell, 200.0, 40.0, arm=1))
    seen = settle(cell)
    assert seen[-1].state == "done"
    assert {it.arm for it in seen} >= {0, 1}


@pytest.mark.parametrize("phase", ["approach", "grasp", "lift", "transfer", "lower", "release", "retreat"])
def test_a_block_dragged_away_is_fetched_from_there(cell, phase):
    one_transfer(cell)
    until(cell, phase, steps=2)
    cell.set_block(away := place(cell, 200.0, 10.0, arm=1))
    after = cell.advance(DT_S)
    assert np.allclose(after.block, away)
    assert after.message
    assert settle(cell)[-1].state == "done"


def test_a_block_is_not_put_where_a_hand_is(cell):
    """All around a hand that leaves: it either keeps its clearance, or the block stays where it was."""
    one_transfer(cell)
    before = until(cell, "retreat")
    hand = before.block
    cell.pause()
    refused = 0
    for angle in np.linspace(0.0, 2 * math.pi, 24, endpoint=False):
        cell.set_block(wish := hand + (25 * math.cos(angle), 25 * math.sin(angle), 0.0))
        after = cell.advance(DT_S)
        if np.allclose(after.block[:2], wish[:2]):
            assert least_gaps_mm(cell, Seen([after], [True]))[1].min() >= cell.motion.block_clearance_mm - 1e-6
        else:
            assert np.array_equal(after.block, before.block)
            assert "in the way" in after.message
            refused += 1
        before = after
    assert 0 < refused < 24
    cell.resume()
    assert settle(cell)[-1].state == "done"


def test_changes_in_a_row_are_one_change_the_newest(cell):
    cell.advance(DT_S)
    random = np.random.default_rng(0)
    for _ in range(500):
        cell.set_goal(goal := some_pose(cell.model.cell, random))
    assert np.array_equal(cell.advance(DT_S).goal, goal)


@pytest.mark.parametrize("pose", [(0.0, 180.0, 0.0), (900.0, 0.0, 0.0), (1e200, 0.0, 0.0)])
def test_what_no_arm_reaches_is_refused_by_name(cell, pose):
    before = cell.advance(DT_S)
    for move in (cell.set_goal, cell.set_block):
        with pytest.raises(OutOfReach):
            move(pose)
    after = cell.advance(DT_S)
    assert np.array_equal(before.goal, after.goal)
    assert np.array_equal(before.block, after.block)


def test_what_is_no_pose_is_refused_by_name(cell, model):
    with pytest.raises(NotFinite):
        cell.set_goal([math.nan, 0, 0])
    with pytest.raises(InvalidSetting):
        cell.set_block([0.0, 0.0])
    with pytest.raises(InvalidSetting):
        cell.new_problem(-1)
    with pytest.raises(InvalidSetting):
        cell.advance(-0.1)
    other = policies.load("exact", build_cell(cell_config("al5a")).cell)
    with pytest.raises(InvalidSetting, match="al5a"):
        cell.set_policy(other)


def test_a_policy_may_be_changed_in_mid_motion(cell):
    cell.new_problem(1)
    for name in ("pretrained_a", "pretrained_b", "greedy", "exact"):
        until(cell, "approach", "transfer", steps=9)
        cell.set_policy(policies.load(name))
        assert cell.advance(DT_S).state == "moving"
    assert settle(cell)[-1].state == "done"


def test_a_random_policy_is_given_up_on(model):
    cell = make(model, "random")
    for _ in range(4):
        last = settle(cell, 2000.0)[-1]
        if last.state == "stuck":
            break
        cell.new_problem()
        cell.advance(DT_S)
    assert last.state == "stuck"
    assert last.episodes > last.solved
    assert last.message


def test_problems_of_a_seed_are_the_same_and_others_follow(model):
    cell = make(model, seed=9)
    first = cell.advance(0.0)
    cell.new_problem()
    second = cell.advance(0.0)
    cell.new_problem(9)
    again = cell.advance(0.0)
    assert np.array_equal(first.block, again.block)
    assert np.array_equal(first.goal, again.goal)
    assert not np.array_equal(first.block, second.block)
    assert again.transfers == 0
    assert again.episodes == 0
