"""The angle chart, compiled: from chart coordinates to places and back, one row or many; arrays as in ``fibres``."""

from __future__ import annotations

import math

import numpy as np

from marl_handover.cell.fibres import Floats, Ints, arcsine, beside, found_fibre, is_shared, length, point_at, seen, split, wrapped
from marl_handover.cell.sectors import ARC_GAP
from marl_handover.compiled import compiled

OUTSIDE = 2.0
"""The beta of a place that lies between two pieces of a fibre, or on none."""

NEAR_MM = 2e-3
"""A place this near to a shared one has the coordinates of the nearest piece's end: twice the tolerance of reach."""

_POINT_MM = 1e-9


@compiled
def stretch(arcs: Floats, count: int) -> float:
    """Radians of eta for one of alpha."""
    halves = 0.0
    for arc in range(count):
        halves += arcs[arc, 1]
    return halves / (1.0 - ARC_GAP * (count - 1) / 2)


@compiled
def place(
    pair: Floats, discs: Floats, arcs: Floats, count: int, inset: float, alpha: float, beta: float, out: Floats, edges: Floats
) -> tuple[float, float]:
    """The place (x, y) of chart coordinates, in the pair's frame; ``count`` of ``arcs`` are in use."""
    unit, start, taken, there = stretch(arcs, count), -1.0, 0, 0.0
    for arc in range(count):
        middle = start + arcs[arc, 1] / unit
        offset = (alpha - middle) * unit
        if arc == 0 or offset >= -arcs[arc, 1] - unit * ARC_GAP / 2:
            taken, there = arc, offset
        start += 2 * arcs[arc, 1] / unit + ARC_GAP
    there = min(arcs[taken, 1], max(-arcs[taken, 1], there)) * inset
    eta, pieces = found_fibre(pair, discs, arcs[taken, 0] + there, arcs[taken], out, edges)
    sign, e, _, sin_e = split(pair, eta)
    left = length(out, pieces) * (1.0 - beta) / 2
    for number in range(pieces):
        begin, end = out[number, 1], out[number, 2]
        if left <= abs(end - begin) or number == pieces - 1:
            middle = (begin + end) / 2
            a = begin + math.copysign(min(left, abs(end - begin)), end - begin)
            return point_at(pair, sign, e, sin_e, int(out[number, 0]), middle + inset * (a - middle))
        left -= abs(end - begin)
    return math.nan, math.nan


@compiled
def middle_place(pair: Floats, discs: Floats, arc: Floats, eta: float, out: Floats, edges: Floats) -> tuple[float, float]:
    """The middle (x, y) of the longest piece of a fibre, in the pair's frame; ``eta`` is of the arc ``arc``."""
    eta, pieces = found_fibre(pair, discs, eta, arc, out, edges)
    sign, e, _, sin_e = split(pair, eta)
    longest = -1.0
    x, y = math.nan, math.nan
    number = 0
    while number < pieces:
        # What the middle of the fibre cuts in two is one piece.
        joined = number + 1 < pieces and out[number, 0] == 0.0 and out[number, 2] == e / 2 and out[number + 1, 1] == e / 2
        length = abs(out[number, 2] - out[number, 1])
        side, at = int(out[number, 0]), (out[number, 1] + out[number, 2]) / 2
        if joined:
            length += abs(out[number + 1, 2] - out[number + 1, 1])
            at = out[number, 1] + length / 2
            if at > e / 2:
                side, at = 1, out[number + 1, 2] + length / 2
        if length > longest:
            longest = length
            x, y = point_at(pair, sign, e, sin_e, side, at)
        number += 2 if joined else 1
    return x, y


