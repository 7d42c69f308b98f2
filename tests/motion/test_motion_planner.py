"""Planned motions: what they promise, against the cell's own kinematics; refusals by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from marl_handover.cell.build import build_cell, cell_config
from marl_handover.config import ArmConfig, CellConfig, MotionConfig
from marl_handover.errors import InvalidSetting, NotFinite, UnknownChoice
from marl_handover.geometry.capsules import ground_clearance_mm, self_clearance_mm
from marl_handover.motion.executor import ExecutorAgent
from marl_handover.motion.path_optimizer import NoPath
from marl_handover.motion.planner import MotionPlanner, string_length
from marl_handover.motion.trajectory import PHASES, OutOfArmsReach, evaluate


def place(model, arm, r, yaw):
    """The world position (2,) at polar coordinates of an arm's base frame."""
    base = model.cell.bases[arm]
    return np.array([base.x_mm + r * np.cos(base.facing_rad + yaw), base.y_mm + r * np.sin(base.facing_rad + yaw)])


radii, yaws = st.floats(150, 230), st.floats(-np.pi / 2, np.pi / 2)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 1), radii, yaws, radii, yaws)
def test_a_cycle_is_continuous_within_limits_and_clear(model, planner, arm, r1, a1, r2, a2):
    pick, put = place(model, arm, r1, a1), place(model, arm, r2, a2)
    motion = planner.pick_place(arm, pick, put, planner.home_rad, planner.home_rad)
    assert [phase.name for phase in motion.phases] == [name for name in PHASES if name in {phase.name for phase in motion.phases}]
    joints = np.concatenate([phase.joints_rad for phase in motion.phases])
    times = np.concatenate([phase.t_s for phase in motion.phases])
    assert (np.diff(times) >= 0).all()
    assert np.diff(times).max() <= 0.02 + 1e-9
    np.testing.assert_allclose(joints[[0, -1]], np.tile(planner.home_rad, (2, 1)), atol=1e-9)
    assert (joints >= model.arm.lower_rad - 1e-9).all()
    assert (joints <= model.arm.upper_rad + 1e-9).all()
    named = {phase.name: phase for phase in motion.phases}
    for q, world in ((named["grasp"].joints_rad[-1], pick), (named["release"].joints_rad[0], put)):
        T = model.arm.fk(q)
        expected = planner.in_base(arm, world)
        np.testing.assert_allclose(T[:3, 3], [*expected, planner.pick_height_mm], atol=0.05)
        np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-6)
    assert ground_clearance_mm(model.arm, joints).min() >= planner.motion.ground_clearance_mm
    assert self_clearance_mm(model.arm, joints).min() > 0
    heights = model.arm.fk(np.concatenate([named[name].joints_rad for name in ("lift", "transfer", "lower") if name in named]))[:, 2, 3]
    assert heights.min() >= planner.pick_height_mm - 1e-6
    assert motion.path_length_mm >= np.linalg.norm(pick - put) - 1e-6
    assert motion.min_clearance_mm >= planner.motion.arm_clearance_mm


def test_the_mirrored_arm_moves_alike(model, planner):
    """The arms are one model, turned: the same polar problem has the same joints."""
    motions = []
    for arm in range(2):
        motions.append(
            planner.pick_place(arm, place(model, arm, 170, 0.7), place(model, arm, 200, -0.5), planner.home_rad, planner.home_rad)
        )
    for left, right in zip(motions[0].paths, motions[1].paths, strict=True):
        np.testing.assert_allclose(left, right, atol=1e-6)


def test_one_problem_one_path(model, planner):
    other = np.array([-0.3, 1.0, -2.2, 1.2, 0.0])
    again = MotionPlanner(model)
    paths = [p.transfer(0, place(model, 0, 160, 1.2), place(model, 0, 220, -0.9), other) for p in (planner, again)]
    np.testing.assert_array_equal(paths[0].points, paths[1].points)


