"""The hand-over angles that two arms have in common, compiled: which intervals of eta have places; arrays as in ``fibres``."""

from __future__ import annotations

import math

import numpy as np

from marl_handover.cell.angle_kernels import in_frame
from marl_handover.cell.arm import REACH_TOLERANCE_MM
from marl_handover.cell.fibres import Floats, Ints, fibre, is_shared, length, seen, split, wrapped
from marl_handover.compiled import compiled

TANGENT_SAMPLES = 180
"""Points of a circle between which it touches a fibre once at most."""

_SAME_RAD = 1e-13
_WITHIN_MM = 1e-6


@compiled
def _touching(pair: Floats, circle: Floats, angle: float) -> float:
    """The change of gamma along a circle, but for a positive factor; it is 0 where the circle touches a fibre."""
    dx, dy = math.cos(angle), math.sin(angle)
    r_1, a_1, r_2, a_2 = seen(pair, circle[0] + circle[2] * dx, circle[1] + circle[2] * dy)
    return (-dy * math.cos(a_1) + dx * math.sin(a_1)) * r_2 - (dy * math.cos(a_2) + dx * math.sin(a_2)) * r_1


@compiled
def _add(pair: Floats, discs: Floats, x: float, y: float, found: Floats, count: int) -> int:
    """Note the eta of a place, if it is shared."""
    if count < len(found) and is_shared(pair, discs, x, y, _WITHIN_MM):
        _, a_1, _, a_2 = seen(pair, x, y)
        found[count] = wrapped(a_1 + a_2)
        return count + 1
    return count


@compiled
def _boundary(pair: Floats, discs: Floats) -> tuple[Floats, Floats]:
    """What bounds the shared space: circles (x, y, radius), and the rays (x, y, direction x, y) of the limits of turns."""
    circles, rays = np.empty((4 + discs.shape[0], 3)), np.empty((4, 4))
    for arm in range(2):
        for end in range(2):
            circles[2 * arm + end, 0] = 0.0
            circles[2 * arm + end, 1] = pair[0] / 2 if arm == 0 else -pair[0] / 2
            circles[2 * arm + end, 2] = math.hypot(pair[1 + 2 * arm + end], pair[5 + arm])
    circles[4:] = discs
    count = 0
    for arm in range(2):
        centre, half, lateral, up = pair[7 + 2 * arm], pair[8 + 2 * arm], pair[5 + arm], 1.0 - 2.0 * arm
        if half < math.pi:
            for way in (-1.0, 1.0):
                sine, cosine = math.sin(centre + way * half), math.cos(centre + way * half)
                rays[count, 0], rays[count, 1] = up * lateral * cosine, up * pair[0] / 2 + lateral * sine
                rays[count, 2], rays[count, 3] = sine, -up * cosine
                count += 1
    return circles, rays[:count]


@compiled
def _touches(pair: Floats, discs: Floats, circle: Floats, found: Floats, count: int) -> int:
    """Note the eta of the places where a circle touches a fibre."""
    before = _touching(pair, circle, 0.0)
    for step in range(1, TANGENT_SAMPLES + 1):
        inner, outer = 2 * math.pi * (step - 1) / TANGENT_SAMPLES, 2 * math.pi * step / TANGENT_SAMPLES
        there = _touching(pair, circle, outer)
        if (there > 0.0) != (before > 0.0):
            for _ in range(50):
                middle = (inner + outer) / 2
                if (_touching(pair, circle, middle) > 0.0) == (before > 0.0):
                    inner = middle
                else:
                    outer = middle
            count = _add(pair, discs, circle[0] + circle[2] * math.cos(inner), circle[1] + circle[2] * math.sin(inner), found, count)
        before = there
    return count


@compiled
def _critical(pair: Floats, discs: Floats) -> Floats:
    """The eta of every corner of the shared space, and of every place where its boundary touches a fibre: sorted.

    Between two of them fibres have places, or none has: nothing else can make a piece of a fibre come or go.
    """
    circles, rays = _boundary(pair, discs)
    found, count = np.empty(4096), 0
    for i in range(len(circles)):
        x, y, r = circles[i, 0], circles[i, 1], circles[i, 2]
        for j in range(i):
            dx, dy = circles[j, 0] - x, circles[j, 1] - y
            square = dx * dx + dy * dy
            if square < 1e-18:
                continue
            along = (square + r * r - circles[j, 2] ** 2) / (2 * square)
            height = r * r / square - along * along
            if height > -1e-9:
                height = math.sqrt(max(height, 0.0))
                for up in (-height, height):
                    count = _add(pair, discs, x + along * dx - up * dy, y + along * dy + up * dx, found, count)
        for ray in range(len(rays)):
            dx, dy = rays[ray, 0] - x, rays[ray, 1] - y
            nearest = -(dx * rays[ray, 2] + dy * rays[ray, 3])
            height = r * r - (dx * dx + dy * dy) + nearest * nearest
            if height > -1e-9:
                for far in (nearest - math.sqrt(max(height, 0.0)), nearest + math.sqrt(max(height, 0.0))):
                    if far > 0.0:
                        count = _add(pair, discs, rays[ray, 0] + far * rays[ray, 2], rays[ray, 1] + far * rays[ray, 3], found, count)
        count = _touches(pair, discs, circles[i], found, count)
    for i in range(len(rays)):
        for j in range(i):
            cross = rays[i, 2] * rays[j, 3] - rays[i, 3] * rays[j, 2]
            if abs(cross) > 1e-12:
                dx, dy = rays[j, 0] - rays[i, 0], rays[j, 1] - rays[i, 1]
                far, other = (dx * rays[j, 3] - dy * rays[j, 2]) / cross, (dx * rays[i, 3] - dy * rays[i, 2]) / cross
                if far > 0.0 and other > 0.0:
                    count = _add(pair, discs, rays[i, 0] + far * rays[i, 2], rays[i, 1] + far * rays[i, 3], found, count)
    ordered = found[:count]
    ordered.sort()
    return ordered


