"""Compiled search of the exact planner: the ways along which hand-over angles add up, and the shortest that solves each problem.

A hop is an arm that passes to another with one arc of hand-over angles. A way is a chain of hops; it knows the way it continues, its last
hop, and the lowest and highest sum of its signed hand-over angles. The ways of a level have the same number of transfers; they are sorted
by their first and last arm, a *bucket* each.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_SAME_RAD = 1e-9
_SPARE = 0.1
"""A way is left out where wider ones cover it, each of them shortened at both ends by this part of the way's own width."""


@compiled
def _apart(angle: float, period: float) -> float:
    """An angle modulo a period, in [-period / 2, period / 2)."""
    return (angle + period / 2) % period - period / 2


@compiled
def _covers(low: float, high: float, other_low: float, other_high: float, period: float) -> bool:
    """Whether all sums of the other way are sums of this one, modulo the period."""
    if high - low >= period:
        return True
    apart = _apart((low + high - other_low - other_high) / 2, period)
    return abs(apart) + (other_high - other_low) / 2 <= (high - low) / 2 + _SAME_RAD


@compiled
def _covered(low: float, high: float, lows: Floats, highs: Floats, kept: Ints, count: int, period: float) -> bool:
    """Whether wider ways, ``count`` of them, together cover a way, with something to spare."""
    spare = _SPARE * (high - low)
    reached = low
    for _ in range(2 * count + 2):
        farthest = reached
        for number in range(count):
            least, most = lows[kept[number]] + spare, highs[kept[number]] - spare
            if most - least >= period:
                return True
            if most > least:
                offset = (reached - least) % period
                if offset <= most - least:
                    farthest = max(farthest, reached + (most - least - offset))
        if farthest >= high:
            return True
        if farthest <= reached:
            return False
        reached = farthest
    return False


@compiled
def _worth_trying(lows: Floats, highs: Floats, members: Ints, count: int, period: float) -> int:
    """Sort out the ways of a bucket: those that one other covers, then those that wider ones together do. Gives how many are left."""
    kept = 0
    for number in range(count):
        way = members[number]
        rivals = False
        for rival in range(kept):
            if _covers(lows[members[rival]], highs[members[rival]], lows[way], highs[way], period):
                rivals = True
                break
        if not rivals:
            left = 0
            for rival in range(kept):
                if not _covers(lows[way], highs[way], lows[members[rival]], highs[members[rival]], period):
                    members[left] = members[rival]
                    left += 1
            members[left] = way
            kept = left + 1
    if kept < 3:
        return kept
    widths = np.empty(kept)
    for number in range(kept):
        widths[number] = lows[members[number]] - highs[members[number]]
    order = np.argsort(widths, kind="mergesort")
    chosen, left = np.empty(kept, np.int64), 0
    for number in range(kept):
        way = members[order[number]]
        if not _covered(lows[way], highs[way], lows, highs, chosen, left, period):
            chosen[left] = way
            left += 1
    for number in range(left):
        members[number] = chosen[number]
    return left


@compiled
def _grown(values: Ints) -> Ints:
    longer = np.empty(2 * len(values), np.int64)
    longer[: len(values)] = values
    return longer


