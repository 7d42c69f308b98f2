"""The twin of two SO-101: bus servos with gravity and play, seen by a camera, calibrated and handing over."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.cli import main
from marl_handover.compose import from_yaml
from marl_handover.config import MotionConfig
from marl_handover.control.hardware_backend import TwinBackend
from marl_handover.control.servo_calibration import ServoCalibration, T_grip_hand, card_place
from marl_handover.control.settings import CardConfig, WorkcellConfig
from marl_handover.control.twin import Twin
from marl_handover.control.workcell import CAMERA_FILE
from marl_handover.files import resource_path
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import load_calibration, make_calibration, save_servos
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.estop import PrivateStop
from marl_handover.hardware.lerobot_file import read_motors
from marl_handover.hardware.settings import COUNTS_PER_RAD, HardwareConfig
from marl_handover.motion.planner import MotionPlanner

ARMS = ("left", "right")
CELL = ["cell=so101", "hardware=so101_twin", "progress=false"]


@pytest.fixture(scope="module")
def model():
    return build_cell(cell_config("so101"))


@pytest.fixture(scope="module")
def config() -> WorkcellConfig:
    return WorkcellConfig(from_yaml(HardwareConfig, resource_path("configs/hardware/so101_twin.yaml")))


@pytest.fixture(scope="module")
def truths(model, config):
    """Arm -> joint -> points (count, angle) of the servos as they truly are."""
    twin = Twin(model, MotionConfig(), config)
    try:
        found = {}
        for name, zeros in twin.electronics.zeros.items():
            sources = zip(ARM_JOINTS, model.arm.description.sources, zeros, strict=False)
            found[name] = {
                joint: [(zero + COUNTS_PER_RAD * (s.sign * q + s.offset_rad), q) for q in (-1.0, 1.0)] for joint, s, zero in sources
            }
        return found, twin.painter.renderer.calibration
    finally:
        twin.close()


@pytest.fixture
def known(truths, model, tmp_path):
    """A folder of calibrations by somebody who knows the truth."""
    points, camera = truths
    camera.save(tmp_path / CAMERA_FILE)
    none = {name: np.zeros(5) for name in ARMS}
    save_servos(tmp_path, {name: make_calibration(name, model.arm, points[name]) for name in ARMS}, none, none)
    return tmp_path


def test_two_so101_hand_a_block_over(model, config, known):
    """To a few millimetres, as sagging servos and a camera allow; each by a motion through filter, bytes and encoders."""
    backend = TwinBackend(model, MotionConfig(), calibration=str(known), hardware=config.hardware)
    try:
        planner, twin = MotionPlanner(model, MotionConfig()), backend.workcell.twin
        pose = backend.reset(np.array([0.0, 20.0, 0.3]), 0)
        for arm, place in ((0, [20.0, -10.0]), (1, [-15.0, 25.0])):
            joints = backend.joints_rad()
            motion = planner.plan_paths(arm, pose[:2], np.array(place), joints[arm], np.delete(joints, arm, axis=0))
            done = backend.execute(arm, motion.paths)
            assert done.refusal is None
            pose = done.pose
            assert math.dist(twin.true_pose()[:2], place) < 4.0
        assert not twin.follower.collisions
        assert np.abs(twin.true_joints_rad() - backend.joints_rad()).max() < math.radians(1.0)
    finally:
        backend.close()


def test_a_card_lies_flat_on_the_hand_however_steep_that_is(model):
    """Its plane is along the roll axis; on the level hand of an AL5A it is where its palm is."""
    paper = build_cell(cell_config("paper"))
    assert card_place(paper.arm, CardConfig()) == pytest.approx([-47.0, 0.0, 13.2])
    assert T_grip_hand(paper.arm) == pytest.approx(np.eye(4))
    tilted = T_grip_hand(model.arm)
    assert math.degrees(math.atan2(-tilted[2, 0], tilted[0, 0])) == pytest.approx(60.0)
    assert card_place(model.arm, CardConfig(place_mm=[-60.0, 1.0, 30.0])) == pytest.approx([-60.0, 1.0, 30.0])
    x, y, z = card_place(model.arm, CardConfig())
    assert -110.0 < x < -40.0
    assert (y, 15.0 < z < 40.0) == (0.0, True)


def test_how_far_a_hand_comes_back_beside_itself_is_told_within_a_fifth(model, config, known, truths):
    """As the camera sees it, against where the hand truly was at every visit."""
    twin = Twin(model, MotionConfig(), config)
    driver = ArmDriver(twin.hardware, model, MotionConfig(), clock=twin.clock, latch=PrivateStop(), confirm=twin.confirm)
    try:
        twin.glue_cards()
        with driver:
            driver.arm()
            procedure = ServoCalibration(driver, twin.camera, truths[1], config.target, config.hand_markers, 3)
            true, base = [], model.cell.bases[0].matrix()
            looked = procedure._marker

            def look(arm, posture):
                found = looked(arm, posture)
                T = base @ model.arm.fk(twin.true_joints_rad()[0]) @ twin._cards[0][1]
                true.append([*T[:2, 3], math.atan2(T[1, 0], T[0, 0])])
                return found

            procedure._marker = look
            told = procedure.repeatability(0)
        at = np.array(true[1::2])  # every other look is at the posture itself, the others are on the way
        spread_mm = math.sqrt((at[:, :2].var(axis=0)).sum())
        assert told.visits == len(at)
        assert told.position_mm == pytest.approx(spread_mm, rel=0.2)
        assert told.yaw_deg == pytest.approx(math.degrees(at[:, 2].std()), rel=0.25, abs=0.05)
    finally:
        twin.close()


@pytest.mark.slow
def test_calibrate_finds_zeros_hands_and_what_lerobot_wants(tmp_path, model, truths, capsys):
    more = [f"calibration={tmp_path}", f"hardware.stop_file={tmp_path / 'stop'}"]
    assert main(["calibrate", *CELL[:2], *more]) == 0
    told = capsys.readouterr().out
    assert told.count("comes back to a posture within") == 2
    for name in ARMS:
        found = load_calibration(tmp_path / f"{name}.json", name, model.arm)
        true = make_calibration(name, model.arm, truths[0][name])
        off_deg = np.degrees(np.abs(found.to_rad(np.full(5, 2048.0)) - true.to_rad(np.full(5, 2048.0))))
        assert off_deg[:4].max() < 0.4
        assert off_deg[4] < 0.8
        motors = read_motors(tmp_path / "lerobot" / f"{name}.json")
        assert tuple(motor.homing_offset for motor in motors) == found.homing_offsets
    assert (
        main(["evaluate", "policy=pretrained_twin", "backend=twin", *CELL, f"calibration={tmp_path}", "episodes=3", "epsilon_deg=5"]) == 0
    )
    assert "100.00%" in capsys.readouterr().out
