"""Servos identified from simulated sightings of a real cell's geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.control.servo_calibration import LEAST_SIGHTINGS, MarkerObservation, Unexplained, solve_calibration
from marl_handover.hardware.calibration import CalibrationProblem, nominal_calibration
from marl_handover.hardware.settings import ARMS, HardwareConfig

CAMERA, PLANE, MARKER = (0.0, 0.0, 700.0), 40.0, (-35.0, 0.0, 18.0)


@pytest.fixture
def truth():
    """Each servo's true zero and slope, off the nominal by a few degrees and percent."""
    random = np.random.default_rng(3)
    zeros = [servo.zero_us + random.normal(0, 20) for servo in HardwareConfig().nominal.values()]
    slopes = [math.degrees(servo.us_per_deg) * random.normal(1, 0.02) for servo in HardwareConfig().nominal.values()]
    return np.array(zeros), np.array(slopes)


def postures(model, count, random):
    """Above the table, in sight of the camera."""
    low, high = np.radians([[-60, 40, -168, -60, -60], [60, 120, -109, 90, 60]])
    q = random.uniform(low, high, (40 * count, 5))
    T = model.arm.fk(q)
    seen = (T[:, 2, 3] > 30) & (T[:, 2, 3] < 250) & (np.hypot(T[:, 0, 3], T[:, 1, 3]) > 120)
    return q[seen][:count]


def sightings(model, arm, truth, count, noise_mm, seed=0, placed=False, marker=MARKER):
    random, (zeros, slopes) = np.random.default_rng(seed), truth
    base, found = model.cell.bases[arm], []
    c, s = base.facing
    for q in postures(model, count, random):
        T = np.eye(4)
        T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], [base.x_mm, base.y_mm]
        T = T @ model.arm.fk(q)
        point = T @ [*((0.0, 0.0, 0.0) if placed else marker), 1.0]
        camera = np.array(CAMERA)
        at = point[:2] if placed else (camera + (PLANE - camera[2]) / (point[2] - camera[2]) * (point[:3] - camera))[:2]
        yaw = math.atan2(T[1, 0], T[0, 0]) + random.normal(0, math.radians(0.3) * noise_mm)
        view = {} if placed else {"camera_mm": CAMERA, "plane_mm": PLANE, "point_mm": marker}
        found.append(MarkerObservation(zeros + slopes * q, at + random.normal(0, noise_mm, 2), yaw, **view))
    return found


def worst_deg(model, calibration, truth, joints=slice(None)):
    """How far the joints are from where the calibration takes them to be, over the working range."""
    q = postures(model, 50, np.random.default_rng(9))
    return np.degrees(np.abs(calibration.to_rad(truth[0] + truth[1] * q) - q).max(axis=0))[joints]


@pytest.mark.parametrize("arm", [0, 1])
def test_without_noise_the_servos_are_found(model, truth, arm):
    before = nominal_calibration(HardwareConfig(), ARMS[arm], model.arm)
    found = solve_calibration(model, before, sightings(model, arm, truth, 60, 0.0), zero_sd_deg=50.0, scale_sd=0.5)
    assert found.calibration.arm == ARMS[arm]
    assert found.residual_mm < 0.05
    assert worst_deg(model, before, truth).max() > 2.0
    assert worst_deg(model, found.calibration, truth).max() < 0.1


def test_with_dead_bands_it_is_far_nearer_than_before(model, truth):
    before = nominal_calibration(HardwareConfig(), "left", model.arm)
    found = solve_calibration(model, before, sightings(model, 0, truth, 60, 1.0))
    assert 0.8 < found.residual_mm < 1.8
    worst = worst_deg(model, found.calibration, truth)
    assert worst[:4].max() < 0.8
    assert worst[4] < 2.0, "a marker this near the axis says little about the roll"
    assert (found.joint_sd_deg < 1.5).all()


def test_an_outlier_spoils_little(model, truth):
    before = nominal_calibration(HardwareConfig(), "left", model.arm)
    seen = sightings(model, 0, truth, 60, 0.3)
    seen[7] = seen[7]._replace(seen_mm=seen[7].seen_mm + 40.0)
    seen[8] = seen[8]._replace(seen_mm=np.array([np.nan, 0.0]))
    assert worst_deg(model, solve_calibration(model, before, seen).calibration, truth).max() < 0.8


