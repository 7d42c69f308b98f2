"""The executor agent: ends where it should, within its limits, and a reason where it declines."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.config import MotionConfig
from marl_handover.errors import UnknownChoice
from marl_handover.motion.executor import ExecutorAgent
from marl_handover.motion.trajectory import evaluate
from tests.canonical_arms import PARKED_DEG

MOTION = MotionConfig()
PARKED = np.radians(PARKED_DEG)


@pytest.fixture(scope="module", params=["paper", "al5a"])
def model(request):
    return build_cell(cell_config(request.param))


def world(model, arm, radius_mm, yaw_rad):
    """The table point (2,) at a distance and a base yaw of an arm."""
    base = model.cell.bases[arm]
    angle = base.facing_rad + yaw_rad
    return np.array([base.x_mm + radius_mm * math.cos(angle), base.y_mm + radius_mm * math.sin(angle)])


def asked(pick_mm, place_mm, joints=PARKED):
    """An arm's observation, as far as the agent reads it."""
    return {"object": np.float32([*pick_mm, 0.3]), "target": np.float32(place_mm), "joints": np.float32(joints), "other_joints": PARKED}


@pytest.mark.parametrize("arm", [0, 1])
def test_direct_cycles_end_level_at_pin_and_place(arm, model):
    """Over the whole annulus sector, its edges and corners included; by the arm's own forward kinematics."""
    cell, agent = model.cell, ExecutorAgent(("arm_left", "arm_right")[arm], model, "direct")
    random = np.random.default_rng(arm)
    sides = [(radius, yaw) for radius in (cell.r_min_mm, cell.r_max_mm) for yaw in (*cell.yaw_rad, 0.0)]
    inside = list(zip(random.uniform(cell.r_min_mm, cell.r_max_mm, 200), random.uniform(*cell.yaw_rad, 200), strict=True))
    for (radius, yaw), (other_radius, other_yaw) in zip(sides + inside, inside[:6] + inside[::-1], strict=True):
        action = agent.act(asked(world(model, arm, radius, yaw), world(model, arm, other_radius, other_yaw)))
        assert (action["grasp"], action["release"], agent.last_refusal) == (1, 1, None)
        approach, transfer, retreat = action["paths"].astype(float)
        np.testing.assert_array_equal(approach[-1], transfer[0])
        np.testing.assert_array_equal(transfer[-1], retreat[0])
        np.testing.assert_allclose([approach[0], retreat[-1]], [PARKED, PARKED], atol=1e-6)
        for joints, distance, angle in ((transfer[0], radius, yaw), (transfer[-1], other_radius, other_yaw)):
            T = model.arm.fk(joints)
            expected = [distance * math.cos(angle), distance * math.sin(angle), cell.pick_height_mm]
            np.testing.assert_allclose(T[:3, 3], expected, atol=0.01)
            np.testing.assert_allclose(T[:3, :3] @ [0, 0, 1], [0, 0, 1], atol=1e-5)  # pitch = roll = 0


def test_direct_paths_are_straight_and_within_limits(model):
    agent = ExecutorAgent("arm_left", model, "direct")
    action = agent.act(asked(world(model, 0, 170.0, -1.2), world(model, 0, 220.0, 1.3)))
    assert action["paths"].dtype == np.float32
    assert action["paths"].shape == (3, MOTION.control_points, 5)
    assert (action["paths"] >= model.arm.lower_rad.astype(np.float32)).all()
    assert (action["paths"] <= model.arm.upper_rad.astype(np.float32)).all()
    for path in action["paths"].astype(float):
        along = evaluate(path, np.linspace(0, 1, 20), MOTION.degree) - path[0]
        share = along @ (path[-1] - path[0]) / ((path[-1] - path[0]) ** 2).sum()
        np.testing.assert_allclose(along, share[:, None] * (path[-1] - path[0]), atol=1e-5)
        assert (np.diff(share) > 0).all()


def test_an_approach_starts_where_the_arm_is(model):
    joints = PARKED + [0.3, -0.2, 0.1, 0.0, 0.0]
    action = ExecutorAgent("arm_right", model, "direct").act(asked(world(model, 1, 200.0, 0.0), world(model, 1, 180.0, 0.4), joints))
    np.testing.assert_allclose(action["paths"][0, 0], joints, atol=1e-6)


@pytest.mark.parametrize("method", ["direct", "optimised"])
@pytest.mark.parametrize(("pick", "place"), [((400.0, 0.0), (200.0, 0.0)), ((200.0, 0.0), (60.0, 0.0)), ((2000.0, 0.0), (200.0, 0.0))])
def test_what_it_cannot_reach_it_declines_and_says_so(method, pick, place, model):
    agent = ExecutorAgent("arm_left", model, method)
    action = agent.act(asked(world(model, 0, *pick), world(model, 0, *place)))
    assert (action["grasp"], action["release"]) == (0, 0)
    assert np.isfinite(action["paths"]).all()
    assert agent.last_refusal
    assert agent.act(asked(world(model, 0, 200.0, 0.0), world(model, 0, 200.0, 0.5)))["grasp"] == 1
    assert agent.last_refusal is None


def test_optimised_cycles_have_the_same_ends(model):
    pick, place = world(model, 0, 200.0, -0.3), world(model, 0, 190.0, 0.6)
    optimised, direct = (ExecutorAgent("arm_left", model, method).act(asked(pick, place)) for method in ("optimised", "direct"))
    assert optimised["grasp"] == optimised["release"] == 1
    np.testing.assert_allclose(optimised["paths"][:, [0, -1]], direct["paths"][:, [0, -1]], atol=1e-3)


@pytest.mark.parametrize("arguments", [("supervisor",), ("arm_left", "paper", "quick")])
def test_unknown_agents_and_methods_are_named(arguments):
    with pytest.raises(UnknownChoice):
        ExecutorAgent(*arguments)
