"""Live cameras against a device that is a queue: the thread, the waiting and the ages are the real ones."""

import queue
import threading
import time

import numpy as np
import pytest

from marl_handover.perception.camera import Frame, LiveCamera, NoCamera, RenderedCamera, StaleFrame


def picture(value):
    return np.full((4, 6, 3), value, np.uint8)


class Tape:
    """A device that gives what is put on it."""

    name = "tape"

    def __init__(self, *values):
        self.items, self.stopped, self.thread = queue.Queue(), 0, None
        for value in values:
            self.items.put(value)

    def grab(self):
        self.thread = threading.current_thread()
        try:
            return picture(self.items.get(timeout=0.01))
        except queue.Empty:
            return None

    def stop(self):
        self.stopped += 1


def test_the_newest_picture_is_read_and_each_only_once():
    tape = Tape(1)
    with LiveCamera(tape, warm_up_s=0.0, max_age_s=5.0, timeout_s=0.3) as camera:
        for value in (2, 3, 4):
            tape.items.put(value)
        frame = camera.read()
        while frame.image[0, 0, 0] != 4:
            frame = camera.read()
        with pytest.raises(StaleFrame, match="tape"):
            camera.read()
        tape.items.put(5)
        following = camera.read()
        assert following.image[0, 0, 0] == 5
        assert following.number > frame.number
        assert following.t_s >= frame.t_s
    assert tape.stopped == 1
    assert not tape.thread.is_alive()


def test_pictures_of_the_warm_up_are_thrown_away():
    tape = Tape(1, 2, 3)
    with LiveCamera(tape, warm_up_s=0.1, max_age_s=5.0, timeout_s=0.1) as camera, pytest.raises(StaleFrame):
        camera.read()


def test_an_old_picture_is_refused_by_age():
    now = [100.0]
    tape = Tape(1)
    with LiveCamera(tape, warm_up_s=0.0, max_age_s=0.2, timeout_s=0.2, clock=lambda: now[0]) as camera:
        tape.items.put(2)
        while not tape.items.empty():
            time.sleep(0.002)
        time.sleep(0.02)
        now[0] = 101.5
        with pytest.raises(StaleFrame, match=r"1\.50 s old, 0\.2 s is allowed"):
            camera.read()
        assert camera.read(max_age_s=2.0).image[0, 0, 0] == 2


def test_a_device_without_pictures_is_no_camera_and_is_let_go():
    tape = Tape()
    with pytest.raises(NoCamera, match="tape gives no pictures"):
        LiveCamera(tape, warm_up_s=0.0, max_age_s=1.0, timeout_s=0.05)
    assert tape.stopped == 1


def test_closing_twice_does_nothing():
    tape = Tape(1)
    camera = LiveCamera(tape, warm_up_s=0.0, max_age_s=1.0, timeout_s=0.5)
    camera.close()
    camera.close()
    assert tape.stopped == 1


def test_rendered_pictures_are_taken_now_unless_they_say_otherwise():
    now = [7.0]
    camera = RenderedCamera(lambda: picture(9), max_age_s=0.2, clock=lambda: now[0])
    first, second = camera.read(), camera.read()
    assert (first.t_s, first.number, second.number) == (7.0, 1, 2)
    late = RenderedCamera(lambda: Frame(picture(9), 6.0, 4), max_age_s=0.2, clock=lambda: now[0])
    with pytest.raises(StaleFrame, match="1.00 s old"):
        late.read()
    assert late.read(max_age_s=1.5).number == 4
