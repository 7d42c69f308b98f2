"""Stops keep to the way and to the limits; two motions joined are one that keeps them too."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover.control.interactive.motion_program import DELAYS, STEP_S, joined, stopped
from marl_handover.motion.time_parametrization import time_path
from marl_handover.motion.trajectory import JointTrajectory, evaluate, still

VELOCITY = np.array([4.6, 3.6, 3.6, 4.2, 7.6])
ACCELERATION = np.full(5, 14.0)
seeds = st.integers(0, 10**6)
shares = st.floats(0.0, 1.0)


def track_of(seed, start=None):
    """A time-optimal motion along a random spline, and its control points."""
    random = np.random.default_rng(seed)
    points = np.cumsum(random.normal(0, 0.4, (11, 5)), axis=0)
    points += 0 if start is None else start - points[0]
    done = time_path(points, 5, VELOCITY, ACCELERATION, STEP_S)
    return JointTrajectory(done.t_s, done.joints_rad, done.velocities_rad_s), points


def bends(track, step_s=0.01):
    """Accelerations over steps of 10 ms."""
    t = np.arange(0.0, track.duration_s + 3 * step_s, step_s)
    return np.diff(track.at(t)[0], 2, axis=0) / step_s**2


@given(seeds, shares)
@settings(max_examples=25)
def test_a_track_is_the_motion_that_was_timed_and_its_rest_is_the_same_later(seed, share):
    track, points = track_of(seed)
    t = np.linspace(0.0, track.duration_s, 333)
    joints, rates = track.at(t)
    exact = time_path(points, 5, VELOCITY, ACCELERATION, track.duration_s / 332)
    assert np.allclose(joints, exact.joints_rad, atol=2e-5)
    assert np.allclose(rates, exact.velocities_rad_s, atol=0.03)
    begun = share * track.duration_s
    rest = track.rest(begun)
    assert np.allclose(rest.at(t - begun)[0][t > begun + 1e-9], joints[t > begun + 1e-9], atol=1e-5)
    assert np.array_equal(rest.end_rad, track.end_rad)


def test_before_its_beginning_and_after_its_end_a_track_rests():
    track, points = track_of(1)
    joints, rates = track.at(np.array([-1.0, track.duration_s + 1.0]))
    assert np.allclose(joints, points[[0, -1]])
    assert not rates.any()


@given(seeds, shares)
@settings(max_examples=40)
def test_a_stop_keeps_to_the_way_and_the_limits(seed, share):
    track, points = track_of(seed)
    begun = share * track.duration_s
    stop = stopped(track, begun, ACCELERATION)
    (joints, rates), (first, rate) = stop.at(np.linspace(0, stop.duration_s, 200)), track.at(begun)
    assert np.allclose(joints[0], first, atol=1e-9)
    assert np.allclose(rates[0], rate, atol=1e-6)
    assert not stop.velocities_rad_s[-1].any()
    assert stop.duration_s <= track.duration_s - begun + STEP_S
    way = evaluate(points, np.linspace(0.0, 1.0, 20001), 5)
    assert max(abs(way - q).max(axis=1).min() for q in joints[::10]) < 1e-3
    assert (abs(rates) <= VELOCITY * 1.001).all()
    assert (abs(bends(stop)) <= ACCELERATION * 1.02).all()


def test_a_stop_is_as_short_as_one_joint_allows():
    """Along a straight line at full speed, v / a; the spline's speed is even in the middle of a long one."""
    points = np.zeros((11, 5))
    points[:, 0] = np.linspace(0.0, 6.0, 11)
    done = time_path(points, 5, VELOCITY, ACCELERATION, STEP_S)
    track = JointTrajectory(done.t_s, done.joints_rad, done.velocities_rad_s)
    stop = stopped(track, track.duration_s / 2, ACCELERATION)
    assert stop.duration_s == pytest.approx(VELOCITY[0] / ACCELERATION[0], rel=0.05)


@given(seeds, shares)
@settings(max_examples=30)
def test_what_is_joined_goes_from_the_one_to_the_other_within_the_limits(seed, share):
    track, _ = track_of(seed)
    begun = share * track.duration_s
    stop = stopped(track, begun, ACCELERATION)
    onward, _ = track_of(seed + 1, stop.end_rad)
    whole = joined(stop, onward, VELOCITY, ACCELERATION, lambda joints: True)
    assert np.allclose(whole.at(0.0), track.at(begun), atol=1e-6)
    assert np.allclose(whole.end_rad, onward.end_rad)
    assert onward.duration_s - 1e-9 <= whole.duration_s <= stop.duration_s + onward.duration_s + 1e-9
    t = np.linspace(0, whole.duration_s, 500)
    assert (abs(whole.at(t)[1]) <= VELOCITY * 1.006).all()
    assert (abs(bends(whole)) <= ACCELERATION * 1.03).all()


def test_who_goes_on_the_same_way_does_not_stop_and_who_must_not_touch_anything_does():
    points = np.zeros((11, 5))
    points[:, 0] = np.linspace(0.0, 3.0, 11)
    done = time_path(points, 5, VELOCITY, ACCELERATION, STEP_S)
    track = JointTrajectory(done.t_s, done.joints_rad, done.velocities_rad_s)
    stop = stopped(track, 0.2, ACCELERATION)
    further = time_path(points + stop.end_rad, 5, VELOCITY, ACCELERATION, STEP_S)
    onward = JointTrajectory(further.t_s, further.joints_rad, further.velocities_rad_s)
    free = joined(stop, onward, VELOCITY, ACCELERATION, lambda joints: True)
    assert free.duration_s == pytest.approx(DELAYS[0] * stop.duration_s + onward.duration_s)
    asked = []
    forbidden = joined(stop, onward, VELOCITY, ACCELERATION, lambda joints: bool(asked.append(joints)))
    assert forbidden.duration_s == pytest.approx(stop.duration_s + onward.duration_s)
    assert asked
    assert all(np.ptp(joints[:, 0]) > 0 for joints in asked)


def test_an_arm_at_rest_stays_where_it_is():
    joints = np.arange(5.0)
    rest = still(joints, 0.4)
    stop = stopped(rest, 0.1, ACCELERATION)
    assert np.allclose(stop.joints_rad, joints)
    assert stop.duration_s < 0.01
