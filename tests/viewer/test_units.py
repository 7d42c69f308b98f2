from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from marl_handover.viewer.words import UPWARDS, flat, metres, product, quaternion, rgb, turned, yaw_of

angles = st.floats(-math.pi, math.pi)
turns = st.tuples(angles, angles, angles).map(lambda euler: Rotation.from_euler("xyz", euler))


def same_turn(wxyz, rotation, tolerance=1e-9):
    assert np.linalg.norm(wxyz) == pytest.approx(1.0, abs=tolerance)
    assert abs(np.dot(wxyz, rotation.as_quat(scalar_first=True))) == pytest.approx(1.0, abs=tolerance)  # q and -q are one turn


@given(turns)
def test_the_quaternion_of_a_matrix_is_that_of_scipy(rotation):
    same_turn(turned(rotation.as_matrix()), rotation)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_half_turns_have_no_w_and_are_found_all_the_same(axis):
    rotation = Rotation.from_rotvec(math.pi * np.array(axis))
    same_turn(turned(rotation.as_matrix()), rotation)


@given(turns, turns)
def test_a_product_turns_by_the_second_first(first, second):
    same_turn(product(*(rotation.as_quat(scalar_first=True) for rotation in (first, second))), first * second)


@given(angles)
def test_the_yaw_of_a_turn_about_the_vertical_is_its_angle(yaw):
    assert yaw_of(quaternion(UPWARDS, yaw)) == pytest.approx(yaw, abs=1e-12)
    assert yaw_of(-quaternion(UPWARDS, yaw)) == pytest.approx(yaw, abs=1e-12)


def test_a_pose_is_laid_on_the_table_in_metres():
    wxyz, position = flat((120.0, -60.0, math.pi / 2), 15.0)
    np.testing.assert_allclose(position, [0.12, -0.06, 0.015])
    np.testing.assert_allclose(wxyz, [math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    assert metres(250.0) == 0.25


def test_a_colour_is_its_three_bytes():
    assert rgb("#004488") == (0, 0x44, 0x88)
