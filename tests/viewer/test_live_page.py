"""The live page on a real server, fed with what real twin sessions published."""

from __future__ import annotations

import json
import os
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.cli import main
from marl_handover.config import TaskConfig
from marl_handover.control.remote_control import SessionCommand
from marl_handover.control.telemetry_reader import EVENTS_FILE, STATE_FILE, Reading, TelemetryReader
from marl_handover.geometry.se3 import flat_pose
from marl_handover.hardware.estop import StopLatch
from marl_handover.task.rules import Command, Rules
from marl_handover.viewer import live as live_words
from marl_handover.viewer.live import LivePage, _picking
from marl_handover.viewer.scene import CellScene

pytestmark = pytest.mark.usefixtures("empty_session_registry")


@pytest.fixture(scope="module")
def session(twin_calibration, tmp_path_factory):
    """States and the picture of a whole episode, and its folder as it was left."""
    folder, stop = tmp_path_factory.mktemp("session") / "live", tmp_path_factory.mktemp("stop") / "stop"
    states, ended, feed = [], threading.Event(), TelemetryReader(folder)

    def collect():
        while not ended.wait(0.01):
            state = feed.read().state
            if state is not None and (not states or state["number"] != states[-1]["number"]):
                states.append(state)

    reader = threading.Thread(target=collect, daemon=True)
    reader.start()
    arguments = ["hardware=twin", f"calibration={twin_calibration}", f"hardware.stop_file={stop}", "policy=exact", "seed=3"]
    assert main(["run", *arguments, f"publish={folder}"]) == 0
    ended.set()
    reader.join()
    states.append(feed.read().state)
    return SimpleNamespace(states=[state for state in states if "arms" in state], folder=folder)


@pytest.fixture
def page(server, tmp_path):
    """A page on an empty folder, and ``show(state)``, which publishes that as of now."""
    page = LivePage(server, None, TelemetryReader(tmp_path))

    def show(state=None, **fields):
        here = {"pid": os.getpid(), "time": time.time(), "over": False, "stop_file": str(tmp_path / "stop")}
        (tmp_path / STATE_FILE).write_text(json.dumps({**(state or {}), **here, **fields}))
        page.update()

    page.show_state = show
    return page


def test_without_a_session_it_says_so_and_offers_nothing(page, tmp_path):
    page.update()
    assert "no session yet" in page._headline.content
    assert all(button.disabled for button in (page._start, page._pause, page._send))
    (tmp_path / STATE_FILE).write_text("{")
    page.update()
    assert "cannot be read" in page._headline.content


def test_every_state_of_an_episode_can_be_shown(page, session):
    said = set()
    for state in session.states:
        page.show_state(state, over=state["over"])
        said.add(page._headline.content.split("<b>")[1].split("</b>")[0])
    # A twin that runs as fast as it can is seen in some of its phases only.
    assert sum(text.startswith(("left arm ", "right arm ")) for text in said) >= 3
    assert "session ended" in said
    assert session.states[-1]["armed"]
    assert "exact" in page._facts.content
    moving = next(state for state in session.states if state["plan"] and state["phase"])
    page.show_state(moving)
    first = moving["plan"][0]
    assert f"{('left', 'right')[first['arm']]} arm" in page._plan.content
    assert page.scene.model.cell.config.name == "paper"


def test_the_block_in_the_hand_stays_where_it_is_held(model, page, session):
    """Carried from a place to another it turns as the rule book says."""
    rules = Rules(model.cell, TaskConfig())
    height = model.cell.pick_height_mm
    random, tried = np.random.default_rng(0), 0
    for _ in range(300):
        arm = int(random.integers(2))
        pose, place = np.array([*random.uniform(-150, 150, 2), random.uniform(-3, 3)]), random.uniform(-150, 150, 2)
        placed, feasible = rules.transfer(pose, np.zeros(3), Command(np.bool_(False), np.int64(arm), place))
        if not feasible:
            continue
        tried += 1
        base = model.cell.bases[arm]
        T_world_base = flat_pose(base.x_mm, base.y_mm, base.facing_rad)
        for where, wanted in ((pose, pose), (placed, placed)):
            grip = np.linalg.inv(T_world_base) @ [where[0], where[1], height, 1.0]
            joints = model.arm.ik(grip[:3])[0]
            np.testing.assert_allclose(T_world_base @ model.arm.fk(joints), _picking(model.cell, arm, where), atol=1e-6)
            arms = [{"holding": index == arm, "joints_rad": joints.tolist()} for index in range(2)]
            state = {"block": {"pose": pose.tolist()}, "arms": arms, "phase": "transfer", "doing": "moving"}
            np.testing.assert_allclose(page._block(model, state), flat_pose(*wanted), atol=1e-6)
    assert tried > 30


