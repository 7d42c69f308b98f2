"""The manipulation spaces of the shipped cells, and the fit against spaces that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover.cell.reach import ManipulationGrid, feasible, fit_annulus, manipulation_grid
from marl_handover.config import CellConfig
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.capsules import ground_clearance_mm, self_clearance_mm
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.robot import describe, robot_config
from marl_handover.geometry.se2 import SE2

DESCRIPTION = describe(robot_config("al5a"))
PAPER = {"base_yaw": [-90, 90], "shoulder": [-14, 150], "elbow": [-168, -108.5], "wrist_pitch": [-95, 95], "wrist_roll": [-90, 90]}
AL5A = {"base_yaw": [-95, 95], "shoulder": [-14, 150], "elbow": [-167, 0], "wrist_pitch": [-95, 100], "wrist_roll": [-90, 90]}
PAPER_ARM = ClosedFormArm(DESCRIPTION, PAPER)


def base_at(x_mm: float, y_mm: float, facing_rad: float) -> SE2:
    return SE2(x_mm, y_mm, (math.cos(facing_rad), math.sin(facing_rad)))


def pair(base_distance_mm: float) -> list[SE2]:
    half = base_distance_mm / 2
    return [base_at(0.0, half, -math.pi / 2), base_at(0.0, -half, math.pi / 2)]


def build(limits: dict[str, list[float]], base_distance_mm: float, pick_height_mm: float = 45.0) -> ManipulationGrid:
    cell = CellConfig(base_distance_mm=base_distance_mm, pick_height_mm=pick_height_mm)
    return manipulation_grid([ClosedFormArm(DESCRIPTION, limits)] * 2, cell, pair(base_distance_mm))


PAPER_GRID = build(PAPER, 360.0)


def known(low: float, high: float, yaw_low: float, yaw_high: float, holes: int = 0) -> ManipulationGrid:
    """A grid around one base whose reachable points are a sector given by hand, less some points in its middle."""
    axis = np.arange(-60.0, 61.0) * 5
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    radius, yaw = np.hypot(points[..., 0], points[..., 1]), np.arctan2(points[..., 1], points[..., 0])
    mask = (radius >= low) & (radius <= high) & (yaw >= yaw_low) & (yaw <= yaw_high)
    i, j = np.nonzero(mask)
    middle = slice(len(i) // 2, len(i) // 2 + holes)
    mask[i[middle], j[middle]] = False
    return ManipulationGrid(axis, axis, mask[None], (base_at(0.0, 0.0, 0.0),), (45.0,))


def test_paper_cell_has_the_papers_annulus() -> None:
    fit = fit_annulus(PAPER_GRID, rounding_mm=1.0)
    assert (fit.r_min_mm, fit.r_max_mm) == (150.0, 230.0)
    assert fit.false_inside_rate == 0.0
    assert fit.missed_rate < 0.02
    assert (fit.yaw_lower_rad, fit.yaw_upper_rad) == pytest.approx((-math.pi / 2, math.pi / 2))


def test_paper_annulus_is_decided_by_joint_limits() -> None:
    """Widening the two limits that matter moves the annulus; the collision shapes leave room at both radii."""
    for radius in (150.0, 230.0):
        q = PAPER_ARM.ik([radius, 0.0, 45.0])[0]
        assert PAPER_ARM.within_limits(q)
        assert self_clearance_mm(PAPER_ARM, q) > 5
        assert ground_clearance_mm(PAPER_ARM, q) > 16  # above a block 15 mm high
    wider = ClosedFormArm(DESCRIPTION, {**PAPER, "elbow": [-168, -100], "wrist_pitch": [-95, 98]})
    assert feasible(wider, [[145.0, 0.0], [235.0, 0.0]], 45.0).all()
    assert not feasible(PAPER_ARM, [[145.0, 0.0], [235.0, 0.0]], 45.0).any()


def test_al5a_cell_reaches_further_and_shares_a_space() -> None:
    fit = fit_annulus(build(AL5A, 440.0), rounding_mm=1.0)
    assert fit.r_min_mm < 150
    assert fit.r_max_mm > 300
    assert fit.r_min_mm < 220 < fit.r_max_mm
    assert fit.false_inside_rate == 0.0
    assert fit.missed_rate < 0.02


def test_grid_is_of_world_multiples_and_mirrored() -> None:
    """The arms are mirror images in y = 0, and so are their spaces; that holds only if each base is turned by its facing."""
    grid = PAPER_GRID
    assert grid.masks.shape == (2, len(grid.x_mm), len(grid.y_mm))
    np.testing.assert_array_equal(grid.x_mm % 5, 0)
    np.testing.assert_array_equal(grid.y_mm, -grid.y_mm[::-1])
    np.testing.assert_array_equal(grid.masks[0], grid.masks[1][:, ::-1])
    assert grid.masks.all(axis=0).any()
    assert not grid.masks[0][:, grid.y_mm > 180].any()  # behind the left base
    edge = np.concatenate([grid.masks[:, [0, -1]].ravel(), grid.masks[:, :, [0, -1]].ravel()])
    assert not edge.any()


def test_mask_equals_feasibility_point_by_point() -> None:
    rng = np.random.default_rng(0)
    for arm_index, base in enumerate(PAPER_GRID.bases):
        for i, j in zip(rng.integers(0, len(PAPER_GRID.x_mm), 40), rng.integers(0, len(PAPER_GRID.y_mm), 40), strict=True):
            point = base.to_local([PAPER_GRID.x_mm[i], PAPER_GRID.y_mm[j]])
            assert feasible(PAPER_ARM, point, 45.0) == PAPER_GRID.masks[arm_index, i, j]


def test_one_arm_and_three_arms_work() -> None:
    cell = CellConfig()
    bases = [base_at(0.0, 0.0, 0.0), base_at(400.0, 0.0, math.pi), base_at(0.0, 400.0, 0.3)]
    assert manipulation_grid([PAPER_ARM], cell, bases[:1]).masks.shape[0] == 1
    three = manipulation_grid([PAPER_ARM] * 3, cell, bases)
    assert three.masks.any(axis=(1, 2)).all()
    fit = fit_annulus(three, 1.0)
    assert (fit.r_min_mm, fit.r_max_mm) == pytest.approx((150, 230), abs=1)


def test_collision_takes_points_away() -> None:
    """Near the table the wrist's own shape touches the ground, whatever the joint limits say."""
    q = PAPER_ARM.ik([190.0, 0.0, 10.0])[0]
    assert ground_clearance_mm(PAPER_ARM, q) < 0
    wide = ClosedFormArm(DESCRIPTION, {name: [-179, 179] for name in PAPER})
    assert wide.within_limits(wide.ik([190.0, 0.0, 10.0])).all()
    assert not feasible(wide, [190.0, 0.0], 10.0)
    folded = wide.ik([118.0, 0.0, 45.0])
    assert wide.within_limits(folded).all()
    assert (self_clearance_mm(wide, folded) < 0).all()
    assert not feasible(wide, [118.0, 0.0], 45.0)


