"""The angle chart is a bijection from the square onto what any two arms share, and its hand-over angles are all that there are."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from marl_handover.arrays import wrap
from marl_handover.cell.arm import Arm, mirrored_pair
from marl_handover.cell.chart import PaperChart
from marl_handover.cell.shared_space import SharedSpace
from marl_handover.errors import NoSharedSpace
from marl_handover.geometry.se2 import SE2

LINE = np.concatenate([np.linspace(-1, 1, 25), [np.nextafter(1, 0), np.nextafter(-1, 0), 1e-12]])
SQUARE = np.stack(np.meshgrid(LINE, LINE, indexing="ij"), -1).reshape(-1, 2)

sectors = st.tuples(
    st.floats(80, 300),  # least radius
    st.floats(30, 250),  # width of the ring
    st.sampled_from([0.0, 0.0, 1.0]).flatmap(lambda some: st.floats(-30, 30).map(lambda delta: some * delta)),  # lateral offset
    st.floats(0.5, 3.1),  # yaw to the right
    st.floats(0.5, 3.1),  # and to the left
    st.floats(-0.4, 0.4),  # facing off the other base
)


def pair(one, other, share: float = 0.78, turn: float = 0.3) -> tuple[Arm, Arm]:
    """Two arms whose bases are ``share`` of the sum of their outer radii apart; of two sectors as above."""
    distance = share * (one[0] + one[1] + other[0] + other[1])
    places = np.zeros(2), distance * np.array([math.cos(turn), math.sin(turn)])
    arms = []
    for name, (low, width, lateral, right, left, off), base, ahead in zip("ab", (one, other), places, (turn, turn + math.pi), strict=True):
        arms.append(Arm(name, SE2.facing_deg(*base, math.degrees(ahead + off)), low, low + width, (-right, left), lateral_mm=lateral))
    return arms[0], arms[1]


def shared(arms: tuple[Arm, Arm]) -> SharedSpace:
    space = SharedSpace(*arms, 1.0, "angle")
    try:
        _ = space.chart
    except NoSharedSpace:
        assume(False)
    return space


def hand_over(arms: tuple[Arm, Arm], points) -> np.ndarray:
    """The difference of both grippers' world yaws at points (..., 2), by its definition."""
    psi = []
    for arm in arms:
        local = arm.base.to_local(points)
        psi.append(arm.base.facing_rad + np.arctan2(local[..., 1], local[..., 0]) - np.arcsin(arm.lateral_mm / np.hypot(*local.T).T))
    return psi[0] - psi[1]


@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(sectors, sectors, st.floats(0.5, 0.95))
def test_every_chart_point_is_in_reach_of_both_arms(one, other, share):
    arms = pair(one, other, share)
    space = shared(arms)
    for square in (SQUARE, SQUARE.astype(np.float32), torch.as_tensor(SQUARE), torch.as_tensor(SQUARE.astype(np.float32))):
        place = space.to_table(square[:, 0], square[:, 1])
        assert place.dtype == square.dtype
        for arm in arms:
            assert arm.reaches(np.asarray(place)).all()


@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(sectors, sectors, st.floats(0.4, 1.0))
def test_round_trips_are_exact_and_the_square_covers_the_whole_space(one, other, share):
    arms = pair(one, other, share)
    space = shared(arms)
    widths = np.cumsum([arc.width_rad for arc in space.chart.arcs])
    ends = np.r_[-1, 2 * widths / widths[-1] - 1]  # where an arc ends beta has no meaning, and there is a gap to the next one
    inner = SQUARE[np.abs(SQUARE[:, :1] - ends).min(-1) > 0.003]
    np.testing.assert_allclose(np.stack(space.from_table(space.to_table(*inner.T)), -1), inner, atol=1e-7)
    draw = np.random.default_rng(0)
    radius = np.sqrt(draw.uniform(arms[0].r_min_mm ** 2, arms[0].r_max_mm ** 2, 20_000))
    points = arms[0].base.around(radius, draw.uniform(-math.pi, math.pi, 20_000))
    away = 0.01  # points nearer to the edge may be on either side of it by rounding
    for slack, inside in ((-away, True), (away, False)):
        wider = [
            Arm(
                a.name,
                a.base,
                a.r_min_mm - slack,
                a.r_max_mm + slack,
                (a.yaw_rad[0] - slack / 80, a.yaw_rad[1] + slack / 80),
                "",
                a.lateral_mm,
            )
            for a in arms
        ]
        both = wider[0].reaches(points) & wider[1].reaches(points)
        seen = (np.abs(np.stack(space.from_table(points), -1)) <= 1 + 1e-9).all(-1)
        assert seen[both].all() if inside else not seen[~both].any()


