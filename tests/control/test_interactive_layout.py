"""The cell to play with, changed while it plays: arms and keep-out discs that are put somewhere, added, taken away, switched off."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.cell import build_cell, build_whole_cell, cell_config
from marl_handover.compose import from_yaml
from marl_handover.config import CellConfig, ObstacleConfig
from marl_handover.control.interactive import layout
from marl_handover.control.interactive.cell import InteractiveCell
from marl_handover.errors import InvalidSetting
from marl_handover.motion.planner import MotionPlanner

STEP_S = 0.05


@pytest.fixture(scope="module")
def triangle():
    return build_cell(cell_config("triangle"))


def playing(model, name="exact", seed=1):
    policy = policies.adapted(name, model.cell.config)
    return InteractiveCell(policy, build_whole_cell(policy.rules.cell.config), seed=seed)


@pytest.fixture
def cell(triangle):
    return playing(triangle)


def until(cell, *states, limit=4000):
    for _ in range(limit):
        snapshot = cell.advance(STEP_S)
        if snapshot.state in states:
            return snapshot
    raise AssertionError(f"still {snapshot.state}: {snapshot.message}")


def put(cell, name, **changes):
    cell.set_layout(replace(cell.layout, arms=[replace(arm, **changes) if arm.name == name else arm for arm in cell.layout.arms]))


def test_a_relaid_model_is_the_one_that_is_built_from_the_same_settings(triangle):
    config = layout.with_base(triangle.cell.config, "west", (-200.0, -150.0, 0.7))
    config = layout.with_disc(config, triangle.relaid(config))
    relaid, built = triangle.relaid(config), build_cell(config)
    assert relaid.cell.names == built.cell.names
    assert relaid.cell.keep_out == built.cell.keep_out
    assert list(relaid.cell.graph.edges) == list(built.cell.graph.edges)
    for one, other in zip(relaid.cell.arms, built.cell.arms, strict=True):
        assert one.base == other.base
        assert one.r_min_mm == pytest.approx(other.r_min_mm, abs=1.0)  # the fit is rounded to a mm, on a grid that lies elsewhere
        assert one.r_max_mm == pytest.approx(other.r_max_mm, abs=1.0)
        np.testing.assert_allclose(one.yaw_rad, other.yaw_rad, atol=0.01)
    for edge, space in relaid.cell.graph.edges.items():
        for one, other in zip(space.chart.arcs, built.cell.graph.edges[edge].chart.arcs, strict=True):
            np.testing.assert_allclose(one, other, atol=0.03)


def test_a_relaid_planner_plans_what_a_new_one_does(triangle):
    model = triangle.relaid(layout.with_base(triangle.cell.config, "west", (-200.0, -150.0, 0.7)))
    pick, place = model.cell.arms[1].at(220.0, np.array([-0.4, 0.5]))
    moved, new = MotionPlanner(triangle).relaid(model), MotionPlanner(model)
    np.testing.assert_array_equal(moved.homes_rad, new.homes_rad)
    one, other = (planner.pick_place(1, pick, place, planner.homes_rad[1], planner.others_home_rad(1)) for planner in (moved, new))
    for phase, its in zip(one.phases, other.phases, strict=True):
        np.testing.assert_array_equal(phase.joints_rad, its.joints_rad)


def test_arms_that_stay_go_on_from_where_they_are_and_the_block_gets_to_its_goal(cell):
    rng = np.random.default_rng(3)
    before = cell.advance(0.0)
    for _ in range(40):
        snapshot = cell.advance(STEP_S)
        arm = int(rng.integers(3))
        name, at = cell.layout.arms[arm].name, cell.layout.arms[arm]
        put(cell, name, x_mm=at.x_mm + rng.normal(), y_mm=at.y_mm + rng.normal(), facing_deg=at.facing_deg + rng.normal())
        before, snapshot = snapshot, cell.advance(0.002)
        others = [index for index in range(3) if index != arm]
        assert abs(snapshot.joints_rad[others] - before.joints_rad[others]).max() < 0.02
        assert snapshot.optimal == int(cell._controller.adapter.exact.plan(cell._controller.world.pose, snapshot.goal).transfers)
    if until(cell, "done", "stuck").state == "stuck":  # the goal was left behind
        cell.new_problem()
        cell.advance(0.0)
    assert until(cell, "done").solved


def test_a_block_in_the_hand_of_an_arm_that_is_carried_away_is_put_down(cell):
    for _ in range(4000):
        snapshot = cell.advance(0.02)
        if snapshot.phase == "transfer":
            break
    held = cell.model.cell.names[snapshot.arm]
    at = next(arm for arm in cell.layout.arms if arm.name == held)
    put(cell, held, x_mm=at.x_mm + 4.0)
    after = cell.advance(0.0)
    np.testing.assert_allclose(after.block, snapshot.block, atol=1.0)
    assert after.T_world_block[2, 3] == 0.0
    np.testing.assert_array_equal(after.joints_rad[snapshot.arm], cell._controller.programs.paths.homes_rad[snapshot.arm])
    assert until(cell, "done", "stuck").state == "done"


def test_a_layout_that_cannot_be_holds_everything_and_says_why_until_one_comes_that_can(cell):
    for _ in range(20):
        before = cell.advance(STEP_S)
    good = cell.layout
    north = good.arms[0]
    put(cell, "west", x_mm=north.x_mm + 10.0, y_mm=north.y_mm)
    broken = [cell.advance(STEP_S) for _ in range(5)][-1]
    assert broken.state == "broken"
    assert "'north', whose base stands there" in broken.message
    assert "\n" not in broken.message
    assert broken.t_s == before.t_s
    cell.set_goal(before.block)  # taken up, and done when the cell can be again
    cell.new_problem()
    assert cell.advance(STEP_S).state == "broken"
    cell.set_layout(good)
    assert until(cell, "done").state == "done"


def test_arms_that_cannot_pass_to_each_other_any_more_do_what_is_left(cell):
    put(cell, "north", y_mm=2000.0)
    cell.advance(0.0)
    assert [len(group) for group in cell.in_order.graph.components] == [1, 2]
    for _ in range(5):
        cell.new_problem()
        assert until(cell, "done", "stuck").state == "done"
    west = next(arm for arm in cell.model.cell.arms if arm.name == "west")
    north = next(arm for arm in cell.model.cell.arms if arm.name == "north")
    cell.set_block([*west.at(220.0, 0.0), 0.0])
    cell.set_goal([*north.at(220.0, 0.0), 0.0])
    stuck = until(cell, "stuck", "done")
    assert stuck.state == "stuck"
    assert "none can pass to one that reaches the goal" in stuck.message


def test_a_goal_that_nobody_reaches_any_more_is_said_and_reached_when_an_arm_comes_back(cell):
    north = next(arm for arm in cell.model.cell.arms if arm.name == "north")
    cell.set_goal([*north.at(300.0, 0.0), 0.4])
    until(cell, "done")
    good, goal = cell.layout, cell.advance(0.0).goal
    cell.set_block([*next(arm for arm in cell.model.cell.arms if arm.name == "west").at(200.0, 1.2), 0.0])
    cell.set_goal([*north.at(200.0, 1.5), 0.0])
    cell.advance(0.0)
    put(cell, "north", y_mm=2000.0)
    lost = until(cell, "stuck", "done")
    assert lost.state == "stuck"
    assert "goal" in lost.message
    assert "out of every arm's reach" in lost.message
    cell.set_layout(good)
    assert until(cell, "done", "stuck").state == "done"
    assert not np.array_equal(cell.advance(0.0).goal, goal)


@pytest.mark.parametrize("name", ["exact", "pretrained_any"])
def test_an_arm_that_is_switched_off_is_left_out_and_stands_in_the_way(triangle, name):
    cell = playing(triangle, name)
    cell.advance(0.5)
    cell.set_layout(layout.switched(cell.layout, "north"))
    until(cell, "done", "stuck")
    for _ in range(3):
        cell.new_problem()
        moved = set()
        while cell.advance(STEP_S).state not in ("done", "stuck"):
            moved.add(cell.advance(0.0).arm)
        assert cell.model.cell.names.index("north") not in moved
        assert len(cell.advance(0.0).joints_rad) == 3
    assert cell.in_order.names == ("west", "east")
    cell.set_layout(layout.switched(cell.layout, "north"))
    cell.advance(0.0)
    assert cell.in_order.names == ("north", "west", "east")


def test_an_arm_that_is_added_can_be_handed_to_and_one_that_is_removed_is_gone(cell, triangle):
    cell.advance(1.0)
    cell.set_layout(layout.with_arm(cell.layout, cell.model))
    cell.advance(0.0)
    assert cell.model.cell.graph.is_connected
    assert len(cell.advance(0.0).joints_rad) == 4
    cell.new_problem()
    assert until(cell, "done").state == "done"
    cell.set_layout(layout.without_arm(cell.layout, "north"))
    cell.advance(0.0)
    assert "north" not in cell.model.cell.names
    cell.set_layout(layout.without_arm(cell.layout, cell.layout.arms[-1].name))
    cell.advance(0.0)
    with pytest.raises(InvalidSetting, match="two arms at least"):
        layout.without_arm(cell.layout, "west")


def test_nothing_is_put_on_a_disc_that_is_dropped(cell):
    cell.advance(1.0)
    for _ in range(3):
        cell.set_layout(layout.with_disc(cell.layout, cell.model, cell.kept_clear()))
        cell.advance(0.0)
    assert len(cell.model.cell.keep_out) == 3
    assert cell.model.cell.is_clear(np.stack([cell.advance(0.0).goal])).all()
    for _ in range(4):
        cell.new_problem()
        snapshot = cell.advance(0.0)
        assert cell.model.cell.is_clear(np.array([placement.pose for placement in snapshot.plan])).all()
        assert until(cell, "done", "stuck").state == "done"


def test_a_policy_of_one_cell_does_not_play_in_another_one_and_does_again_when_that_is_back(model):
    cell = InteractiveCell(policies.load("pretrained_b"), model, seed=2)
    first = cell.layout
    cell.advance(0.5)
    placed = layout.placed_arms(first, model)
    cell.set_layout(layout.with_base(placed, "left", (10.0, 180.0, -math.pi / 2)))
    broken = cell.advance(0.1)
    assert broken.state == "broken"
    assert "pretrained_b" in broken.message
    cell.set_policy(policies.load("exact"))
    assert until(cell, "moving", "done").state in ("moving", "done")
    cell.set_policy(policies.load("pretrained_b"))
    assert cell.advance(0.1).state == "broken"
    cell.set_layout(first)
    assert until(cell, "done").state == "done"


def test_a_saved_cell_is_read_back_as_it_was(triangle, tmp_path):
    config = layout.with_arm(layout.with_base(triangle.cell.config, "west", (-200.04, 0.0, 0.7)), triangle)
    config = layout.switched(layout.with_disc(config, triangle.relaid(config)), "north")
    path = tmp_path / "mine.yaml"
    path.write_text(layout.file_text(config, "mine"))
    assert from_yaml(CellConfig, path) == replace(config, name="mine")
    assert build_whole_cell(from_yaml(CellConfig, path)).cell.num_arms == 4
    assert len(path.read_text().splitlines()) < 40


def test_the_pair_is_saved_with_places_and_stands_where_it_stood(model, tmp_path):
    placed = layout.placed_arms(model.cell.config, model)
    path = tmp_path / "pair.yaml"
    path.write_text(layout.file_text(placed, "pair"))
    built = build_cell(from_yaml(CellConfig, path)).cell
    for one, other in zip(built.arms, model.cell.arms, strict=True):
        np.testing.assert_allclose(one.base.matrix(), other.base.matrix(), atol=1e-9)
        assert (one.r_min_mm, one.r_max_mm) == (other.r_min_mm, other.r_max_mm)


def test_what_cannot_be_added_is_named(triangle):
    config = triangle.cell.config
    while len(config.arms) < 8:
        config = layout.with_arm(config, triangle.relaid(config))
    with pytest.raises(InvalidSetting, match="at most 8"):
        layout.with_arm(config, triangle.relaid(config))
    covered = replace(triangle.cell.config, obstacles=[ObstacleConfig(0.0, 0.0, 2000.0)])
    with pytest.raises(InvalidSetting, match="room for one more"):
        layout.with_disc(covered, triangle.relaid(covered))
    with pytest.raises(InvalidSetting, match="in order"):
        layout.switched(replace(triangle.cell.config, enabled=["west"]), "west")
