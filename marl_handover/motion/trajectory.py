"""What an arm is told and what it then does: the three paths of a cycle, and the timed phases they become."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import WorkFailed

Floats = NDArray[np.float64]

PHASES = ("approach", "grasp", "lift", "transfer", "lower", "release", "retreat")
"""Names of a cycle's phases, in order."""


class NoPath(WorkFailed):
    """No collision-free path was found. ``reason``: ``start``, ``end`` (that pose itself is too near something) or ``path``."""

    def __init__(self, reason: str, what: str, shortfall_mm: float, starts: int) -> None:
        self.reason, self.what, self.shortfall_mm, self.starts = reason, what, shortfall_mm, starts
        if reason == "path":
            text = f"no collision-free path among {starts} starts; the nearest miss is {shortfall_mm:.1f} mm short of {what}"
        else:
            text = f"the {reason} pose is {shortfall_mm:.1f} mm short of {what}"
        super().__init__(text)


class OutOfArmsReach(WorkFailed):
    """A command names a place outside the arm's own manipulation space."""

    def __init__(self, arm: int, what: str, position_mm: Floats) -> None:
        self.arm, self.what, self.position_mm = arm, what, position_mm
        super().__init__(f"arm {arm} cannot {what} at ({position_mm[0]:.1f}, {position_mm[1]:.1f}) mm: outside its manipulation space")


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
