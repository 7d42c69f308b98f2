"""Objects at the edge of all reach are shown inside it; all others where they are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.cell import load_cell

PAPER = load_cell("paper")
EDGE_MM = 1.0


@given(x=st.floats(-300, 300), y=st.floats(-300, 300), theta=st.floats(-math.pi, math.pi))
def test_what_is_shown_is_the_object_or_a_reachable_place_near_it(x, y, theta):
    pose = np.array([x, y, theta])
    shown = PAPER.clamp_to_workspace(pose, EDGE_MM)
    assert shown[2] == theta
    if PAPER.reaches(pose).any():
        np.testing.assert_array_equal(shown, pose)
    elif not np.array_equal(shown, pose):
        assert PAPER.reaches(shown).any()
        assert math.dist(shown[:2], pose[:2]) <= EDGE_MM
    np.testing.assert_array_equal(PAPER.clamp_to_workspace(shown, EDGE_MM), shown)


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize("yaw_deg", [-90, -70, 65, 90])
@pytest.mark.parametrize("rim", ["inner", "outer"])
def test_half_a_millimetre_off_the_rim_is_reachable_two_are_not(arm, yaw_deg, rim):
    base = PAPER.bases[arm]
    angle = base.facing_rad + math.radians(yaw_deg)
    radius, sign = (PAPER.r_min_mm, -1) if rim == "inner" else (PAPER.r_max_mm, 1)
    at = {off: base.position_mm + (radius + sign * off) * np.array([math.cos(angle), math.sin(angle)]) for off in (0.0, 0.5, 2.0)}
    assert not PAPER.reaches(at[0.5]).any()
    np.testing.assert_allclose(PAPER.clamp_to_workspace(np.array([*at[0.5], 0.3]), EDGE_MM), [*at[0.0], 0.3], atol=1e-6)
    far = np.array([*at[2.0], 0.3])
    np.testing.assert_array_equal(PAPER.clamp_to_workspace(far, EDGE_MM), far)


@pytest.mark.parametrize("arm", [0, 1])
def test_beyond_the_yaw_limit(arm):
    base = PAPER.bases[arm]
    behind = np.array([190.0, base.y_mm - 0.6 * base.facing[1], 1.0])
    assert not PAPER.reaches(behind).any()
    shown = PAPER.clamp_to_workspace(behind, EDGE_MM)
    assert PAPER.reaches(shown)[arm]
    np.testing.assert_allclose(shown[:2], [190.0, base.y_mm], atol=0.01)
