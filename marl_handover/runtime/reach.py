"""Objects at the edge of what the arms reach."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.cell import Cell

Floats = NDArray[np.float64]


def drawn_in(cell: Cell, pose: Floats, edge_mm: float) -> Floats:
    """``pose`` (3,) as a supervisor is to see it.

    An object that lies up to ``edge_mm`` outside every arm's sector, as placement noise may leave it, is shown at the next place inside,
    so that the rule book lets an arm take it; the arm still goes for where it was measured, if its joints allow. Every other object is
    shown where it is, also one that is farther out: no arm can reach it.
    """
    square, yaw = cell.polar(pose)
    if cell.within(square, yaw).any():
        return pose
    radius = np.clip(np.sqrt(square), cell.r_min_mm, cell.r_max_mm)
    angle = cell.gripper_yaw(np.clip(yaw, *cell.yaw_rad))
    bases = np.array([base.position_mm for base in cell.bases])
    places = bases + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    away = np.hypot(*(places - pose[:2]).T)
    nearest = int(away.argmin())
    return np.array([*places[nearest], pose[2]]) if away[nearest] <= edge_mm else pose
