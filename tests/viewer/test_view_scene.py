from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marl_handover.palette import ALERT, ARMS, GOAL
from marl_handover.viewer.scene import CellScene, place_names
from marl_handover.viewer.words import rgb

JOINTS = np.array([[0.1, 1.0, -2.0, 0.5, 0.0], [0.0, 2.0, -2.0, 0.3, 0.0]])
PLAN = np.array([[30.0, 0.0, 1.0], [-60.0, 20.0, 0.3], [150.0, -80.0, 2.0]])


@pytest.fixture
def scene(server, model):
    return CellScene(server, model)


@pytest.fixture
def sent(server):
    """How many messages a call sends."""
    buffer = server._websock_server.get_message_buffer()

    def count(call, *arguments):
        before = buffer.message_counter
        call(*arguments)
        return buffer.message_counter - before

    return count


def test_what_has_not_changed_is_not_sent_again(scene, sent):
    calls = [
        (scene.show_joints, JOINTS, (True, False)),
        (scene.show_block, (10.0, 20.0, 0.5)),
        (scene.show_goal, (30.0, 20.0, 0.5)),
        (scene.show_plan, PLAN, [0, 1, 0], (10.0, 20.0, 0.5)),
    ]
    for call, *arguments in calls:
        assert sent(call, *arguments) > 0
    for call, *arguments in calls:
        assert sent(call, *arguments) == 0


def test_one_arm_and_its_block_in_motion_are_a_handful_of_messages(scene, sent):
    scene.show_joints(JOINTS)
    scene.show_block(np.eye(4))
    moved = JOINTS + np.array([[0.01], [0.0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", 0.1).as_matrix(), (1.0, 2.0, 30.0)
    assert sent(scene.show_joints, moved) == 5
    assert sent(scene.show_block, T) == 2


def test_a_block_is_shown_by_its_pose_or_by_its_transform_alike(server, scene):
    node = server.scene.get_handle_by_name("/block")
    scene.show_block((120.0, -60.0, 0.7), 25.0)
    wxyz, position = node.wxyz.copy(), node.position.copy()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", 0.7).as_matrix(), (120.0, -60.0, 25.0)
    scene.show_block(None)
    assert not node.visible
    scene.show_block(T)
    assert node.visible
    np.testing.assert_allclose(node.position, position)
    np.testing.assert_allclose(node.wxyz, wxyz, atol=1e-12)
    np.testing.assert_allclose(position, [0.12, -0.06, 0.025])


def test_a_goal_that_no_arm_reaches_is_red(server, scene):
    body = server.scene.get_handle_by_name("/goal/body")
    for reachable, colour in ((False, ALERT), (True, GOAL)):
        scene.show_goal((0.0, 0.0, 0.0), reachable)
        assert tuple(body.color) == rgb(colour)


def test_ghosts_have_the_colour_of_the_arm_and_go_when_the_plan_does(server, scene):
    scene.show_plan(PLAN, [0, 1, 0])
    ghosts = [server.scene.get_handle_by_name(f"/plan_{number}") for number in range(3)]
    bodies = [server.scene.get_handle_by_name(f"/plan_{number}/body") for number in range(3)]
    assert [tuple(body.color) for body in bodies] == [rgb(ARMS[arm]) for arm in (0, 1, 0)]
    np.testing.assert_allclose([1e3 * ghost.position[:2] for ghost in ghosts], PLAN[:, :2])
    scene.show_plan(PLAN[:1], [1])
    assert [ghost.visible for ghost in ghosts] == [True, False, False]
    assert tuple(bodies[0].color) == rgb(ARMS[1])
    scene.show_plan([], [])
    assert not any(ghost.visible for ghost in ghosts)


def test_the_way_is_drawn_in_the_arms_colours(server, scene):
    scene.show_plan(PLAN, [0, 1, 0], (-100.0, 50.0, 0.0))
    left, right = (server.scene.get_handle_by_name(f"/path_{arm}") for arm in (0, 1))
    np.testing.assert_allclose(1e3 * left.points[:, :, :2], [[[-100, 50], PLAN[0, :2]], [PLAN[1, :2], PLAN[2, :2]]], atol=1e-3)
    np.testing.assert_allclose(1e3 * right.points[:, :, :2], [[PLAN[0, :2], PLAN[1, :2]]], atol=1e-3)
    scene.show_plan(PLAN[:1], [0])
    assert not left.visible
    assert not right.visible


def test_plans_of_any_length_for_hours_do_not_grow_what_a_new_viewer_is_sent(server, scene):
    buffer = server._websock_server.get_message_buffer()
    random = np.random.default_rng(0)

    def some(count):
        for _ in range(count):
            length = int(random.integers(0, 8))
            scene.show_plan(random.uniform(-150, 150, (length, 3)), [0] * length)
            scene.show_goal(random.uniform(-150, 150, 3))

    some(200)
    kept = len(buffer.message_from_id)
    some(400)
    assert len(buffer.message_from_id) <= kept


def test_one_place_has_one_label():
    goal = np.array([100.0, 0.0, 3.1])
    plan = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [3.0, 4.0, 1.0], [100.5, 0.0, 3.1 - 2 * math.pi]])
    assert place_names(plan, goal) == ["1, 3", "2", "", None, "goal (4)"]
    assert place_names(plan, None) == ["1, 3", "2", "", "4", "goal"]
    assert place_names(plan[:0], goal) == ["goal"]


def test_a_block_at_the_goal_but_turned_keeps_its_ghost():
    assert place_names(np.array([[100.0, 0.0, 0.0]]), np.array([100.0, 0.0, 1.0])) == ["1", "goal"]
