"""Between the package and viser, whose lengths are in m, whose turns are quaternions (w, x, y, z) and whose colours are numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Colour = tuple[int, int, int]

UPWARDS = (0.0, 0.0, 1.0)


def metres(length_mm: ArrayLike) -> Floats:
    """Lengths or points of any shape."""
    return np.asarray(length_mm, float) / 1000.0


def rgb(colour: str) -> Colour:
    """Of ``#RRGGBB``."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def quaternion(axis: Sequence[float], angle_rad: float) -> Floats:
    """The turn (4,) by ``angle_rad`` about a unit vector."""
    half = angle_rad / 2
    return np.array([math.cos(half), *(math.sin(half) * component for component in axis)])


def product(first: Floats, second: Floats) -> Floats:
    """The turn (4,) that makes ``second`` and then ``first``."""
    w, v, a, b = first[0], first[1:], second[0], second[1:]
    return np.array([w * a - v @ b, *(w * b + a * v + np.cross(v, b))])


def turned(R: Floats) -> Floats:
    """The quaternion (4,) of a rotation matrix (3, 3)."""
    # Of the four components the largest is found without loss of accuracy; the others follow from it.
    squares = np.array([1 + np.trace(R), *(1 + 2 * R[i, i] - np.trace(R) for i in range(3))])
    largest = int(np.argmax(squares))
    sums = np.array(
        [
            [0.0, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], 0.0, R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], 0.0, R[2, 1] + R[1, 2]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], 0.0],
        ]
    )
    row = sums[largest]
    row[largest] = squares[largest]
    return np.asarray(row / (2 * math.sqrt(squares[largest])))


def yaw_of(wxyz: Floats) -> float:
    """The turn in rad about the vertical of a quaternion (4,) that is one about the vertical."""
    return 2 * math.atan2(wxyz[3], wxyz[0]) if wxyz[0] >= 0 else 2 * math.atan2(-wxyz[3], -wxyz[0])


def flat(pose: ArrayLike, height_mm: float = 0.0) -> tuple[Floats, Floats]:
    """Quaternion (4,) and position (3,) in m of a pose (x_mm, y_mm, yaw_rad) at a height above the table."""
    x_mm, y_mm, yaw_rad = np.asarray(pose, float)
    return quaternion(UPWARDS, float(yaw_rad)), metres([x_mm, y_mm, height_mm])
