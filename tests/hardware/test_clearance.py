"""The gate's compiled geometry against the cell's, with wrist roll, and what it proves of the postures between two against them all."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.cell import build_cell, cell_config
from marl_handover.geometry.capsules import Capsule, block_capsules, capsule_pairs, segment_distance, self_clearance_mm
from marl_handover.geometry.se3 import transform
from marl_handover.hardware.clearance import FAR_MM, SETTLED_MM, alone_mm, arm_shapes, between_mm, still


@pytest.fixture(scope="module", params=["paper", "so101"])
def model(request):
    """A hand that is level where it picks, and one that points 60 degrees down: its roll axis is not the grip's x."""
    return build_cell(cell_config(request.param))


@pytest.fixture(scope="module")
def postures(model):
    return np.random.default_rng(0).uniform(model.arm.lower_rad, model.arm.upper_rad, (60, 5))


@pytest.fixture(scope="module")
def bases(model):
    return [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]


def held(model):
    """The block's and the pin's capsules, in the frame of the grip."""
    config = model.cell.config
    return [
        Capsule(model.arm.description.grasp_link, c.start_mm, c.end_mm, c.radius_mm)
        for c in block_capsules(config.block, model.cell.pick_height_mm)
    ]


def placed(model, q, base, holding=False):
    """End points (K, 2, 3) in the world and radii (K,), the slow way."""
    frames, T = model.arm.link_transforms(q), transform((base[0], base[1], 0.0), (0.0, 0.0, base[2]))
    capsules = [*capsule_pairs(model.arm.description)[0], *(held(model) if holding else [])]
    ends = [[(T @ frames[c.link] @ np.append(end, 1.0))[:3] for end in (c.start_mm, c.end_mm)] for c in capsules]
    return np.array(ends), np.array([c.radius_mm for c in capsules])


def corners_mm(model, q):
    """Height of the lowest point of the rim of the disc around the held block."""
    config, turns = model.cell.config, np.linspace(0, 2 * np.pi, 721)
    radius = config.block.side_mm / math.sqrt(2)
    rim = np.stack([radius * np.cos(turns), radius * np.sin(turns), np.full(721, -model.cell.pick_height_mm), np.ones(721)])
    top = rim + np.array([[0.0], [0.0], [config.block.height_mm], [0.0]])
    T = model.arm.fk(q)
    return float(min((T @ rim)[2].min(), (T @ top)[2].min()))


def exactly(model, q, holding):
    """Height, distance to itself, height of the block, by the gate's geometry, of an arm that stands."""
    gaps = np.empty(3)
    alone_mm(still(q), arm_shapes(model, holding), np.full(3, FAR_MM), gaps)
    return gaps


def test_alone(model, postures):
    moving = arm_shapes(model).capsules[:, 0] >= 2
    for q in postures:
        gaps = exactly(model, q, False)
        ends, radii = placed(model, q, (0.0, 0.0, 0.0))
        assert gaps[0] == pytest.approx((ends[:, :, 2].min(axis=1) - radii)[moving].min(), abs=1e-9)
        assert gaps[1] == pytest.approx(float(self_clearance_mm(model.arm, q)), abs=1e-9)
        assert gaps[2] == FAR_MM, "it holds nothing"


def test_alone_with_the_block(model, postures):
    bare = len(capsule_pairs(model.arm.description)[0])
    for q in postures:
        gaps = exactly(model, q, True)
        ends, radii = placed(model, q, (0.0, 0.0, 0.0), True)
        pin = (ends[:, :, 2].min(axis=1) - radii)[-1]
        assert gaps[0] == pytest.approx(min(pin, exactly(model, q, False)[0]), abs=1e-9)
        own, block = ends[:5], ends[bare:]
        apart = segment_distance(own[:, None, 0], own[:, None, 1], block[None, :, 0], block[None, :, 1]) - radii[:5, None] - radii[bare:]
        assert gaps[1] == pytest.approx(min(float(self_clearance_mm(model.arm, q)), apart.min()), abs=1e-9)
        assert corners_mm(model, q) - 1e-3 <= gaps[2] <= corners_mm(model, q) + 1e-9


