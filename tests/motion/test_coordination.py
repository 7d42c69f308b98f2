"""Overlapping cycles keep their clearance on a common clock, and save time."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.geometry.capsules import capsule_pairs, segment_distance
from marl_handover.motion.coordination import coordinate, earliest_start_s
from tests.motion.test_motion_planner import place


@pytest.fixture(scope="module")
def motions(model, planner):
    """A block handed over in the middle, and back."""
    pick, middle, end = place(model, 0, 190, 1.2), np.array([20.0, 5.0]), place(model, 1, 200, -1.0)
    park = planner.home_rad
    return [
        planner.pick_place(0, pick, middle, park, park), planner.pick_place(1, middle, end, park, park),
        planner.pick_place(1, end, middle, park, park), planner.pick_place(0, middle, pick, park, park),
    ]  # fmt: skip


def joints_at(motion, t_s):
    """Joints (5,) at a time of the cycle's own clock, held before and after."""
    t = np.concatenate([phase.t_s for phase in motion.phases])
    q = np.concatenate([phase.joints_rad for phase in motion.phases])
    return np.array([np.interp(t_s, t, q[:, joint]) for joint in range(5)])


def arm_gap(model, planner, q):
    """Smallest distance of the two arms' capsules, fingers open; joints (2, 5), by the cell's own kinematics."""
    shapes = []
    for arm, base in enumerate(model.cell.bases):
        c, s = np.cos(base.facing_rad), np.sin(base.facing_rad)
        T = np.array([[c, -s, 0, base.x_mm], [s, c, 0, base.y_mm], [0, 0, 1, 0], [0, 0, 0, 1]])
        frames = model.arm.link_transforms(q[arm], planner.motion.finger_travel_mm)
        rows = []
        for capsule in capsule_pairs(model.arm.description)[0]:
            M = T @ frames[capsule.link]
            rows.append([M[:3, :3] @ capsule.start_mm + M[:3, 3], M[:3, :3] @ capsule.end_mm + M[:3, 3], [capsule.radius_mm] * 3])
        shapes.append(np.array(rows))
    a, b = shapes[0][:, None], shapes[1][None]
    return float((segment_distance(a[..., 0, :], a[..., 1, :], b[..., 0, :], b[..., 1, :]) - a[..., 2, 0] - b[..., 2, 0]).min())


def test_the_next_arm_starts_early_and_clear(model, planner, motions):
    before, motion = motions[:2]
    start = earliest_start_s(planner, before, motion)
    assert 0 <= start < before.duration_s - 0.1, "nothing is saved"
    released = next(phase for phase in before.phases if phase.name == "release").t_s[-1]
    arrival = next(phase for phase in motion.phases if phase.name == "approach").t_s[-1]
    assert start + arrival >= released - 1e-9
    for t in np.arange(start, min(before.duration_s, start + motion.duration_s), 0.004):  # between the samples too
        gap = arm_gap(model, planner, np.stack([joints_at(before, t), joints_at(motion, t - start)]))
        assert gap >= planner.motion.arm_clearance_mm

    earlier = start - 0.1
    gaps = [arm_gap(model, planner, np.stack([joints_at(before, t), joints_at(motion, t - earlier)])) for t in np.arange(0, 6, 0.02)]
    too_near, too_soon = min(gaps) < planner.motion.arm_clearance_mm + 20, earlier + arrival < released
    assert too_near or too_soon, "it could have started earlier"


def test_a_sequence_takes_less_time_overlapped(planner, motions):
    schedule = coordinate(planner, motions)
    assert schedule.starts_s[0] == 0
    assert schedule.sequential_s == pytest.approx(sum(motion.duration_s for motion in motions))
    assert schedule.overlapped_s < schedule.sequential_s
    assert 0 < schedule.saved < 0.6
    # The same arm twice: the second cycle waits for the first.
    assert schedule.starts_s[2] == pytest.approx(schedule.starts_s[1] + motions[1].duration_s)


def test_random_hand_overs_keep_clear_between_samples(model, planner):
    generator, park = np.random.default_rng(2), planner.home_rad
    for _ in range(6):
        pick, end = (place(model, arm, *generator.uniform([150, -1.5], [230, 1.5])) for arm in range(2))
        middle = model.cell.chart.to_table(*generator.uniform(-1, 1, 2))
        before, motion = planner.pick_place(0, pick, middle, park, park), planner.pick_place(1, middle, end, park, park)
        start = earliest_start_s(planner, before, motion)
        for t in np.arange(start, before.duration_s, 0.005):
            gap = arm_gap(model, planner, np.stack([joints_at(before, t), joints_at(motion, t - start)]))
            assert gap >= planner.motion.arm_clearance_mm


def test_no_cycle_no_time(planner):
    assert coordinate(planner, []) == ((), 0, 0.0)
