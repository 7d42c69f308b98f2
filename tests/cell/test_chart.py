"""The chart is a bijection from the square onto the shared space."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from marl_handover.cell import PaperChart
from marl_handover.errors import NoSharedSpace

coordinate = st.floats(-1, 1)
charts = st.builds(
    lambda low, width, share: PaperChart(low, low + width, 2 * (low + share * width)),
    st.floats(50, 300),
    st.floats(5, 300),
    st.floats(0.05, 0.95),
)
LINE = np.concatenate([np.linspace(-1, 1, 201), [np.nextafter(1, 0), np.nextafter(-1, 0), 1e-12]])
SQUARE = np.stack(np.meshgrid(LINE, LINE, indexing="ij"), -1).reshape(-1, 2)


def distances(chart: PaperChart, position) -> np.ndarray:
    """Distance from both bases, by the definition of the shared space."""
    x_mm, y_mm = np.asarray(position, np.float64)[..., 0], np.asarray(position, np.float64)[..., 1]
    half = chart.base_distance_mm / 2
    return np.stack([np.hypot(x_mm, y_mm - half), np.hypot(x_mm, y_mm + half)], -1)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_every_chart_point_is_in_reach_of_both_arms(cell, dtype, library):
    alpha, beta = SQUARE.astype(dtype).T
    if library == "torch":
        alpha, beta = torch.as_tensor(alpha.copy()), torch.as_tensor(beta.copy())
    position = cell.chart.to_table(alpha, beta)
    assert str(position.dtype).endswith(np.dtype(dtype).name)
    assert cell.reaches(position).all()


@pytest.mark.parametrize("library", [np.tanh, torch.tanh])
def test_saturated_tanh_actions_are_in_reach(paper, library):
    logits = np.array([(a, b) for a in (-40, -9, 0.3, 9, 40) for b in (-40, -9, 9, 40)], np.float32)
    squashed = np.asarray(library(torch.as_tensor(logits) if library is torch.tanh else logits))
    assert (np.abs(squashed) == 1).any()
    assert paper.reaches(paper.chart.to_table(squashed[:, 0], squashed[:, 1])).all()


@given(chart=charts, alpha=coordinate, beta=coordinate)
def test_chart_points_obey_the_definition_for_any_annulus(chart, alpha, beta):
    distance = distances(chart, chart.to_table(np.float64(alpha), np.float64(beta)))
    assert (distance >= chart.r_min_mm - 1e-9).all()
    assert (distance <= chart.r_max_mm + 1e-9).all()


@given(chart=charts, alpha=st.floats(-0.999, 0.999), beta=coordinate)
def test_round_trip_is_exact_off_the_tips(chart, alpha, beta):
    back = chart.from_table(chart.to_table(np.float64(alpha), np.float64(beta)))
    np.testing.assert_allclose(back, (alpha, beta), atol=1e-9)


@given(alpha=st.floats(-0.999, 0.999), beta=coordinate, inset=st.floats(0.1, 1))
def test_round_trip_with_an_inset(paper, alpha, beta, inset):
    chart = paper.with_inset(inset).chart
    np.testing.assert_allclose(chart.from_table(chart.to_table(np.float64(alpha), np.float64(beta))), (alpha, beta), atol=1e-9)


@given(first=st.tuples(st.floats(-0.99, 0.99), coordinate), second=st.tuples(st.floats(-0.99, 0.99), coordinate))
def test_different_coordinates_are_different_places(paper, first, second):
    chart = paper.chart
    apart = max(abs(first[0] - second[0]), abs(first[1] - second[1]))
    assume(apart > 1e-6)
    places = [chart.to_table(*np.float64(point)) for point in (first, second)]
    slope = 2 * max(1.0, chart.x_max_mm)  # steeper than the map's inverse anywhere within |alpha| <= 0.99
    assert np.hypot(*(places[0] - places[1])) > apart / slope


def test_tips_have_beta_zero_and_no_nan(cell):
    alpha, beta = cell.chart.from_table(np.array([[cell.chart.x_max_mm + 1, 0.0], [-cell.chart.x_max_mm - 1, 0.0]]))
    assert np.abs(alpha).min() > 1
    assert (beta == 0).all()


def test_the_square_covers_the_whole_shared_space(cell):
    """Points of the table, kept by the definition of the shared space, all have coordinates in the square."""
    chart = cell.chart
    box = (chart.x_max_mm * 1.1, chart.base_distance_mm / 2)
    points = np.random.default_rng(0).uniform(-1, 1, (200_000, 2)) * box
    distance = distances(chart, points)
    shared = ((distance >= chart.r_min_mm) & (distance <= chart.r_max_mm)).all(-1)
    assert 1000 < shared.sum() < 199_000
    coordinates = np.stack(chart.from_table(points), -1)
    assert (np.abs(coordinates[shared]) <= 1 + 1e-12).all()
    outside = ~shared & (np.abs(points[:, 0]) < chart.x_max_mm)  # beyond the tips the width is 0 and beta has no meaning
    assert (np.abs(coordinates[outside, 1]) > 1 - 1e-12).all()


@given(chart=charts)
def test_the_two_branches_of_the_width_meet_at_x_switch(chart):
    assume(chart.base_distance_mm**2 >= chart.r_max_mm**2 - chart.r_min_mm**2)  # else the shared space reaches behind the bases
    half, x_mm = chart.base_distance_mm / 2, chart.x_switch_mm
    outer = math.sqrt(chart.r_max_mm**2 - x_mm**2) - half
    inner = half - math.sqrt(chart.r_min_mm**2 - x_mm**2)
    if x_mm == 0:  # the outer circles alone bound the shared space
        assert outer <= inner + 1e-6
    else:
        assert outer == pytest.approx(inner, abs=1e-6)
    assert float(chart.y_max_mm(np.float64(x_mm))) == pytest.approx(outer, abs=1e-6)


def test_x_switch_and_x_max_of_the_paper_cell(paper):
    """By hand: the circle of radius 150 about one base meets the circle of radius 230 about the other."""
    assert paper.chart.x_max_mm == pytest.approx(math.sqrt(230**2 - 180**2))
    x_mm, y_mm = paper.chart.x_switch_mm, float(paper.chart.y_max_mm(np.float64(paper.chart.x_switch_mm)))
    assert math.hypot(x_mm, 180 - y_mm) == pytest.approx(150)
    assert math.hypot(x_mm, 180 + y_mm) == pytest.approx(230)


def test_inset_keeps_away_from_the_edge(paper):
    inner = paper.with_inset(0.9)
    edge = np.array([(a, b) for a in np.linspace(-1, 1, 81) for b in np.linspace(-1, 1, 21) if max(abs(a), abs(b)) == 1])
    position = inner.chart.to_table(*edge.T)
    alpha, beta = paper.chart.from_table(position)
    np.testing.assert_allclose(np.maximum(np.abs(alpha), np.abs(beta)), 0.9, atol=1e-12)
    assert inner.reaches(position).all()
    assert paper.config.chart_inset == 1.0  # the cell it was made from is left as it was


@pytest.mark.parametrize("distance_mm", [100.0, 300.0, 460.0, 1000.0, math.nan])
def test_no_shared_space_is_named(distance_mm):
    with pytest.raises(NoSharedSpace, match=r"base_distance_mm = .*300.*460"):
        PaperChart(150.0, 230.0, distance_mm)
