"""Compiled geometry of the places that two arms share, sorted by their hand-over angle.

The frame of a pair has its origin midway between the bases and +y towards the first arm's. a_1 and a_2 are the angles at the bases from the
base line to the grippers' directions, both counted towards +x; the hand-over angle is gamma = pi + eta with eta = a_1 + a_2. The places of
one eta are a curve, its *fibre*: without lateral offsets an arc of a circle through both bases. By the law of sines, with lateral offsets
delta and distances R in the arms' own planes,

    R_1 = (D sin(a_2) - delta_2 - delta_1 cos(eta)) / sin(eta)        R_2 = (D sin(a_1) + delta_1 + delta_2 cos(eta)) / sin(eta)

so that a fibre runs with a_2 from 0 to eta, and every limit of a radius, of a yaw and of a disc is a bound of a_2 in closed form.
What is admissible is a union of intervals. For eta < 0 all is mirrored. Near gamma = 0 the places are at both ends of the fibre,
where a_2 or a_1 is tiny: so it is cut in the middle, *side* 0 has the coordinate a = a_2, side 1 a = a_1, and neither loses digits.

Arrays: a pair is a row (15,): D; least and greatest R of the first arm, then of the second; both lateral offsets; centre and half of the
range of a_1, then of a_2; x, y, cos, sin of the frame in the world. Discs (M, 3) are x, y, radius in the pair's frame. An arc is a row
(2,): centre and half of an interval of eta. Lengths in mm, angles in rad.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from marl_handover.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PAIR_SIZE = 15

_LEAST_RAD, _LEAST_BESIDE_RAD = 1e-12, 3e-8
"""How near to 0 and pi eta is told from them: without lateral offsets, and with, which cost digits there."""

_STRAIGHT_RAD = 1e-2


@compiled
def wrapped(angle: float) -> float:
    """An angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


@compiled
def split(pair: Floats, eta: float) -> tuple[float, float, float, float]:
    """The sign of eta, and its absolute value e, pi - e and sin(e), none of which is 0."""
    least = _LEAST_BESIDE_RAD if pair[5] != 0.0 or pair[6] != 0.0 else _LEAST_RAD
    sign = 1.0 if eta >= 0.0 else -1.0
    e = min(max(abs(eta), least), math.pi - least)
    rest = math.pi - e  # without rounding, where it is small
    return sign, e, rest, math.sin(min(e, rest))


@compiled
def beside(pair: Floats, sign: float, e: float) -> tuple[float, float]:
    """What lateral offsets add to R_1 sin(e) and R_2 sin(e) to make D sin(a_2) and D sin(a_1)."""
    first, second = sign * pair[5], sign * pair[6]
    return second + first * math.cos(e), -first - second * math.cos(e)


@compiled
def point_at(pair: Floats, sign: float, e: float, sin_e: float, side: int, a: float) -> tuple[float, float]:
    """The place (x, y) at coordinate ``a`` of a side of the fibre."""
    add_1, add_2 = beside(pair, sign, e)
    b = e - a
    sin_b, cos_b = math.sin(b), math.cos(b)
    if side == 0:
        radius, lateral = (pair[0] * math.sin(a) - add_1) / sin_e, sign * pair[5]
        return sign * (radius * sin_b + lateral * cos_b), pair[0] / 2 - radius * cos_b + lateral * sin_b
    radius, lateral = (pair[0] * math.sin(a) - add_2) / sin_e, sign * pair[6]
    return sign * (radius * sin_b - lateral * cos_b), radius * cos_b + lateral * sin_b - pair[0] / 2


@compiled
def turned_away(angle: float, centre: float, half: float) -> bool:
    """Whether an angle is outside the range of a turn."""
    return half < math.pi and abs(wrapped(angle - centre)) > half


@compiled
def in_a_disc(discs: Floats, x: float, y: float, less: float) -> bool:
    """Whether a place is inside a disc, made smaller by ``less`` mm."""
    for disc in range(discs.shape[0]):  # noqa: SIM110 - numba compiles this
        if math.hypot(x - discs[disc, 0], y - discs[disc, 1]) < discs[disc, 2] - less:
            return True
    return False


@compiled
def _allowed(pair: Floats, discs: Floats, sign: float, e: float, sin_e: float, side: int, a: float, low: float, high: float) -> bool:
    """Whether the place at ``a`` is admissible; ``low`` and ``high`` bound the sine of the other angle e - a."""
    b = e - a
    sine = math.sin(b) if e < 2.0 else math.sin(math.pi - e + a)
    if sine < low or sine > high:
        return False
    a_1, a_2 = (b, a) if side == 0 else (a, b)
    if turned_away(sign * a_1, pair[7], pair[8]) or turned_away(sign * a_2, pair[9], pair[10]):
        return False
    if discs.shape[0] == 0:
        return True
    x, y = point_at(pair, sign, e, sin_e, side, a)
    return not in_a_disc(discs, x, y, 0.0)


