"""What a path is judged against, packed for the compiled functions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Scene(NamedTuple):
    """One arm, what it holds and what stands around it. Lengths in mm; layouts of the rows: :mod:`marl_handover.geometry.kernels`.

    Attributes:
        planar: (14,) the arm's links.
        capsules: (K, 9) its shapes, sorted by level, then those of the held block.
        carried: index of the first shape that is held.
        pairs: (P, 2) indices of shapes that must not touch; first those of base or turret with the hand.
        obstacles: (M, 9) of what stands around, the other arm's first.
        arm_rows: how many of them are the other arm's.
        group: (5,) a ball around all obstacles (x, y, z, radius), and the greatest clearance they demand.
        clearance: (2,) demanded to itself and to the table.
        pick_height: of the grip at both ends.
        edges: (E, 2) the held block's lower edges (x, z) in the wrist's frame.
        profile: (8,) of the lift-over: the two ends (x, y), the length scale of each end (0: it asks for nothing), lift, ground clearance.
    """

    planar: Floats
    capsules: Floats
    carried: int
    pairs: Ints
    obstacles: Floats
    arm_rows: int
    group: Floats
    clearance: Floats
    pick_height: float
    edges: Floats
    profile: Floats
