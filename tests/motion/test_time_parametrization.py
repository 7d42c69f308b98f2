"""The timing keeps to the path and to the limits, and is as fast as toppra's on the same path."""

from __future__ import annotations

import math

import numpy as np
import pytest
import toppra
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree
from toppra import constraint

from marl_handover.errors import InvalidSetting, NotFinite
from marl_handover.motion.time_parametrization import time_path
from marl_handover.motion.trajectory import JointTrajectory, evaluate, knots

Floats = NDArray[np.float64]

DEGREE = 5
VELOCITY = 0.8 * np.array([5.8, 4.55, 4.55, 5.24, 9.5])
ACCELERATION = np.full(5, math.radians(800.0))
KINDS = ("zero end", "free end", "nearly straight", "one joint", "wild", "triple end", "there and back", "slow middle")


def random_path(kind: str, seed: int) -> Floats:
    """Control points (N, 5) of a random path of a kind."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    n = int(rng.integers(6, 12)) if kind != "slow middle" else 11
    start, end = rng.uniform(-1.5, 1.5, (2, 5))
    line = start + rng.choice([0.1, 0.5, 1.0]) * np.outer(np.linspace(0.0, 1.0, n), end - start)
    points = line + rng.normal(0.0, 0.001 if kind == "nearly straight" else 0.15, (n, 5))
    if kind == "zero end":
        points[1], points[-2] = points[0], points[-1]
    elif kind == "one joint":
        points[:, 1:] = points[0, 1:]
        points[:, 0] = rng.uniform(-1.5, 1.5, n)
    elif kind == "wild":
        points = rng.uniform(-1.5, 1.5, (n, 5))
    elif kind == "triple end":
        points[:3], points[-3:] = points[0], points[-1]
    elif kind == "there and back":
        points = points + points[::-1]
    elif kind == "slow middle":
        points[4:8] = points[4]
    return points


def strain(path: JointTrajectory) -> tuple[float, float]:
    """The greatest speed and acceleration relative to the limits, by differences of the samples; before and after the path, rest."""
    step = path.t_s[1] - path.t_s[0]
    speeds = np.diff(path.joints_rad, axis=0) / step
    joints = np.concatenate([path.joints_rad[:1], path.joints_rad, path.joints_rad[-1:]])
    return float(np.abs(speeds / VELOCITY).max()), float(np.abs(np.diff(joints, 2, axis=0) / step**2 / ACCELERATION).max())


class SplinePath(toppra.interpolator.AbstractGeometricPath):
    """The same B-spline, for toppra."""

    path_interval = np.array([0.0, 1.0])
    waypoints = None

    def __init__(self, points: Floats) -> None:
        spline = BSpline(knots(len(points), DEGREE), points, DEGREE)
        self.derivatives = [spline, spline.derivative(1), spline.derivative(2)]

    @property
    def dof(self) -> int:
        return int(self.derivatives[0].c.shape[1])

    def __call__(self, tau: Floats, order: int = 0) -> Floats:
        return self.derivatives[order](tau)


def toppra_duration(points: Floats, grid: int = 500) -> float:
    """Duration of toppra's motion from rest to rest."""
    limits = [
        constraint.JointVelocityConstraint(np.stack([-VELOCITY, VELOCITY], axis=1)),
        constraint.JointAccelerationConstraint(np.stack([-ACCELERATION, ACCELERATION], axis=1)),
    ]
    problem = toppra.algorithm.TOPPRA(limits, SplinePath(points), gridpoints=np.linspace(0.0, 1.0, grid + 1), solver_wrapper="seidel")
    speeds = problem.compute_parameterization(0.0, 0.0, return_data=True)[1]
    return float(np.sum(2.0 / grid / (speeds[1:] + speeds[:-1])))


@pytest.mark.parametrize("kind", KINDS)
def test_not_slower_than_toppra_by_more_than_3_percent(kind: str) -> None:
    """toppra's grid is five times finer here. Where a path all but stands still it is toppra that takes longer."""
    for seed in range(15):
        points = random_path(kind, seed)
        duration = time_path(points, DEGREE, VELOCITY, ACCELERATION, 0.02).t_s[-1]
        assert duration < 1.03 * toppra_duration(points), seed


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_limits_hold_between_the_samples(kind: str, seed: int) -> None:
    points = random_path(kind, seed)
    speed, acceleration = strain(time_path(points, DEGREE, VELOCITY, ACCELERATION, 1e-3))
    assert speed <= 1.002
    # A joint path that all but stops in its middle may exceed the limit by a few percent for a millisecond there.
    assert acceleration <= (1.1 if kind in ("one joint", "slow middle") else 1.02)