@compiled
def _disc_edges(pair: Floats, disc: Floats, sign: float, e: float, sin_e: float, side: int, low: float, high: float, out: Floats) -> int:
    """Where a side of the fibre crosses the edge of a disc: fills ``out``, gives their number.

    With w = 2 a_2 - e the squared distance to the centre is a constant plus multiples of cos(w) and sin(w): a quadratic in tan(w / 2).
    """
    if pair[5] != 0.0 or pair[6] != 0.0:
        return _sought_edges(pair, disc, sign, e, sin_e, side, low, high, out)
    x, y = sign * disc[0], disc[1]
    count = 0
    distance = pair[0]
    if math.pi - e < _STRAIGHT_RAD:
        return _straight_edges(distance, x, y if side == 0 else -y, disc[2], e, sin_e, out)
    up = y - distance / 2  # the centre as the first base sees it
    half_rest = (math.pi - e) / 2
    tangent = math.tan(e / 2) if e < 2.0 else 1 / math.tan(half_rest)
    here = (distance / (2 * math.sin(half_rest))) ** 2 - distance * x * tangent + distance * up + x * x + up * up - disc[2] ** 2
    across = distance**2 * math.cos(e) / (2 * sin_e**2) + distance * x / sin_e
    along = distance**2 / (2 * sin_e) + distance * up / sin_e
    square = here + 2 * across
    root = along * along - here * square
    if root <= 0.0:
        return 0
    q = -(along + math.copysign(math.sqrt(root), along))
    for number in range(2):
        upper, lower = (q, square) if number == 0 else (here, q)
        if lower != 0.0:
            w = 2 * math.atan(upper / lower)
            out[count] = (e + w) / 2 if side == 0 else (e - w) / 2
            count += 1
    return count


@compiled
def _straight_edges(distance: float, x: float, y: float, radius: float, e: float, sin_e: float, out: Floats) -> int:
    """The same for a fibre that is almost the straight line beyond a base: there the distance from the base tells places apart."""
    up, cos_e = y - distance / 2, math.cos(e)
    square, across = 1 + 2 * sin_e * (x * cos_e + up * sin_e) / distance, x * sin_e - up * cos_e
    rest = x * x + up * up - radius * radius
    count = 0
    for end in (-1.0, 1.0):
        far, root, cos_a = 0.0, 0.0, 1.0
        for _ in range(5):  # cos(a) hardly differs from 1
            root = (cos_a * across) ** 2 - square * rest
            if root <= 0.0:
                break
            far = (cos_a * across + end * math.sqrt(root)) / square
            cos_a = math.sqrt(max(1 - (far * sin_e / distance) ** 2, 0.0))
        if root > 0.0 and abs(far) * sin_e < distance:
            out[count] = math.asin(far * sin_e / distance)
            count += 1
    return count


@compiled
def _sought_edges(pair: Floats, disc: Floats, sign: float, e: float, sin_e: float, side: int, low: float, high: float, out: Floats) -> int:
    """The same for arms with lateral offsets, whose fibres are no circles: by looking along the fibre."""
    count, pieces, before = 0, 32, 0.0
    for step in range(pieces + 1):
        a = low + (high - low) * step / pieces
        there = _clearance(pair, disc, sign, e, sin_e, side, a)
        if step and (there > 0.0) != (before > 0.0) and count < out.shape[0]:
            inner, outer = low + (high - low) * (step - 1) / pieces, a
            for _ in range(60):
                middle = (inner + outer) / 2
                if (_clearance(pair, disc, sign, e, sin_e, side, middle) > 0.0) == (before > 0.0):
                    inner = middle
                else:
                    outer = middle
            out[count] = (inner + outer) / 2
            count += 1
        before = there
    return count


@compiled
def _clearance(pair: Floats, disc: Floats, sign: float, e: float, sin_e: float, side: int, a: float) -> float:
    x, y = point_at(pair, sign, e, sin_e, side, a)
    return math.hypot(x - disc[0], y - disc[1]) - disc[2]


@compiled
def arcsine(sine: float) -> float:
    """The angle in [-pi / 2, pi / 2] with that sine; of more than 1, that of 1."""
    return math.asin(min(1.0, max(-1.0, sine)))


@compiled
def _cuts(
    pair: Floats,
    discs: Floats,
    sign: float,
    e: float,
    rest: float,
    sin_e: float,
    side: int,
    first: float,
    last: float,
    least: float,
    most: float,
    edges: Floats,
) -> int:
    """Where a side of the fibre may begin or end between ``first`` and ``last``: fills ``edges``, these two included, gives their number.

    ``least`` and ``most`` bound the sine of the other angle.
    """
    edges[0], edges[1] = first, last
    found = 2
    for sine in (least, most):
        if -1.0 < sine < 1.0:
            angle = math.asin(sine)
            edges[found], edges[found + 1] = e - angle, angle - rest
            found += 2
    own, its = (9, 7) if side == 0 else (7, 9)
    for end in (-1.0, 1.0):
        if pair[own + 1] < math.pi:
            edges[found] = wrapped(sign * (pair[own] + end * pair[own + 1]))
            found += 1
        if pair[its + 1] < math.pi:
            angle = wrapped(sign * (pair[its] + end * pair[its + 1]))
            edges[found], edges[found + 1] = e - angle, e - angle - 2 * math.pi
            found += 2
    for disc in range(discs.shape[0]):
        found += _disc_edges(pair, discs[disc], sign, e, sin_e, side, first, last, edges[found : found + 8])
    kept = 0
    for number in range(found):
        if first <= edges[number] <= last:
            edges[kept] = edges[number]
            kept += 1
    return kept


