"""The files of a servo calibration belong together, and that is looked at."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from marl_handover.control.settings import twin_workcell
from marl_handover.errors import CorruptFile, MissingFile, UnsupportedKinematics
from marl_handover.geometry.robot import read_robot, robot_config
from marl_handover.hardware.calibration import (
    SERVO_FILES,
    SET_FILE,
    CalibrationProblem,
    calibrations,
    load_backlash,
    load_calibration,
    nominal_calibration,
    require_one_set,
    save_servos,
)
from marl_handover.hardware.settings import ARMS, HardwareConfig


@pytest.fixture
def save(model, tmp_path):
    """``save(time, band)``: a calibration of both arms into one folder, which is returned."""

    def write(measured_s, band_us):
        nominal = {arm: nominal_calibration(twin_workcell().hardware, arm, model.arm) for arm in ARMS}
        arms = {arm: replace(calibration, measured_unix_s=measured_s) for arm, calibration in nominal.items()}
        bands = {arm: np.full(5, band_us) for arm in ARMS}
        save_servos(tmp_path / "cell", arms, bands, bands)
        return tmp_path / "cell"

    return write


def test_what_was_saved_together_is_one_set(save, model):
    folder = save(1.0, 4.0)
    require_one_set(folder)
    assert {path.name for path in folder.iterdir()} == {*SERVO_FILES, SET_FILE}
    assert load_calibration(folder / "left.json", "left", model.arm).measured_unix_s == 1.0
    np.testing.assert_array_equal(load_backlash(folder)["right"], np.full(5, 4.0))


def test_the_one_before_stays_beside_every_file_and_can_be_put_back(save):
    folder = save(1.0, 4.0)
    before = {name: (folder / name).read_bytes() for name in (*SERVO_FILES, SET_FILE)}
    save(2.0, 5.0)
    for name, content in before.items():
        kept = [path for path in folder.glob(f"{name}.*.bak")]
        assert [path.read_bytes() for path in kept] == [content]
        kept[0].replace(folder / name)
    require_one_set(folder)


@pytest.mark.parametrize("name", SERVO_FILES)
def test_files_of_two_calibrations_are_no_set(save, name):
    """As a run leaves them that breaks off between two files, or a hand that puts back one of them."""
    folder = save(1.0, 4.0)
    old = (folder / name).read_bytes()
    save(2.0, 5.0)
    (folder / name).write_bytes(old)
    with pytest.raises(CalibrationProblem, match=f"{name} changed .* calibrate what=servos"):
        require_one_set(folder)
    require_one_set(folder, [other for other in SERVO_FILES if other != name])


def test_a_missing_or_damaged_file_is_named(save):
    folder = save(1.0, 4.0)
    whole = (folder / SET_FILE).read_text()
    for damaged in ("", "[]", "{}", json.dumps({"version": 99}), json.dumps({"version": 1, "sha256": 3})):
        (folder / SET_FILE).write_text(damaged)
        with pytest.raises(CorruptFile, match=SET_FILE):
            require_one_set(folder)
    (folder / SET_FILE).write_text(whole)
    for name in (*SERVO_FILES, SET_FILE):
        (folder / name).rename(folder / "away")
        with pytest.raises(MissingFile, match=name):
            require_one_set(folder)
        (folder / "away").rename(folder / name)
    require_one_set(folder)


@pytest.mark.parametrize(("robot", "lacks"), [("px100", "the joint wrist_roll"), ("so101", "a hand with two fingers that slide")])
def test_a_robot_that_the_servos_are_not_wired_for_is_refused(robot, lacks):
    with pytest.raises(UnsupportedKinematics, match=f"{robot}.urdf: .* this robot lacks {lacks}; .*use backend=bullet"):
        calibrations(HardwareConfig(), read_robot(robot_config(robot)))
