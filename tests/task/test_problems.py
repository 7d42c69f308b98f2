"""Random problems are uniform on the union of what the arms reach."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from marl_handover.task.problems import sample_poses, sample_positions, sample_problems

COUNT = 200_000
STEP_MM, BLOCK = 1.0, 40  # a Monte-Carlo grid of 1 mm, counted in squares of 40 mm


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def table(cell):
    """Centres of a 1 mm grid over the table (n, n, 2) and, by the definition of the sectors, which arm reaches them (n, n, 2)."""
    axis = np.arange(-560, 560, STEP_MM) + STEP_MM / 2
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    reach = []
    for side in (1, -1):
        dx, dy = points[..., 0], points[..., 1] - side * cell.config.base_distance_mm / 2
        radius, yaw = np.hypot(dx, dy), np.arctan2(side * dx, -side * dy)
        inside = (radius >= cell.r_min_mm) & (radius <= cell.r_max_mm)
        reach.append(inside & (yaw >= cell.yaw_rad[0]) & (yaw <= cell.yaw_rad[1]))
    return points, np.stack(reach, -1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_all_positions_are_in_reach_and_uniform(cell, dtype):
    points = sample_positions(cell, COUNT, seeded(0), dtype)
    assert points.shape == (COUNT, 2)
    assert points.dtype == dtype
    assert cell.reaches(points).any(-1).all()
    _, reach = table(cell)
    union = reach.any(-1)
    blocks = union.reshape(len(union) // BLOCK, BLOCK, len(union) // BLOCK, BLOCK).sum((1, 3))
    edges = np.arange(len(blocks) + 1) * BLOCK * STEP_MM - 560
    counts = np.histogram2d(*points.numpy().T.astype(float), bins=(edges, edges))[0]
    assert counts.sum() == COUNT
    expected = COUNT * blocks / blocks.sum()
    filled = expected > 50  # slivers at the rim are too small for the grid
    score = ((counts - expected)[filled] ** 2 / expected[filled]).sum()
    freedom = filled.sum() - 1
    assert freedom > 60
    assert score < freedom + 6 * math.sqrt(2 * freedom)  # chi-square: a point twice as dense in the shared space is at 100 times that


def test_the_shared_space_has_its_share(cell):
    _, reach = table(cell)
    shares = [reach[..., 0].sum(), reach[..., 1].sum(), reach.all(-1).sum()] / reach.any(-1).sum()
    drawn = cell.reaches(sample_positions(cell, COUNT, seeded(1))).double()
    measured = [*drawn.mean(0), (drawn.sum(-1) == 2).double().mean()]
    np.testing.assert_allclose(measured, shares, atol=0.01)
    assert 0.05 < shares[2] < 0.5


def test_theta_is_uniform(paper):
    theta = sample_poses(paper, COUNT, seeded(2))[:, 2].numpy()
    assert theta.min() >= -math.pi
    assert theta.max() <= math.pi
    counts = np.histogram(theta, 72, (-math.pi, math.pi))[0]
    assert ((counts - COUNT / 72) ** 2 / (COUNT / 72)).sum() < 71 + 5 * math.sqrt(142)


def test_start_goal_and_theta_are_independent(paper):
    start, goal = sample_problems(paper, COUNT, seeded(3))
    correlation = np.corrcoef(np.concatenate([start, goal], -1).T) - np.eye(6)
    assert np.abs(correlation).max() < 0.02


def test_the_generator_decides(paper):
    first, again, other = (sample_problems(paper, 100, seeded(seed)) for seed in (4, 4, 5))
    for one, same, different in zip(first, again, other, strict=True):
        assert torch.equal(one, same)
        assert not torch.equal(one, different)
    generator = seeded(4)
    sample_problems(paper, 100, generator)
    assert not torch.equal(sample_problems(paper, 100, generator)[0], first[0])


@pytest.mark.parametrize("count", [0, 1, 7])
def test_any_count_is_served(paper, count):
    start, goal = sample_problems(paper, count, seeded(6))
    assert start.shape == goal.shape == (count, 3)
    assert paper.reaches(torch.cat([start, goal])).any(-1).all()