def test_what_no_servos_explain_is_refused(model, truth):
    """A camera that was knocked half way, pictures that belong to other postures, sightings of the other arm."""
    before = nominal_calibration(HardwareConfig(), "left", model.arm)
    seen = sightings(model, 0, truth, 60, 0.3)
    knocked = [*seen[:30], *(sighting._replace(seen_mm=sighting.seen_mm + np.array([60.0, -40.0])) for sighting in seen[30:])]
    mixed = [sighting._replace(seen_mm=other.seen_mm) for sighting, other in zip(seen, seen[::-1], strict=True)]
    for wrong in (knocked, mixed, sightings(model, 1, truth, 60, 0.3)):
        with pytest.raises(Unexplained, match="loose") as caught:
            solve_calibration(model, before, wrong)
        assert caught.value.off_mm > 5.0


def test_blocks_put_down_tell_the_base_yaw_and_the_reach(model, truth):
    before = nominal_calibration(HardwareConfig(), "right", model.arm)
    seen = sightings(model, 1, truth, 40, 0.3, placed=True)
    found = solve_calibration(model, before, seen)
    assert worst_deg(model, found.calibration, truth, slice(0, 1))[0] < 0.3
    assert found.residual_mm < 0.6


def test_joints_about_which_nothing_was_seen_stay_as_they_were(model, truth):
    before = nominal_calibration(HardwareConfig(), "right", model.arm)
    blind = [sighting._replace(yaw_rad=math.nan) for sighting in sightings(model, 1, truth, 40, 0.3, placed=True)]
    found = solve_calibration(model, before, blind)
    q = np.array([0.1, 1.5, -2.3, 0.3, 0.4])
    assert found.calibration.to_us(q)[4] == pytest.approx(before.to_us(q)[4], abs=0.5)
    with pytest.raises(CalibrationProblem, match="usable sightings"):
        solve_calibration(model, before, blind[: LEAST_SIGHTINGS - 1])


HALVES = np.array([2.0, 5.5, 3.0, 4.5, 4.0])


def approached(model, arm, truth, count, noise_mm, **options):
    """Sightings at postures that each servo came to from one side or the other, and rests half its band short of."""
    random, found = np.random.default_rng(5), []
    for sighting in sightings(model, arm, truth, count, noise_mm, **options):
        came = random.choice([-1.0, 1.0], 5)
        found.append(sighting._replace(pulses_us=sighting.pulses_us + came * HALVES, came=tuple(came)))
    return found


@pytest.mark.parametrize("arm", [0, 1])
def test_every_servos_own_dead_band_is_found_from_both_sides(model, truth, arm):
    before = nominal_calibration(HardwareConfig(), ARMS[arm], model.arm)
    found = solve_calibration(model, before, approached(model, arm, truth, 80, 0.2), position_sd_mm=0.2)
    np.testing.assert_allclose(found.half_band_us[:3], HALVES[:3], atol=1.0)
    assert (np.abs(found.half_band_us - HALVES) < 4 * found.half_band_sd_us).all()
    one_sided = [sighting._replace(came=(0.0,) * 5) for sighting in approached(model, arm, truth, 80, 0.2)]
    assert found.residual_mm < 0.7 * solve_calibration(model, before, one_sided, position_sd_mm=0.2).residual_mm


def test_a_band_that_nobody_can_tell_is_the_arms_usual_one_and_said_to_be_unsure(model, truth):
    """The yaws are not seen and the wrist's roll moves a point on its axis by nothing."""
    before = nominal_calibration(HardwareConfig(), "left", model.arm)
    seen = approached(model, 0, truth, 80, 0.2, marker=(-35.0, 0.0, 0.0))
    blind = [sighting._replace(yaw_rad=math.nan) for sighting in seen]
    found = solve_calibration(model, before, blind, position_sd_mm=0.2)
    assert found.half_band_sd_us[4] > 1.3 > 2 * found.half_band_sd_us[:3].max()
    assert found.half_band_us[4] == pytest.approx(found.half_band_us[:4].mean(), abs=1.0)