@pytest.mark.parametrize("kind", KINDS)
def test_one_limit_is_used_at_nearly_all_times(kind: str) -> None:
    """Time-optimal means that some joint is at its greatest speed or acceleration at every moment."""
    points = random_path(kind, 3)
    path = time_path(points, DEGREE, VELOCITY, ACCELERATION, 1e-3)
    speeds = np.abs(path.velocities_rad_s[1:-1] / VELOCITY).max(axis=1)
    accelerations = np.abs(np.diff(path.joints_rad, 2, axis=0) / path.t_s[1] ** 2 / ACCELERATION).max(axis=1)
    assert np.mean(np.maximum(speeds, accelerations) > 0.9) > 0.85


@settings(max_examples=60, deadline=None)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 10**6), sample_s=st.sampled_from([0.02, 0.005, 0.3]))
def test_samples_are_even_on_the_path_and_end_at_its_ends(kind: str, seed: int, sample_s: float) -> None:
    points = random_path(kind, seed)
    path = time_path(points, DEGREE, VELOCITY, ACCELERATION, sample_s)
    steps = np.diff(path.t_s)
    assert path.t_s[0] == 0.0
    assert 0.0 < steps.min() <= steps.max() <= sample_s * (1 + 1e-9)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    np.testing.assert_array_equal(path.joints_rad[[0, -1]], points[[0, -1]])
    np.testing.assert_array_equal(path.velocities_rad_s[[0, -1]], 0.0)
    dense = evaluate(points, np.linspace(0.0, 1.0, 20001), DEGREE)
    assert cKDTree(dense).query(path.joints_rad)[0].max() < 2e-3  # half the distance between two of the dense points
    assert path.joints_rad.shape == path.velocities_rad_s.shape == (len(path.t_s), 5)


@pytest.mark.parametrize("kind", KINDS)
def test_velocities_are_the_derivative_of_the_joints(kind: str) -> None:
    path = time_path(random_path(kind, 5), DEGREE, VELOCITY, ACCELERATION, 1e-3)
    middle = np.diff(path.joints_rad, axis=0) / path.t_s[1]
    mean = 0.5 * (path.velocities_rad_s[1:] + path.velocities_rad_s[:-1])
    # Where the acceleration jumps within a step the two differ by at most a quarter of the jump's effect.
    np.testing.assert_allclose(middle, mean, atol=0.6 * ACCELERATION[0] * path.t_s[1])
    assert np.median(np.abs(middle - mean)) < 1e-4


def test_a_straight_line_is_bang_bang() -> None:
    """The slowest joint alone gives the duration: two ramps of 2 sqrt(d / a), or ramps and a plateau."""
    for reach in (0.2, 3.0):
        end = reach * np.array([1.0, -0.5, 0.3, 0.0, 0.1])
        for shape in (np.linspace(0.0, 1.0, 8), np.array([0.0, 0.0, 0.2, 0.4, 0.5, 0.9, 1.0, 1.0])):
            duration = time_path(np.outer(shape, end), DEGREE, VELOCITY, ACCELERATION, 0.02).t_s[-1]
            ramp = VELOCITY[0] / ACCELERATION[0]
            exact = 2 * math.sqrt(reach / ACCELERATION[0]) if reach < VELOCITY[0] * ramp else reach / VELOCITY[0] + ramp
            assert duration == pytest.approx(exact, rel=1e-3)


@settings(max_examples=30, deadline=None)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 10**6))
def test_backwards_takes_as_long(kind: str, seed: int) -> None:
    points = random_path(kind, seed)
    there = time_path(points, DEGREE, VELOCITY, ACCELERATION, 0.02).t_s[-1]
    back = time_path(points[::-1], DEGREE, VELOCITY, ACCELERATION, 0.02).t_s[-1]
    assert there == pytest.approx(back, rel=0.03)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), factor=st.floats(0.1, 10.0))
def test_time_scales_with_the_limits(seed: int, factor: float) -> None:
    """Twice the speed at four times the acceleration halves the time."""
    points = random_path("zero end", seed)
    slow = time_path(points, DEGREE, VELOCITY, ACCELERATION, 0.02).t_s[-1]
    fast = time_path(points, DEGREE, factor * VELOCITY, factor**2 * ACCELERATION, 0.02).t_s[-1]
    assert fast * factor == pytest.approx(slow, rel=1e-6)


@pytest.mark.parametrize("repeats", [4, 5, 6, 8])
def test_any_number_of_repeated_control_points(repeats: int) -> None:
    """Corners at which the path stands still, and ends that start with many zero derivatives."""
    rng = np.random.default_rng(repeats)
    points = np.repeat(rng.uniform(-1.0, 1.0, (3, 5)), repeats, axis=0)
    path = time_path(points, DEGREE, VELOCITY, ACCELERATION, 1e-3)
    legs = [math.sqrt(np.abs(np.diff(points[::repeats], axis=0) / ACCELERATION).max(axis=1)[leg]) for leg in range(2)]
    speed, acceleration = strain(path)
    assert speed <= 1.01
    assert acceleration <= 1.1
    assert path.t_s[-1] < 1.2 * 2 * sum(legs) + 0.1