@compiled
def all_ways(
    num_arms: int, hop_from: Ints, hop_to: Ints, hop_low: Floats, hop_high: Floats, levels: int, period: float
) -> tuple[Ints, Ints, Floats, Floats, Ints]:
    """The ways worth trying of up to ``levels`` transfers.

    Returns:
        parent, hop (W,): the way that each continues and its last hop, -1 for one transfer; low, high (W,): sums in rad;
        start (levels, num_arms, num_arms + 1): ways of a bucket [level, first, last] are from its entry to the next.
    """
    buckets = num_arms * num_arms
    parent, hop = np.full(64, -1, np.int64), np.full(64, -1, np.int64)
    low, high, last = np.zeros(64), np.zeros(64), np.zeros(64, np.int64)
    start = np.zeros((levels, num_arms, num_arms + 1), np.int64)
    total = 0
    for first in range(num_arms):
        for arm in range(num_arms + 1):
            start[0, first, arm] = total
            if arm == first:
                last[total] = first
                total += 1
    for level in range(1, levels):
        c_parent, c_hop, c_first = np.empty(256, np.int64), np.empty(256, np.int64), np.empty(256, np.int64)
        c_low, c_high = np.empty(256), np.empty(256)
        count = 0
        for first in range(num_arms):
            for way in range(start[level - 1, first, 0], start[level - 1, first, num_arms]):
                for step in range(len(hop_from)):
                    if hop_from[step] == last[way]:
                        if count == len(c_parent):
                            c_parent, c_hop, c_first = _grown(c_parent), _grown(c_hop), _grown(c_first)
                            c_low, c_high = np.append(c_low, np.empty(count)), np.append(c_high, np.empty(count))
                        c_parent[count], c_hop[count], c_first[count] = way, step, first
                        c_low[count], c_high[count] = low[way] + hop_low[step], high[way] + hop_high[step]
                        count += 1
        members, filled = np.empty((buckets, max(count, 1)), np.int64), np.zeros(buckets, np.int64)
        for number in range(count):
            bucket = c_first[number] * num_arms + hop_to[c_hop[number]]
            members[bucket, filled[bucket]] = number
            filled[bucket] += 1
        for first in range(num_arms):
            for arm in range(num_arms):
                bucket = first * num_arms + arm
                start[level, first, arm] = total
                for number in range(_worth_trying(c_low, c_high, members[bucket], filled[bucket], period)):
                    if total == len(parent):
                        parent, hop, last = _grown(parent), _grown(hop), _grown(last)
                        low, high = np.append(low, np.empty(total)), np.append(high, np.empty(total))
                    way = members[bucket, number]
                    parent[total], hop[total], last[total] = c_parent[way], c_hop[way], arm
                    low[total], high[total] = c_low[way], c_high[way]
                    total += 1
            start[level, first, num_arms] = total
    return parent[:total], hop[:total], low[:total], high[:total], start


@compiled
def shortest(
    start_in: NDArray[np.bool_],
    goal_in: NDArray[np.bool_],
    psi: Floats,
    goal_psi: Floats,
    turn: Floats,
    epsilon: Floats,
    low: Floats,
    high: Floats,
    start: Ints,
    period: float,
    out: Ints,
    fit: Floats,
) -> None:
    """The shortest way of each problem, and among equally short ones that with the most slack.

    ``start_in``, ``goal_in`` (n, num_arms): who reaches start and goal; ``psi``, ``goal_psi`` (n, num_arms): gripper yaws there; ``turn``
    (n,) of the object from start to goal; ``epsilon`` (n,); all in rad. ``low``, ``high`` and ``start`` are those of :func:`all_ways`.
    Fills ``out`` (n, 3) with transfers (0: there is none), first arm and way, and ``fit`` (n, 2) with the fraction of the way's interval
    and the orientation error left.
    """
    levels, arms = start.shape[0], start.shape[1]
    for row in range(len(turn)):
        out[row, 0], out[row, 1], out[row, 2], fit[row, 0], fit[row, 1] = 0, 0, 0, 0.0, 0.0
        best = -math.inf
        for level in range(levels):
            for first in range(arms):
                if not start_in[row, first]:
                    continue
                for last in range(arms):
                    if not goal_in[row, last]:
                        continue
                    needed = turn[row] + psi[row, first] - goal_psi[row, last]
                    for way in range(start[level, first, last], start[level, first, last + 1]):
                        centre, half = (low[way] + high[way]) / 2, (high[way] - low[way]) / 2
                        # The representative nearest to the interval's centre is the one with the most slack.
                        offset = (needed - centre + period / 2) % period - period / 2
                        inside = min(max(offset, -half), half)
                        error, slack = inside - offset, half - abs(offset)
                        if abs(error) <= epsilon[row] and slack > best:
                            best = slack
                            out[row, 0], out[row, 1], out[row, 2] = level + 1, first, way
                            fit[row, 0] = (inside + half) / (2 * half) if half > 0 else 0.0
                            fit[row, 1] = error
            if out[row, 0] > 0:
                break
