"""Clamped uniform B-splines: basis, derivatives, bounds.

A path is q(tau) = sum_i B_i,d(tau) theta_i for tau in [0, 1] (the paper's zeta, section Set-up), with control points theta (N, joints).
Clamped: the path starts at the first control point and ends at the last. A path lies in the convex hull of its control points.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from marl_handover.errors import InvalidSetting

Floats = NDArray[np.float64]


def knots(control_points: int, degree: int) -> Floats:
    """The clamped uniform knot vector (N + degree + 1,). Raises :class:`InvalidSetting` unless N > degree >= 1."""
    if degree < 1 or control_points <= degree:
        raise InvalidSetting("control_points", control_points, f"more than the degree, {degree}, which must be at least 1")
    inner = np.linspace(0.0, 1.0, control_points - degree + 1)
    return np.concatenate([np.zeros(degree), inner, np.ones(degree)])


def basis(tau: ArrayLike, control_points: int, degree: int, derivative: int = 0) -> Floats:
    """Basis functions, or their derivative with respect to tau, at ``tau`` (n,) in [0, 1]: (n, N)."""
    spline = BSpline(knots(control_points, degree), np.eye(control_points), degree)
    return np.asarray(spline(np.clip(np.asarray(tau, dtype=float), 0.0, 1.0), nu=derivative))


@lru_cache(maxsize=64)
def sampled_basis(samples: int, control_points: int, degree: int, derivative: int = 0) -> Floats:
    """:func:`basis` at ``samples`` even values of tau from 0 to 1; computed once for each, read-only."""
    values = basis(np.linspace(0.0, 1.0, samples), control_points, degree, derivative)
    values.setflags(write=False)
    return values


@lru_cache(maxsize=16)
def sample_places(samples: int, crowding: float) -> Floats:
    """Values of tau (S,) from 0 to 1, denser towards both ends, where the lift-over profile is steep."""
    even = np.linspace(0.0, 1.0, samples)
    tau: Floats = even - crowding * np.sin(2 * math.pi * even) / (2 * math.pi)
    tau[0], tau[-1] = 0.0, 1.0
    return tau


def evaluate(control_points: ArrayLike, tau: ArrayLike, degree: int, derivative: int = 0) -> Floats:
    """The path of control points (N, joints), or its derivative, at ``tau`` (n,): (n, joints)."""
    points = np.asarray(control_points, dtype=float)
    return basis(tau, len(points), degree, derivative) @ points
