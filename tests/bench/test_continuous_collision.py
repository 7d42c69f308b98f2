"""What is proved of a path holds wherever one looks."""

from __future__ import annotations

import numpy as np
import pytest
from continuous_collision import certify

from marl_handover.motion.initial_guesses import fit_control_points
from marl_handover.motion.trajectory import evaluate
from tests.motion.test_motion_planner import place

OTHER = np.array([-0.3, 1.0, -2.2, 1.2, 0.0])


def least_margin(segment, points, samples):
    margins, _ = segment.check(evaluate(points, np.linspace(0, 1, samples), 5)[:, :4])
    return min(margins.arm, margins.block, margins.itself, margins.ground)


@pytest.mark.parametrize("seed", range(8))
def test_the_proof_is_a_lower_bound_and_a_near_one(model, planner, seed):
    generator = np.random.default_rng(seed)
    pick, put = (place(model, 0, *generator.uniform([150, -1.5], [230, 1.5])) for _ in range(2))
    segment, guesses = planner.carrying(0, pick, put, planner.home_rad)
    for points in (
        fit_control_points(next(guesses), segment.collision_model.limits, 9, 5),
        planner.transfer(0, pick, put, planner.home_rad).points[:, :4],
    ):
        certificate = certify(segment, points, 5)
        seen = least_margin(segment, points, 20_001)
        assert certificate.margin_mm <= seen + 1e-9
        if seen > 0.05:
            assert certificate.proved


def test_a_path_through_the_other_arm_is_not_proved(model, planner):
    other = np.append(model.arm.ik([190.0, 0.0, 60.0])[0, :4], 0.0)
    segment, guesses = planner.carrying(0, place(model, 0, 175, 1.1), place(model, 0, 175, -1.1), other)
    points = fit_control_points(list(guesses)[1], segment.collision_model.limits, 9, 5)
    assert least_margin(segment, points, 2001) < 0
    certificate = certify(segment, points, 5)
    assert not certificate.proved
    assert certificate.margin_mm <= least_margin(segment, points, 2001) + 1e-9


def test_no_point_moves_faster_than_the_levers_say(model, planner):
    from tests.geometry.test_kernels import in_base, placed, postures

    h = 1e-4
    for q in postures(model, 200, 11):
        _, before = placed(planner.collision_model, q)
        for joint in range(4):
            moved = q.copy()
            moved[joint] += h
            _, after = placed(planner.collision_model, moved)
            for e in (0, 3):
                step = np.linalg.norm(in_base(after[:, e : e + 3], moved[0]) - in_base(before[:, e : e + 3], q[0]), axis=1)
                assert (step <= h * planner.collision_model.levers_mm[joint] * 1.001).all()
