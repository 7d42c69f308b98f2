"""Pairs of two kinds of arms: how far apart they stand, how each sees the shared space, and what cannot be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from marl_handover.arrays import wrap
from marl_handover.cell import Cell, build_cell, load_cell
from marl_handover.cell.arm import Arm, mirrored_pair
from marl_handover.config import ArmConfig, CellConfig, TaskConfig
from marl_handover.errors import InvalidSetting, NoSharedSpace, OutOfReach
from marl_handover.task.observations import ARM_FIELDS, observe
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules

COARSE = CellConfig(name="test", grid_mm=10.0)
MIXED = replace(COARSE, arms=[ArmConfig("small"), ArmConfig("large", robot="al5a")])


def pair(*sectors, distance_mm=360.0, **settings) -> Cell:
    """Arms face to face; a sector is (least radius, greatest radius, lateral offset)."""
    arms = []
    for name, base, (low, high, lateral) in zip("ab", mirrored_pair(distance_mm), sectors, strict=True):
        arms.append(Arm(name, base, low, high, (-1.6, 1.6), lateral_mm=lateral))
    return Cell(tuple(arms), replace(CellConfig(), **settings))


def problems(cell, count=2000):
    start, goal = (part.numpy() for part in sample_problems(cell, count, torch.Generator().manual_seed(0)))
    return start, goal, np.arange(count) % 3 - 1


def field(rules, name, *problem):
    blocks = observe(rules, "relative", *problem)
    return blocks.reshape(len(blocks), 2, -1)[..., ARM_FIELDS.index(name)]


@pytest.mark.parametrize(("changes", "distance_mm"), [({}, 360.0), ({"robot": "al5a"}, 490.0), ({"arms": MIXED.arms}, 420.0)])
def test_arms_that_are_not_placed_face_each_other_as_far_apart_as_suits_their_rings(changes, distance_mm):
    cell = load_cell(replace(COARSE, **changes))
    assert cell.base_distance_mm == cell.config.base_distance_mm == distance_mm
    assert [base.facing for base in cell.bases] == [(0.0, -1.0), (0.0, 1.0)]
    assert round(0.78 * sum(arm.r_max_mm for arm in cell.arms), -1) == distance_mm


def test_a_distance_that_is_given_is_kept():
    assert load_cell(replace(MIXED, base_distance_mm=400.0)).base_distance_mm == 400.0


def test_a_ring_that_starts_far_out_stands_where_the_rings_overlap():
    """0.78 of twice 230 mm are within the inner radii of such rings."""
    cell = load_cell(replace(COARSE, r_min_mm=200.0))
    assert 2 * 200 < cell.base_distance_mm < 2 * 230


def test_a_ring_too_small_for_any_distance_is_one_line():
    with pytest.raises(
        NoSharedSpace, match=r"none works for these rings \(left 228 to 230 and right 228 to 230 mm\); choose another"
    ) as caught:
        build_cell(replace(COARSE, r_min_mm=228.0, chart="paper"))
    assert len(str(caught.value)) < 300
    assert build_cell(replace(COARSE, r_min_mm=228.0)).cell.chart.arcs


def test_out_of_reach_names_the_ring_of_each():
    cell = load_cell(MIXED)
    with pytest.raises(OutOfReach, match=r"150 to 230 mm from the base of 'small' or 1\d\d to 3\d\d mm from the base of 'large'"):
        cell.require_reached("goal", np.array([900.0, 0.0]))


def test_objects_at_the_edge_of_either_ring_are_shown_inside_it():
    cell = load_cell(MIXED)
    for arm in cell.arms:
        for radius, inside in ((arm.r_max_mm + 0.5, arm.r_max_mm), (arm.r_min_mm - 0.5, arm.r_min_mm)):
            pose = np.array([*arm.at(radius, 1.4), 0.3])
            shown = cell.clamp_to_workspace(pose, 1.0)
            np.testing.assert_allclose(shown, pose if cell.reaches(pose).any() else [*arm.at(inside, 1.4), 0.3], atol=1e-9)


@pytest.mark.parametrize(
    ("sectors", "view", "elements"),
    [
        (((150, 230, 0.0), (150, 230, 0.0)), (1, -1), 4),  # mirror images: the first arm sees the mirrored table
        (((150, 230, 12.0), (150, 230, 12.0)), (-1, -1), 2),  # only half a turn takes them onto each other
        (((150, 230, 12.0), (150, 230, -12.0)), (1, -1), 2),
        (((150, 230, 0.0), (140, 250, 0.0)), (1, -1), 2),  # nothing swaps them
    ],
)
def test_each_arm_sees_its_own_base_at_the_bottom(sectors, view, elements):
    cell = pair(*sectors)
    assert len(cell.symmetries) == elements
    assert cell.views == (view, (1, 1))
    rules = Rules(cell, TaskConfig())
    start, goal, previous = problems(cell)
    for element in (each for each in cell.symmetries if each.swaps and (each.matrix[0][0], each.matrix[1][1]) == view):
        image = observe(rules, "relative", element.pose(start), element.pose(goal), element.arm(previous)).reshape(len(start), 2, -1)
        seen = observe(rules, "relative", start, goal, previous).reshape(len(start), 2, -1)
        np.testing.assert_allclose(image[:, ::-1], seen, atol=1e-9)


@pytest.mark.parametrize("lateral", [(12.0, 0.0), (12.0, -20.0), (-5.0, -5.0)])
def test_the_middle_of_the_hand_over_angles_is_shown_as_half_a_turn(lateral):
    cell = pair((150, 240, lateral[0]), (150, 230, lateral[1]))
    assert cell.is_foldable
    rules = Rules(cell, TaskConfig())
    start, goal, previous = problems(cell)
    place = cell.shared.to_table(0 * start[:, 0], 0 * start[:, 0])
    psi = cell.gripper_yaw(cell.polar(place)[1])
    middle = np.stack([psi[:, 0] - psi[:, 1], psi[:, 1] - psi[:, 0]], -1)
    goal_psi = cell.gripper_yaw(cell.polar(goal)[1])[:, ::-1]
    needed = cell.gripper_yaw(cell.polar(start)[1]) - (start[:, 2] - goal[:, 2])[:, None] - goal_psi
    turn = np.array([view.turn_sign for view in cell.views])
    shown = np.arctan2(field(rules, "sin_hand_over", start, goal, previous), field(rules, "cos_hand_over", start, goal, previous))
    matters = cell.reaches(goal)[:, ::-1]
    np.testing.assert_allclose(wrap(shown - turn * (needed - middle) - math.pi)[matters], 0, atol=1e-9)


def test_a_space_in_two_pieces_that_is_not_its_own_mirror_image_is_not_folded():
    assert pair((150, 230, 0.0), (150, 230, 0.0), distance_mm=280.0, chart="angle").is_foldable
    lopsided = pair((150, 230, 12.0), (150, 230, -20.0), distance_mm=280.0, chart="angle")
    assert len(lopsided.chart.arcs) == 2
    assert not lopsided.is_foldable


def test_what_needs_the_papers_chart_says_so():
    with pytest.raises(InvalidSetting, match=r"cell\.chart = 'angle': must be 'paper', which takes two arms with the same ring, for DQN"):
        load_cell(MIXED).paper_chart("DQN")
    with pytest.raises(
        NoSharedSpace, match=r"cell\.chart=paper needs equal rings, no lateral offset and no obstacles, cell\.chart=angle does not"
    ):
        build_cell(replace(MIXED, chart="paper"))
