from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.cell import build_cell, cell_config
from marl_handover.motion.path_optimizer import NoPath, Segment
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.slsqp_planner import first_guess, grip_speed, plan_slsqp, sample_margins, solve
from marl_handover.motion.trajectory import evaluate

TAU = np.linspace(0.0, 1.0, 1001)


@pytest.fixture(scope="module")
def planner() -> MotionPlanner:
    return MotionPlanner(build_cell(cell_config("paper")))


def carrying(planner: MotionPlanner, pick: tuple[float, float], place: tuple[float, float], other: np.ndarray | None = None) -> Segment:
    """A transfer of the right arm, the left one parked if nothing else is said."""
    segment, _ = planner.carrying(1, np.array(pick), np.array(place), planner.home_rad if other is None else other)
    return segment


TRANSFERS = [((-110.0, -50.0), (90.0, -10.0)), ((40.0, 0.0), (-60.0, -20.0))]


@pytest.mark.parametrize(("pick", "place"), TRANSFERS)
def test_its_path_holds_what_the_paper_demands(planner, pick, place):
    """Poses at both ends by the arm model's own kinematics, limits, and the dense check within a millimetre."""
    segment = carrying(planner, pick, place)
    found = plan_slsqp(segment, tolerance_mm=1.0)
    assert found.points.shape == (7, 5)
    assert found.starts == 1
    assert found.evaluations > 1
    q = evaluate(found.points, TAU, 5)
    T = planner.model.arm.fk(q)
    ends = np.stack([planner.in_base(1, np.array(place_mm)) for place_mm in (pick, place)])
    np.testing.assert_allclose(T[[0, -1], :2, 3], ends, atol=1e-3)
    np.testing.assert_allclose(T[[0, -1], 2, 3], planner.pick_height_mm, atol=1e-3)
    np.testing.assert_allclose(found.points[[0, -1], 1:4].sum(axis=1), 0.0, atol=1e-6)
    np.testing.assert_allclose(found.points[[0, -1], 4], 0.0, atol=1e-6)
    assert ((q >= planner.model.arm.lower_rad - 1e-9) & (q <= planner.model.arm.upper_rad + 1e-9)).all()
    assert found.margins == segment.check(np.ascontiguousarray(q[:, :4]))[0]
    assert found.margins.worst >= -1.0
    steps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    assert found.length_mm == pytest.approx(steps.sum(), rel=1e-6)
    assert segment.lower_bound_mm * 0.995 <= found.length_mm <= segment.lower_bound_mm * 1.1


def test_it_makes_its_first_guess_shorter_or_feasible(planner):
    segment = carrying(planner, *TRANSFERS[0])
    margins, length = segment.check(np.ascontiguousarray(evaluate(first_guess(segment), TAU, 5)[:, :4]))
    found = plan_slsqp(segment, tolerance_mm=1.0)
    assert margins.worst < -5.0 or found.length_mm < length


def test_without_tolerance_it_is_judged_like_any_other_path(planner):
    """What the program holds at its samples only is short somewhere between them; the refusal says by how much."""
    segment = carrying(planner, (-200.0, -180.0), (200.0, -175.0))
    margins = plan_slsqp(segment, tolerance_mm=1.0).margins
    assert -1.0 < margins.worst < 0.0
    with pytest.raises(NoPath, match="1001 samples") as refused:
        plan_slsqp(segment)
    assert refused.value.reason == "path"
    assert refused.value.shortfall_mm == pytest.approx(-margins.worst)


def test_too_few_iterations_are_no_path(planner):
    segment = carrying(planner, *TRANSFERS[0])
    assert solve(segment, maxiter=2)[1] == 2
    with pytest.raises(NoPath) as refused:
        plan_slsqp(segment, maxiter=1, tolerance_mm=1.0)
    assert refused.value.reason == "path"


def test_an_end_that_is_too_near_the_other_arm_is_refused_before_the_search(planner):
    """The left arm grasps where the right one is to place."""
    other = planner.grasp_joints(0, "place", np.array([90.0, -10.0]))
    with pytest.raises(NoPath) as refused:
        plan_slsqp(carrying(planner, *TRANSFERS[0], other))
    assert refused.value.reason == "end"


def test_the_first_guess_is_the_joint_line_lifted(planner):
    segment = carrying(planner, *TRANSFERS[0])
    guess = first_guess(segment)
    line = segment.ends[0] + (segment.ends[1] - segment.ends[0]) * np.linspace(0, 1, 7)[:, None]
    np.testing.assert_allclose(guess[[0, -1], :4], segment.ends)
    np.testing.assert_allclose(guess[:, 0], line[:, 0])
    height = [planner.model.arm.fk(np.append(q[:4], 0.0))[2, 3] for q in (*guess[1:-1], *np.pad(line, ((0, 0), (0, 1)))[1:-1])]
    np.testing.assert_allclose(np.subtract(height[:5], height[5:]), segment.scene.profile[6], atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_speed_and_margins_are_those_of_the_dense_check(planner, seed):
    """Integrated speed is the length; the least of the single samples' margins is the path's."""
    random = np.random.default_rng(seed)
    segment = carrying(planner, *TRANSFERS[0])
    low, high = planner.model.arm.lower_rad, planner.model.arm.upper_rad
    points = random.uniform(low, high, (7, 5)) * np.array([1, 1, 1, 1, 0])
    q, slope = evaluate(points, TAU, 5), evaluate(points, TAU, 5, 1)
    margins, length = segment.check(np.ascontiguousarray(q[:, :4]))
    assert np.trapezoid(grip_speed(segment.scene.planar, q, slope), TAU) == pytest.approx(length, rel=1e-4)
    out = np.empty((1001, 6))
    sample_margins(np.ascontiguousarray(q[:, :4]), segment.scene, out)
    np.testing.assert_allclose(out.min(axis=0), margins, atol=1e-9)
