"""What an arm is told and what it then does: the three paths of a cycle, and the timed phases they become."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PHASES = ("approach", "grasp", "lift", "transfer", "lower", "release", "retreat")
"""Names of a cycle's phases, in order."""


class CyclePaths(NamedTuple):
    """Control points (N, 5) in rad of one cycle's three splines: parked to pin, pin to place, place to parked."""

    approach: Floats
    transfer: Floats
    retreat: Floats


@dataclass(frozen=True)
class Phase:
    """A timed piece of a cycle.

    ``t_s`` (n,) runs on over the phases of a cycle, at intervals of at most 20 ms; a phase's first sample is the last of the phase before.
    ``joints_rad`` (n, 5); ``gripper_mm`` (n,) is how far each finger is from closed.
    """

    name: str
    t_s: Floats
    joints_rad: Floats
    gripper_mm: Floats


@dataclass(frozen=True)
class TransferMotion:
    """One transfer, planned and timed: ``arm`` takes the block from ``from_mm`` (2,) to ``to_mm`` (2,), the other arm holding still."""

    arm: int
    from_mm: Floats
    to_mm: Floats
    paths: CyclePaths
    phases: tuple[Phase, ...]
    other_joints_rad: Floats
    path_length_mm: float
    min_clearance_mm: float
    planning_ms: float

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return float(self.phases[-1].t_s[-1] - self.phases[0].t_s[0])
