"""The four symmetries are a group, and act on every object of the task in step."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.cell import LEFT, NO_ARM, RIGHT
from tests.symmetries import GROUP, mirror

poses = st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(-math.pi, math.pi)).map(np.array)
elements = st.sampled_from(GROUP)
IDENTITY = mirror()


def same_pose(first, second) -> bool:
    turn = np.remainder(first[..., 2] - second[..., 2] + math.pi, 2 * math.pi) - math.pi
    return np.allclose(first[..., :2], second[..., :2], atol=0) and np.allclose(turn, 0, atol=1e-12)


def test_the_group_is_kleins():
    assert len(set(GROUP)) == 4
    assert IDENTITY in GROUP
    for first, second in itertools.product(GROUP, GROUP):
        assert first.then(second) in GROUP
        assert first.then(second) == second.then(first)
    for element in GROUP:
        assert element.then(element) == IDENTITY
        assert element.then(IDENTITY) == element


@given(first=elements, second=elements, pose=poses)
def test_products_act_as_one_after_the_other_on_poses(first, second, pose):
    assert same_pose(second.pose(first.pose(pose)), first.then(second).pose(pose))


@given(element=elements, pose=poses)
def test_poses_stay_wrapped_and_libraries_agree(element, pose):
    image = element.pose(pose)
    assert -math.pi <= image[2] < math.pi
    assert same_pose(element.pose(torch.as_tensor(pose)).numpy(), image)


@pytest.mark.parametrize(("first", "second"), list(itertools.product(GROUP, GROUP)))
def test_products_act_as_one_after_the_other_on_arms_and_actions(first, second, paper, rules_of):
    both, rules = first.then(second), rules_of(paper)
    arms = np.array([NO_ARM, LEFT, RIGHT])
    np.testing.assert_array_equal(second.arm(first.arm(arms)), both.arm(arms))
    action = np.random.default_rng(0).uniform(-1, 1, (50, 4))
    action[:4, 1] = (0.0, -0.0, 1.0, -1.0)  # a zero means L
    for one, other in zip(rules.decode(second.action(first.action(action))), rules.decode(both.action(action)), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("element", GROUP)
def test_arms_and_actions_swap_together(element, cell, rules_of):
    """The image of a decoded command is the decoded image of the action; the table mirrors with the chart."""
    rules = rules_of(cell)
    action = np.random.default_rng(1).uniform(-1, 1, (200, 4))
    action[:3, 1] = (0.0, 1e-12, -1e-12)
    command, image = rules.decode(action), rules.decode(element.action(action))
    np.testing.assert_array_equal(image.final, command.final)
    np.testing.assert_array_equal(image.arm, element.arm(command.arm))
    flat = np.concatenate([command.place_mm, np.zeros((200, 1))], -1)
    np.testing.assert_allclose(image.place_mm, element.pose(flat)[:, :2], atol=1e-12)


def test_each_mirror_by_hand():
    """M_y: (x, y, theta) -> (x, -y, -theta), L <-> R. M_x: (x, y, theta) -> (-x, y, pi - theta)."""
    pose, action = np.array([10.0, 20.0, 0.25]), np.array([1.0, -1.0, 0.5, 0.75])
    np.testing.assert_allclose(mirror(y=True).pose(pose), [10, -20, -0.25])
    np.testing.assert_allclose(mirror(x=True).pose(pose), [-10, 20, math.pi - 0.25])
    np.testing.assert_allclose(mirror(y=True).action(action), [1, 1, 0.5, -0.75])
    np.testing.assert_allclose(mirror(x=True).action(action), [1, -1, -0.5, 0.75])


@pytest.mark.parametrize("element", GROUP)
def test_reach_is_symmetric(element, cell):
    points = np.random.default_rng(2).uniform(-1, 1, (20_000, 3)) * (400, 600, math.pi)
    reach, image = cell.reaches(points), cell.reaches(element.pose(points))
    assert reach[:, 0].any()
    np.testing.assert_array_equal(image, reach[:, ::-1] if element.swaps else reach)
