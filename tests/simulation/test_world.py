"""The laws of the simulated cell: placement as the closed form says, determinism, what is held, what collides."""

import math

import numpy as np
import pytest

from marl_handover.errors import UnknownChoice
from marl_handover.simulation.engine import NoWindow
from marl_handover.simulation.world import SimulatedCell
from tests.canonical_arms import PARKED_DEG

CASES = [
    (0, (30.0, -15.0, 0.3), (-60.0, -5.0)),
    (1, (-127.0, -99.0, -2.0), (150.0, -150.0)),  # at r_min, half a turn of the base
    (0, (-100.0, -20.0, 3.0), (-228.0, 165.0)),  # out to r_max
]


def off(pose, wanted):
    gap = pose - wanted
    return math.hypot(gap[0], gap[1]), abs(math.degrees(math.remainder(gap[2], 2 * math.pi)))


@pytest.mark.parametrize(("arm", "pose", "place"), CASES)
def test_a_friction_grasp_puts_the_block_where_the_closed_form_says(cell, cycle, expected, arm, pose, place):
    cell.reset(pose)
    report = cell.run(arm, cycle(arm, pose[:2], place))
    position_mm, yaw_deg = off(cell.object_pose(), expected(arm, pose, place))
    assert position_mm < 2
    assert yaw_deg < 1
    assert report.arms[arm].grasped
    assert report.arms[arm].kept
    assert not report.collisions
    assert math.degrees(cell.tilt_rad()) < 0.5
    assert not cell.held(arm)
    np.testing.assert_allclose(cell.joints_rad(), np.tile(np.radians(PARKED_DEG), (2, 1)), atol=math.radians(0.2))


def test_a_constraint_grasp_is_nearly_exact(model, motion, engine, cycle, expected):
    arm, pose, place = CASES[0]
    with SimulatedCell(model, motion, engine=engine, grasp="constraint") as cell:
        cell.reset(pose)
        cell.run(arm, cycle(arm, pose[:2], place))
        position_mm, yaw_deg = off(cell.object_pose(), expected(arm, pose, place))
    assert position_mm < 0.3
    assert yaw_deg < 0.1


def test_equal_calls_give_bit_identical_states_whatever_went_before_and_beside(model, motion, engine, cycle):
    arm, pose, place = CASES[0]
    phases = cycle(arm, pose[:2], place)
    with SimulatedCell(model, motion, engine=engine) as first, SimulatedCell(model, motion, engine=engine) as second:
        second.reset((0.0, 10.0, 1.0))
        second.run(1, cycle(1, (0.0, 10.0), (40.0, 0.0))[:2])
        states = []
        for cell in (first, second):
            cell.reset(pose)
            cell.run(arm, phases[:4])
            states.append(np.concatenate([cell.object_pose(), cell.joints_rad().ravel()]))
    assert states[0].tobytes() == states[1].tobytes()


def test_reset_stands_the_block_at_its_pose_and_parks_the_arms(cell, motion):
    cell.reset((40.0, 20.0, -2.5))
    np.testing.assert_allclose(cell.object_pose(), (40.0, 20.0, -2.5), atol=2e-3)
    np.testing.assert_allclose(cell.joints_rad(), np.tile(np.radians(PARKED_DEG), (2, 1)), atol=1e-4)
    assert cell.block.height_mm() == pytest.approx(0, abs=0.01)
    assert not cell.collisions()
    assert not any(cell.held(arm) for arm in range(2))


def test_a_lifted_block_is_held_by_the_arm_that_lifted_it(cell, cycle):
    cell.reset((30.0, -15.0, 0.0))
    cell.run(0, cycle(0, (30.0, -15.0), (-60.0, -5.0))[:3])
    assert cell.held(0)
    assert not cell.held(1)
    assert cell.block.height_mm() == pytest.approx(40, abs=0.5)


def test_fingers_that_close_beside_the_pin_grasp_nothing_and_leave_the_block(cell, cycle):
    cell.reset((100.0, -120.0, 0.0))
    report = cell.run(0, cycle(0, (-30.0, -25.0), (60.0, -10.0)))
    assert not report.arms[0].grasped
    assert off(cell.object_pose(), np.array([100.0, -120.0, 0.0])) == pytest.approx((0, 0), abs=0.05)


def test_an_arm_driven_into_the_table_is_reported(cell, cycle, joints_at):
    cell.reset((100.0, 60.0, 0.0))
    phases = list(cycle(0, (0.0, 0.0), (0.0, 0.0))[:1])
    low = joints_at(0, (0.0, 0.0), 5.0)[0]
    start = phases[0].joints_rad[-1]
    crash = start + np.linspace(0, 1, 30)[:, None] * (low - (0, 0, 0, 0.5, 0) - start)
    phases.append(phases[0].__class__("transfer", phases[0].t_s[-1] + np.linspace(0, 1, 30), crash, np.full(30, 12.0)))
    assert "arm 0 - table" in cell.run(0, phases).collisions


def test_arms_that_reach_for_the_same_place_are_reported(cell, cycle):
    cell.reset((100.0, 60.0, 0.0))
    report = cell.run_together({arm: cycle(arm, (0.0, 0.0), (0.0, 0.0))[:1] for arm in range(2)})
    assert "arm 0 - arm 1" in report.collisions


def test_two_arms_move_on_one_clock(cell, cycle, expected):
    pose, place = (-100.0, 90.0, 0.5), (100.0, 90.0)
    cell.reset(pose)
    calls = []
    report = cell.run_together({0: cycle(0, pose[:2], place), 1: cycle(1, (-120.0, -110.0), (120.0, -110.0))}, lambda: calls.append(1))
    assert off(cell.object_pose(), expected(0, pose, place)) < (2, 1)
    assert report.arms[0].kept
    assert not report.arms[1].grasped
    assert len(calls) == int(report.duration_s / 0.02 + 1e-6)


def test_servos_follow_within_their_speed(cell, model, cycle):
    phases = cycle(0, (30.0, -15.0), (-60.0, -5.0))
    cell.reset((30.0, -15.0, 0.0))
    seen = []
    cell.run(0, phases, lambda: seen.append(cell.joints_rad()[0]))
    limits = [model.arm.description.joint(name).velocity for name in ("base_yaw", "shoulder", "elbow", "wrist_pitch", "wrist_roll")]
    assert np.all(np.abs(np.diff(seen, axis=0)) / 0.02 <= np.array(limits) * 1.01)
    t_s, joints = (np.concatenate([getattr(phase, name) for phase in phases]) for name in ("t_s", "joints_rad"))
    wanted = np.stack([np.interp(0.02 * np.arange(1, len(seen) + 1), t_s, column) for column in joints.T], axis=1)
    assert np.abs(seen - wanted).max() < math.radians(1.5)


def test_bad_settings_are_refused(model, motion, engine, monkeypatch):
    with pytest.raises(UnknownChoice, match="glue"):
        SimulatedCell(model, motion, engine=engine, grasp="glue")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(NoWindow, match="display"):
        SimulatedCell(model, motion, engine=engine, gui=True)
