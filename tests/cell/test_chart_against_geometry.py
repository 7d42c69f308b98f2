"""The angle chart of any two arms among discs, against plain geometry: nothing outside, nothing missed, round trips, all the angles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from marl_handover.cell import layout_cell
from tests.oracles.layouts import NARROW_MM, SURE, layout_with_a_sliver, random_layout, wrapped

REACH_MM, ROUND_TRIP_MM, OUTSIDE_MM = 1e-3, 1e-6, 0.05
TIP_MM, ROUND_TRIP_AT_TIP_MM = 1e-4, 1e-5
STEP_RAD = math.radians(0.02)
SPECIAL = np.array([-1.0, 1.0, 0.0, np.nextafter(1, 0), np.nextafter(-1, 0), 1e-12, 1 - 6e-8, 0.3])
"""Edges of the square, its middle, what float32 makes of nearly 1, and one value that is nothing special."""

THOROUGH = 12
"""Of so many pairs all hand-over angles of one are looked at."""


def random_cell(draw):
    """Two to four arms of equal or other rings, near each other or not, with 0 to 4 discs, the first one in the middle of a curve."""
    count, discs = draw.choice([2, 3, 4]), draw.choice([0, 0, 1, 2, 3, 4])
    return random_layout(draw, count, mixed=draw.random() < 0.7, close=draw.random() < 0.4, discs=discs)


def spaces_of(layout):
    """(i, j) -> what two arms share, with its angle chart; only two that share something."""
    edges = layout_cell(layout.arms, layout.obstacles).graph.edges
    return {pair: replace(space, charted="angle") for pair, space in edges.items()}


def square(draw, count):
    """Chart points (n, 2): random ones, edges and corners, and what float32 makes of nearly 1."""
    points = draw.uniform(-1, 1, (count, 2))
    edges = draw.uniform(-1, 1, (count, 2))
    edges[np.arange(count), draw.integers(2, size=count)] = draw.choice(SPECIAL, count)
    return np.concatenate([points, edges, np.stack(np.meshgrid(SPECIAL, SPECIAL), -1).reshape(-1, 2)])


def places(layout, i, j, draw):
    """Places (n, 2) in and about what the arms share: uniform, near edges and corners, on and near the line through the bases."""
    near = [curve(draw.uniform(0, 1, 40)) for curve in layout.edge_curves(i, j)]
    corners = layout.corners(i, j)
    near.append(np.repeat(corners[layout.margin(corners, (i, j)).min(-1) > -1e-6], 12, 0))
    near = np.concatenate(near)
    near = near + draw.normal(0, 1, near.shape) * 10 ** draw.uniform(-5.5, 0.5, (len(near), 1))
    one, other = layout.bases[[i, j]]
    across = np.array([-1, 1]) * (other - one)[::-1] / math.dist(one, other)
    along = one + draw.uniform(-5, 6, (100, 1)) * (other - one)
    offset = draw.choice([0.0, 1.0, -1.0], (100, 1)) * 10 ** draw.uniform(-12, 0, (100, 1))
    return np.concatenate([layout.sample_shared(i, j, 1000, draw), near, along + offset * across])


def faults_of(layout, space, pair, draw, *, thorough):
    """What is wrong with the chart of what two arms share, in words."""
    points = square(draw, 80)
    said = faults_on_the_square(layout, space, pair, points) + faults_on_the_table(layout, space, pair, draw)
    return said + (faults_of_arcs(layout, space, pair) if thorough else [])


def faults_in_float32(layout, space, pair, draw):
    """The same of chart points in float32, whose places are rounded too."""
    points = square(draw, 80)
    return faults_on_the_square(layout, space, pair, points.astype(np.float32), REACH_MM + rounding_mm(space, points))


def faults_on_the_square(layout, space, pair, points, round_trip_mm=ROUND_TRIP_MM):
    said, dtype = [], points.dtype
    place = space.to_table(points[:, 0], points[:, 1])
    assert place.dtype == dtype
    margin = layout.margin(place, pair).min(-1)
    if not (margin >= -REACH_MM).all():
        worst = int(np.argmin(np.nan_to_num(margin, nan=-np.inf)))
        said.append(f"{dtype} chart point {points[worst].tolist()} lands {-margin[worst]} mm outside, at {place[worst].tolist()}")
    off = np.hypot(*(space.to_table(*space.from_table(place)) - place).T)
    off = off - np.maximum(round_trip_mm, tip_mm(space, points))
    if not (off <= 0).all():
        worst = int(np.argmax(np.nan_to_num(off, nan=np.inf)))
        said.append(f"{dtype} chart point {points[worst].tolist()} comes back {off[worst]} mm too far away")
    if dtype == np.float64:
        said += faults_of_alpha(layout, place, pair, points[:, 0])
    return said


def faults_of_alpha(layout, place, pair, alpha):
    """Equal alpha has to be an equal hand-over angle; the chart points hold every alpha of the corners several times."""
    said, angle = [], layout.hand_over_angle(place, *pair)
    for value in SPECIAL:
        off = np.abs(wrapped(angle[alpha == value] - angle[alpha == value][0]))
        if not (off <= 1e-8).all():
            said.append(f"at alpha = {value!r} the angle depends on beta: {off.max()} rad")
    return said


def tip_mm(space, points):
    """How far off a chart point may come back where its curve is about to vanish: the length is a root of the angle's rounding."""
    ends = [space.to_table(points[:, 0], np.full_like(points[:, 0], beta)) for beta in (-1, 1)]
    return np.where(np.hypot(*(ends[1] - ends[0]).T) < TIP_MM, ROUND_TRIP_AT_TIP_MM, 0)


