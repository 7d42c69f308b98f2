"""Geometry behind the pictures of the table."""

from __future__ import annotations

import math

import numpy as np

from marl_handover.report.table import sector_mm, square_mm


def test_the_sector_outline_is_what_the_arm_just_reaches(cell):
    for arm in range(cell.num_arms):
        outline = sector_mm(cell, arm)
        assert cell.reaches(outline)[:, arm].all()
        base = np.array([cell.bases[arm].x_mm, cell.bases[arm].y_mm])
        outwards = base + (outline - base) * np.where(np.arange(len(outline)) < len(outline) // 2, 1.01, 0.99)[:, None]
        assert not cell.reaches(outwards)[:, arm].any()


def test_the_block_is_a_square_turned_by_theta():
    corners = square_mm((10.0, -20.0, 0.3), 40.0)
    np.testing.assert_allclose(corners.mean(0), (10, -20), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(np.roll(corners, 1, 0) - corners, axis=1), 40)
    front = corners[[0, 3]].mean(0) - (10, -20)
    assert abs(math.atan2(front[1], front[0]) - 0.3) < 1e-12
