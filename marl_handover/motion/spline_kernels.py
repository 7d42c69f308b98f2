"""Compiled kernels that read a B-spline: its values, its cusps, its pieces that stand still."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STILL = 1e-9
"""A dq/dtau smaller than this part of the greatest is none; a path shorter than this, in rad, stands still."""

_NO_TURN = math.cos(math.radians(3.0))


@njit(cache=True, nogil=True, error_model="numpy")
def spline(points: Floats, knots: Floats, degree: int, tau: Floats) -> Floats:
    """The spline (n, joints) at ``tau`` (n,), ascending, by the recursion of Cox and de Boor."""
    joints = points.shape[1]
    values = np.zeros((tau.shape[0], joints))
    basis = np.empty(degree + 1)
    span = degree
    for j in range(tau.shape[0]):
        at = tau[j]
        while span < points.shape[0] - 1 and at >= knots[span + 1]:
            span += 1
        basis[0] = 1.0
        for order in range(1, degree + 1):
            carried = 0.0
            for r in range(order):
                right, left = knots[span + 1 + r], knots[span + 1 + r - order]
                part = basis[r] / (right - left)
                basis[r] = carried + (right - at) * part
                carried = (at - left) * part
            basis[order] = carried
        for r in range(degree + 1):
            for k in range(joints):
                values[j, k] += basis[r] * points[span - degree + r, k]
    return values


@njit(cache=True, nogil=True, error_model="numpy")
def dot(a: Floats, i: int, b: Floats, j: int) -> float:
    """The product of row i of ``a`` and row j of ``b``."""
    total = 0.0
    for k in range(a.shape[1]):
        total += a[i, k] * b[j, k]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def turns(tau: Floats, first: Floats) -> Floats:
    """About where the path turns by more than a right angle from one ``tau`` (n,) to the next; ``first`` (n, joints) is dq/dtau.

    Where dq/dtau vanishes at a ``tau``, its neighbours are compared, and any turn counts.
    """
    most = 0.0
    for j in range(tau.shape[0]):
        most = max(most, dot(first, j, first, j))
    found = np.empty(tau.shape[0])
    count, last = 0, -1
    for j in range(tau.shape[0]):
        square = dot(first, j, first, j)
        if square <= STILL**2 * most:
            continue
        if last >= 0:
            along = dot(first, last, first, j)
            before = dot(first, last, first, last)
            if along < (0.0 if j == last + 1 else _NO_TURN * math.sqrt(before * square)):
                found[count] = tau[last] + (before - along) / (before - 2.0 * along + square) * (tau[j] - tau[last])  # secant
                count += 1
        last = j
    return found[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def still_spans(first_points: Floats, knots: Floats, degree: int) -> Floats:
    """The inner ends of those spans between knots on which the path stands still."""
    most = 0.0
    for j in range(first_points.shape[0]):
        most = max(most, dot(first_points, j, first_points, j))
    found = np.empty(2 * first_points.shape[0])
    count, run = 0, 0
    for j in range(first_points.shape[0]):
        run = run + 1 if dot(first_points, j, first_points, j) <= STILL**2 * most else 0
        if run >= degree:
            for end in range(2):
                if 0.0 < knots[j + 1 + end] < 1.0:
                    found[count] = knots[j + 1 + end]
                    count += 1
    return found[:count]