def test_buttons_follow_what_the_session_allows(page, session):
    state = session.states[len(session.states) // 2]
    page.show_state(state)
    assert all(button.disabled for button in (page._start, page._pause, page._send))
    assert "Watching only" in page._steering.content
    page.show_state(state, view_control=True, pausing=False)
    assert (page._start.disabled, page._pause.disabled, page._send.disabled) == (True, False, False)
    page.show_state(state, view_control=True, pausing=True)
    assert (page._start.disabled, page._pause.disabled) == (False, True)
    page.show_state(state, view_control=True, over=True)
    assert all(button.disabled for button in (page._start, page._pause, page._send))


def test_stop_latches_and_says_whether_anybody_obeyed(page, session, tmp_path, monkeypatch):
    page.show_state(session.states[-1])
    monkeypatch.setattr("marl_handover.viewer.live.ANSWER_S", 0.0)
    page.stop()
    latch = StopLatch(tmp_path / "stop")
    assert latch.is_set()
    assert latch.reason() == "STOP pressed in the browser"
    page.update()
    assert "CUT THE POWER" in page._stop_note.content
    latch.obeyed()
    page.update()
    assert "has stopped its arms" in page._stop_note.content


def test_what_a_session_says_is_text_and_no_page(page, session, tmp_path):
    evil = "<script>alert(1)</script>"
    page.show_state(session.states[-1], text=evil, policy=evil, faults={evil: 1}, doing=evil)
    (tmp_path / EVENTS_FILE).write_text(json.dumps({"t_s": 1.0, "event": "bad_reply", "text": evil}) + "\n")
    page.update()
    handles = (page._headline, page._facts, page._log, page._arms, page._plan, page._steering)
    assert any("&lt;script&gt;" in handle.content for handle in handles)
    assert not any("<script" in handle.content for handle in handles)


def test_a_folder_whose_reading_fails_is_told_and_the_page_stays(page, session, monkeypatch):
    page.show_state(session.states[-1])
    monkeypatch.setattr(page.feed, "read", lambda: [][0])
    page.update()
    assert "IndexError" in page._headline.content


def test_the_log_keeps_its_tail(page, session, tmp_path):
    page.show_state(session.states[-1])
    (tmp_path / EVENTS_FILE).write_text("".join(f'{{"t_s": {t}, "event": "resumed"}}\n' for t in range(100)))
    page.update()
    assert page._log.content.count("resumed") == 30
    assert page._log.content.index("99.00") < page._log.content.index("70.00"), "the newest first"


def test_a_page_opened_for_another_cell_shows_the_session_s(server, session, tmp_path):
    scene = CellScene(server, build_cell(cell_config("al5a")))
    page = LivePage(server, scene, TelemetryReader(session.folder))
    page.update()
    assert page.scene is not scene
    assert page.scene.model.cell.config.name == "paper"


@pytest.mark.parametrize(
    "fields",
    [
        {"arms": [{}]},
        {"arms": 5},
        {"plan": [{"pose": [1.0]}]},
        {"goal": [1.0]},
        {"block": {"pose": ["a", None, 1]}},
        {"latch": None},
        {"failures": None},
        {"control": {"number": "x"}, "view_control": True},
        {"cell": {"block": {}}, "session": "another"},
    ],
)
def test_a_state_that_cannot_be_shown_is_said_and_the_page_goes_on(page, session, tmp_path, fields):
    page.show_state(session.states[-1], over=False)
    assert page._failure.content == ""
    page.show_state({**session.states[-1], "doing": "stopped", "quiet_s": 0.0, **fields}, over=False)
    if "session" not in fields:
        assert "cannot be shown" in page._failure.content
    page.stop()
    assert StopLatch(tmp_path / "stop").is_set()
    page.show_state(session.states[-1])
    assert page._failure.content == ""


def test_events_without_sense_are_shown_as_they_are(page, session, tmp_path):
    page.show_state(session.states[-1])
    odd = [{"pose": [1.0]}, {"goal": []}, {"arm": 1.0}, {"t_s": True}, {"was": [1e14, 0, 0]}, {"pose": ["a", 1]}]
    (tmp_path / EVENTS_FILE).write_text("".join(json.dumps({"t_s": 1.0, "event": "seen"} | row) + "\n" for row in odd))
    page.update()
    assert page._failure.content == ""
    assert page._log.content.count("seen") == len(odd)
    assert "seen" in live_words.log([{"t_s": float("nan"), "event": "seen", "pose": [float("nan"), 1.0, 2.0]}])


def test_what_was_said_of_a_session_does_not_hold_for_the_next(page, session):
    state = session.states[-1]
    page.show_state(state)
    page._ask(SessionCommand.PAUSE)
    page.stop()
    page.update()
    assert "only be stopped" in page._steering.content
    assert "latched" in page._stop_note.content
    page.show_state(state, session="another", view_control=True)
    assert page._steering.content == ""
    assert page._stop_note.content == ""


def test_a_request_is_followed_until_the_session_has_taken_it(page, session, monkeypatch):
    state = {**session.states[-1], "view_control": True}
    earlier = {"number": 1, "command": "pause", "goal": None, "refused": None}
    page.show_state(state, control=earlier)
    page._ask(SessionCommand.START)
    page.update()
    assert "start: asked" in page._steering.content
    monkeypatch.setattr("marl_handover.viewer.live.MAX_AGE_S", 0.0)
    page.update()
    assert "start: the session has not taken it" in page._steering.content
    page.show_state(state, control={**earlier, "number": page._asked[0], "command": "start"})
    assert "start: done" in page._steering.content


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, "no port"),
        ({"armed": True}, "no port. Arms hold"),
        ({"latch": {"set": True, "reason": "x"}}, "no port. To allow motion, at the cell: marl-handover stop clear=true"),
        ({"armed": True, "latch": {"set": True}}, "no port. Arms hold. To allow motion, at the cell: marl-handover stop clear=true"),
    ],
)
@pytest.mark.parametrize("word", ["stopped", "failed"])
def test_what_is_said_of_arms_and_stop_at_the_end_is_so(word, fields, said):
    state = {"doing": word, "text": "no port", "over": True, "latch": {"set": False}} | fields
    assert f">{said}<" in live_words.headline(Reading(state, False, "", 0.0))


