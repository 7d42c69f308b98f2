"""The closed-form cell against its definition and against the URDF's own kinematics."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from marl_handover.cell import LEFT, RIGHT, build_cell, cell_config
from marl_handover.geometry.se3 import transform
from marl_handover.task.problems import sample_positions
from marl_handover.task.rules import Command


@pytest.fixture(scope="module", params=["paper", "al5a"])
def model(request):
    return build_cell(cell_config(request.param))


def reachable(model, count: int, seed: int, arm: int) -> np.ndarray:
    points = sample_positions(model.cell, 4 * count, torch.Generator().manual_seed(seed)).numpy()
    return points[model.cell.reaches(points)[:, arm]][:count]


def base_frame(model, arm: int) -> np.ndarray:
    """T_world_base in mm."""
    base = model.cell.bases[arm]
    return transform((base.x_mm, base.y_mm, 0.0), (0.0, 0.0, math.atan2(base.facing[1], base.facing[0])))


def held(model, arm: int, points: np.ndarray) -> np.ndarray:
    """T_world_grip (n, 4, 4) with the pin held at table points (n, 2), through the URDF's inverse and forward kinematics."""
    T_world_base = base_frame(model, arm)
    world = np.concatenate([points, np.full((len(points), 1), model.cell.pick_height_mm), np.ones((len(points), 1))], -1)
    q = model.arm.ik((world @ np.linalg.inv(T_world_base).T)[:, :3])
    within = model.arm.within_limits(q)
    assert within.any(-1).all()
    chosen = q[np.arange(len(q)), within.argmax(-1)]
    T_world_grip = T_world_base @ model.arm.fk(chosen)
    np.testing.assert_allclose(T_world_grip[:, :3, 3], world[:, :3], atol=1e-6)
    return T_world_grip


@pytest.mark.parametrize("arm", [LEFT, RIGHT])
def test_a_transfer_turns_the_object_as_the_urdf_does(model, arm, rules_of, assert_same_angle):
    """The yaw by which T_world_grip turns between pick and place is theta' - theta of the closed form."""
    points = reachable(model, 1000, 3, arm)
    pick, place = points[:500], points[500:]
    T_world_pick, T_world_place = held(model, arm, pick), held(model, arm, place)
    R_turn = T_world_place[:, :3, :3] @ T_world_pick[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(R_turn[:, 2, 2], 1, atol=1e-9)  # nothing but yaw
    theta = np.random.default_rng(4).uniform(-math.pi, math.pi, 500)
    pose = np.concatenate([pick, theta[:, None]], -1)
    command = Command(np.zeros(500, bool), np.full(500, arm), place)
    moved, feasible = rules_of(model.cell).transfer(pose, pose, command)
    assert feasible.all()
    assert_same_angle(moved[:, 2] - theta, np.arctan2(R_turn[:, 1, 0], R_turn[:, 0, 0]))
    np.testing.assert_array_equal(moved[:, :2], place)


@pytest.mark.parametrize("arm", [LEFT, RIGHT])
def test_gripper_yaw_is_that_of_the_urdf(model, arm, assert_same_angle):
    points = reachable(model, 300, 5, arm)
    R = held(model, arm, points)[:, :3, :3]
    assert_same_angle(model.cell.gripper_yaw(model.cell.polar(points)[1])[:, arm], np.arctan2(R[:, 1, 0], R[:, 0, 0]))


def test_the_sector_agrees_with_the_urdf_grid(model):
    """Every grid point of the sector can be reached by the URDF's arm."""
    grid = model.grid
    points = np.stack(np.meshgrid(grid.x_mm, grid.y_mm, indexing="ij"), -1)
    reach = model.cell.reaches(points)
    for arm in (LEFT, RIGHT):
        assert reach[..., arm].sum() > 500
        assert grid.masks[arm][reach[..., arm]].all()


def test_reach_is_the_definition_in_both_libraries(cell):
    points = np.random.default_rng(6).uniform(-1, 1, (50_000, 2)) * (400, 600)
    low, high = cell.yaw_rad
    for index, side in ((LEFT, 1), (RIGHT, -1)):
        dx, dy = points[:, 0], points[:, 1] - side * cell.config.base_distance_mm / 2
        radius, yaw = np.hypot(dx, dy), np.arctan2(side * dx, -side * dy)  # about the direction of the other base
        margin = np.min([radius - cell.r_min_mm, cell.r_max_mm - radius, (yaw - low) * radius, (high - yaw) * radius], 0)
        clear = np.abs(margin) > 0.01  # membership has a tolerance; see below
        assert 0.03 < (margin > 0).mean() < 0.5
        np.testing.assert_array_equal(cell.reaches(points)[clear, index], margin[clear] > 0)
    np.testing.assert_array_equal(cell.reaches(torch.as_tensor(points)).numpy(), cell.reaches(points))


def test_polar_equals_in_both_libraries(cell):
    points = np.random.default_rng(7).uniform(-400, 400, (1000, 2))
    for ours, theirs in zip(cell.polar(points), cell.polar(torch.as_tensor(points)), strict=True):
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-12, atol=1e-12)
    square, yaw = cell.polar(points)
    for index, base in enumerate(cell.bases):
        np.testing.assert_allclose(np.sqrt(square[:, index]), np.hypot(points[:, 0] - base.x_mm, points[:, 1] - base.y_mm))
    assert (np.abs(yaw) <= math.pi).all()


def test_arms_are_mirror_images(cell):
    points = np.random.default_rng(8).uniform(-1, 1, (20_000, 2)) * (400, 600)
    mirrored = points * (1, -1)
    np.testing.assert_array_equal(cell.reaches(points), cell.reaches(mirrored)[:, ::-1])
    np.testing.assert_allclose(cell.polar(points)[1], -cell.polar(mirrored)[1][:, ::-1], atol=1e-12)
    assert cell.bases[LEFT].y_mm == -cell.bases[RIGHT].y_mm > 0
    assert cell.views[LEFT].y_sign == cell.views[LEFT].turn_sign == -1
    assert cell.views[RIGHT].y_sign == cell.views[RIGHT].turn_sign == 1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_yaw_limits_of_the_paper_cell(paper, dtype):
    """At +-90 degrees the left arm reaches along its base's line y = 180 mm, and not behind it."""
    points = np.array([[200, 180], [-200, 180], [200, 179], [200, 181], [-200, 181], [0, 380], [0, -20]], dtype)
    assert paper.reaches(points)[:, LEFT].tolist() == [True, True, True, False, False, False, True]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_membership_has_a_micrometre_of_tolerance(paper, dtype):
    radius = np.array([149.9, 149.9995, 150, 230, 230.0005, 230.1], dtype)
    points = np.stack([0 * radius, 180 - radius], -1).astype(dtype)
    assert paper.reaches(points)[:, LEFT].tolist() == [False, True, True, True, True, False]