@compiled
def coordinates(
    pair: Floats, discs: Floats, arcs: Floats, count: int, inset: float, x: float, y: float, out: Floats, edges: Floats
) -> tuple[float, float]:
    """Chart coordinates (alpha, beta) of a place of the pair's frame; beyond [-1, 1]^2 where it is outside."""
    r_1, a_1, r_2, a_2 = seen(pair, x, y)
    eta = wrapped(a_1 + a_2)
    unit, start, alpha, nearest, taken = stretch(arcs, count), -1.0, 0.0, math.inf, 0
    for arc in range(count):
        offset = wrapped(eta - arcs[arc, 0])
        if abs(offset) - arcs[arc, 1] < nearest:
            nearest, taken = abs(offset) - arcs[arc, 1], arc
            alpha = start + (arcs[arc, 1] + offset / inset) / unit
        start += 2 * arcs[arc, 1] / unit + ARC_GAP
    if not is_shared(pair, discs, x, y, NEAR_MM):
        return alpha, OUTSIDE
    there = min(arcs[taken, 1], max(-arcs[taken, 1], wrapped(eta - arcs[taken, 0])))
    eta, pieces = found_fibre(pair, discs, arcs[taken, 0] + there, arcs[taken], out, edges)
    sign, e, _, sin_e = split(pair, eta)
    adds = beside(pair, sign, e)
    near_1, near_2 = sign * a_1, sign * a_2
    if abs(near_1) < abs(near_2):  # the sum of both is e; of the other angle a turn may be missing
        near_2 = e - near_1
    else:
        near_1 = e - near_2
    side = 0 if near_2 <= near_1 else 1
    a = arcsine(((r_1 if side == 0 else r_2) * sin_e + adds[side]) / pair[0])
    if a > e / 2:
        side, a = 1 - side, e - a
    return alpha, _along(out, pieces, inset, side, a, e, _POINT_MM * sin_e / pair[0])


@compiled
def _along(pieces: Floats, count: int, inset: float, side: int, a: float, e: float, point: float) -> float:
    """Beta of the coordinate ``a`` of a side, or of the nearest place of a piece; a piece shorter than ``point`` rad is one place."""
    total = length(pieces, count)
    nearest, reached, at = math.inf, 0.0, 0.0
    own = a if side == 0 else e - a
    for number in range(count):
        begin, end = pieces[number, 1], pieces[number, 2]
        size, here = abs(end - begin), int(pieces[number, 0]) == side
        low, high = (begin, end) if pieces[number, 0] == 0.0 else (e - begin, e - end)
        beside = max(min(begin, end) - a, a - max(begin, end)) if here else max(low - own, own - high)
        if beside < nearest:
            nearest = beside
            if size <= point:
                at = reached + size / 2
            elif beside <= 0.0 and here:
                middle = (begin + end) / 2
                at = reached + abs(middle - begin) + (a - middle) / inset * (1.0 if end > begin else -1.0)
            else:
                # Not quite at the end where another piece begins: rounding would put the place there.
                off = min(size / 2, max(1e-9 * total, min(beside, 1e-7 * total)))
                if abs(own - low) < abs(own - high):
                    at = reached + (0.0 if number == 0 else off)
                else:
                    at = reached + (size if number == count - 1 else size - off)
        reached += size
    return 1.0 - 2.0 * at / total if total > 0.0 else 0.0


@compiled
def in_world(pair: Floats, x: float, y: float) -> tuple[float, float]:
    """A point of the pair's frame in the world."""
    return pair[11] + pair[13] * x - pair[14] * y, pair[12] + pair[14] * x + pair[13] * y


@compiled
def in_frame(pair: Floats, x: float, y: float) -> tuple[float, float]:
    """A point of the world in the pair's frame."""
    dx, dy = x - pair[11], y - pair[12]
    return pair[13] * dx + pair[14] * dy, pair[13] * dy - pair[14] * dx


@compiled
def places(
    pairs: Floats,
    discs: Floats,
    n_discs: Ints,
    arcs: Floats,
    n_arcs: Ints,
    inset: float,
    edge: Ints,
    alpha: Floats,
    beta: Floats,
    out: Floats,
) -> None:
    """World places (n, 2) of chart coordinates (n,) of the edges ``edge`` (n,); NaN where that is negative."""
    pieces, scratch = np.empty((64 + 8 * discs.shape[1], 3)), np.empty(64 + 8 * discs.shape[1])
    for row in range(len(edge)):
        i = edge[row]
        if i < 0:
            out[row, 0], out[row, 1] = math.nan, math.nan
        else:
            x, y = place(pairs[i], discs[i, : n_discs[i]], arcs[i], n_arcs[i], inset, alpha[row], beta[row], pieces, scratch)
            out[row, 0], out[row, 1] = in_world(pairs[i], x, y)