@compiled
def angle_arcs(pair: Floats, discs: Floats) -> Floats:
    """All eta that the shared space offers, as arcs (n, 2), the lowest centre first; none where nothing is shared."""
    ends = _critical(pair, discs)
    out, edges = np.empty((64 + 8 * len(discs), 3)), np.empty(64 + 8 * len(discs))
    count = len(ends)
    if count == 0:
        some = fibre(pair, discs, 1.0, out, edges)
        return np.array([[0.0, math.pi]]) if some else np.empty((0, 2))
    arcs, found = np.empty((count + 1, 2)), 0  # begin and end for now
    for number in range(count):
        begin = ends[number]
        end = ends[number + 1] if number + 1 < count else ends[0] + 2 * math.pi
        joins = found > 0 and arcs[found - 1, 1] == begin
        if end - begin <= _SAME_RAD:
            if joins:
                arcs[found - 1, 1] = end
        elif fibre(pair, discs, wrapped((begin + end) / 2), out, edges):
            if joins:
                arcs[found - 1, 1] = end
            else:
                arcs[found, 0], arcs[found, 1] = begin, end
                found += 1
    if found == 0:
        return np.empty((0, 2))
    if found > 1 and arcs[found - 1, 1] >= arcs[0, 0] + 2 * math.pi - _SAME_RAD:
        arcs[0, 0] = arcs[found - 1, 0] - 2 * math.pi
        found -= 1
    kept = 0
    for number in range(found):
        begin, end = arcs[number, 0], arcs[number, 1]
        if _is_wide(pair, discs, begin, end, out, edges):
            arcs[kept, 0], arcs[kept, 1] = wrapped((begin + end) / 2), min((end - begin) / 2, math.pi)
            kept += 1
    return arcs[np.argsort(arcs[:kept, 0])]


@compiled
def _is_wide(pair: Floats, discs: Floats, begin: float, end: float, out: Floats, edges: Floats) -> bool:
    """Whether any fibre between two eta is longer than the tolerance of reach; what is narrower everywhere is no place."""
    for step in range(1, 20):
        eta = wrapped(begin + (end - begin) * step / 20)
        if length(out, fibre(pair, discs, eta, out, edges)) * pair[0] > REACH_TOLERANCE_MM * split(pair, eta)[3]:
            return True
    return False


@compiled
def pair_row(arms: Floats, i: int, j: int, row: Floats) -> None:
    """Fill the row (15,) of two arms; ``arms`` (N, 8) are x, y, facing, least and greatest radius and yaw, lateral offset."""
    dx, dy = arms[i, 0] - arms[j, 0], arms[i, 1] - arms[j, 1]
    distance = math.hypot(dx, dy)
    row[0] = distance
    for number in range(2):
        arm = i if number == 0 else j
        handed = 1.0 - 2.0 * number
        lateral = arms[arm, 7] if abs(arms[arm, 7]) > _WITHIN_MM else 0.0
        for end in range(2):
            row[1 + 2 * number + end] = math.sqrt(max(arms[arm, 3 + end] ** 2 - lateral**2, 0.0))
        row[5 + number] = lateral
        low, high = arms[arm, 5], arms[arm, 6]
        towards = wrapped(math.atan2(-handed * dy, -handed * dx) - arms[arm, 2])
        row[7 + 2 * number] = handed * ((low + high) / 2 - towards)
        row[8 + 2 * number] = 2 * math.pi if high - low > 2 * math.pi - 1e-6 else (high - low) / 2
    row[11], row[12] = (arms[i, 0] + arms[j, 0]) / 2, (arms[i, 1] + arms[j, 1]) / 2
    row[13], row[14] = dy / distance, -dx / distance


@compiled
def layout_edges(arms: Floats, discs: Floats, number: Ints, pairs: Floats, discs_there: Floats, arcs: Floats, n_arcs: Ints) -> int:
    """All that the arms (N, 8) of a layout share, with keep-out discs (M, 3) in the world, as rows of a table of edges.

    Fills ``number`` (N, N) with the edge of each two arms, -1 where they share nothing, and the first rows of ``pairs`` (E, 15),
    ``discs_there`` (E, M, 3), ``arcs`` (E, K, 2) and ``n_arcs`` (E,). Gives how many edges there are; -1 if K arcs are too few.
    """
    count = 0
    number[:] = -1
    for i in range(len(arms)):
        for j in range(i + 1, len(arms)):
            if math.hypot(arms[i, 0] - arms[j, 0], arms[i, 1] - arms[j, 1]) >= arms[i, 4] + arms[j, 4]:
                continue
            row = pairs[count]
            pair_row(arms, i, j, row)
            for disc in range(len(discs)):
                discs_there[count, disc, 0], discs_there[count, disc, 1] = in_frame(row, discs[disc, 0], discs[disc, 1])
                discs_there[count, disc, 2] = discs[disc, 2]
            found = angle_arcs(row, discs_there[count])
            if len(found) > arcs.shape[1]:
                return -1
            if len(found):
                arcs[count, : len(found)], n_arcs[count] = found, len(found)
                number[i, j] = number[j, i] = count
                count += 1
    return count
