"""The twin by itself: one clock for bytes, servos, physics and pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.arrays import wrap
from marl_handover.config import MotionConfig
from marl_handover.control.servo_calibration import card_place
from marl_handover.control.settings import twin_workcell
from marl_handover.control.twin import Twin
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.errors import DeviceError
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.safety_filter import JointCommand
from marl_handover.perception.detector import Detector
from tests.canonical_arms import PARKED_DEG

PARKED = np.radians(PARKED_DEG)


@pytest.fixture
def config(engine):
    config = twin_workcell()
    config.twin.engine = engine
    return config


@pytest.fixture
def twin(model, config):
    twin = Twin(model, MotionConfig(), config)
    yield twin
    twin.close()


@pytest.fixture
def driver(model, twin, tmp_path):
    driver = ArmDriver(twin.hardware, model, MotionConfig(), clock=twin.clock, latch=StopLatch(tmp_path / "stop"), confirm=twin.confirm)
    driver.connect()
    driver.configure()
    driver.arm()
    yield driver
    driver.close()


def test_the_picture_shows_the_block_where_it_truly_is(model, twin):
    detector = Detector(twin.painter.renderer.calibration, model.cell.config.block)
    for pose in ([40.0, -30.0, 1.0], [-120.0, 100.0, -2.5]):
        twin.set_object_pose(pose)
        twin.clock.sleep_s(0.3)
        seen, true = detector.detect(twin.camera.read().image).block.pose, twin.true_pose()
        assert math.dist(seen[:2], true[:2]) < 0.5
        assert abs(float(wrap(seen[2] - true[2]))) < math.radians(1.0)
        assert math.dist(true[:2], pose[:2]) < 0.5


def test_bytes_move_servos_and_servos_move_the_physics(twin, driver):
    target = PARKED + np.radians([10.0, 0, 0, 0, 0])
    driver.drive(1, target, driver.gripper_mm(1), 30.0)
    driver.wait(0.5)
    servos, bodies = twin.electronics.joints_rad(twin.clock.now_s()), twin.true_joints_rad()
    assert math.degrees(servos[1, 0] - PARKED[0]) == pytest.approx(10.0, abs=4.0), "servos are off their nominal zeros by a few degrees"
    np.testing.assert_allclose(bodies, servos, atol=math.radians(0.5))
    assert isinstance(twin.clock, VirtualClock)


def test_equal_twins_do_the_same(model, config, tmp_path):
    ends = []
    for number in range(2):
        twin = Twin(model, MotionConfig(), config)
        latch = StopLatch(tmp_path / f"stop{number}")
        with ArmDriver(twin.hardware, model, MotionConfig(), clock=twin.clock, latch=latch, confirm=twin.confirm) as driver:
            driver.arm()
            driver.drive(0, PARKED + 0.1, 12.0, 40.0)
            ends.append((twin.true_joints_rad(), twin.camera.read().image, twin.clock.now_s()))
        twin.close()
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    np.testing.assert_array_equal(ends[0][1], ends[1][1])
    assert ends[0][2] == ends[1][2]


def test_a_frozen_camera_repeats_its_picture_and_thaws(twin):
    first = twin.camera.read()
    twin.freeze(0.5)
    twin.clock.sleep_s(0.1)
    again = twin.camera.read()
    np.testing.assert_array_equal(first.image, again.image)
    assert again.number > first.number
    twin.clock.sleep_s(0.5)
    assert (twin.camera.read().image != first.image).any()


def test_the_operator_parks_the_arms_of_a_board_that_forgot_them(twin, driver):
    parked = twin.true_joints_rad()
    driver.drive(0, PARKED + np.radians([30.0, -30.0, 0, 0, 0]), 12.0, 60.0)
    driver.wait(0.2)
    twin.add_faults([make_fault("brownout", twin.clock.now_s(), 0.1)])
    twin.clock.sleep_s(0.5)
    with pytest.raises(DeviceError):
        driver.move([JointCommand(0, PARKED, 12.0)], 2.0)
    assert np.degrees(np.abs(twin.true_joints_rad()[0] - PARKED)).max() > 20.0
    if driver.state == "lost":
        driver.reconnect()
    driver.arm()
    assert np.degrees(np.abs(twin.true_joints_rad() - parked)).max() < 1.5, "but for dead bands, as before"


def test_cards_and_boards_are_seen_and_never_laid_exactly(twin):
    bare = twin.camera.read().image
    twin.glue_cards()
    assert (twin.camera.read().image != bare).mean() > 0.0
    off = [np.linalg.norm(T[:3, 3] - card_place(twin.model.arm, twin.config.hand_markers)) for _, T in twin._cards]
    assert all(0.0 < value < 2.0 for value in off)
    twin.take_cards_off()
    assert not twin._cards
