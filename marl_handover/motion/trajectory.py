"""What an arm is told and what it then does: the three paths of a cycle, and the timed phases they become."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from marl_handover.errors import InvalidSetting, WorkFailed

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