@compiled
def chart_coordinates(
    pairs: Floats, discs: Floats, n_discs: Ints, arcs: Floats, n_arcs: Ints, inset: float, edge: Ints, at: Floats, out: Floats
) -> None:
    """Chart coordinates (n, 2) of world places (n, 2) of the edges ``edge`` (n,); NaN where that is negative."""
    pieces, scratch = np.empty((64 + 8 * discs.shape[1], 3)), np.empty(64 + 8 * discs.shape[1])
    for row in range(len(edge)):
        i = edge[row]
        if i < 0 or math.isnan(at[row, 0]):
            out[row, 0], out[row, 1] = math.nan, math.nan
        else:
            x, y = in_frame(pairs[i], at[row, 0], at[row, 1])
            pair = coordinates(pairs[i], discs[i, : n_discs[i]], arcs[i], n_arcs[i], inset, x, y, pieces, scratch)
            out[row, 0], out[row, 1] = pair


@compiled
def middles(pairs: Floats, discs: Floats, n_discs: Ints, arcs: Floats, n_arcs: Ints, edge: Ints, eta: Floats, out: Floats) -> None:
    """World places (n, 2), in the middle of the longest piece of the fibres ``eta`` (n,) of the edges ``edge`` (n,); NaN where negative."""
    pieces, scratch = np.empty((64 + 8 * discs.shape[1], 3)), np.empty(64 + 8 * discs.shape[1])
    for row in range(len(edge)):
        i = edge[row]
        out[row, 0], out[row, 1] = math.nan, math.nan
        if i >= 0 and not math.isnan(eta[row]):
            nearest, taken = math.inf, 0
            for arc in range(n_arcs[i]):
                away = abs(wrapped(eta[row] - arcs[i, arc, 0])) - arcs[i, arc, 1]
                if away < nearest:
                    nearest, taken = away, arc
            arc_there = arcs[i, taken]
            there = arc_there[0] + min(arc_there[1], max(-arc_there[1], wrapped(eta[row] - arc_there[0])))
            x, y = middle_place(pairs[i], discs[i, : n_discs[i]], arc_there, there, pieces, scratch)
            out[row, 0], out[row, 1] = in_world(pairs[i], x, y)


@compiled
def place_slopes(
    pairs: Floats,
    discs: Floats,
    n_discs: Ints,
    arcs: Floats,
    n_arcs: Ints,
    inset: float,
    edge: Ints,
    alpha: Floats,
    beta: Floats,
    out: Floats,
) -> None:
    """How places change with alpha, ``out[:, :, 0]`` (n, 2), and with beta, ``out[:, :, 1]``, in mm for one.

    By differences to both sides; where these are not alike, as beside a gap, the smaller one.
    """
    pieces, scratch = np.empty((64 + 8 * discs.shape[1], 3)), np.empty(64 + 8 * discs.shape[1])
    step = 1e-6
    for row in range(len(edge)):
        i = edge[row]
        for axis in range(2):
            out[row, 0, axis], out[row, 1, axis] = 0.0, 0.0
        if i >= 0:
            here = discs[i, : n_discs[i]]
            x, y = place(pairs[i], here, arcs[i], n_arcs[i], inset, alpha[row], beta[row], pieces, scratch)
            for axis in range(2):
                best = math.inf
                for way in (-step, step):
                    a = alpha[row] + (way if axis == 0 else 0.0)
                    b = beta[row] + (way if axis == 1 else 0.0)
                    if -1.0 <= a <= 1.0 and -1.0 <= b <= 1.0:
                        u, v = place(pairs[i], here, arcs[i], n_arcs[i], inset, a, b, pieces, scratch)
                        dx, dy = (u - x) / way, (v - y) / way
                        if math.hypot(dx, dy) < best:
                            best = math.hypot(dx, dy)
                            out[row, 0, axis], out[row, 1, axis] = (
                                pairs[i, 13] * dx - pairs[i, 14] * dy,
                                pairs[i, 14] * dx + pairs[i, 13] * dy,
                            )