def test_there_and_back_stops_at_the_cusp() -> None:
    """Along a straight line and back: twice the time of the line."""
    line = np.linspace(0.0, 1.0, 7)
    for turn in (0.3, 0.5, 0.8):
        tau = np.linspace(0.0, 1.0, 9)
        shape = np.interp(tau, [0.0, turn, 1.0], [0.0, 1.0, 0.0])
        points = np.outer(shape, [1.0, 0.4, -0.3, 0.0, 0.0])
        top = evaluate(points, np.linspace(0.0, 1.0, 4001), DEGREE)[:, 0].max()
        once = time_path(np.outer(line, top * points[4] / points[4, 0]), DEGREE, VELOCITY, ACCELERATION, 0.02).t_s[-1]
        path = time_path(points, DEGREE, VELOCITY, ACCELERATION, 1e-3)
        # It need not rest at the turn: the braking and the start are one acceleration.
        assert path.t_s[-1] == pytest.approx(2 * once, rel=0.01)
        assert strain(path)[1] <= 1.02


def test_a_path_that_stands_still_has_two_samples() -> None:
    points = np.tile([0.1, 0.2, 0.3, 0.4, 0.5], (7, 1))
    path = time_path(points, DEGREE, VELOCITY, ACCELERATION, 0.02)
    np.testing.assert_array_equal(path.t_s, [0.0, 0.02])
    np.testing.assert_array_equal(path.joints_rad, points[:2])
    np.testing.assert_array_equal(path.velocities_rad_s, 0.0)


@pytest.mark.parametrize("size", [1e-8, 1e-4, 100.0, 1e5])
def test_any_size_of_path(size: float) -> None:
    path = time_path(size * random_path("zero end", 1), DEGREE, VELOCITY, ACCELERATION, max(0.02, size))
    assert np.isfinite(path.joints_rad).all()
    assert path.t_s[-1] > 0.0
    assert len(path.t_s) > 1


def test_one_joint_and_other_degrees() -> None:
    for degree in (3, 4, 6):
        points = np.random.default_rng(degree).uniform(-1.0, 1.0, (9, 1))
        path = time_path(points, degree, [4.0], [14.0], 1e-3)
        step = path.t_s[1]
        assert np.abs(np.diff(path.joints_rad[:, 0], 2) / step**2).max() < 14.0 * 1.05
        np.testing.assert_array_equal(path.joints_rad[[0, -1]], points[[0, -1]])


def test_the_same_path_gives_the_same_motion() -> None:
    points = random_path("wild", 9)
    a, b = (time_path(points.copy(), DEGREE, VELOCITY, ACCELERATION, 0.02) for _ in range(2))
    for name in ("t_s", "joints_rad", "velocities_rad_s"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_the_control_points_are_left_alone_and_need_not_be_contiguous() -> None:
    points = random_path("zero end", 2)
    frozen = points[:, ::-1]
    frozen.setflags(write=False)
    path = time_path(frozen, DEGREE, VELOCITY[::-1], ACCELERATION, 0.02)
    mirrored = time_path(points, DEGREE, VELOCITY, ACCELERATION, 0.02)
    np.testing.assert_allclose(path.joints_rad[:, ::-1], mirrored.joints_rad, atol=1e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_control_point_that_is_not_finite_is_named(bad: float) -> None:
    points = random_path("wild", 0)
    points[2, 3] = bad
    with pytest.raises(NotFinite, match="control_points"):
        time_path(points, DEGREE, VELOCITY, ACCELERATION, 0.02)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"control_points": np.zeros((5, 5))}, "control_points"),
        ({"control_points": np.zeros(5)}, "control_points"),
        ({"control_points": np.full((8, 5), 1e9)}, "control_points"),
        ({"degree": 2}, "degree"),
        ({"velocity_rad_s": VELOCITY[:4]}, "velocity_rad_s"),
        ({"velocity_rad_s": 0.0 * VELOCITY}, "velocity_rad_s"),
        ({"acceleration_rad_s2": -ACCELERATION}, "acceleration_rad_s2"),
        ({"acceleration_rad_s2": math.nan * ACCELERATION}, "acceleration_rad_s2"),
        ({"sample_s": 0.0}, "sample_s"),
        ({"grid": 1}, "grid"),
    ],
)
def test_bad_input_is_named(change: dict[str, object], name: str) -> None:
    good = {
        "control_points": random_path("wild", 0),
        "degree": DEGREE,
        "velocity_rad_s": VELOCITY,
        "acceleration_rad_s2": ACCELERATION,
        "sample_s": 0.02,
    }
    with pytest.raises(InvalidSetting, match=name):
        time_path(**{**good, **change})
