"""The dense check of a path, without any tolerance: clearances, heights and length at many samples."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled
from marl_handover.geometry.kernels import (
    FAR_MM,
    at_wrist,
    broad_phase,
    closest_points,
    forward_kinematics,
    hand_ball,
    hand_is_away,
    into_arm_plane,
    place_capsules,
)
from marl_handover.motion.collision_model import Scene
from marl_handover.motion.objective import first_moving, ramp

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ROUNDING_MM = 1e-6
"""Heights that are met exactly at an end, such as a block standing on the table, may fall short by this much."""


COARSE = 25
"""The coarse pass looks at every 25th sample."""


class Margins(NamedTuple):
    """What a path leaves over, in mm, at the tightest sample; negative where it falls short.

    ``arm`` and ``block``: smallest distance less the clearance demanded, to the other arm and to the standing block; ``itself``, ``ground``
    likewise; ``lift``: height of the grip over the lift-over profile; ``edge``: height of the held block over what is demanded of it.
    """

    arm: float
    block: float
    itself: float
    ground: float
    lift: float
    edge: float

    @property
    def worst(self) -> float:
        """The smallest margin; lift and edge count from their rounding on."""
        return min(self.arm, self.block, self.itself, self.ground, self.lift + ROUNDING_MM, self.edge + ROUNDING_MM)


@compiled
def dense_margins(Q: Floats, scene: Scene, out: Floats) -> float:
    """Fill ``out`` (6,) with the fields of :class:`Margins` over the joint samples ``Q`` (S, 4); the grip's path length in mm.

    A coarse pass finds what is nearly the tightest, so that the full one can skip nearly every pair: those that are surely farther apart.
    """
    planar, capsules, pairs, obstacles = scene.planar, scene.capsules, scene.pairs, scene.obstacles
    edges, profile, K = scene.edges, scene.profile, scene.capsules.shape[0]
    frames, ends, placed, point, slope = np.empty((1, 5, 4)), np.empty((K, 10)), np.empty((2, 10)), np.empty(6), np.empty(3)
    first, hand = first_moving(capsules), 0
    while hand < K and capsules[hand, 0] < 4.0:
        hand += 1
    out[:] = FAR_MM
    length, px, py, pz = 0.0, 0.0, 0.0, 0.0
    for stride in (COARSE, 1):
        for i in range(0, Q.shape[0], stride):
            forward_kinematics(planar, Q, i, frames, 0)
            place_capsules(capsules, frames, 0, ends)
            cy, sy = math.cos(Q[i, 0]), math.sin(Q[i, 0])
            _around(cy, sy, first, hand, planar, capsules, obstacles, scene.arm_rows, frames, ends, placed, point, out)
            _itself(first, scene.carried, planar, capsules, pairs, scene.clearance, frames, ends, point, out)
            if stride > 1:
                continue
            r, z = at_wrist(frames, 0, planar[6], planar[7])
            x, y = r * cy, r * sy
            if i > 0:
                length += math.sqrt((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2)
            px, py, pz = x, y, z
            ramp(x, y, profile, slope)
            out[4] = min(out[4], z - scene.pick_height - profile[6] * slope[0])
            for e in range(edges.shape[0]):
                _, height = at_wrist(frames, 0, edges[e, 0], edges[e, 1])
                out[5] = min(out[5], height - profile[7] * slope[0])
    return length


@compiled
def _around(
    cy: float, sy: float, first: int, hand: int, planar: Floats, capsules: Floats, obstacles: Floats, arm_rows: int, frames: Floats,
    ends: Floats, placed: Floats, point: Floats, out: Floats,
) -> None:  # fmt: skip
    """Take one sample's distances to obstacles into ``out``; the hand's shapes are skipped together where a ball around them is away."""
    hand_ball(planar, frames, 0, placed, 1)
    for j in range(obstacles.shape[0]):
        into_arm_plane(obstacles, j, cy, sy, placed, 0)
        field = 0 if j < arm_rows else 1
        away = obstacles[j, 6] + obstacles[j, 7]
        for k in range(first, hand if broad_phase(placed, 1, placed, 0, away + planar[13] + out[field]) else capsules.shape[0]):
            need = away + capsules[k, 7]
            if not broad_phase(ends, k, placed, 0, need + out[field]):
                out[field] = min(out[field], closest_points(ends, k, placed, 0, point) - need)


@compiled
def _itself(
    first: int, carried: int, planar: Floats, capsules: Floats, pairs: Ints, clearance: Floats, frames: Floats, ends: Floats,
    point: Floats, out: Floats,
) -> None:  # fmt: skip
    """Take one sample's distances of the arm to itself and to the table into ``out``."""
    P, grouped = pairs.shape[0], 0
    if hand_is_away(planar, frames, 0, clearance[0] + max(out[2], 0.0)):
        while grouped < P and pairs[grouped, 0] < first and capsules[pairs[grouped, 1], 0] >= 4.0:
            grouped += 1
    for p in range(grouped, P):
        a, b = pairs[p, 0], pairs[p, 1]
        need = clearance[0] + capsules[a, 7] + capsules[b, 7]
        if not broad_phase(ends, a, ends, b, need + out[2]):
            out[2] = min(out[2], closest_points(ends, a, ends, b, point) - need)
    for k in range(first, carried):
        out[3] = min(out[3], min(ends[k, 2], ends[k, 5]) - capsules[k, 7] - clearance[1])
