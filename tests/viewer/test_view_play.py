from __future__ import annotations

import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from viewer_client import Client
from viser import _messages

from marl_handover import policies
from marl_handover.control.interactive.cell import InteractiveCell
from marl_handover.viewer.play import PlayPage
from marl_handover.viewer.server import address, keep_updating
from marl_handover.viewer.words import flat, plain

EVIL = "<img src=x onerror=alert(1)> ![x](http://somewhere/x.png)"
SEEN_S = 30.0


class Watched(InteractiveCell):
    """Remembers what the page was told last, and how often it asked."""

    last = None
    told = 0

    def advance(self, dt_s):
        self.last = super().advance(dt_s)
        self.told += 1
        return self.last


@pytest.fixture
def cell(model):
    return Watched(policies.load("exact"), model, seed=3)


@pytest.fixture
def viewer(server, cell):
    """Somebody who looks at a page that runs eight times as fast as it should."""
    page = PlayPage(server, cell, policies.load("exact"), policies.adapted, ("exact", "pretrained_b", "nonsense"), 4.0)
    ended = threading.Event()
    thread = threading.Thread(target=keep_updating, args=(lambda dt_s: page.update(2 * dt_s), 50.0, ended))
    thread.start()
    with Client(address(server)) as viewer:
        viewer.wait(lambda: len(server.get_clients()) == 1 and "position" in viewer.nodes.get("/goal", {}), SEEN_S)
        yield viewer
    ended.set()
    thread.join()


def drag(viewer, name, pose):
    wxyz, position = flat(pose, 8.0)
    viewer.drag(name, position, wxyz, "start")
    viewer.drag(name, position, wxyz)
    viewer.drag(name, position, wxyz, "end")


def at(viewer, name):
    return 1e3 * np.asarray(viewer.nodes[name]["position"])


def near(viewer, name, place):
    return lambda: np.hypot(*(at(viewer, name)[:2] - place)) < 1e-3


def test_a_dragged_goal_is_reached_and_stays_until_somebody_wants_another(viewer, cell):
    pose = np.array([-120.0, 60.0, 1.0])
    drag(viewer, "/goal_handle", pose)
    viewer.wait(near(viewer, "/goal", pose[:2]), SEEN_S)
    viewer.wait(lambda: "Done: the block is at its goal" in viewer.text(), SEEN_S)
    np.testing.assert_allclose(at(viewer, "/block")[:2], pose[:2], atol=0.01)
    assert viewer.panel[viewer.input("next problem by itself")]["value"] is False
    viewer.set("new problem", True)
    viewer.wait(lambda: not near(viewer, "/goal", pose[:2])(), SEEN_S)


def test_a_goal_dragged_out_of_reach_is_put_where_an_arm_reaches_it(viewer, cell):
    drag(viewer, "/goal_handle", (0.0, 900.0, 0.0))
    viewer.wait(lambda: at(viewer, "/goal")[1] > 100 and bool(cell.model.cell.reaches(at(viewer, "/goal")[:2]).any()), SEEN_S)
    viewer.wait(lambda: "Done" in viewer.text(), SEEN_S)


def test_a_dragged_block_lies_where_it_was_dragged(viewer, cell):
    viewer.set("pause", True)
    viewer.wait(lambda: "Paused" in viewer.text(), SEEN_S)
    place = (160.0, 60.0)
    drag(viewer, "/block_handle", (*place, 0.2))
    viewer.wait(near(viewer, "/block", place), SEEN_S)


WISHES = {
    "goal": lambda viewer: drag(viewer, "/goal_handle", (0.0, 0.0, 0.0)),
    "block": lambda viewer: drag(viewer, "/block_handle", (160.0, 60.0, 0.2)),
    "numbers": lambda viewer: viewer.set("x, y [mm], turn [°]", [40.0, 10.0, 90.0]),
    "problem": lambda viewer: viewer.set("new problem", True),
    "policy": lambda viewer: viewer.set("policy", "pretrained_b"),
    "pause": lambda viewer: viewer.set("pause", True),
}


def looked_at(viewer, cell, times=25):
    """Until the page has looked at the cell so often, and with it at everything it was sent."""
    told = cell.told
    viewer.wait(lambda: cell.told >= told + times, SEEN_S)


@pytest.mark.parametrize("wish", WISHES.values(), ids=WISHES)
def test_stop_freezes_everything_and_what_is_asked_for_before_it_is_cleared_is_not_done(viewer, cell, wish):
    viewer.set("STOP", True)
    viewer.wait(lambda: "STOPPED" in viewer.text(), SEEN_S)
    frozen, goal, adapter = cell.last, at(viewer, "/goal").copy(), cell._controller.adapter
    assert viewer.panel[viewer.input("clear the stop")]["disabled"] is False
    wish(viewer)
    looked_at(viewer, cell)
    assert cell.last.state == "stopped"
    viewer.set("clear the stop", True)
    viewer.wait(lambda: "Paused" in viewer.text(), SEEN_S)
    looked_at(viewer, cell)
    assert cell.last.t_s == frozen.t_s
    for name in ("joints_rad", "T_world_block", "goal"):
        np.testing.assert_array_equal(getattr(cell.last, name), getattr(frozen, name))
    np.testing.assert_array_equal(at(viewer, "/goal"), goal)
    assert cell._controller.adapter is adapter
    assert viewer.panel[viewer.input("policy")]["value"] == "exact"
    shown = viewer.panel[viewer.input("x, y [mm], turn [°]")]["value"]
    np.testing.assert_allclose(shown, (*frozen.goal[:2], math.degrees(frozen.goal[2])), atol=0.051)
    viewer.set("go on", True)
    viewer.wait(lambda: "STOPPED" not in viewer.text() and "Paused" not in viewer.text(), SEEN_S)


