"""Uniform actions: in the chart as before, or on the table."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from marl_handover.errors import InvalidSetting, UnknownChoice
from marl_handover.learning.algorithm import Places, UniformActions
from marl_handover.task.rules import Rules


def uniform(count, seed=0):
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_places_spread_by_area_are_those_of_rejection_sampling(cell):
    """Kolmogorov-Smirnov against points of the bounding box that both arms reach, along both axes of the table."""
    spread = Places(cell.chart).spread(uniform(20_000)).double()
    found = cell.chart.to_table(spread[:, 0], spread[:, 1]).numpy()
    random = np.random.default_rng(1)
    box = random.uniform(-1, 1, (400_000, 2)) * [cell.chart.x_max_mm, cell.r_max_mm - cell.chart.base_distance_mm / 2]
    expected = box[cell.reaches(box).all(-1)]
    assert len(expected) > 50_000
    for axis in (0, 1):
        assert kstest(found[:, axis], expected[:, axis]).pvalue > 0.01
    chart = cell.chart.to_table(*uniform(20_000).double().T).numpy()
    assert kstest(chart[:, 0], expected[:, 0]).pvalue < 1e-6, "uniform in the chart is something else"


def test_spreading_keeps_edges_order_and_the_mirror_symmetries(paper):
    places = Places(paper.chart)
    corners = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [0.0, 0.5]])
    torch.testing.assert_close(places.spread(corners), corners, atol=1e-6, rtol=0)
    line = torch.stack([torch.linspace(-1, 1, 1001), torch.zeros(1001)], -1)
    assert (places.spread(line)[:, 0].diff() > 0).all()
    some = uniform(500)
    torch.testing.assert_close(places.spread(-some), -places.spread(some), atol=1e-5, rtol=0)
    torch.testing.assert_close(places.spread(some)[:, 1], some[:, 1])


def test_uniform_in_the_chart_is_the_generator_itself(paper, small):
    config = small("sac")
    drawn = UniformActions(Rules(paper, config.task), config).draw(50, torch.Generator().manual_seed(3))
    torch.testing.assert_close(drawn, torch.rand(50, 4, generator=torch.Generator().manual_seed(3)) * 2 - 1, atol=0, rtol=0)
    area = small("sac", "algorithm.exploration=area")
    spread = UniformActions(Rules(paper, area.task), area).draw(50, torch.Generator().manual_seed(3))
    assert torch.equal(spread[:, [0, 1, 3]], drawn[:, [0, 1, 3]])
    assert not torch.equal(spread[:, 2], drawn[:, 2])


def test_wider_actions_have_no_area(paper, small):
    class Wider(Rules):
        action_size = 9

    config = small("sac", "algorithm.exploration=area")
    with pytest.raises(InvalidSetting, match=r"algorithm\.exploration"):
        UniformActions(Wider(paper, config.task), config)
    assert UniformActions(Wider(paper, config.task), small("sac")).draw(3, torch.Generator()).shape == (3, 9)


def test_an_unknown_exploration_is_named(small):
    with pytest.raises(UnknownChoice, match="chart, area"):
        small("sac", "algorithm.exploration=volume").validate()
