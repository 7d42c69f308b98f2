"""Backlash is taken out exactly, and its file says what is wrong with it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from marl_handover.control.trajectory_player import Backlash
from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile
from marl_handover.hardware.calibration import BACKLASH_FILE, backlash_text, half_bands_rad, load_backlash, nominal_calibration
from marl_handover.hardware.settings import ARMS, HardwareConfig
from marl_handover.motion.trajectory import Phase

HALF = np.radians([[0.4, 0.5, 0.3, 0.4, 0.6], [0.2, 0.2, 0.2, 0.2, 0.2]])
WIDE = np.full(5, 10.0)


def followed(aims, start, half):
    """Where servos with backlash stand along ``aims`` (n, 5): they move only when pushed by an edge of their band."""
    here, way = start.copy(), []
    for aim in aims:
        here = np.clip(here, aim - half, aim + half)
        way.append(here.copy())
    return np.array(way)


def phases_of(joints):
    t_s = 0.02 * np.arange(len(joints))
    middle = len(joints) // 2
    return [
        Phase("approach", t_s[: middle + 1], joints[: middle + 1], np.zeros(middle + 1)),
        Phase("grasp", t_s[middle:], joints[middle:], np.zeros(len(joints) - middle)),
    ]


@given(st.integers(0, 10**6), st.integers(6, 60), st.sampled_from([0, 1]))
@example(2031, 34, 0)
def test_servos_with_backlash_go_where_they_are_wanted(seed, count, arm):
    random = np.random.default_rng(seed)
    steps = random.normal(0, 0.02, (count, 5)) * random.choice([0.0, 1.0], (count, 1), p=[0.2, 0.8])
    steps[abs(steps) < 2e-6] = 0.0  # less than a microradian is no motion
    steps[0] = random.choice([-1.0, 1.0], 5) * 3 * HALF[arm]
    joints = np.cumsum(np.vstack([np.zeros(5), steps]), axis=0)
    backlash = Backlash(HALF, -WIDE, WIDE)
    compensated = backlash.compensated(arm, phases_of(joints))
    aims = np.concatenate([compensated[0].joints_rad, compensated[1].joints_rad[1:]])
    unknown = random.uniform(-1, 1, 5) * HALF[arm]
    reached = followed(aims, joints[0] + unknown, HALF[arm])
    np.testing.assert_allclose(reached[1:], joints[1:], atol=1e-12)


def test_the_next_motion_begins_on_the_side_where_the_last_one_ended():
    backlash = Backlash(HALF, -WIDE, WIDE)
    up = np.linspace(0, 1, 11)[:, None] * np.ones(5)
    compensated = backlash.compensated(0, phases_of(up))
    backlash.note_reached(0, up[-1], compensated[-1].joints_rad[-1])
    np.testing.assert_allclose(backlash.compensation_rad[0], HALF[0])
    again = backlash.compensated(0, phases_of(up[::-1]))
    np.testing.assert_allclose(again[0].joints_rad[0] - up[-1], HALF[0])
    np.testing.assert_allclose(again[0].joints_rad[1] - up[-2], -HALF[0])
    backlash.reset()
    assert not backlash.compensation_rad.any()


def test_aims_keep_to_the_limits():
    backlash = Backlash(HALF, np.zeros(5), np.ones(5))
    compensated = backlash.compensated(0, phases_of(np.linspace(0, 1, 11)[:, None] * np.ones(5)))
    assert compensated[1].joints_rad.max() == 1.0


def test_half_a_band_is_an_angle_of_each_servo(planner):
    arm = planner.model.arm
    maps = [nominal_calibration(HardwareConfig(), name, arm) for name in ARMS]
    found = np.degrees(half_bands_rad({"left": [4.0, 3.0, 2.0, 1.0, 5.0], "right": np.full(5, 2.0)}, maps))
    np.testing.assert_allclose(found, [[4 / 9.5, 3 / 9.2, 2 / 9.2, 1 / 9.5, 0.5], [2 / 9.5, 2 / 9.2, 2 / 9.2, 2 / 9.5, 0.2]])


def test_file_round_trip_and_what_may_be_wrong_with_it(tmp_path):
    with pytest.raises(MissingFile, match="calibrate"):
        load_backlash(tmp_path)
    half, sure = {"left": [3.9, 1.0, 2.0, 6.5, 4.0], "right": np.arange(5.0)}, {"left": np.ones(5), "right": np.full(5, 0.3)}
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / BACKLASH_FILE).write_text(backlash_text(half, sure))
    found = load_backlash(tmp_path / "new")
    for arm, bands in half.items():
        np.testing.assert_allclose(found[arm], bands)
    assert json.loads((tmp_path / "new" / BACKLASH_FILE).read_text())["half_band_sd_us"]["right"]["elbow"] == 0.3
    path = tmp_path / BACKLASH_FILE
    path.write_text("{")
    with pytest.raises(CorruptFile):
        load_backlash(tmp_path)
    path.write_text(json.dumps({"version": 1, "half_band_us": {"left": 3.9, "right": 4.2}}))
    with pytest.raises(CorruptFile, match="version 1.*each joint.*calibrate what=servos"):
        load_backlash(tmp_path)
    content = json.loads((tmp_path / "new" / BACKLASH_FILE).read_text())
    content["half_band_us"]["right"]["elbow"] = 99
    path.write_text(json.dumps(content))
    with pytest.raises(InvalidSetting, match="right.elbow"):
        load_backlash(tmp_path)
    del content["half_band_us"]["right"]["elbow"]
    path.write_text(json.dumps(content))
    with pytest.raises(CorruptFile, match="elbow"):
        load_backlash(tmp_path)
