"""What each named layout shows."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from marl_handover.config import LAYOUTS
from marl_handover.errors import UnknownChoice
from marl_handover.task.observations import ARM_FIELDS, OBJECT_FIELDS, RAW_FIELDS, observation_size, observe
from tests.symmetries import mirror

COUNT = 5000
ODD = {"x", "goal_x", "sin_finish_error", "finish_error_in_epsilons", "sin_hand_over", "other_finish_error_in_epsilons"}
"""Fields of an arm's block that change sign when the table is mirrored along the base line."""

layouts = pytest.mark.parametrize("layout", LAYOUTS)


def blocks(vector):
    return np.asarray(vector).reshape(*vector.shape[:-1], 2, len(ARM_FIELDS))


@layouts
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_size_dtype_and_range(layout, dtype, cell, rules_of, draw):
    pose, goal, previous, _ = draw(cell, COUNT, 0)
    vector = observe(
        rules_of(cell), layout, torch.as_tensor(pose, dtype=dtype), torch.as_tensor(goal, dtype=dtype), torch.as_tensor(previous)
    )
    assert vector.shape == (COUNT, observation_size(layout))
    assert vector.dtype == dtype
    assert torch.isfinite(vector).all()
    assert vector.abs().max() <= 1 + 1e-6  # no field outgrows the others


def test_sizes_are_those_of_the_named_fields():
    assert [observation_size(layout) for layout in ("raw", "object", "relative")] == [7, 4, 2 * len(ARM_FIELDS)]
    assert (len(RAW_FIELDS), len(OBJECT_FIELDS)) == (7, 4)
    with pytest.raises(UnknownChoice, match="pixels"):
        observation_size("pixels")


@layouts
def test_numpy_equals_torch_and_rows_equal_batches(layout, cell, rules_of, draw):
    rules = rules_of(cell, symmetry_order=2)
    pose, goal, previous, _ = draw(cell, 200, 1)
    vector = observe(rules, layout, pose, goal, previous)
    assert vector.shape == (200, observation_size(layout))
    np.testing.assert_allclose(observe(rules, layout, *map(torch.as_tensor, (pose, goal, previous))).numpy(), vector, atol=1e-9)
    for row in range(20):
        np.testing.assert_allclose(observe(rules, layout, pose[row], goal[row], previous[row]), vector[row], atol=1e-12)


def test_raw_is_the_documented_scaling(cell, rules_of, draw):
    pose, goal, previous, _ = draw(cell, COUNT, 2)
    scale = (cell.r_max_mm, cell.r_max_mm + cell.config.base_distance_mm / 2, math.pi)
    expected = np.concatenate([pose / scale, goal / scale, np.array([0.0, -1.0, 1.0])[previous + 1][:, None]], -1)
    np.testing.assert_allclose(observe(rules_of(cell), "raw", pose, goal, previous), expected, atol=1e-12)


def test_object_is_raw_without_the_goal(cell, rules_of, draw):
    pose, goal, previous, _ = draw(cell, COUNT, 3)
    rules = rules_of(cell)
    vector = observe(rules, "object", pose, goal, previous)
    np.testing.assert_array_equal(vector, observe(rules, "object", pose, goal[::-1], previous))
    shown = [RAW_FIELDS.index(name) for name in OBJECT_FIELDS]
    np.testing.assert_array_equal(vector, observe(rules, "raw", pose, goal, previous)[:, shown])


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_mirroring_the_arms_swaps_their_blocks(order, cell, rules_of, draw):
    rules, mirrored = rules_of(cell, symmetry_order=order), mirror(y=True)
    pose, goal, previous, _ = draw(cell, COUNT, 4)
    seen = blocks(observe(rules, "relative", pose, goal, previous))
    image = blocks(observe(rules, "relative", mirrored.pose(pose), mirrored.pose(goal), mirrored.arm(previous)))
    np.testing.assert_allclose(image, seen[:, ::-1], atol=1e-9)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_mirroring_along_the_base_line_flips_exactly_the_odd_fields(order, cell, rules_of, draw):
    rules, mirrored = rules_of(cell, symmetry_order=order), mirror(x=True)
    pose, goal, previous, _ = draw(cell, COUNT, 5)
    seen = blocks(observe(rules, "relative", pose, goal, previous))
    image = blocks(observe(rules, "relative", mirrored.pose(pose), mirrored.pose(goal), previous))
    flips = np.abs(image + seen).max((0, 1)) < 1e-9
    stays = np.abs(image - seen).max((0, 1)) < 1e-9
    assert {name for name, flip in zip(ARM_FIELDS, flips, strict=True) if flip} == ODD
    assert {name for name, stay in zip(ARM_FIELDS, stays, strict=True) if stay} == set(ARM_FIELDS) - ODD