def rounding_mm(space, points):
    """How far a place moves if alpha is rounded to float32; far where a curve is about to vanish."""
    place = space.to_table(points[:, 0], points[:, 1])
    ulp = np.finfo(np.float32).eps
    others = [space.to_table(np.clip(points[:, 0] + step, -1, 1), points[:, 1]) for step in (-2 * ulp, 2 * ulp)]
    return np.max([np.hypot(*(other - place).T) for other in others], 0)


def faults_on_the_table(layout, space, pair, draw):
    said = []
    place = places(layout, *pair, draw)
    margin = layout.margin(place, pair).min(-1)
    alpha, beta = space.from_table(place)
    with np.errstate(invalid="ignore"):
        within = (np.abs(alpha) <= 1 + 1e-9) & (np.abs(beta) <= 1 + 1e-9)
    inside, outside = margin >= ROUND_TRIP_MM, margin < -OUTSIDE_MM
    missed = inside & ~within
    if missed.any():
        missed[missed] = counted(layout, pair, place[missed])
    if missed.any():
        worst = int(np.argmax(np.where(missed, margin, -np.inf)))
        said.append(f"{missed.sum()} places missed; {place[worst].tolist()}, {margin[worst]} mm inside, is at {alpha[worst], beta[worst]}")
    if (outside & within).any():
        worst = int(np.argmin(np.where(within, margin, np.inf)))
        said.append(f"place {place[worst].tolist()}, {-margin[worst]} mm outside, is at {alpha[worst], beta[worst]}")
    inside &= within
    off = np.hypot(*(space.to_table(alpha[inside], beta[inside]) - place[inside]).T)
    if not (off <= ROUND_TRIP_MM).all():
        worst = int(np.argmax(np.nan_to_num(off, nan=np.inf)))
        said.append(f"place {place[inside][worst].tolist()} comes back {off[worst]} mm away")
    return said


def counted(layout, pair, place):
    """Which places (n, 2) are surely of a space that is not narrower than 1 um everywhere."""
    sampled = layout.sampled_angles(*pair, STEP_RAD / 2)
    after = np.searchsorted(sampled, layout.hand_over_angle(place, *pair))
    counts = layout.counts(*pair, sampled, STEP_RAD / 2)
    return counts[after % len(sampled)] | counts[after - 1]


