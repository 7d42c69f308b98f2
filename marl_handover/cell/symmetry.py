"""The symmetries of a cell: isometries of the table that take its arms onto each other.

They are computed from where the arms stand and what they reach. A mirrored pair has four (identity, M_y, which swaps the arms, M_x, which
does not, and their product; method section 4), a regular ring of n arms 2 n, most cells only the identity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Array, namespace, wrap
from marl_handover.cell.arm import Arm, Disc
from marl_handover.cell.shared_space import SharedSpace

NO_ARM, LEFT, RIGHT = -1, 0, 1
ARM_LETTERS = ("L", "R")

_SAME_MM, _SAME_RAD = 1e-6, 1e-6

Matrix = tuple[tuple[float, float], tuple[float, float]]


class View(NamedTuple):
    """How an arm of a pair sees the frame of the shared space, so that each has its own base at the bottom: signs of x and of y."""

    x_sign: int
    y_sign: int

    @property
    def turn_sign(self) -> int:
        """Of angles: -1 in a mirror image."""
        return self.x_sign * self.y_sign


def pair_views(group: Sequence[Symmetry]) -> tuple[View, View]:
    """The views of the first and the second arm of a pair with these symmetries.

    The second sees the frame as it is, the first its image under the symmetry that swaps the arms: mirrored, unless only half a turn takes
    them onto each other, as where grips are beside their planes; mirrored also where none does, for the base line to be the same line.
    """
    swaps = [element for element in group if element.swaps]
    turned = bool(swaps) and not any(element.reflects for element in swaps)
    return View(-1 if turned else 1, -1), View(1, 1)


@dataclass(frozen=True)
class Symmetry:
    """One isometry p -> matrix p + shift_mm that takes a cell onto itself.

    Attributes:
        matrix: rotation or reflection.
        shift_mm: (x, y).
        arms: the image of each arm's index.
        chart_signs: (i, j), i < j, -> signs of alpha and beta in the chart of the image of that pair's shared space.
    """

    matrix: Matrix
    shift_mm: tuple[float, float]
    arms: tuple[int, ...]
    chart_signs: Mapping[tuple[int, int], tuple[int, int]] = field(compare=False, hash=False)

    @property
    def reflects(self) -> bool:
        """Whether it turns left into right."""
        (a, b), (c, d) = self.matrix
        return a * d - b * c < 0

    @property
    def swaps(self) -> bool:
        """Whether any arm becomes another one."""
        return self.arms != tuple(range(len(self.arms)))

    def pose(self, pose: Array) -> Array:
        """Image of poses (..., 3): x_mm, y_mm, theta_rad."""
        xp, ((a, b), (c, d)), (x_mm, y_mm) = namespace(pose), self.matrix, self.shift_mm
        x, y, theta = pose[..., 0], pose[..., 1], pose[..., 2]
        angle = math.atan2(c, a)
        return xp.stack([a * x + b * y + x_mm, c * x + d * y + y_mm, wrap(angle - theta if self.reflects else theta + angle)], -1)

    def arm(self, arm: Array) -> Array:
        """Image of arm indices (...); NO_ARM stays."""
        if not self.swaps:
            return arm
        xp = namespace(arm)
        image = arm
        for index, other in enumerate(self.arms):
            image = xp.where(arm == index, other, image)
        return image

    def chart(self, alpha: Array, beta: Array, pair: tuple[int, int] = (0, 1)) -> tuple[Array, Array]:
        """Image of coordinates in the chart of a pair of arms."""
        across, along = self.chart_signs[pair]
        return (-alpha if across < 0 else alpha), (-beta if along < 0 else beta)

    def action(self, action: Array) -> Array:
        """Image of actions as :meth:`~marl_handover.task.rules.Rules.decode` reads them: of a pair (..., 4), of N arms (..., 2 N + 3)."""
        xp, count = namespace(action), len(self.arms)
        if count == 2:
            alpha, beta = self.chart(action[..., 2], action[..., 3])
            # Zero means the first arm, so the swapped value of 0 has to come out positive.
            arm = xp.where(action[..., 1] > 0, -xp.ones_like(alpha), xp.ones_like(alpha)) if self.swaps else action[..., 1]
            return xp.stack([action[..., 0], arm, alpha, beta], -1)
        source = [self.arms.index(arm) for arm in range(count)]
        scores = [action[..., 1 + offset + arm] for offset in (0, count) for arm in source]
        giver, receiver = xp.argmax(action[..., 1 : 1 + count], -1), xp.argmax(action[..., 1 + count : 1 + 2 * count], -1)
        alpha, beta = action[..., -2], action[..., -1]
        for (i, j), (across, along) in self.chart_signs.items():
            there = ((giver == i) & (receiver == j)) | ((giver == j) & (receiver == i))
            alpha, beta = xp.where(there, across * alpha, alpha), xp.where(there, along * beta, beta)
        return xp.stack([action[..., 0], *scores, alpha, beta], -1)

    def then(self, other: Symmetry) -> Symmetry:
        """This one first, then ``other``."""
        R, S = np.array(self.matrix), np.array(other.matrix)
        signs = {}
        for (i, j), (across, along) in self.chart_signs.items():
            image = (self.arms[i], self.arms[j])
            further = other.chart_signs[(min(image), max(image))]
            signs[(i, j)] = (across * further[0], along * further[1])
        shift = S @ np.array(self.shift_mm) + np.array(other.shift_mm)
        return Symmetry(_exact(S @ R), (float(shift[0]), float(shift[1])), tuple(other.arms[arm] for arm in self.arms), signs)


def symmetries(arms: Sequence[Arm], spaces: Mapping[tuple[int, int], SharedSpace], discs: Sequence[Disc] = ()) -> tuple[Symmetry, ...]:
    """All symmetries of arms that share ``spaces``, with keep-out ``discs``, the identity first."""
    found = []
    for image in range(len(arms)):
        for handed in (1.0, -1.0):
            # An isometry is known by what it makes of one frame, and whether it reflects.
            R = arms[image].base.rotation() @ np.diag([1.0, handed]) @ arms[0].base.rotation().T
            shift = arms[image].base.position_mm - R @ arms[0].base.position_mm
            permutation = [_image(arm, arms, R, shift, handed) for arm in arms]
            if None not in permutation and len(set(permutation)) == len(arms) and _maps(discs, R, shift):
                found.append(_symmetry(R, shift, tuple(permutation), spaces))  # type: ignore[arg-type]
    return tuple(sorted(found, key=lambda one: (-one.matrix[0][0], -one.matrix[1][1])))


def _maps(discs: Sequence[Disc], R: np.ndarray, shift: np.ndarray) -> bool:
    """Whether an isometry takes every disc onto one of them."""
    images = [(*(R @ np.array(disc[:2]) + shift), disc.radius_mm) for disc in discs]
    return all(any(np.abs(np.subtract(image, disc)).max() < _SAME_MM for disc in discs) for image in images)


def _symmetry(R: np.ndarray, shift: np.ndarray, arms: tuple[int, ...], spaces: Mapping[tuple[int, int], SharedSpace]) -> Symmetry:
    signs = {}
    for (i, j), space in spaces.items():
        image = spaces[(min(arms[i], arms[j]), max(arms[i], arms[j]))]
        one, other = space.frame.rotation(), image.frame.rotation()
        signs[(i, j)] = tuple(round(float(other[:, axis] @ R @ one[:, axis])) for axis in range(2))
    return Symmetry(_exact(R), (float(round(shift[0], 9)) + 0.0, float(round(shift[1], 9)) + 0.0), arms, signs)  # type: ignore[arg-type]


def _image(arm: Arm, arms: Sequence[Arm], R: np.ndarray, shift: np.ndarray, handed: float) -> int | None:
    """The arm that stands where ``arm`` comes to stand, and can do what it can."""
    low, high = sorted(handed * value for value in arm.yaw_rad)
    lateral = handed * arm.lateral_mm
    for index, other in enumerate(arms):
        there = np.linalg.norm(R @ arm.base.position_mm + shift - other.base.position_mm) < _SAME_MM
        faces = np.linalg.norm(R @ arm.base.rotation()[:, 0] - other.base.rotation()[:, 0]) < _SAME_RAD
        reach = max(abs(arm.r_min_mm - other.r_min_mm), abs(arm.r_max_mm - other.r_max_mm)) < _SAME_MM
        turns = max(abs(low - other.yaw_rad[0]), abs(high - other.yaw_rad[1])) < _SAME_RAD
        beside = abs(lateral - other.lateral_mm) < _SAME_MM
        if there and faces and reach and turns and beside and arm.robot == other.robot:
            return index
    return None


def _exact(R: np.ndarray) -> Matrix:
    """The entries; those of quarter turns are whole."""
    whole = np.round(R)
    (a, b), (c, d) = (np.where(abs(R - whole) < 1e-9, whole, R) + 0.0).tolist()
    return (a, b), (c, d)