def field(vector, name):
    return blocks(vector)[..., ARM_FIELDS.index(name)]


def test_relative_fields_say_what_their_names_say(cell, rules_of, draw):
    rules = rules_of(cell, epsilon_deg=40.0)
    pose, goal, previous, _ = draw(cell, COUNT, 6)
    vector = observe(rules, "relative", pose, goal, previous)
    np.testing.assert_array_equal(field(vector, "reaches_object"), cell.reaches(pose))
    np.testing.assert_array_equal(field(vector, "reaches_goal"), cell.reaches(goal))
    np.testing.assert_array_equal(field(vector, "other_reaches_object"), cell.reaches(pose)[:, ::-1])
    np.testing.assert_array_equal(field(vector, "other_reaches_goal"), cell.reaches(goal)[:, ::-1])
    np.testing.assert_array_equal(field(vector, "was_previous"), previous[:, None] == [0, 1])
    np.testing.assert_array_equal(field(vector, "other_was_previous"), previous[:, None] == [1, 0])
    own = np.array([-1.0, 1.0])  # the left arm sees the mirror image
    error, matters = rules.finishing_error(pose, goal), cell.reaches(goal)  # without reach an arm's error has no bearing
    for name, e, gate in (("", error, matters), ("other_", error[:, ::-1], matters[:, ::-1])):
        in_epsilons = e / math.radians(40)
        np.testing.assert_allclose(
            field(vector, f"{name}finish_error_in_epsilons"), gate * np.clip(own * in_epsilons, -3, 3) / 3, atol=1e-12
        )
        margin = np.where(gate, np.clip(2 * (1 - np.abs(in_epsilons)), -1, 1), -1)
        np.testing.assert_allclose(field(vector, f"{name}finish_margin"), margin, atol=1e-12)
    np.testing.assert_allclose(field(vector, "cos_finish_error"), matters * np.cos(error), atol=1e-12)
    np.testing.assert_allclose(field(vector, "sin_finish_error"), matters * own * np.sin(error), atol=1e-12)
    for name, place in (("", pose), ("goal_", goal)):
        np.testing.assert_allclose(field(vector, f"{name}x"), place[:, :1] * [1, 1] / cell.r_max_mm)
        np.testing.assert_allclose(field(vector, f"{name}y"), place[:, 1:2] * own / cell.r_max_mm)
    np.testing.assert_allclose(field(vector, "log_epsilon"), math.log(math.radians(40)) / 4)
    can = field(vector, "reaches_object") * field(vector, "reaches_goal") * (np.abs(field(vector, "finish_error_in_epsilons")) <= 1 / 3)
    np.testing.assert_array_equal(can.astype(bool), rules.can_finish(pose, goal))


def test_hand_over_field_names_the_place_where_the_other_arm_can_finish(cell, rules_of, draw):
    """Where the shown hand-over angle equals that of the place itself, passing the object there lets the other arm finish exactly."""
    rules = rules_of(cell)
    pose, goal, previous, action = draw(cell, COUNT, 7)
    action[:, 0] = -1
    result = rules.step(pose, goal, previous, action)
    arm, rows = result.command.arm, np.arange(COUNT)
    sign = np.array([view.turn_sign for view in cell.views])[arm]
    seen = observe(rules, "relative", pose, goal, previous)
    needed = sign * np.arctan2(field(seen, "sin_hand_over"), field(seen, "cos_hand_over"))[rows, arm]
    psi = cell.gripper_yaw(cell.polar(result.placed)[1])
    angle = psi[rows, arm] - psi[rows, 1 - arm]
    left = rules.orientation_error(angle, needed)
    error = rules.finishing_error(result.placed, goal)[rows, 1 - arm]
    done = result.feasible & cell.reaches(goal)[rows, 1 - arm]
    assert done.sum() > 1000
    np.testing.assert_allclose(np.cos(error[done] - left[done]), 1, atol=1e-9)


def test_epsilon_a_problem_is_shown(paper, rules_of, draw):
    rules = rules_of(paper)
    pose, goal, previous, _ = draw(paper, 100, 8)
    epsilon = np.geomspace(0.01, 1.0, 100)
    batch = observe(rules, "relative", pose, goal, previous, epsilon)
    rows = [observe(rules, "relative", pose[i], goal[i], previous[i], float(epsilon[i])) for i in range(100)]
    np.testing.assert_allclose(batch, rows, atol=1e-12)
    np.testing.assert_allclose(field(batch, "log_epsilon")[:, 0], np.log(epsilon) / 4)