@pytest.mark.parametrize(("holding", "also"), [(False, False), (True, False), (False, True), (True, True)])
def test_between(model, postures, bases, holding, also):
    shapes, others = arm_shapes(model, holding), arm_shapes(model, also)
    for q, other in zip(postures, postures[::-1], strict=True):
        ends, radii = placed(model, q, bases[0], holding)
        other_ends, other_radii = placed(model, other, bases[1], also)
        gaps = segment_distance(ends[:, None, 0], ends[:, None, 1], other_ends[None, :, 0], other_ends[None, :, 1])
        expected = (gaps - radii[:, None] - other_radii).min()
        assert between_mm(still(q), still(other), True, shapes, others, *bases, FAR_MM) == pytest.approx(expected, abs=1e-9)
        assert between_mm(still(other), still(q), False, others, shapes, *bases[::-1], FAR_MM) == pytest.approx(expected, abs=1e-9)


angles = st.lists(st.floats(-1.0, 1.0), min_size=5, max_size=5).map(np.array)
ways = st.tuples(st.integers(0, 59), angles, angles, st.sampled_from([0.0, 0.1, 0.4]), st.sampled_from([0.0, 0.1]))


def way_of(postures, drawn):
    number, along, across, far, late = drawn
    return np.stack([postures[number], postures[number] + late * across, postures[number] + far * along])


def on(way, share, late):
    return (1 - share) * ((1 - late) * way[0] + late * way[1]) + share * way[2]


@given(ways, st.booleans(), st.floats(0, 1), st.floats(0, 1), st.floats(-30, 30))
def test_what_is_proved_of_a_way_holds_of_every_posture_on_it(model, postures, drawn, holding, share, late, nearness_mm):
    """Limits are set near what one posture has, so that the proof is hard; no other one may be below what was proved."""
    way = way_of(postures, drawn)
    limits = exactly(model, on(way, 0.5, 0.5), holding) + nearness_mm - 30.0
    gaps = np.empty(3)
    alone_mm(way, arm_shapes(model, holding), limits, gaps)
    if (gaps >= limits).all():
        assert (exactly(model, on(way, share, late), holding) >= limits - SETTLED_MM - 1e-9).all()


@given(ways, ways, st.tuples(*[st.floats(0, 1)] * 4), st.tuples(st.booleans(), st.booleans(), st.booleans()), st.floats(0, 60))
def test_and_of_two_arms(model, postures, bases, drawn, other_drawn, at, flags, nearness_mm):
    together, *holding = flags
    shapes = [arm_shapes(model, it) for it in holding]
    way, other = way_of(postures, drawn), way_of(postures, other_drawn)
    start = between_mm(still(way[2]), still(other[2]), True, *shapes, *bases, FAR_MM)
    limit_mm = start - nearness_mm
    if between_mm(way, other, together, *shapes, *bases, limit_mm) >= limit_mm:
        q, p = on(way, *at[:2]), on(other, *(at[:2] if together else at[2:]))
        assert between_mm(still(q), still(p), True, *shapes, *bases, FAR_MM) >= limit_mm - SETTLED_MM - 1e-9


@given(ways, ways, st.floats(0, 60))
def test_what_is_found_too_near_is_a_posture_on_the_way(model, postures, bases, drawn, other_drawn, nearness_mm):
    """Of arms that stood before: no bound is too wide, no look too many; asked for just that distance, the same posture is found again."""
    shapes = arm_shapes(model, True)
    way, other = (way_of(postures, (*it[:4], 0.0)) for it in (drawn, other_drawn))
    limit_mm = between_mm(still(way[2]), still(other[2]), True, shapes, shapes, *bases, FAR_MM) - nearness_mm
    gap = between_mm(way, other, True, shapes, shapes, *bases, limit_mm)
    if gap < limit_mm:
        assert between_mm(way, other, True, shapes, shapes, *bases, gap + 1e-9) == gap
