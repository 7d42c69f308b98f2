"""Live cameras against a device that is a queue: the thread, the waiting and the ages are the real ones."""

import queue
import threading
import time

import numpy as np
import pytest

from marl_handover.perception.camera import Frame, LiveCamera, NoCamera, RenderedCamera, Reopening, StaleFrame


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


def test_whoever_only_watches_takes_no_picture_away():
    tape = Tape(1)
    with LiveCamera(tape, warm_up_s=0.0, max_age_s=5.0, timeout_s=5.0) as camera:
        tape.items.put(2)
        while camera.newest().image[0, 0, 0] != 2:
            pass
        assert camera.newest().number == camera.read().number
    assert RenderedCamera(lambda: picture(1), max_age_s=1.0).newest() is None


def test_a_picture_that_is_not_there_need_not_be_waited_for():
    tape = Tape(1)
    with LiveCamera(tape, warm_up_s=0.0, max_age_s=5.0, timeout_s=600.0) as camera:
        with pytest.raises(StaleFrame):
            camera.read(wait_s=0.0)
        tape.items.put(2)
        while camera.newest().number < 2:
            time.sleep(0.002)
        assert camera.read(wait_s=0.0).image[0, 0, 0] == 2


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


class Plug:
    """Opens one device after the other; None stands for a socket with nothing in it."""

    def __init__(self, *devices):
        self.devices, self.opened = list(devices), 0

    def __call__(self):
        self.opened += 1
        device = self.devices.pop(0) if self.devices else None
        if device is None:
            raise NoCamera("nothing is plugged in")
        return device


def test_a_camera_that_was_unplugged_comes_back():
    before, after = Tape(1, 2), Tape(7)
    plug = Plug(before, None, None, after)
    with LiveCamera(Reopening(plug, after_s=0.05), warm_up_s=0.0, max_age_s=5.0, timeout_s=30.0) as camera:
        frame = camera.read()
        while frame.image[0, 0, 0] != 7:
            following = camera.read()
            assert following.number > frame.number
            frame = following
    assert (plug.opened, before.stopped, after.stopped) == (4, 1, 1)


def test_a_device_is_opened_anew_only_after_a_while_without_pictures():
    now, tape = [0.0], Tape(1)
    plug = Plug(tape, None, Tape(2), Tape(3))
    device = Reopening(plug, after_s=2.0, clock=lambda: now[0])
    given = []
    for step in range(60):
        now[0] = 0.1 * step
        if step == 15:
            tape.items.put(4)
        image = device.grab()
        given.append(None if image is None else int(image[0, 0, 0]))
    assert [value for value in given if value] == [1, 4, 2]
    assert plug.opened == 3, "once at first, once in vain, once more: 2 s after the last picture, and after every attempt"
    device.stop()
    now[0] += 100.0
    assert device.grab() is None
    assert plug.opened == 3, "what was let go stays closed"


def test_a_device_that_is_not_there_at_first_is_no_camera():
    with pytest.raises(NoCamera, match="nothing is plugged in"):
        Reopening(Plug(), after_s=1.0)
