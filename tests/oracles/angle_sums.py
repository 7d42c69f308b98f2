"""The fewest transfers of a problem by brute force: sampled hand-over places, sums of their angles, every sequence of arms.

The set of angles that k hand-overs can add up to is a set of bins on the circle, one for each first and last arm; one more hand-over is a
circular convolution. Of every set there are two: ``inner`` never claims a plan that is not there, ``outer`` never misses one. What is
narrower than 1 um everywhere is no shared space: ``inner`` has none of its angles, ``outer`` has them.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

BINS = 18_000
"""Of 0.02 degrees."""

ROUNDING_RAD = 1e-9


class AngleSums:
    """What sums of hand-over angles a layout offers."""

    def __init__(self, layout, bins=BINS):
        self.layout, self.bins = layout, bins
        self.width_rad = 2 * math.pi / bins
        count = layout.count
        self.inner, self.sampled = np.zeros((2, count, count, bins), bool)
        for i in range(count):
            for j in range(i):
                angles = layout.sampled_angles(i, j, self.width_rad / 2)
                index = np.rint(angles / self.width_rad).astype(int) % bins
                self.sampled[i, j, index] = self.sampled[j, i, -index % bins] = True
                index = index[layout.counts(i, j, angles, self.width_rad / 2)]
                self.inner[i, j, index] = self.inner[j, i, -index % bins] = True

    @cached_property
    def outer(self):
        """Every bin within two of a sampled one."""
        wide = self.sampled.copy()
        for shift in (-2, -1, 1, 2):
            wide |= np.roll(self.sampled, shift, -1)
        return wide

    def fewest(self, start, goal, epsilon_rad, limit=20, *, outer=False):
        """Fewest transfers (n,) of problems, poses (n, 3); 0 where ``limit`` are not enough.

        Every plan it finds is real, perhaps not the shortest; if ``outer`` no plan is shorter, perhaps there is none so short.
        """
        layout, best = self.layout, np.zeros(len(start), int)
        slack = 1e-3 if outer else 0.0
        # (n, first, last): the sum that the hand-overs have to have, and whether the first reaches the start and the last the goal.
        able = layout.reaches(start, slack)[:, :, None] & layout.reaches(goal, slack)[:, None, :]
        needed = (goal[:, 2] - start[:, 2])[:, None, None] + layout.psi(start)[:, :, None] - layout.psi(goal)[:, None, :]
        step = np.fft.rfft((self.outer if outer else self.inner).astype(float))
        sums = np.zeros_like(self.inner)
        sums[np.arange(layout.count), np.arange(layout.count), 0] = True
        for transfers in range(1, limit + 1):
            rounding = (transfers - 1) * self.width_rad / 2 + ROUNDING_RAD
            open_ = np.flatnonzero(best == 0)
            found = able[open_] & self._within(sums, needed[open_], epsilon_rad + (rounding if outer else -rounding))
            best[open_[found.any((1, 2))]] = transfers
            if best.all():
                break
            spectrum = np.einsum("ijf,jkf->ikf", np.fft.rfft(sums.astype(float)), step, optimize=True)
            sums = np.fft.irfft(spectrum, self.bins) > 0.5
        return best

    def _within(self, sums, needed, reach_rad):
        """Whether a sum lies within ``reach_rad`` of what is needed, (n, N, N), first arm by last arm."""
        middle = np.remainder(needed, 2 * math.pi) / self.width_rad
        low = np.ceil(middle - reach_rad / self.width_rad).astype(int)
        high = np.floor(middle + reach_rad / self.width_rad).astype(int)
        below = np.zeros((*sums.shape[:2], self.bins + 1), np.int32)
        np.cumsum(sums, -1, out=below[..., 1:])
        rows, columns = np.arange(len(sums))[:, None], np.arange(len(sums))[None, :]

        def number_below(index):
            return below[rows, columns, index % self.bins] + (index // self.bins) * below[..., -1]

        return number_below(np.maximum(high + 1, low)) > number_below(low)


def moved(layout, pose, arm, place):
    """Pose (n, 3) of a block that arm (n,) took to place (n, 2): theta' = theta + psi(p') - psi(p)."""
    rows = np.arange(len(pose))
    turn = layout.psi(place)[rows, arm] - layout.psi(pose)[rows, arm]
    theta = np.remainder(pose[:, 2] + turn + math.pi, 2 * math.pi) - math.pi
    return np.concatenate([place, theta[:, None]], -1)
