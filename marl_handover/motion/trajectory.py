"""What an arm is told and what it then does: the three paths of a cycle, and the timed phases they become."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import WorkFailed

Floats = NDArray[np.float64]

PHASES = ("approach", "grasp", "lift", "transfer", "lower", "release", "retreat")
"""Names of the phases of a pick and place, in order."""

LOADED_PHASES = ("lift", "transfer", "lower")
"""Those in which the hand holds the block."""


INSTANT_S = 0.002
"""How long a motion lasts that is over already."""


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
        super().__init__(f"arm {arm} cannot {what} at ({position_mm[0]:z.1f}, {position_mm[1]:z.1f}) mm: outside its manipulation space")


class PickPlacePaths(NamedTuple):
    """Control points (N, 5) in rad of one cycle's three splines: parked to pin, pin to place, place to parked."""

    approach: Floats
    transfer: Floats
    retreat: Floats


@dataclass(frozen=True)
class JointTrajectory:
    """A timed motion of one arm, from rest to rest: ``t_s`` (n,) from 0, ``joints_rad`` (n, joints), ``velocities_rad_s`` (n, joints).

    Cubics join the samples, so these are as near to the motion as they are dense.
    """

    t_s: Floats
    joints_rad: Floats
    velocities_rad_s: Floats

    @property
    def duration_s(self) -> float:
        """How long it takes."""
        return float(self.t_s[-1])

    @property
    def end_rad(self) -> Floats:
        """Joints (5,) at its end."""
        return np.asarray(self.joints_rad[-1])

    def at(self, t_s: Floats | float) -> tuple[Floats, Floats]:
        """Joints and rates (..., 5) at times (...); before its beginning and after its end it rests there."""
        t = np.asarray(t_s, float)
        i = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, len(self.t_s) - 2)
        h = (self.t_s[i + 1] - self.t_s[i])[..., None]
        z = np.clip((t - self.t_s[i])[..., None] / h, 0.0, 1.0)
        p, q, v, w = self.joints_rad[i], self.joints_rad[i + 1], h * self.velocities_rad_s[i], h * self.velocities_rad_s[i + 1]
        bend, twist = 3 * (q - p) - 2 * v - w, 2 * (p - q) + v + w
        rates = (v + z * (2 * bend + 3 * z * twist)) / h
        inside = ((t >= 0.0) & (t <= self.t_s[-1]))[..., None]
        return p + z * (v + z * (bend + z * twist)), np.where(inside, rates, 0.0)

    def rest(self, t_s: float) -> JointTrajectory:
        """What is left of it from ``t_s`` on."""
        if t_s <= 0.0:
            return self
        if t_s >= self.duration_s:
            return still(self.end_rad, INSTANT_S)
        joints, rates = self.at(t_s)
        after = int(np.searchsorted(self.t_s, t_s + 1e-9))
        t = np.concatenate([[0.0], self.t_s[after:] - t_s])
        return JointTrajectory(
            t, np.concatenate([joints[None], self.joints_rad[after:]]), np.concatenate([rates[None], self.velocities_rad_s[after:]])
        )


def still(joints_rad: Floats, duration_s: float) -> JointTrajectory:
    """An arm that holds ``joints_rad`` (5,)."""
    return JointTrajectory(np.array([0.0, duration_s]), np.stack([joints_rad, joints_rad]), np.zeros((2, len(joints_rad))))


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
    """One transfer: ``arm`` takes the block from ``from_mm`` (2,) to ``to_mm`` (2,), the others holding still at
    ``other_joints_rad`` (others, 5), or (5,) where there is one.

    ``phases`` are its trajectory, and empty before it is timed.
    """

    arm: int
    from_mm: Floats
    to_mm: Floats
    paths: PickPlacePaths
    phases: tuple[Phase, ...]
    other_joints_rad: Floats
    path_length_mm: float
    min_clearance_mm: float
    planning_ms: float

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return float(self.phases[-1].t_s[-1] - self.phases[0].t_s[0])