@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(sectors, sectors, st.floats(0.4, 1.0))
def test_alpha_is_the_hand_over_angle_and_the_arcs_hold_all_of_them(one, other, share):
    arms = pair(one, other, share)
    space = shared(arms)
    alpha = np.linspace(-1, 1, 101)
    angle = [hand_over(arms, space.to_table(alpha, 0 * alpha + beta)) for beta in (-0.9, 0.0, 0.7)]
    for another in angle[1:]:
        np.testing.assert_allclose(wrap(another - angle[0]), 0, atol=1e-8)
    points = np.random.default_rng(1).uniform(-1, 1, (50_000, 2)) * 1200
    points = points[arms[0].reaches(points) & arms[1].reaches(points)]
    found = np.remainder(hand_over(arms, points), 2 * math.pi)
    within = [np.abs(wrap(found - (arc.low_rad + arc.width_rad / 2))) <= arc.width_rad / 2 + 1e-4 for arc in space.chart.arcs]
    assert np.any(within, 0).all()
    for arc in space.chart.arcs:
        gamma = np.linspace(arc.low_rad + 1e-9, arc.low_rad + arc.width_rad - 1e-9, 50)
        places = space.in_world(space.chart.at_angle(gamma))
        np.testing.assert_allclose(wrap(hand_over(arms, places) - gamma), 0, atol=1e-8)
        assert arms[0].reaches(places).all()
        assert arms[1].reaches(places).all()


def test_of_equal_arms_it_has_the_angles_of_the_papers_chart(paper):
    space = SharedSpace(*paper.arms, 1.0, "angle")
    np.testing.assert_allclose(space.chart.arcs, paper.chart.arcs, atol=1e-12)
    tip = PaperChart(150.0, 230.0, 360.0).x_max_mm
    np.testing.assert_allclose(space.to_table(np.array([-1.0, 1.0]), np.zeros(2)), [[-tip, 0], [tip, 0]], atol=1e-6)


def test_a_space_in_two_pieces_has_two_arcs():
    left, right = (Arm(name, base, 150.0, 230.0, (-1.5, 1.5)) for name, base in zip("lr", mirrored_pair(280.0), strict=True))
    arcs = SharedSpace(left, right, 1.0, "angle").chart.arcs
    assert len(arcs) == 2
    half_turn = [arc.low_rad <= math.pi <= arc.low_rad + arc.width_rad for arc in arcs]
    assert not any(half_turn)  # between the bases neither reaches


def test_the_symmetries_of_the_cell_are_those_of_its_charts(paper):
    space = SharedSpace(*paper.arms, 1.0, "angle")
    alpha, beta = np.random.default_rng(2).uniform(-1, 1, (2, 1000))
    place = space.to_table(alpha, beta)
    np.testing.assert_allclose(space.to_table(-alpha, beta), place * [-1, 1], atol=1e-9)
    np.testing.assert_allclose(space.to_table(alpha, -beta), place * [1, -1], atol=1e-9)


def test_gradients_are_finite_on_the_whole_square():
    arms = pair((150.0, 80.0, 12.0, 1.5, 1.0, 0.1), (269.0, 165.0, 0.0, 1.6, 1.6, 0.0))
    square = torch.as_tensor(SQUARE).requires_grad_()
    place = SharedSpace(*arms, 1.0, "angle").to_table(square[:, 0], square[:, 1])
    (slope,) = torch.autograd.grad(place.sum(), square)
    assert torch.isfinite(slope).all()


def test_arms_without_such_a_space_are_named():
    sector = (100.0, 200.0, 0.0, 3.1, 3.1, 0.0)
    with pytest.raises(NoSharedSpace, match="arms 'a' and 'b' reach 100 to 300 and 100 to 300 mm; they have no place in common"):
        _ = SharedSpace(*pair(sector, sector, 1.1), 1.0, "angle").chart
