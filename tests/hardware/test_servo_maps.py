"""Servo maps, their file, and the procedure that measures them on emulated servos."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from marl_handover.errors import CannotWrite, CorruptFile, MissingFile, UnknownChoice
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import (
    CalibrationProblem,
    ServoMap,
    calibrations,
    load_calibration,
    make_calibration,
    nominal_calibration,
)
from marl_handover.hardware.settings import HardwareConfig


def points(zero_us=1500.0, us_per_deg=9.5, degrees=(-60.0, 0.0, 60.0)):
    return [(zero_us + us_per_deg * angle, math.radians(angle)) for angle in degrees]


def test_the_nominal_map_by_hand():
    servo = ServoMap("elbow", points(732.0, -9.2))
    assert servo.to_us(math.radians(-83.5)) == pytest.approx(1500.2)
    assert math.degrees(servo.to_rad(1500.2)) == pytest.approx(-83.5)
    assert servo.least_us_per_rad() == pytest.approx(9.2 * 180 / math.pi)


@given(
    st.sampled_from(["line", "pieces"]),
    st.sampled_from([1, -1]),
    st.lists(st.floats(8.0, 12.0), min_size=1, max_size=5),
    st.floats(-2.0, 2.0),
)
def test_there_and_back_is_where_one_was(fit, sense, scales, angle):
    pulse, degrees, measured = 700.0, -60.0, [(700.0, math.radians(-60.0))]
    for scale in scales:
        pulse, degrees = pulse + 200.0, degrees + sense * 200.0 / scale
        measured.append((pulse, math.radians(degrees)))
    try:
        servo = ServoMap("joint", measured, fit)
    except CalibrationProblem:
        assume(False)  # bent too much for a line
    assert servo.to_rad(servo.to_us(angle)) == pytest.approx(angle, abs=1e-9)
    rising = servo.to_us(np.linspace(-2, 2, 50))
    assert (np.diff(rising) * sense > 0).all()
    if fit == "pieces":
        assert servo.residual_rad == pytest.approx(0.0, abs=1e-12)


def test_least_squares_agree_with_polyfit():
    random = np.random.default_rng(0)
    measured = [(pulse, (pulse - 1480) / 540 + random.normal(0, 0.01)) for pulse in np.linspace(700, 2300, 9)]
    slope, offset = np.polyfit(*np.array(measured).T, 1)
    np.testing.assert_allclose(
        ServoMap("joint", measured).to_rad([600.0, 1500.0, 2400.0]), slope * np.array([600.0, 1500.0, 2400.0]) + offset
    )


@pytest.mark.parametrize(
    ("measured", "why"),
    [
        ([], "two points"),
        ([(1500.0, 0.0)], "two points"),
        ([(1500.0, 0.0), (1500.0, 0.1)], "two points"),
        ([(1500.0, 0.0), (1600.0, math.nan)], "not finite"),
        ([(1000.0, 0.0), (2000.0, 0.5)], "us a degree"),
        ([(1000.0, 0.0), (1100.0, 0.9)], "us a degree"),
        ([(1000.0, -0.8), (1500.0, 0.3), (2000.0, 0.8)], "degrees off"),
    ],
)
def test_points_that_cannot_be_one_servos_are_refused(measured, why):
    with pytest.raises(CalibrationProblem, match=why):
        ServoMap("shoulder", measured)


def test_pieces_have_to_go_one_way():
    with pytest.raises(CalibrationProblem, match="one way"):
        ServoMap("shoulder", [(1000.0, 0.0), (1400.0, 0.6), (1800.0, 0.5)], "pieces")
    with pytest.raises(UnknownChoice):
        ServoMap("shoulder", points(), "cubic")


def measured_arm(model, arm="left"):
    return make_calibration(arm, model.arm, {joint: points(1500 + 10 * index) for index, joint in enumerate(ARM_JOINTS)})


def test_a_file_holds_what_was_measured_and_a_backup_what_was_before(model, tmp_path):
    path = tmp_path / "arms" / "left.json"
    first = measured_arm(model)
    assert first.save(path) is None
    read = load_calibration(path, "left", model.arm)
    assert read.measured_unix_s == first.measured_unix_s > 0
    q = np.array([0.1, 2.0, -2.0, 0.5, -0.3])
    np.testing.assert_array_equal(read.to_us(q), first.to_us(q))
    np.testing.assert_allclose(read.to_rad(read.to_us(q)), q)
    before = path.read_bytes()
    backups = [measured_arm(model).save(path) for _ in range(3)]
    assert len(set(backups)) == 3
    assert backups[0].read_bytes() == before
    assert not list(path.parent.glob("*.tmp"))


def test_the_file_has_to_fit_the_arm(model, tmp_path):
    path = tmp_path / "left.json"
    measured_arm(model).save(path)
    with pytest.raises(CalibrationProblem, match="arm 'left'.*wanted 'right'"):
        load_calibration(path, "right", model.arm)
    content = json.loads(path.read_text())
    for change, error, why in [
        ({"version": 2}, CorruptFile, "version 2"),
        ({"robot": "al5d"}, CalibrationProblem, "al5d"),
        ({"joints": {}}, CalibrationProblem, "wanted"),
        ({"limits_rad": {**content["limits_rad"], "elbow": [-1.0, 1.0]}}, CalibrationProblem, "elbow.*calibrate again"),
        ({"joints": {**content["joints"], "elbow": {"fit": "line", "points": [{"pulse_us": 1}]}}}, CorruptFile, "angle_rad"),
    ]:
        path.write_text(json.dumps({**content, **change}))
        with pytest.raises(error, match=why):
            load_calibration(path, "left", model.arm)
    path.write_text("{")
    with pytest.raises(CorruptFile):
        load_calibration(path, "left", model.arm)
    with pytest.raises(MissingFile, match="calibrate"):
        load_calibration(tmp_path / "none.json", "left", model.arm)
    with pytest.raises(CannotWrite, match="left.json cannot be written"):
        measured_arm(model).save(path / "below")


def test_settings_name_the_files(model, tmp_path):
    config = HardwareConfig()
    assert [calibration.measured_unix_s for calibration in calibrations(config, model.arm)] == [0.0, 0.0]
    config.arms["right"].calibration = str(tmp_path / "right.json")
    measured_arm(model, "right").save(tmp_path / "right.json")
    left, right = calibrations(config, model.arm)
    assert (left.measured_unix_s, right.measured_unix_s > 0) == (0.0, True)


def test_the_paper_cells_joint_range_has_pulses(model):
    calibration = nominal_calibration(HardwareConfig(), "left", model.arm)
    ends = calibration.to_us(np.stack([model.arm.lower_rad, model.arm.upper_rad]))
    assert ends.min() >= 500
    assert ends.max() <= 2500