@compiled
def fibre(pair: Floats, discs: Floats, eta: float, out: Floats, edges: Floats) -> int:
    """The admissible pieces of the fibre of ``eta``, from the first base to the second: fills rows (side, begin, end) of ``out``.

    On side 1, which is run through with a falling, begin is above end. ``edges`` is scratch. Gives the number of pieces.
    """
    sign, e, rest, sin_e = split(pair, eta)
    adds = beside(pair, sign, e)
    count = 0
    for side in range(2):
        one, other = (1, 3) if side == 0 else (3, 1)
        low = (pair[one] * sin_e + adds[side]) / pair[0]
        high = (pair[one + 1] * sin_e + adds[side]) / pair[0]
        if low >= 1.0 or high <= -1.0:
            continue
        first, last = arcsine(low), min(arcsine(high), e / 2)
        if first >= last:
            continue
        least = (pair[other] * sin_e + adds[1 - side]) / pair[0]
        most = (pair[other + 1] * sin_e + adds[1 - side]) / pair[0]
        if least >= 1.0:
            continue
        kept = _cuts(pair, discs, sign, e, rest, sin_e, side, first, last, least, most, edges)
        ordered = edges[:kept]
        ordered.sort()
        start = count
        for number in range(kept - 1):
            begin, end = ordered[number], ordered[number + 1]
            if end > begin and _allowed(pair, discs, sign, e, sin_e, side, (begin + end) / 2, least, most):
                if count > start and out[count - 1, 2] == begin:
                    out[count - 1, 2] = end
                else:
                    out[count, 0], out[count, 1], out[count, 2] = side, begin, end
                    count += 1
        if side == 1:
            for number in range((count - start + 1) // 2):  # from the middle of the fibre on
                low_row, high_row = start + number, count - 1 - number
                begin, end = out[low_row, 1], out[low_row, 2]
                out[low_row, 1], out[low_row, 2] = out[high_row, 2], out[high_row, 1]
                if low_row != high_row:
                    out[high_row, 1], out[high_row, 2] = end, begin
    return count


@compiled
def length(pieces: Floats, count: int) -> float:
    """How long all pieces of a fibre are together, in rad."""
    total = 0.0
    for number in range(count):
        total += abs(pieces[number, 2] - pieces[number, 1])
    return total


@compiled
def found_fibre(pair: Floats, discs: Floats, eta: float, arc: Floats, out: Floats, edges: Floats) -> tuple[float, int]:
    """The fibre of ``eta``, or, at the end of an arc where rounding leaves none, of the nearest angle inside that has one."""
    count, nearer = fibre(pair, discs, wrapped(eta), out, edges), 1e-15
    while count == 0 and nearer < 1e-3:
        eta = arc[0] + (eta - arc[0]) * (1.0 - nearer)
        count, nearer = fibre(pair, discs, wrapped(eta), out, edges), 10 * nearer
    return wrapped(eta), count


@compiled
def seen(pair: Floats, x: float, y: float) -> tuple[float, float, float, float]:
    """R_1, a_1, R_2, a_2 of a place."""
    ahead, behind = pair[0] / 2 - y, pair[0] / 2 + y
    r_1 = math.sqrt(max(x * x + ahead * ahead - pair[5] ** 2, 0.0))
    r_2 = math.sqrt(max(x * x + behind * behind - pair[6] ** 2, 0.0))
    a_1, a_2 = math.atan2(x, ahead), math.atan2(x, behind)
    if pair[5] != 0.0:
        a_1 -= math.atan2(pair[5], r_1)
    if pair[6] != 0.0:
        a_2 += math.atan2(pair[6], r_2)
    return r_1, wrapped(a_1), r_2, wrapped(a_2)


@compiled
def is_shared(pair: Floats, discs: Floats, x: float, y: float, tolerance_mm: float) -> bool:
    """Whether a place is shared, or at most about ``tolerance_mm`` beside what is."""
    r_1, a_1, r_2, a_2 = seen(pair, x, y)
    if r_1 < pair[1] - tolerance_mm or r_1 > pair[2] + tolerance_mm or r_2 < pair[3] - tolerance_mm or r_2 > pair[4] + tolerance_mm:
        return False
    if turned_away(a_1, pair[7], pair[8] + tolerance_mm / max(r_1, 1.0)) or turned_away(
        a_2, pair[9], pair[10] + tolerance_mm / max(r_2, 1.0)
    ):
        return False
    return not in_a_disc(discs, x, y, tolerance_mm)
