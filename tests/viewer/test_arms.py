from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marl_handover.geometry.se3 import transform
from marl_handover.viewer.scene import ArmNodes


@pytest.fixture
def arms(server, model):
    return [ArmNodes(server, model, index) for index in range(2)]


def placed(server, name):
    """T_world_node in mm, along the tree of nodes."""
    T = np.eye(4)
    parts = name.strip("/").split("/")
    for depth in range(1, len(parts) + 1):
        node = server.scene.get_handle_by_name("/" + "/".join(parts[:depth]))
        own = np.eye(4)
        own[:3, :3] = Rotation.from_quat(node.wxyz, scalar_first=True).as_matrix()
        own[:3, 3] = 1e3 * np.asarray(node.position)
        T = T @ own
    return T


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("arm", [0, 1])
def test_every_link_is_where_the_forward_kinematics_say(server, model, arms, arm, seed):
    random = np.random.default_rng(seed)
    q = random.uniform(model.arm.lower_rad, model.arm.upper_rad)
    arms[arm].show(q)
    for opened in (0.0, 1.0):
        arms[arm].open(opened)
        base = model.cell.bases[arm]
        T_world_base = transform((base.x_mm, base.y_mm, 0.0), (0.0, 0.0, base.facing_rad))
        for link, T_base_link in model.arm.link_transforms(q, None if opened else 0.0).items():
            np.testing.assert_allclose(placed(server, arms[arm].names[link]), T_world_base @ T_base_link, atol=1e-9, err_msg=link)


def test_every_collision_shape_is_drawn_at_its_size(server, model, arms):
    for link in model.arm.description.links:
        for number, shape in enumerate(link.collisions):
            node = server.scene.get_handle_by_name(f"{arms[0].names[link.name]}/shape_{number}")
            size = node.dimensions if shape.kind == "box" else (node.radius, node.height)
            np.testing.assert_allclose(1e3 * np.asarray(size), shape.size_mm)
            np.testing.assert_allclose(1e3 * np.asarray(node.position), shape.xyz_mm)


def test_to_turn_all_joints_is_five_messages(server, model, arms):
    buffer = server._websock_server.get_message_buffer()
    arms[0].show(model.arm.lower_rad)
    before = buffer.message_counter
    arms[0].show(model.arm.upper_rad)
    assert buffer.message_counter - before == 5