def test_a_path_keeps_clear_of_an_arm_in_its_way(model, planner):
    """The other arm reaches into the middle; the straight way is through it."""
    other = np.append(model.arm.ik([190.0, 0.0, 60.0])[0, :4], 0.0)
    pick, put = place(model, 0, 175, 1.1), place(model, 0, 175, -1.1)
    segment, guesses = planner.carrying(0, pick, put, other)
    from marl_handover.motion.initial_guesses import fit_control_points

    plain = evaluate(fit_control_points(list(guesses)[1], segment.collision_model.limits, 9, 5), np.linspace(0, 1, 201), 5)
    assert segment.check(plain)[0].arm < 0, "the plain way should be blocked, or nothing is tested"
    found = planner.transfer(0, pick, put, other)
    margins, length = segment.check(evaluate(found.points[:, :4], np.linspace(0, 1, 4001), 5))
    assert margins.arm > -0.01  # between the checked samples too
    assert length >= segment.lower_bound_mm


def test_a_place_under_the_other_arm_is_refused_by_name(model, planner):
    other = np.append(model.arm.ik([180.0, 0.0, 45.0])[0, :4], 0.0)
    with pytest.raises(NoPath, match="the end pose is .* mm short of the clearance to the other arm") as caught:
        planner.transfer(0, place(model, 0, 200, 1.0), place(model, 0, 180, 0.0), other)
    assert caught.value.reason == "end"
    assert caught.value.shortfall_mm > 0


def test_places_without_a_way_are_refused_after_a_search(planner):
    """Problems in which the other arm hangs over an end; the long search and RRT-Connect found no way either."""
    rows = [json.loads(line) for line in (Path(__file__).parents[2] / "bench/data/no_way.jsonl").read_text("utf-8").splitlines()]
    for row in rows[:2]:
        with pytest.raises(NoPath, match="no collision-free path among 16 starts; the nearest miss is") as caught:
            planner.transfer(row["arm"], *(np.array(row[key]) for key in ("pick_mm", "place_mm", "other_rad")))
        assert (caught.value.reason, caught.value.starts) == ("path", 16)
        assert caught.value.shortfall_mm > 0


def test_the_string_is_a_lower_bound(model, planner):
    generator = np.random.default_rng(3)
    for _ in range(10):
        pick, put = (place(model, 0, *generator.uniform([150, -1.5], [230, 1.5])) for _ in range(2))
        found = planner.transfer(0, pick, put, planner.home_rad)
        distance = float(np.linalg.norm(pick - put))
        share = min(1.0, distance / 50)
        bound = string_length(distance, 25.0 * share, 40.0 * share)
        assert found.length_mm >= bound - 0.05
        assert bound >= distance


def test_putting_it_back_where_it_is_goes_nowhere(model, planner):
    at = place(model, 1, 190, 0.2)
    motion = planner.pick_place(1, at, at, planner.home_rad, planner.home_rad)
    assert motion.path_length_mm < 1.0


def test_the_papers_method_plans_a_cycle_too(model):
    planner = MotionPlanner(model, MotionConfig(method="paper"))
    pick, put = place(model, 0, 180, 0.4), place(model, 0, 190, -0.3)
    motion = planner.pick_place(0, pick, put, planner.home_rad, planner.home_rad)
    assert len(motion.paths.transfer) == 7
    best = MotionPlanner(model).transfer(0, pick, put, planner.home_rad)
    assert motion.path_length_mm == pytest.approx(best.length_mm, rel=0.05)
    with pytest.raises(InvalidSetting, match="motion.method"):
        ExecutorAgent("arm_left", model, motion=MotionConfig(method="paper"))


