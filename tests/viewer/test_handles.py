from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from viewer_client import Client
from viser import _messages

from marl_handover.viewer.handles import PlaneHandle, on_level
from marl_handover.viewer.server import address
from marl_handover.viewer.words import flat

number = st.floats(-2, 2)


@given(number, number, st.floats(0.3, 2), number, number, st.floats(-0.2, 0.2))
def test_the_line_of_sight_to_a_point_at_a_height_meets_it_there(x, y, z, a, b, height):
    eye, point = np.array([x, y, z]), np.array([a, b, height])
    seen = eye + 0.4 * (point - eye)
    np.testing.assert_allclose(on_level(eye, seen, height), point, atol=1e-9)


def test_a_line_of_sight_above_the_horizon_meets_no_table():
    assert on_level(np.array([0, 0, 1.0]), np.array([1.0, 0, 1.5]), 0.0) is None
    assert on_level(np.array([0, 0, 1.0]), np.array([1.0, 0, 1.0]), 0.0) is None


@pytest.fixture
def handle(server):
    body = server.scene.add_box("/thing", dimensions=(0.04, 0.04, 0.01))
    handle = PlaneHandle(server, "/handle", 8.0, [body.name])
    handle.show((100.0, 50.0, 0.5))
    return handle


@pytest.fixture
def viewer(server, handle):
    with Client(address(server)) as viewer:
        viewer.wait(lambda: "/handle" in viewer.nodes and len(server.get_clients()) == 1, 10)
        yield viewer


def drag(viewer, pose, phase="update"):
    wxyz, position = flat(pose, 8.0)
    viewer.drag("/handle", tuple(position), tuple(wxyz), phase)


def until(condition):
    import time

    end = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.005)


def test_of_what_is_dragged_the_newest_is_fetched_once(handle, viewer):
    assert handle.fetch() is None
    drag(viewer, (0, 0, 0), "start")
    for x_mm in range(20):
        drag(viewer, (x_mm, -30.0, -2.5))
    until(lambda: handle.held is not None and handle.held[0] == pytest.approx(19.0))
    dragged = handle.fetch()
    np.testing.assert_allclose(dragged.pose, [19.0, -30.0, -2.5], atol=1e-9)
    assert not dragged.released
    assert handle.fetch() is None


def test_a_handle_is_not_pulled_out_of_the_hand_that_holds_it(server, handle, viewer):
    drag(viewer, (0, 0, 0), "start")
    drag(viewer, (20.0, 0.0, 0.0))
    until(lambda: handle.held is not None and handle.held[0] == pytest.approx(20.0))
    handle.show((100.0, 50.0, 0.5))
    node = server.scene.get_handle_by_name("/handle")
    assert node.position[0] == pytest.approx(0.02)
    drag(viewer, (20.0, 0.0, 0.0), "end")
    until(lambda: handle.held is None)
    assert handle.fetch().released
    handle.show((100.0, 50.0, 0.5))
    assert node.position[0] == pytest.approx(0.1)


def test_a_viewer_that_goes_in_mid_drag_lets_go(server, handle):
    with Client(address(server)) as viewer:
        viewer.wait(lambda: "/handle" in viewer.nodes, 10)
        until(lambda: len(server.get_clients()) == 1)
        drag(viewer, (0, 0, 0), "start")
        drag(viewer, (20.0, 0.0, 0.0))
        until(lambda: handle.held is not None)
    until(lambda: handle.held is None)


def test_the_thing_itself_is_dragged_along_the_table_by_where_it_was_grabbed(handle, viewer):
    """The eye is at (-0.6, 0, 0.5) m; the grab is 10 mm beside the middle, 10 mm up; both points are given on another plane of sight."""
    eye = np.array([-0.6, 0.0, 0.5])
    grab, goal = np.array([0.11, 0.05, 0.01]), np.array([-0.02, 0.12, 0.01])

    def move(phase, point):
        seen = tuple(eye + 0.8 * (point - eye))
        viewer.send(_messages.SceneNodeDragMessage(phase, "/thing", None, tuple(grab), (0, 0), seen, (0, 0), "left", None))

    move("start", grab)
    move("update", goal)
    until(lambda: handle.held is not None and handle.held[0] < 0)
    np.testing.assert_allclose(handle.held, [-30.0, 120.0, 0.5], atol=1e-6)
    move("end", goal)
    until(lambda: handle.held is None)
    np.testing.assert_allclose(handle.fetch().pose, [-30.0, 120.0, 0.5], atol=1e-6)
    assert math.isclose(grab[2], goal[2])
