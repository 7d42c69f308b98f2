"""Looking at rendered pictures until the block lies still, on a virtual clock."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest

from marl_handover.control.events import Event, EventLog
from marl_handover.control.pose_monitor import PoseMonitor
from marl_handover.control.settings import WatchConfig
from marl_handover.geometry.se3 import flat_pose
from marl_handover.hardware.clock import RealClock, VirtualClock
from marl_handover.perception.calibration import hung_camera
from marl_handover.perception.camera import Frame, LiveCamera, RenderedCamera, StaleFrame
from marl_handover.perception.detector import Detector
from marl_handover.perception.scene import CellPainter
from marl_handover.perception.settings import LookConfig, MountConfig
from marl_handover.perception.tracker import Tracker

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
        self.pose_monitor = PoseMonitor(camera, tracker, self.clock, WatchConfig(timeout_s=3.0), self.log)

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
    view = stage.pose_monitor.wait_steady()
    assert math.dist(view.block[:2], POSE[:2]) < 0.5
    assert abs(view.block[2] - POSE[2]) < math.radians(1.0)
    assert stage.clock.now_s() == pytest.approx(3 / 30)
    assert view.goal is None
    assert not stage.log.counts


def test_the_printed_goal_is_seen_too(stage):
    stage.goal = np.array([-60.0, 10.0, 0.5])
    view = stage.pose_monitor.wait_steady()
    assert math.dist(view.goal[:2], stage.goal[:2]) < 0.5
    assert stage.pose_monitor.last_goal is not None


def test_a_moving_block_is_waited_for(stage):
    def move():
        stage.pose = stage.pose + (2.0, 0.0, 0.0)
        if stage.clock.now_s() < 0.5:
            stage.clock.at(stage.clock.now_s() + 1 / 60, move)

    stage.clock.at(0.0, move)
    view = stage.pose_monitor.wait_steady()
    assert stage.clock.now_s() > 0.5
    assert math.dist(view.block[:2], stage.pose[:2]) < 0.5


def test_a_hidden_marker_is_said_and_waited_for(stage):
    stage.hidden_s = 1.5
    view = stage.pose_monitor.wait_steady()
    assert view.block is not None
    assert stage.log.counts == {Event.MARKER_HIDDEN: 1, Event.RECOVERED: 1}


def test_nothing_is_waited_for_longer_than_there_is_patience(stage):
    stage.hidden_s = 100.0
    view = stage.pose_monitor.wait_steady()
    assert view.block is None
    assert view.camera_works
    assert stage.clock.now_s() == pytest.approx(3.0, abs=0.1)
    stage.late_s = 100.0
    view = stage.pose_monitor.wait_steady(patience_s=0.5)
    assert view.block is None
    assert not view.camera_works


def test_a_frozen_camera_is_told_from_a_hidden_block(stage):
    stage.pose_monitor.wait_steady()
    stage.frozen_s = stage.clock.now_s() + 1.0
    stage.pose = POSE + (40.0, 0.0, 0.0)
    view = stage.pose_monitor.wait_steady()
    assert math.dist(view.block[:2], stage.pose[:2]) < 0.5, "an old picture says nothing about now"
    assert stage.log.counts == {Event.CAMERA_FROZEN: 1, Event.RECOVERED: 1}
    assert stage.clock.now_s() > 1.0


def test_a_glance_takes_one_picture(stage):
    assert math.dist(stage.pose_monitor.poll()[:2], POSE[:2]) < 0.5
    assert stage.clock.now_s() == 0.0
    stage.hidden_s = 100.0
    stage.clock.sleep_s(0.1)
    assert stage.pose_monitor.poll() is None


class Stuck:
    """A camera that gives one picture at a time, and none unless it is told to."""

    name = "stuck"

    def __init__(self, image):
        self.image, self.go = image, threading.Event()
        self.go.set()

    def grab(self):
        if not self.go.wait(0.02):
            return None
        self.go.clear()
        return self.image

    def stop(self):
        pass


@pytest.fixture
def live(model, painter):
    """A watcher behind a live camera that has stopped giving pictures, and would be waited for longer than any test lasts."""
    clock, device = RealClock(), Stuck(painter.picture(flat_pose(*POSE), None, None))
    camera = LiveCamera(device, warm_up_s=0.0, max_age_s=1e6, timeout_s=600.0, clock=clock.now_s)
    log = EventLog(clock.now_s)
    tracker = Tracker(Detector(painter.renderer.calibration, model.cell.config.block))
    pose_monitor = PoseMonitor(camera, tracker, clock, WatchConfig(picture_s=0.1, timeout_s=1.0), log)
    yield pose_monitor, device
    camera.close()


def in_time(call):
    """What a call gives; it must not take for ever."""
    given = []
    thread = threading.Thread(target=lambda: given.append(call()), daemon=True)
    thread.start()
    thread.join(30.0)
    assert given, "it waits"
    return given[0]


def test_a_glance_does_not_wait_for_a_camera_that_gives_nothing(live):
    pose_monitor, device = live
    assert in_time(pose_monitor.poll) is None
    device.go.set()
    while pose_monitor.camera.newest().number < 2:
        device.go.wait(0.01)
    assert math.dist(in_time(pose_monitor.poll)[:2], POSE[:2]) < 0.5
    assert in_time(pose_monitor.poll) is None, "the same picture says nothing new"


def test_a_look_at_a_camera_that_gives_nothing_ends_and_says_so(live):
    pose_monitor, _ = live
    view = in_time(pose_monitor.wait_steady)
    assert view.block is None
    assert not view.camera_works
    assert pose_monitor.log.counts == {Event.CAMERA_FROZEN: 1}


def test_pictures_that_come_more_slowly_than_looks_are_waited_for(model, painter):
    """Six pictures a second, thirty looks: those that find nothing new say nothing against the sightings between them."""
    stage = Stage(model, painter)
    read, next_s = stage.pose_monitor.camera.read, [0.0]

    def slowly(max_age_s=None, wait_s=None):
        if stage.clock.now_s() < next_s[0]:
            raise StaleFrame("slow camera", 0.0, 0.0)
        next_s[0] = stage.clock.now_s() + 1 / 6
        return read(max_age_s, wait_s)

    stage.pose_monitor.camera.read = slowly
    view = stage.pose_monitor.wait_steady()
    assert math.dist(view.block[:2], POSE[:2]) < 0.5
    assert not stage.log.counts
