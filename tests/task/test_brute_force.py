"""The oracles for cells of many arms agree with each other, with plain search, and with published numbers; no code of the package."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest

from tests.oracles.angle_sums import AngleSums, moved
from tests.oracles.layouts import Layout, equal_angle_curve, random_layout, wrapped

EPSILON_RAD = math.radians(5)


def layouts(count=4, arms=(2, 3, 5)):
    draw = np.random.default_rng(7)
    return [random_layout(draw, arms[k % len(arms)], mixed=k % 2 == 0, close=k % 3 == 0, discs=k % 5) for k in range(count)]


def ring(count, side_mm=360.0):
    """Equal arms on a regular polygon that face its middle."""
    radius = side_mm / (2 * math.sin(math.pi / count))
    sector = {"r_min_mm": 150.0, "r_max_mm": 230.0, "yaw_range_rad": [-math.pi / 2, math.pi / 2]}
    turns = 2 * math.pi / count * np.arange(count)
    arms = [
        {"name": f"{turn:.2f}", "x_mm": radius * math.cos(turn), "y_mm": radius * math.sin(turn), "facing_rad": turn + math.pi}
        for turn in turns
    ]
    return Layout([arm | sector for arm in arms], [])


def test_every_angle_is_offered_on_the_edge():
    draw = np.random.default_rng(0)
    for layout in layouts(12):
        sums = AngleSums(layout)
        for i, j in combinations(range(layout.count), 2):
            place = layout.sample_shared(i, j, 5000, draw)
            index = np.rint(layout.hand_over_angle(place, i, j) / sums.width_rad).astype(int) % sums.bins
            assert sums.outer[i, j, index].all()
            back = np.rint(layout.hand_over_angle(place, j, i) / sums.width_rad).astype(int) % sums.bins
            assert sums.outer[j, i, back].all()


def test_no_angle_is_claimed_that_no_place_has():
    """Each bin's angle, tried on its own curve of equal angle: a fine row of places on that circle finds one for the two arms."""
    draw, tried = np.random.default_rng(1), 0
    for layout in layouts(6):
        sums = AngleSums(layout)
        for i, j in combinations(range(layout.count), 2):
            angles = layout.sampled_angles(i, j, math.radians(1))
            for angle in draw.permutation(angles)[:5]:
                distance = math.dist(layout.bases[i], layout.bases[j])
                axis = math.atan2(*(layout.bases[j] - layout.bases[i])[::-1])
                turned = float(wrapped(angle))
                if not 0.05 < abs(turned) < math.pi - 0.05:
                    continue
                at_base = np.linspace(0, math.pi - abs(turned), 20_001)[1:-1]
                radius = distance * np.sin(at_base + abs(turned)) / math.sin(abs(turned))  # law of sines
                bearing = axis - math.copysign(1, turned) * at_base
                place = layout.bases[i] + radius[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
                np.testing.assert_allclose(wrapped(layout.hand_over_angle(place, i, j) - angle), 0, atol=1e-8)
                assert layout.margin(place, (i, j)).min(-1).max() > -0.2
                assert sums.outer[i, j, round(angle / sums.width_rad) % sums.bins]
                tried += 1
    assert tried > 50


def test_the_length_of_a_curve_of_equal_angle_is_that_of_its_places():
    draw, points, tried = np.random.default_rng(5), 20_000, 0
    for layout in layouts(8):
        for i, j in combinations(range(layout.count), 2):
            for place in layout.sample_shared(i, j, 100, draw)[:4]:
                angle = float(layout.hand_over_angle(place, i, j))
                around_mm = math.pi * math.dist(*layout.bases[[i, j]]) / max(abs(math.sin(angle)), 1e-9)
                if around_mm < 1e5:
                    usable = equal_angle_curve(layout, i, j, place, points)[1]
                    assert layout.curve_mm(i, j, angle) == pytest.approx(usable.mean() * around_mm, abs=8 * around_mm / points)
                    tried += 1
    assert tried > 50


def test_the_shipped_pair_offers_its_angles():
    inner = np.flatnonzero(AngleSums(ring(2)).inner[0, 1]) * 0.02
    least = 2 * math.degrees(math.asin(180 / 230))  # at the tips of the lens
    assert (inner.min(), inner.max()) == (pytest.approx(least, abs=0.02), pytest.approx(360 - least, abs=0.02))


@pytest.mark.parametrize(("count", "mean"), [(2, 2.93), (3, 2.43), (4, 2.69), (5, 2.78), (6, 3.02), (8, 3.44)])
def test_means_of_regular_rings_are_those_of_a_prototype_written_apart(count, mean):
    layout = ring(count)
    start, goal = layout.sample_problems(5000, np.random.default_rng(2))
    assert AngleSums(layout).fewest(start, goal, EPSILON_RAD).mean() == pytest.approx(mean, abs=0.04)


def test_plain_search_over_places_finds_nothing_shorter_and_mostly_the_same():
    """One, two and three transfers played out with random hand-over places, every sequence of arms."""
    draw, counts = np.random.default_rng(3), []
    for layout in layouts(4, (2, 3)):
        start, goal = layout.sample_problems(20, draw)
        sums = AngleSums(layout)
        most, least = (sums.fewest(start, goal, EPSILON_RAD, outer=outer) for outer in (False, True))
        found = searched(layout, start, goal, draw)
        assert ((least > 0) & (least <= found))[found < 4].all()
        counts.append((np.where(most == 0, 4, np.minimum(most, 4)) == found).mean())
    assert np.mean(counts) > 0.9  # a few hundred places for each pair of arms miss the tightest plans


def searched(layout, start, goal, draw):
    best, arms = np.full(len(start), 4), range(layout.count)
    shared = {}
    for i, j in combinations(arms, 2):
        shared[i, j] = shared[j, i] = layout.sample_shared(i, j, 3000, draw)[:200]
    for row in range(len(start)):
        from_here = [(arm, start[row : row + 1]) for arm in arms if layout.reaches(start[row])[arm]]
        for transfers in (1, 2, 3):
            if any(_finishes(layout, pose, arm, goal[row]) for arm, pose in from_here):
                best[row] = transfers
                break
            passed = []
            for (arm, pose), receiver in [(each, arm) for each in from_here for arm in arms]:
                place = shared.get((arm, receiver), np.zeros((0, 2)))
                if len(place):
                    some = pose[:: max(1, len(pose) // 250)]
                    poses, places = np.repeat(some, len(place), 0), np.tile(place, (len(some), 1))
                    passed.append((receiver, moved(layout, poses, np.full(len(poses), arm), places)))
            from_here = passed
    return best


def _finishes(layout, pose, arm, goal):
    if not layout.reaches(goal)[arm]:
        return False
    theta = moved(layout, pose, np.full(len(pose), arm), np.broadcast_to(goal[:2], (len(pose), 2)))[:, 2]
    return bool((np.abs(wrapped(theta - goal[2])) <= EPSILON_RAD).any())


def test_layouts_are_what_they_are_asked_to_be():
    draw = np.random.default_rng(4)
    for count in (2, 4, 8):
        layout = random_layout(draw, count, mixed=False, close=True, discs=2)
        assert (layout.rings == layout.rings[0]).all()
        apart = np.hypot(*(layout.bases[:, None] - layout.bases[None]).transpose(2, 0, 1))
        assert 60 <= apart[np.triu_indices(count, 1)].min() < 180
        cut = 0
        for i, j in combinations(range(count), 2):
            bare = Layout(layout.arms, [])
            for place in bare.sample_shared(i, j, 400, draw)[:40]:
                curve, usable = equal_angle_curve(bare, i, j, place)
                disc = np.hypot(*(curve - layout.discs[0, :2]).T) < layout.discs[0, 2]
                runs = (usable & ~disc & np.roll(usable & disc, -1)).any() and (usable & ~disc & np.roll(usable & disc, 1)).any()
                cut += bool(runs)
        assert cut  # the first disc has places on either side of it on a curve of equal angle