def test_an_approach_comes_down_on_the_pin(model, planner):
    """Beside the pin, at the fingers' inner width and less, the fingertips are above its top."""
    pick = place(model, 0, 160, 0.9)
    found = planner.reach(0, planner.home_rad, pick, planner.home_rad, leaving=False)
    T = model.arm.fk(evaluate(found.points, np.linspace(0, 1, 501), 5))
    away = np.linalg.norm(T[:, :2, 3] - planner.in_base(0, pick), axis=1)
    beside = (away > 10) & (away < 25)
    assert (T[beside, 2, 3] - 6 > model.cell.config.block.pin_top_mm).all()


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"pick_mm": [400.0, 0.0]}, OutOfArmsReach, "cannot pick up at"),
        ({"place_mm": [0.0, -179.0]}, OutOfArmsReach, "cannot place at"),
        ({"pick_mm": [np.nan, 0.0]}, NotFinite, "pick_mm"),
        ({"place_mm": [1.0, 2.0, 3.0]}, InvalidSetting, "place_mm"),
        ({"joints_rad": np.zeros(4)}, InvalidSetting, "joints_rad"),
        ({"joints_rad": np.radians([0.0, 140.0, -115.0, 70.0, 30.0])}, InvalidSetting, "wrist roll 0"),
        ({"joints_rad": np.radians([120.0, 140.0, -115.0, 70.0, 0.0])}, InvalidSetting, "joints_rad"),
        ({"other_joints_rad": np.full(5, np.inf)}, NotFinite, "other_joints_rad"),
    ],
)
def test_bad_commands_are_named(model, planner, changes, error, text):
    command = {
        "arm": 0, "pick_mm": place(model, 0, 190, 0.3), "place_mm": place(model, 0, 170, -0.3), "joints_rad": planner.home_rad,
        "other_joints_rad": planner.home_rad,
    }  # fmt: skip
    with pytest.raises(error, match=text):
        planner.pick_place(**{**command, **changes})


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("arm_clearance_mm", -1.0), ("lift_scale_mm", 0.0), ("velocity_scale", 1.5), ("control_points", 6), ("degree", 2),
        ("num_initial_guesses", 0), ("sample_s", 0.1), ("parked_deg", [0.0, 0.0, 0.0, 0.0, 0.0]), ("parked_deg", [0.0, 140.0]),
    ],
)  # fmt: skip
def test_bad_settings_are_named(model, setting, value):
    with pytest.raises(InvalidSetting, match=f"motion.{setting}"):
        MotionPlanner(model, MotionConfig(**{setting: value}))


def test_the_papers_method_has_its_own_degree(model):
    with pytest.raises(InvalidSetting, match="motion.degree = 4: must be 5 with motion.method=paper"):
        MotionPlanner(model, MotionConfig(method="paper", degree=4))


def test_an_unknown_method_is_named(model):
    with pytest.raises(UnknownChoice, match="motion.method = 'ompl' is not known; choose one of: optimised, paper"):
        MotionPlanner(model, MotionConfig(method="ompl"))


def test_the_other_shipped_cell_moves_too():
    model = build_cell(cell_config("al5a"))
    planner = MotionPlanner(model)
    generator = np.random.default_rng(5)
    for _ in range(5):
        low, high = [model.cell.r_min_mm, model.cell.yaw_rad[0]], [model.cell.r_max_mm, model.cell.yaw_rad[1]]
        pick, put = (place(model, 1, *generator.uniform(low, high)) for _ in range(2))
        motion = planner.pick_place(1, pick, put, planner.home_rad, planner.home_rad)
        assert motion.min_clearance_mm >= planner.motion.arm_clearance_mm


def test_each_other_arm_is_avoided_where_it_stands():
    """With three arms: rows of obstacles are those of the two others, each at its own joints; one vector for both is refused."""
    places = [(0.0, 207.8, -90.0), (-180.0, -103.9, 30.0), (180.0, -103.9, 150.0)]
    arms = [ArmConfig(f"arm{k}", *place) for k, place in enumerate(places)]
    three = MotionPlanner(build_cell(replace(CellConfig(grid_mm=10.0), arms=arms)))
    reaching = np.array([0.2, 1.2, -2.2, 1.0, 0.0])
    base = three.model.cell.bases[0]
    pick, place = base.around(180.0, np.array([-0.9, 0.9]))
    home, one = np.tile(three.home_rad, (2, 1)), np.stack([reaching, three.home_rad])
    alone, with_one = (three.carrying(0, pick, place, joints)[0].scene.obstacles for joints in (home, one))
    assert len(alone) == len(with_one) == 2 * len(three.collision_model.capsules)
    half = len(alone) // 2
    np.testing.assert_array_equal(alone[half:], with_one[half:])
    assert abs(alone[:half] - with_one[:half]).max() > 10.0
    motion = three.pick_place(0, pick, place, three.home_rad, home)
    assert motion.min_clearance_mm >= three.motion.arm_clearance_mm
    with pytest.raises(InvalidSetting, match=r"other_joints_rad = \(5,\): must be an array of shape \(2, 5\)"):
        three.pick_place(0, pick, place, three.home_rad, three.home_rad)
