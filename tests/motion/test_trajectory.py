"""Laws of the clamped B-splines."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.errors import InvalidSetting
from marl_handover.motion.trajectory import basis, evaluate, knots

SIZES = st.tuples(st.integers(1, 6), st.integers(1, 8)).map(lambda pair: (pair[0] + pair[1], pair[0]))


@given(SIZES, st.floats(0, 1))
def test_the_basis_is_a_partition_of_unity(size, tau):
    values = basis([tau], *size)
    assert values.shape == (1, size[0])
    assert (values >= -1e-12).all()
    assert values.sum() == pytest.approx(1.0, abs=1e-12)


@given(SIZES, st.integers(0, 1000))
def test_a_path_starts_and_ends_at_its_control_points_and_stays_in_their_hull(size, seed):
    points = np.random.default_rng(seed).normal(size=(size[0], 5))
    path = evaluate(points, np.linspace(0, 1, 101), size[1])
    np.testing.assert_allclose(path[[0, -1]], points[[0, -1]], atol=1e-12)
    assert (path >= points.min(axis=0) - 1e-12).all()
    assert (path <= points.max(axis=0) + 1e-12).all()


@pytest.mark.parametrize("derivative", [1, 2])
def test_derivatives_agree_with_differences(derivative):
    points = np.random.default_rng(1).normal(size=(9, 5))
    tau, h = np.linspace(0.01, 0.99, 37), 1e-5
    low, high = (evaluate(points, tau + sign * h, 5, derivative - 1) for sign in (-1, 1))
    np.testing.assert_allclose(evaluate(points, tau, 5, derivative), (high - low) / (2 * h), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(("count", "degree"), [(5, 5), (3, 5), (4, 0)])
def test_too_few_control_points_are_refused(count, degree):
    with pytest.raises(InvalidSetting, match="control_points"):
        knots(count, degree)
