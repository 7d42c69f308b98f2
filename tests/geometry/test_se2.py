"""Frames on the table: to the world and back, the same as their matrix."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.se3 import apply, flat_pose, rotation, transform

angles, places = st.floats(-math.pi, math.pi), st.floats(-500.0, 500.0)


@st.composite
def frames(draw):
    angle = draw(angles)
    return SE2(draw(places), draw(places), (math.cos(angle), math.sin(angle)))


@given(frames(), places, places, places)
def test_there_and_back_is_the_same_point(frame, x, y, z):
    for point in (np.array([x, y]), np.array([[x, y, z], [z, x, y]])):
        np.testing.assert_allclose(frame.to_local(frame.to_world(point)), point, atol=1e-9)
        np.testing.assert_allclose(frame.to_world(frame.to_local(point)), point, atol=1e-9)


@given(frames(), places, places, places)
def test_the_matrix_does_the_same(frame, x, y, z):
    np.testing.assert_allclose(apply(frame.matrix(), [x, y, z]), frame.to_world([x, y, z]), atol=1e-9)


@given(frames(), st.floats(0.0, 300.0), angles)
def test_a_point_around_a_frame_is_seen_there(frame, radius, yaw):
    x, y = frame.to_local(frame.around(radius, yaw))
    np.testing.assert_allclose([x, y], [radius * math.cos(yaw), radius * math.sin(yaw)], atol=1e-9)


@given(angles, angles, angles)
def test_roll_pitch_and_yaw_are_about_fixed_axes(roll, pitch, yaw):
    expected = rotation(np.array(yaw), (0, 0, 1)) @ rotation(np.array(pitch), (0, 1, 0)) @ rotation(np.array(roll), (1, 0, 0))
    np.testing.assert_allclose(transform((0, 0, 0), (roll, pitch, yaw))[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(flat_pose(1.0, 2.0, yaw, 3.0), transform((1.0, 2.0, 3.0), (0.0, 0.0, yaw)), atol=1e-12)