def faults_of_arcs(layout, space, pair):
    """The arcs hold the angles of all places on the edge of the space, and no angle far from these."""
    said = []
    arcs = [(arc.low_rad, arc.width_rad) for arc in space.chart.arcs]
    sampled = layout.sampled_angles(*pair, STEP_RAD / 2)
    beyond = np.min([np.abs(wrapped(sampled - low - width / 2)) - width / 2 for low, width in arcs], 0)
    beyond *= layout.counts(*pair, sampled, STEP_RAD / 2)
    if beyond.max() > 1e-7:
        said.append(f"angle {sampled[beyond.argmax()]} of a place lies {beyond.max()} rad outside the arcs {arcs}")
    for low, width in arcs:
        angles = np.remainder(low + np.linspace(0, 1, 500) * width, 2 * math.pi)
        ring = np.concatenate([sampled[-1:] - 2 * math.pi, sampled, sampled[:1] + 2 * math.pi])
        after = np.clip(np.searchsorted(ring, angles), 1, len(ring) - 1)
        off = np.minimum(np.abs(ring[after] - angles), np.abs(angles - ring[after - 1]))
        if off.max() > 2 * STEP_RAD:
            said.append(f"angle {angles[off.argmax()]} of arc {low, width} is {off.max()} rad from that of any place")
    return said


def judge(seed, pairs, faults):
    """Random pairs one after the other until one has a fault."""
    draw, done = np.random.default_rng([20, seed]), 0
    while done < pairs:
        layout = random_cell(draw)
        for pair, space in spaces_of(layout).items():
            said = faults(layout, space, pair, draw, done)
            assert not said, (done, pair, said, layout)
            done += 1


def in_float64(layout, space, pair, draw, done):
    return faults_of(layout, space, pair, draw, thorough=done % THOROUGH == 0)


def in_float32(layout, space, pair, draw, done):
    return faults_in_float32(layout, space, pair, draw)


@pytest.mark.parametrize(("faults", "pairs"), [(in_float64, 100), (in_float32, 50)])
def test_the_chart_is_a_bijection_onto_what_two_arms_share(faults, pairs):
    judge(0, pairs, faults)


@pytest.mark.parametrize("less_mm", [0.0, 1e-4, 2e-3, 0.01, 1.0])
def test_the_chart_holds_where_a_place_hardly_is_one(less_mm):
    layout = layout_with_a_sliver(less_mm)
    said = faults_of(layout, spaces_of(layout)[0, 2], (0, 2), np.random.default_rng(0), thorough=True)
    assert not said


def test_a_space_narrower_than_a_micrometre_everywhere_is_none():
    """A triangle beside all else that two arms share grows: it is a space from where a curve of equal angle in it is that long."""
    none_mm, some_mm = 0.0, 1.0
    for _ in range(30):
        middle_mm = (none_mm + some_mm) / 2
        arcs = spaces_of(layout_with_a_sliver(middle_mm))[0, 2].chart.arcs
        assert len(arcs) in (1, 2)
        none_mm, some_mm = (middle_mm, some_mm) if len(arcs) == 1 else (none_mm, middle_mm)
    layout = layout_with_a_sliver(some_mm)
    angles = layout.sampled_angles(0, 2, STEP_RAD / 2)
    longest_mm = max(layout.curve_mm(0, 2, angle) for angle in angles[angles < 3])
    assert longest_mm == pytest.approx(NARROW_MM, rel=SURE - 1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 21))
def test_the_chart_is_a_bijection_for_a_thousand_pairs(seed):
    judge(seed, 1000, in_float64)


@pytest.mark.slow
def test_the_chart_is_a_bijection_for_a_thousand_pairs_in_float32():
    judge(21, 1000, in_float32)
