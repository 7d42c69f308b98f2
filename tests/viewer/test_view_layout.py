"""The cell is changed on the page while it plays: by what a viewer drags and presses, over the wire."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from viewer_client import Client

from marl_handover import policies
from marl_handover.cell import build_cell, build_whole_cell, cell_config
from marl_handover.control.interactive.cell import InteractiveCell
from marl_handover.palette import ALERT, FAINT
from marl_handover.viewer.play import PlayPage
from marl_handover.viewer.server import address, keep_updating
from marl_handover.viewer.table import dial, shared_mesh
from marl_handover.viewer.words import flat, rgb

SEEN_S = 30.0
NAMES = ("exact", "pretrained_any")


@pytest.fixture(scope="module")
def ring():
    return build_cell(cell_config("ring6"))


@pytest.fixture
def cell(ring):
    policy = policies.adapted("exact", ring.cell.config)
    return InteractiveCell(policy, build_whole_cell(policy.rules.cell.config), seed=3)


@pytest.fixture
def page(server, cell):
    return PlayPage(
        server, cell, policies.load("exact", cell.model.cell), lambda name: policies.adapted(name, cell.model.cell.config), NAMES
    )


@pytest.fixture
def viewer(server, cell, page):
    ended = threading.Event()
    thread = threading.Thread(target=keep_updating, args=(page.update, 50.0, ended, page.dragged))
    thread.start()
    with Client(address(server)) as viewer:
        viewer.wait(lambda: len(server.get_clients()) == 1 and "position" in viewer.nodes.get("/goal", {}), SEEN_S)
        yield viewer
    ended.set()
    thread.join()


def carry(viewer, name, pose):
    wxyz, position = flat(pose, 5.0)
    viewer.drag(name, position, wxyz, "start")
    viewer.drag(name, position, wxyz)
    viewer.drag(name, position, wxyz, "end")


def at(viewer, name):
    return 1e3 * np.asarray(viewer.nodes[name]["position"])


def press(viewer, group, button):
    viewer.set(group, button)


def test_a_dragged_base_takes_its_arm_and_what_it_shares_along(server, viewer, cell):
    before = server.scene.get_handle_by_name("/shared").vertices
    pose = np.array([-60.0, 360.0, np.radians(-80.0)])
    carry(viewer, "/base_0_0", pose)
    viewer.wait(lambda: np.allclose(at(viewer, "/arm_0"), [*pose[:2], 0.0], atol=0.1), SEEN_S)
    viewer.wait(lambda: not np.array_equal(server.scene.get_handle_by_name("/shared").vertices, before), SEEN_S)
    assert cell.layout.arms[0].x_mm == pytest.approx(-60.0)
    assert cell.layout.arms[0].facing_deg == pytest.approx(-80.0)
    viewer.wait(lambda: viewer.panel[viewer.input("arm")]["value"] == "one", SEEN_S)
    np.testing.assert_allclose(cell.model.cell.bases[0].position_mm, pose[:2])


def test_a_base_held_inside_another_one_is_red_and_one_line_says_so_and_the_page_lives_on(server, viewer, cell):
    two = cell.layout.arms[1]
    carry(viewer, "/base_0_0", (two.x_mm + 5.0, two.y_mm, 0.0))
    viewer.wait(lambda: "the cell cannot be like this" in viewer.text(), SEEN_S)
    assert "whose base stands there" in viewer.text()
    viewer.wait(lambda: np.allclose(at(viewer, "/arm_0")[:2], (two.x_mm + 5.0, two.y_mm), atol=0.1), SEEN_S)
    viewer.wait(lambda: (np.asarray(server.scene.get_handle_by_name("/reach_0").colors) == rgb(ALERT)).all(), SEEN_S)
    press(viewer, "arms", "add")
    viewer.wait(lambda: "move what is red" in viewer.text(), SEEN_S)
    carry(viewer, "/base_0_0", (0.0, 440.0, np.radians(-90.0)))
    viewer.wait(lambda: "the cell cannot be like this" not in viewer.text(), SEEN_S)
    viewer.wait(lambda: "goes to the block" in viewer.text() or "carries the block" in viewer.text(), SEEN_S)


def test_arms_that_cannot_pass_to_each_other_are_named_while_the_rest_goes_on(viewer, cell):
    carry(viewer, "/base_0_0", (0.0, 1500.0, 0.0))
    viewer.wait(lambda: "the arms fall into groups that share no place" in viewer.text(), SEEN_S)
    viewer.set("the cell as it was", True)
    viewer.wait(lambda: "the arms fall into groups" not in viewer.text(), SEEN_S)
    np.testing.assert_allclose(cell.model.cell.bases[0].position_mm, (0.0, 440.0))


def test_arms_are_added_switched_off_and_removed(viewer, cell):
    press(viewer, "arms", "remove")
    viewer.wait(lambda: "chosen first, or dragged" in viewer.text(), SEEN_S)
    press(viewer, "arms", "add")
    viewer.wait(lambda: "/arm_6" in viewer.nodes and cell.model.cell.num_arms == 7, SEEN_S)
    viewer.wait(lambda: viewer.panel[viewer.input("arm")]["options"][-1] == "seven", SEEN_S)
    viewer.set("arm", "two")
    press(viewer, "arms", "on / off")
    viewer.wait(lambda: cell.in_order.num_arms == 6 and viewer.nodes["/arm_1/shape_0"]["color"] == list(rgb(FAINT)), SEEN_S)
    press(viewer, "arms", "on / off")
    viewer.wait(lambda: cell.in_order.num_arms == 7, SEEN_S)
    press(viewer, "arms", "remove")
    viewer.wait(lambda: cell.model.cell.names == ("one", "three", "four", "five", "six", "seven"), SEEN_S)
    viewer.wait(lambda: viewer.panel[viewer.input("arm")]["value"] == "none", SEEN_S)
    viewer.wait(lambda: "/base_2_0" in viewer.nodes, SEEN_S)  # the nodes to drag are new ones
    carry(viewer, "/base_2_1", (380.0, -210.0, 2.6))
    viewer.wait(lambda: np.allclose(cell.model.cell.bases[1].position_mm, (380.0, -210.0)), SEEN_S)


def test_a_disc_is_dropped_dragged_resized_and_taken_away(viewer, cell):
    press(viewer, "discs", "drop")
    viewer.wait(lambda: len(cell.model.cell.keep_out) == 1 and viewer.nodes.get("/disc_0", {}).get("visible"), SEEN_S)
    viewer.wait(lambda: "/keep_out_0" in viewer.nodes, SEEN_S)
    carry(viewer, "/keep_out_0", (300.0, 30.0, 0.0))
    viewer.wait(lambda: np.allclose(at(viewer, "/disc_0")[:2], (300.0, 30.0), atol=0.1), SEEN_S)
    viewer.set("radius [mm]", 35.0)
    viewer.wait(lambda: cell.model.cell.config.obstacles[0].radius_mm == 35.0, SEEN_S)
    viewer.wait(lambda: viewer.nodes["/disc_0/body"]["radius"] == pytest.approx(0.035), SEEN_S)
    press(viewer, "discs", "remove")
    viewer.wait(lambda: not cell.model.cell.keep_out and not viewer.nodes["/disc_0"]["visible"], SEEN_S)


def test_hand_over_angles_are_shown_on_demand(viewer, cell):
    assert "/dial_0" not in viewer.nodes
    viewer.set("hand-over angles", True)
    viewer.wait(lambda: "/dial_5" in viewer.nodes, SEEN_S)
    texts = {viewer.nodes[f"/dial_{number}"]["text"] for number in range(6)}
    assert texts == {"89–250°", "110–271°"}  # as the docs have them, and seen from the other arm
    viewer.set("hand-over angles", False)
    viewer.wait(lambda: not viewer.nodes["/dial_0"]["visible"] and not viewer.nodes["/dial_arcs"]["visible"], SEEN_S)


def test_after_a_stop_no_base_is_moved(viewer, cell):
    viewer.set("STOP", True)
    viewer.wait(lambda: "STOPPED" in viewer.text(), SEEN_S)
    before = cell.layout
    carry(viewer, "/base_0_0", (0.0, 400.0, 0.0))
    press(viewer, "discs", "drop")
    viewer.set("clear the stop", True)
    viewer.wait(lambda: "Paused" in viewer.text(), SEEN_S)
    viewer.wait(lambda: not viewer.panel[viewer.input("pause" if "pause" in str(viewer.panel) else "go on")]["disabled"], SEEN_S)
    assert cell.layout is before
    assert np.allclose(at(viewer, "/arm_0")[:2], (0.0, 440.0))


@pytest.mark.parametrize("name", ["ring6", "line4", "triangle"])
def test_the_shade_covers_what_two_arms_share(name):
    cell = build_cell(cell_config(name)).cell
    for (i, j), space in cell.graph.edges.items():
        vertices, faces = shared_mesh(cell, space)
        middle = vertices[:, :2].mean(0)
        seen = cell.reaches(middle + 0.999 * (vertices[:, :2] - middle))
        assert seen[:, [i, j]].mean() > 0.98  # spaces are not convex: a vertex drawn in may leave them
        a, b, c = (vertices[faces[:, corner], :2] for corner in range(3))
        area = 0.5 * abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()
        points = middle + np.random.default_rng(0).uniform(-330, 330, (400_000, 2))
        exact = cell.reaches(points)[:, [i, j]].all(-1).mean() * 660**2
        assert area == pytest.approx(exact, rel=0.02)


def test_a_dial_has_the_angles_of_every_place_that_two_arms_share():
    cell = build_cell(cell_config("triangle")).cell
    for (i, j), space in cell.graph.edges.items():
        middle, arcs = dial(space)
        assert cell.reaches(middle)[[i, j]].all()
        alpha, beta = np.random.default_rng(1).uniform(-1, 1, (2, 1000))
        psi = cell.gripper_yaw(cell.polar(space.to_table(alpha, beta))[1])
        angle = np.mod(psi[:, i] - psi[:, j], 2 * np.pi)
        assert np.logical_or.reduce([(angle >= low - 1e-3) & (angle <= high + 1e-3) for low, high in arcs]).all()
