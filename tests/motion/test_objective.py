"""Cost, gradient and dense check of a path against finite differences and brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from marl_handover.cell.build import build_cell
from marl_handover.geometry.capsules import segment_distance
from marl_handover.motion.initial_guesses import fit_control_points
from marl_handover.motion.objective import Penalty, columns, first_moving, lagrangian, ramp
from marl_handover.motion.path_optimizer import WEIGHTS
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import evaluate
from tests.canonical_arms import SO101
from tests.geometry.test_kernels import placed

OTHER = np.array([0.3, 1.0, -2.2, 1.2, 0.0])


@pytest.fixture(scope="module")
def aside(tmp_path_factory):
    """The planner of two arms whose grips lie beside their planes, their hands pointing down."""
    cell = replace(SO101, lateral=-25.0).cell(tmp_path_factory.mktemp("aside"), grid_mm=10.0, base_distance_mm=360.0)
    return MotionPlanner(build_cell(cell))


@pytest.fixture(params=["carrying", "reaching", "leaving", "carrying aside", "reaching aside"])
def case(request, planner, aside):
    """A segment and joint samples of a rough guess, some of them in collision."""
    pick, place = np.array([-120.0, 40.0]), np.array([150.0, 60.0])
    planner = aside if request.param.endswith("aside") else planner
    if request.param.startswith("carrying"):
        segment, guesses = planner.carrying(0, pick, place, OTHER)
        guess = next(guesses)
    else:
        segment, guesses = planner.reaching(0, planner.home_rad, pick, OTHER, leaving=request.param == "leaving")
        guess = next(guesses)
    points = fit_control_points(guess, segment.collision_model.limits, 9, 5)
    points[1:-1] += np.random.default_rng(0).normal(size=(7, 4)) * 0.4
    return segment, evaluate(points, np.linspace(0, 1, 21), 5)


def priced(segment, samples, seed=None):
    shape = (len(samples), columns(segment.scene))
    lam = np.zeros(shape) if seed is None else np.random.default_rng(seed).uniform(0, 3, shape)
    return Penalty(lam, 0.7, np.full(len(samples) - 1, 1 / (len(samples) - 1)), WEIGHTS)


@pytest.mark.parametrize("seed", [None, 1])
def test_the_gradient_is_the_slope_of_the_cost(case, seed):
    segment, Q = case
    price, h = priced(segment, Q, seed), 1e-6
    grad, values = np.empty_like(Q), np.empty((len(Q), columns(segment.scene)))
    lagrangian(Q, segment.scene, price, grad, values)
    assert (values > 0).any(), "the guess should violate something, or the penalty is not tested"
    scratch = (np.empty_like(grad), np.empty_like(values))
    for i in range(1, len(Q) - 1):
        for j in range(4):
            f = []
            for sign in (-1, 1):
                moved = Q.copy()
                moved[i, j] += sign * h
                f.append(lagrangian(moved, segment.scene, price, *scratch))
            slope = (f[1] - f[0]) / (2 * h)
            assert grad[i, j] == pytest.approx(slope, rel=2e-4, abs=2e-2)


def test_the_dense_check_is_the_brute_force_minimum(case):
    segment, Q = case
    scene = segment.scene
    margins, length = segment.check(Q)
    first, aside = first_moving(scene.capsules), scene.planar[8]
    arm, block, itself, ground = [], [], [], []
    grips = []
    for q in Q:
        frames, everything = placed(segment.collision_model, q)
        ends = everything[: len(scene.capsules)]
        c, s = np.cos(q[0]), np.sin(q[0])
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        for number, row in enumerate(scene.obstacles):
            a, b = turn @ row[:3], turn @ row[3:6]
            for k in range(first, len(ends)):
                gap = segment_distance(ends[k, :3], ends[k, 3:6], a, b) - row[6] - row[7] - scene.capsules[k, 7]
                (arm if number < scene.arm_rows else block).append(gap)
        for i, j in scene.pairs:
            gap = segment_distance(ends[i, :3], ends[i, 3:6], ends[j, :3], ends[j, 3:6])
            itself.append(gap - scene.capsules[i, 7] - scene.capsules[j, 7] - scene.clearance[0])
        for k in range(first, scene.carried):
            ground.append(min(ends[k, 2], ends[k, 5]) - scene.capsules[k, 7] - scene.clearance[1])
        tool = scene.planar[6:8]
        r = frames[0, 4, 0] + frames[0, 4, 2] * tool[0] - frames[0, 4, 3] * tool[1]
        z = frames[0, 4, 1] + frames[0, 4, 3] * tool[0] + frames[0, 4, 2] * tool[1]
        grips.append([r * c - aside * s, r * s + aside * c, z])
    assert margins.arm == pytest.approx(min(arm), abs=1e-9)
    assert margins.itself == pytest.approx(min(itself), abs=1e-9)
    assert margins.ground == pytest.approx(min(ground), abs=1e-9)
    if block:
        assert margins.block == pytest.approx(min(block), abs=1e-9)
    assert length == pytest.approx(np.linalg.norm(np.diff(grips, axis=0), axis=1).sum())


def test_the_ramp_is_flat_at_its_ends_and_full_far_away():
    profile, out = np.array([0.0, 0.0, 200.0, 0.0, 25.0, 25.0, 40.0, 2.0]), np.empty(3)
    for x, expected in ((0.0, 0.0), (200.0, 0.0), (100.0, 1.0), (1000.0, 1.0)):
        ramp(x, 0.0, profile, out)
        assert out[0] == pytest.approx(expected, abs=1e-6)
    h = 1e-6
    for x, y in ((10.0, 5.0), (30.0, -3.0), (190.0, 1.0)):
        ramp(x, y, profile, out)
        gradient = out[1:].copy()
        for axis, (dx, dy) in enumerate(((h, 0), (0, h))):
            values = []
            for sign in (-1, 1):
                ramp(x + sign * dx, y + sign * dy, profile, out)
                values.append(out[0])
            assert gradient[axis] == pytest.approx((values[1] - values[0]) / (2 * h), abs=1e-7)