@given(low=st.floats(20, 150), width=st.floats(20, 120), yaw_low=st.floats(-2.5, -0.3), yaw_high=st.floats(0.3, 2.5))
@settings(max_examples=40, deadline=None)
def test_a_known_sector_is_found_again(low: float, width: float, yaw_low: float, yaw_high: float) -> None:
    grid = known(low, low + width, yaw_low, yaw_high)
    fit = fit_annulus(grid)
    assert (fit.false_inside_rate, fit.missed_rate) == (0.0, 0.0)
    assert low <= fit.r_min_mm <= low + 5
    assert low + width - 5 <= fit.r_max_mm <= low + width
    assert yaw_low - 1e-9 <= fit.yaw_lower_rad
    assert fit.yaw_upper_rad <= yaw_high + 1e-9


def test_the_fit_avoids_a_hole_and_counts_what_it_missed() -> None:
    whole, holed = known(100, 200, -1, 1), known(100, 200, -1, 1, holes=1)
    fit = fit_annulus(holed)
    assert fit.false_inside_rate == 0.0
    assert 0 < fit.missed_rate < 0.6
    radius = np.hypot(*np.moveaxis(holed.points_base_mm(0), -1, 0))
    yaw = np.arctan2(holed.points_base_mm(0)[..., 1], holed.points_base_mm(0)[..., 0])
    inside = (radius >= fit.r_min_mm - 1e-6) & (radius <= fit.r_max_mm + 1e-6)
    inside &= (yaw >= fit.yaw_lower_rad - 1e-9) & (yaw <= fit.yaw_upper_rad + 1e-9)
    assert fit.missed_rate == pytest.approx((holed.masks[0] & ~inside).sum() / holed.masks[0].sum())
    assert fit_annulus(whole, weight=1000.0).missed_rate == 0.0
    lenient = fit_annulus(holed, weight=0.0)
    assert lenient.missed_rate == 0.0
    assert lenient.false_inside_rate > 0


def test_rounding_goes_inwards() -> None:
    grid = known(101.0, 199.0, -1, 1)
    exact, rounded = fit_annulus(grid, 0.0), fit_annulus(grid, 4.0)
    assert rounded.r_min_mm == 4 * math.ceil(exact.r_min_mm / 4)
    assert rounded.r_max_mm == 4 * math.floor(exact.r_max_mm / 4)
    assert rounded.r_min_mm % 4 == 0
    assert rounded.missed_rate >= exact.missed_rate


def test_bad_settings_are_named() -> None:
    with pytest.raises(InvalidSetting, match="pick_height_mm = 400"):
        fit_annulus(build(PAPER, 360.0, pick_height_mm=400.0))
    with pytest.raises(InvalidSetting, match="pick_height_mm"):
        build(PAPER, 360.0, pick_height_mm=math.nan)
    with pytest.raises(InvalidSetting, match="grid_mm"):
        manipulation_grid([PAPER_ARM] * 2, CellConfig(grid_mm=0.0), pair(360.0))
    with pytest.raises(InvalidSetting, match="fit_rounding_mm"):
        fit_annulus(known(101.0, 130.0, -1, 1), rounding_mm=100.0)
