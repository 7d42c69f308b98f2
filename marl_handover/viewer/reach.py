"""The nearest place that an arm of the cell reaches, for a pose that somebody drags about."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell import Cell

Floats = NDArray[np.float64]


def within_reach(cell: Cell, pose: Floats) -> Floats:
    """``pose`` (3,) in mm and rad with its position moved to the nearest one (to rounding) that some arm reaches."""
    if cell.reaches(pose[:2]).any():
        return pose.copy()
    candidates = np.concatenate([_of_sector(cell, arm, pose[:2]) for arm in range(cell.num_arms)])
    reached = candidates[cell.reaches(candidates).any(-1)]
    nearest = reached[int(np.argmin(np.hypot(*(reached - pose[:2]).T)))]
    return np.array([*nearest, pose[2]])


def _of_sector(cell: Cell, arm: int, point_mm: Floats) -> Floats:
    """Points (n, 2) of one arm's annulus sector, the nearest to ``point_mm`` among them: on its arcs, its straight edges, its corners."""
    base = cell.bases[arm]
    centre, (low, high) = base.position_mm, cell.yaw_rad
    square, yaw = (float(value[arm]) for value in cell.polar(point_mm))
    radius = math.sqrt(square)
    at = [(float(np.clip(radius, cell.r_min_mm, cell.r_max_mm)), float(np.clip(yaw, low, high)))]
    at += [(float(np.clip(radius * math.cos(yaw - edge), cell.r_min_mm, cell.r_max_mm)), edge) for edge in (low, high)]
    return np.array([centre + r * np.array([math.cos(base.facing_rad + a), math.sin(base.facing_rad + a)]) for r, a in at])
