"""What first guesses and parked poses take from an arm's size: lengths and postures that were found for the AL5A, as shares of its own."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats

NEAR_SHARES = (0.1, 0.2, 0.35, 0.45)
"""How far in front of the shoulder guesses let the wrist and the grip come, and where they draw the arm in to, as shares of its length."""

UPRIGHT = 1
POSTURES_DEG = ((120.0, -10.0, 50.0), (140.0, 25.0, 95.0), (130.0, -30.0, 30.0))
"""Where upper arm, forearm and hand point half-way of the guesses that draw the arm in: reaching up, upright, folded."""

LEVERS_MM, LENGTH_MM = np.array([190.0, 190.0, 130.0, 100.0]), 300.0
"""How far a radian of yaw and the three pitches moves the grip of an arm of this length."""


class Proportions(NamedTuple):
    """What guesses take from an arm's size: its whole length, how near to the yaw axis its wrist and its grip may come, two radii to draw
    it in to, all in mm; which way its hand points at zero, in rad; and joints (3,) of the pitches in :data:`POSTURES_DEG`.
    """

    length_mm: float
    wrist_least_mm: float
    grip_least_mm: float
    near_mm: float
    middle_mm: float
    hand_rad: float
    postures_rad: tuple[Floats, ...]


def proportions(planar: Floats) -> Proportions:
    """Those of an arm with these links, as :mod:`marl_handover.geometry.kernels` has them."""
    return _proportions(tuple(planar[:8].tolist()))


@lru_cache(maxsize=16)
def _proportions(planar: tuple[float, ...]) -> Proportions:
    links = [planar[2:4], planar[4:6], planar[6:8]]
    length = round(sum(math.hypot(*link) for link in links), 6)
    slopes = [math.degrees(math.atan2(link[1], link[0])) for link in links]
    postures = []
    for directions in POSTURES_DEG:
        upper, fore, hand = (direction - slope for direction, slope in zip(directions, slopes, strict=True))
        postures.append(np.radians((upper, fore - upper, hand - fore)))
    wrist, grip, near, middle = (round(planar[0] + share * length, 6) for share in NEAR_SHARES)
    return Proportions(length, wrist, grip, near, middle, math.radians(slopes[2]), tuple(postures))
