"""Laws of a timed cycle."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from marl_handover.cell.build import build_cell, cell_config
from marl_handover.config import MotionConfig
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.motion.pick_place import LIFTED_MM, timed_phases
from marl_handover.motion.trajectory import PHASES, Phase, PickPlacePaths, basis
from tests.canonical_arms import PARKED_DEG

Floats = NDArray[np.float64]

PICK_MM = 45.0
ARM = build_cell(cell_config("paper")).arm
MOTION = MotionConfig()
VELOCITY = MOTION.velocity_scale * np.array([ARM.description.joint(name).velocity for name in ARM_JOINTS])
ACCELERATION = math.radians(MOTION.acceleration_deg_s2)


def fit_control_points(samples):
    """Control points near joint samples at even tau, the ends exact."""
    B = basis(np.linspace(0, 1, len(samples)), MOTION.control_points, MOTION.degree)
    ends = np.outer(B[:, 0], samples[0]) + np.outer(B[:, -1], samples[-1])
    return np.concatenate([samples[:1], np.linalg.lstsq(B[:, 1:-1], samples - ends)[0], samples[-1:]])


def cycle_paths(yaws_rad: tuple[float, float], radii_mm: tuple[float, float], lift_mm: float = 40.0) -> PickPlacePaths:
    """A cycle of an arm alone: over the table in an arc, straight in joints to and from the parked pose."""
    part = np.linspace(0.0, 1.0, 60)
    yaw, radius = (low + (high - low) * part for low, high in (yaws_rad, radii_mm))
    height = PICK_MM + lift_mm * np.sin(math.pi * part)
    grip = np.stack([radius * np.cos(yaw), radius * np.sin(yaw), height], axis=1)
    transfer = fit_control_points(ARM.ik(grip)[:, 0])
    parked = np.radians(PARKED_DEG)
    way = np.linspace(0.0, 1.0, MOTION.control_points)[:, None]
    return PickPlacePaths(parked + way * (transfer[0] - parked), transfer, transfer[-1] + way * (parked - transfer[-1]))


def joined(phases: tuple[Phase, ...]) -> tuple[Floats, Floats, Floats]:
    """Times, joints and fingers of the whole cycle, samples that two phases share once."""
    parts = [(p.t_s, p.joints_rad, p.gripper_mm) for p in phases]
    t, q, fingers = (np.concatenate([parts[0][k], *(part[k][1:] for part in parts[1:])]) for k in range(3))
    return t, q, fingers


reaches = st.tuples(st.floats(160.0, 200.0), st.floats(160.0, 200.0))
yaws = st.tuples(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9))


@settings(max_examples=50, deadline=None)
@given(yaws_rad=yaws, radii_mm=reaches, lift_mm=st.floats(12.0, 60.0))
def test_laws_of_a_cycle(yaws_rad: tuple[float, float], radii_mm: tuple[float, float], lift_mm: float) -> None:
    paths = cycle_paths(yaws_rad, radii_mm, lift_mm)
    phases = timed_phases(paths, ARM, MOTION, PICK_MM)
    names = [phase.name for phase in phases]
    assert names == [name for name in PHASES if name in names]
    assert set(PHASES) - set(names) <= {"lift", "lower"}
    assert phases[0].t_s[0] == 0.0
    for before, after in itertools.pairwise(phases):
        assert before.t_s[-1] == after.t_s[0]
        assert before.gripper_mm[-1] == after.gripper_mm[0]
        np.testing.assert_allclose(before.joints_rad[-1], after.joints_rad[0], atol=1e-12)
    t, q, fingers = joined(phases)
    assert 0.0 < np.diff(t).min() <= np.diff(t).max() <= MOTION.sample_s * (1 + 1e-9)
    assert (np.abs(np.diff(q, axis=0) / np.diff(t)[:, None]) <= 1.001 * VELOCITY).all()
    assert fingers.min() == 0.0
    assert fingers.max() == MOTION.finger_travel_mm
    for phase in phases:
        assert len(phase.t_s) == len(phase.joints_rad) == len(phase.gripper_mm) >= 2


@settings(max_examples=20, deadline=None)
@given(yaws_rad=yaws, radii_mm=reaches)
def test_accelerations_are_within_their_limit_across_the_phases(yaws_rad: tuple[float, float], radii_mm: tuple[float, float]) -> None:
    """At a fine sampling: from rest to rest where the hand opens and closes, and without a jerk where only the name changes."""
    phases = timed_phases(cycle_paths(yaws_rad, radii_mm), ARM, replace(MOTION, sample_s=1e-3), PICK_MM)
    t, q, _ = joined(phases)
    speeds = np.diff(q, axis=0) / np.diff(t)[:, None]
    between = 0.5 * (np.diff(t)[1:] + np.diff(t)[:-1])
    assert np.abs(np.diff(speeds, axis=0) / between[:, None]).max() <= 1.02 * ACCELERATION


def test_ends_of_the_phases() -> None:
    phases = {phase.name: phase for phase in timed_phases(cycle_paths((-0.7, 0.6), (170.0, 190.0)), ARM, MOTION, PICK_MM)}
    assert tuple(phases) == PHASES
    parked = np.radians(PARKED_DEG)
    np.testing.assert_array_equal(phases["approach"].joints_rad[0], parked)
    np.testing.assert_allclose(phases["retreat"].joints_rad[-1], parked, atol=1e-12)
    for name, yaw, radius in (("grasp", -0.7, 170.0), ("release", 0.6, 190.0)):
        still = phases[name].joints_rad
        np.testing.assert_array_equal(still, np.tile(still[0], (len(still), 1)))
        T_base_grip = ARM.fk(still[0])
        np.testing.assert_allclose(T_base_grip[:3, 3], [radius * math.cos(yaw), radius * math.sin(yaw), PICK_MM], atol=1e-6)
        np.testing.assert_allclose(T_base_grip[2, :3], [0.0, 0.0, 1.0], atol=1e-9)  # pitch = roll = 0
    assert phases["grasp"].t_s[-1] - phases["grasp"].t_s[0] == pytest.approx(MOTION.grasp_s)
    assert phases["release"].t_s[-1] - phases["release"].t_s[0] == pytest.approx(MOTION.release_s)
    assert (np.diff(phases["grasp"].gripper_mm) < 0).all()
    assert (np.diff(phases["release"].gripper_mm) > 0).all()
    for name in ("approach", "retreat"):
        assert (phases[name].gripper_mm == MOTION.finger_travel_mm).all()
    for name in ("lift", "transfer", "lower"):
        assert (phases[name].gripper_mm == 0.0).all()


def test_lift_and_lower_are_the_low_ends_of_one_motion() -> None:
    phases = {phase.name: phase for phase in timed_phases(cycle_paths((-0.8, 0.5), (165.0, 180.0)), ARM, MOTION, PICK_MM)}
    heights = {name: ARM.fk(phases[name].joints_rad)[:, 2, 3] - PICK_MM for name in ("lift", "transfer", "lower")}
    assert (heights["lift"][:-1] < LIFTED_MM).all()
    assert heights["lift"][-1] >= LIFTED_MM
    assert (heights["transfer"] >= LIFTED_MM).all()
    assert (heights["lower"][1:] < LIFTED_MM).all()
    for before, after in (("lift", "transfer"), ("transfer", "lower")):
        steps = [phases[before].joints_rad[-1] - phases[before].joints_rad[-2], phases[after].joints_rad[1] - phases[after].joints_rad[0]]
        assert np.abs(steps[0]).max() > 1e-3  # it does not stop there
        np.testing.assert_allclose(steps[0], steps[1], atol=ACCELERATION * MOTION.sample_s**2 * 1.01)


def test_a_transfer_that_stays_low_is_all_transfer() -> None:
    phases = timed_phases(cycle_paths((-0.2, 0.2), (170.0, 170.0), lift_mm=6.0), ARM, MOTION, PICK_MM)
    assert [phase.name for phase in phases] == ["approach", "grasp", "transfer", "release", "retreat"]


def test_slower_limits_make_a_longer_cycle() -> None:
    paths = cycle_paths((-0.7, 0.7), (170.0, 170.0))
    ends = [
        timed_phases(paths, ARM, replace(MOTION, **change), PICK_MM)[-1].t_s[-1]
        for change in ({}, {"acceleration_deg_s2": 400.0}, {"velocity_scale": 0.2})
    ]
    assert ends[0] < min(ends[1:])


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"velocity_scale": 0.0}, "velocity_scale"),
        ({"velocity_scale": 1.2}, "velocity_scale"),
        ({"acceleration_deg_s2": math.nan}, "acceleration_deg_s2"),
        ({"sample_s": 0.0}, "sample_s"),
        ({"grasp_s": -1.0}, "fingers"),
    ],
)
def test_bad_settings_are_named(change: dict[str, float], name: str) -> None:
    with pytest.raises(InvalidSetting, match=name):
        timed_phases(cycle_paths((-0.7, 0.7), (170.0, 170.0)), ARM, replace(MOTION, **change), PICK_MM)


def test_paths_that_do_not_meet_are_refused() -> None:
    paths = cycle_paths((-0.7, 0.7), (170.0, 170.0))
    with pytest.raises(InvalidSetting, match="retreat"):
        timed_phases(paths._replace(retreat=paths.retreat + 0.01), ARM, MOTION, PICK_MM)
