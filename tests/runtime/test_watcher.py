"""Looking at rendered pictures until the block lies still, on a virtual clock."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.hardware.clock import VirtualClock
from marl_handover.perception.calibration import flat_pose, hung_camera
from marl_handover.perception.camera import Frame, RenderedCamera
from marl_handover.perception.detector import Detector
from marl_handover.perception.scene import CellPainter
from marl_handover.perception.settings import LookConfig, MountConfig
from marl_handover.perception.tracker import Tracker
from marl_handover.runtime.events import Event, EventLog
from marl_handover.runtime.settings import WatchConfig
from marl_handover.runtime.watcher import Watcher

POSE = np.array([30.0, -20.0, 3.1])


@pytest.fixture(scope="module")
def painter(model):
    return CellPainter(model, hung_camera(MountConfig(), (1280, 720)), look=LookConfig(noise=2.0))


class Stage:
    """A camera over a block that can be moved, hidden, and a camera that can be frozen or late."""

    def __init__(self, model, painter):
        self.clock, self.pose, self.goal = VirtualClock(), POSE, None
        self.hidden_s = self.frozen_s = self.late_s = 0.0
        self._painter, self._last, self._number = painter, None, 0
        tracker = Tracker(Detector(painter.renderer.calibration, model.cell.config.block))
        camera = RenderedCamera(self.picture, 0.2, self.clock.now_s)
        self.log = EventLog(self.clock.now_s)
        self.watcher = Watcher(camera, tracker, self.clock, WatchConfig(patience_s=3.0), self.log)

    def picture(self):
        now_s = self.clock.now_s()
        self._number += 1
        if self._last is None or now_s >= self.frozen_s:
            self._last = self._painter.picture(None if now_s < self.hidden_s else flat_pose(*self.pose), None, self.goal)
        return Frame(self._last, now_s - (1.0 if now_s < self.late_s else 0.0), self._number)


@pytest.fixture
def stage(model, painter):
    return Stage(model, painter)


def test_a_block_at_rest_is_seen_after_four_pictures(stage):
    view = stage.watcher.look()
    assert math.dist(view.block[:2], POSE[:2]) < 0.5
    assert abs(view.block[2] - POSE[2]) < math.radians(1.0)
    assert stage.clock.now_s() == pytest.approx(3 / 30)
    assert view.goal is None
    assert not stage.log.counts


def test_the_printed_goal_is_seen_too(stage):
    stage.goal = np.array([-60.0, 10.0, 0.5])
    view = stage.watcher.look()
    assert math.dist(view.goal[:2], stage.goal[:2]) < 0.5
    assert stage.watcher.last_goal is not None


def test_a_moving_block_is_waited_for(stage):
    def move():
        stage.pose = stage.pose + (2.0, 0.0, 0.0)
        if stage.clock.now_s() < 0.5:
            stage.clock.at(stage.clock.now_s() + 1 / 60, move)

    stage.clock.at(0.0, move)
    view = stage.watcher.look()
    assert stage.clock.now_s() > 0.5
    assert math.dist(view.block[:2], stage.pose[:2]) < 0.5


def test_a_hidden_marker_is_said_and_waited_for(stage):
    stage.hidden_s = 1.5
    view = stage.watcher.look()
    assert view.block is not None
    assert stage.log.counts == {Event.MARKER_HIDDEN: 1, Event.RECOVERED: 1}


def test_nothing_is_waited_for_longer_than_there_is_patience(stage):
    stage.hidden_s = 100.0
    view = stage.watcher.look()
    assert view.block is None
    assert view.camera_works
    assert stage.clock.now_s() == pytest.approx(3.0, abs=0.1)
    stage.late_s = 100.0
    view = stage.watcher.look(patience_s=0.5)
    assert view.block is None
    assert not view.camera_works


def test_a_frozen_camera_is_told_from_a_hidden_block(stage):
    stage.watcher.look()
    stage.frozen_s = stage.clock.now_s() + 1.0
    stage.pose = POSE + (40.0, 0.0, 0.0)
    view = stage.watcher.look()
    assert math.dist(view.block[:2], stage.pose[:2]) < 0.5, "an old picture says nothing about now"
    assert stage.log.counts == {Event.CAMERA_FROZEN: 1, Event.RECOVERED: 1}
    assert stage.clock.now_s() > 1.0


def test_a_glance_takes_one_picture(stage):
    assert math.dist(stage.watcher.glance()[:2], POSE[:2]) < 0.5
    assert stage.clock.now_s() == 0.0
    stage.hidden_s = 100.0
    stage.clock.sleep_s(0.1)
    assert stage.watcher.glance() is None