@pytest.mark.parametrize(
    ("number", "transfers", "ended", "over", "said"),
    [
        (-1, 0, 0, False, "none yet"),
        (0, 0, 0, False, "1, transfer 1"),
        (0, 3, 1, False, "1, ended; transfers: 3"),
        (1, 2, 1, False, "2, transfer 3"),
        (1, 2, 1, True, "2, ended; transfers: 2"),
    ],
)
def test_progress_counts_what_was_and_is(session, number, transfers, ended, over, said):
    totals = {"episodes": ended, "solved": 0, "transfers": transfers}
    state = session.states[-1] | {"episode": {"number": number, "transfers": transfers}, "totals": totals, "over": over}
    assert f">{said}<" in live_words.facts(state)


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({"doing": "paused"}, "paused"),
        ({"doing": "moving", "pausing": True}, "pauses before the next"),
        ({"doing": "stopped", "text": "fire", "latch": {"set": True, "reason": "fire"}}, "stop clear=true"),
        ({"doing": "failed", "text": "no port"}, "no port"),
        ({"doing": "looking", "quiet_s": 60.0}, "said nothing for 60 s"),
        ({"doing": "looking", "latch": {"set": True, "reason": "fire"}}, "STOP IS LATCHED"),
        ({"doing": "waiting: the marker is hidden"}, "hidden"),
    ],
)
def test_headlines(fields, word):
    state = {"doing": "", "text": "", "over": False, "quiet_s": 0.0, "pausing": False, "arms": [], "phase": ""} | fields
    assert word in live_words.headline(Reading(state, True, "", 0.0))
    assert "gone" in live_words.headline(Reading(state, False, "process 1 is gone", 9.0))


def test_hand_overs_to_come_name_any_of_the_arms():
    state = {
        "arms": [{"name": name} for name in ("north", "west", "east")],
        "plan": [{"arm": 2, "final": False, "pose": [1.0, 2.0, 0.5]}, {"arm": 1, "final": True, "pose": [3.0, 4.0, 0.0]}],
    }
    shown = live_words.plan(state)
    assert shown.index("east arm") < shown.index("hand-over") < shown.index("west arm") < shown.index("to the goal")