def test_after_a_stop_is_cleared_one_click_goes_on_also_when_the_button_still_says_pause(viewer, cell):
    viewer.set("STOP", True)
    viewer.wait(lambda: "STOPPED" in viewer.text(), SEEN_S)
    button = viewer.input("pause")
    stopped_s = cell.last.t_s
    viewer.set("clear the stop", True)
    viewer.send(_messages.GuiUpdateMessage(button, {"value": True}))
    viewer.wait(lambda: cell.last.t_s > stopped_s, SEEN_S)


def test_of_policies_chosen_while_one_is_loaded_the_newest_only_is_loaded(server, cell):
    begun, go_on, loaded = threading.Event(), threading.Event(), []

    def load(name):
        loaded.append(name)
        begun.set()
        assert go_on.wait(SEEN_S)
        return policies.load("exact")

    names = ("exact", *"abcdefgh")
    page = PlayPage(server, cell, policies.load("exact"), load, names)
    threads = []
    for name in names[1:]:
        page._policy_choice.value = name
        threads.append(threading.Thread(target=page._choose, args=(SimpleNamespace(client_id=1),)))
        threads[-1].start()
        assert begun.wait(SEEN_S)
    for thread in threads[1:]:
        thread.join(SEEN_S)
        assert not thread.is_alive(), "only the thread that loads is busy"
    go_on.set()
    threads[0].join(SEEN_S)
    assert loaded == ["a", "h"]
    assert page._chosen == "h"


@pytest.mark.parametrize("calls", [("stop", "clear"), ("clear",)])
def test_a_drag_that_the_page_has_not_looked_at_when_a_stop_is_cleared_is_lost(server, cell, calls):
    page = PlayPage(server, cell, policies.load("exact"), policies.adapted, ("exact",))
    if "stop" not in calls:
        cell.stop()
    page.update(0.02)
    goal = cell.last.goal
    page._goal_handle._note(np.array([40.0, 10.0, 0.0]), "update")
    for call in calls:
        getattr(cell, call)()
    page.update(0.02)
    np.testing.assert_array_equal(cell.last.goal, goal)
    page._goal_handle._note(np.array([40.0, 10.0, 0.0]), "update")
    page.update(0.02)
    np.testing.assert_allclose(cell.last.goal, (40.0, 10.0, 0.0))


def test_a_goal_in_numbers_is_taken_up(viewer):
    viewer.set("x, y [mm], turn [°]", [40.0, 10.0, 90.0])
    viewer.wait(near(viewer, "/goal", (40.0, 10.0)), SEEN_S)
    turn = viewer.nodes["/goal"]["wxyz"]
    assert 2 * math.atan2(turn[3], turn[0]) == pytest.approx(math.pi / 2)


def test_another_policy_plays_and_one_that_is_none_is_named(viewer):
    viewer.set("policy", "pretrained_b")
    viewer.set("policy", "nonsense")
    viewer.wait(lambda: "nonsense" in viewer.text(), SEEN_S)
    viewer.wait(lambda: viewer.panel[viewer.input("policy")]["value"] == "pretrained_b", SEEN_S)


def test_a_failed_choice_is_told_beside_what_goes_on_and_until_something_succeeds(server, cell, model):
    page = PlayPage(server, cell, policies.load("exact"), policies.adapted, ("exact", "nonsense"))
    page._policy_choice.value = "nonsense"
    page._choose(SimpleNamespace(client_id=1))
    messages = set()
    for _ in range(200):
        page.update(0.1)
        assert "nonsense" in page._state.content
        assert plain(cell.last.message) in page._state.content
        messages.add(cell.last.message)
    assert len(messages) > 2
    page._policy_choice.value = "exact"
    page._choose(SimpleNamespace(client_id=1))
    page.update(0.1)
    assert "nonsense" not in page._state.content


def test_what_a_viewer_sends_for_a_policy_is_text_and_no_page(viewer):
    viewer.set("policy", EVIL)
    viewer.wait(lambda: "is not known" in viewer.text(), SEEN_S)
    assert "alert" in viewer.text()
    assert "<img" not in viewer.text()
    assert "![" not in viewer.text()


def test_solved_problems_are_counted_and_followed_by_others(viewer):
    viewer.wait(lambda: "| problems solved | 2 of 2 (100%) |" in viewer.text(), 3 * SEEN_S)
    assert "| transfers ÷ fewest | 1.00 |" in viewer.text()


def test_a_viewer_that_sends_nonsense_does_no_harm(viewer, cell):
    goal = at(viewer, "/goal").copy()
    for label, value in (("speed", math.nan), ("x, y [mm], turn [°]", [math.inf, 0.0, 0.0]), ("policy", "/somebodys/run")):
        viewer.set(label, value)
    viewer.drag("/goal_handle", (math.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    viewer.wait(lambda: "policy = '/somebodys/run' is not known" in viewer.text(), SEEN_S)
    np.testing.assert_array_equal(at(viewer, "/goal"), goal)
    viewer.set("speed", 1.0)
    drag(viewer, "/goal_handle", (-120.0, 60.0, 0.0))
    viewer.wait(near(viewer, "/goal", (-120.0, 60.0)), SEEN_S)
