from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from viewer_client import Client

from marl_handover import policies
from marl_handover.config import MotionConfig, NoiseConfig
from marl_handover.control.closed_loop import ClosedLoop
from marl_handover.control.transfers import transfer_row
from marl_handover.envs.backends import NoisyBackend
from marl_handover.learning.evaluation import random_problems
from marl_handover.motion.planner import MotionPlanner
from marl_handover.viewer.server import address
from marl_handover.viewer.trace import TracePage, moment_words
from marl_handover.viewer.trace_file import Step, Trace, read_trace

FRAME_S = 0.02


class Nobody(policies.SupervisorPolicy):
    """Wants no arm to move."""

    def __init__(self, rules):
        super().__init__(rules, "nobody")

    def act(self, pose, goal, previous_arm):
        return np.full(4, np.nan)


def steps_of(model, lengths, seed=0):
    """Made-up transfers by turns of the arms, of places that both reach, and where the episodes begin."""
    random = np.random.default_rng(seed)
    steps, starts = [], [0]
    for length in lengths:
        goal = np.array([*model.cell.chart.to_table(*random.uniform(-0.9, 0.9, 2)), 1.0])
        here = np.array([*model.cell.chart.to_table(*random.uniform(-0.9, 0.9, 2)), 0.3])
        for number in range(length):
            last = number == length - 1
            there = np.array([*(goal[:2] if last else model.cell.chart.to_table(*random.uniform(-0.9, 0.9, 2))), 0.5])
            steps.append(Step(here, goal, number % 2, last, there[:2], there, "success" if last else "", 0.087, ""))
            here = there
        starts.append(len(steps))
    return Trace(steps, starts, list(range(len(lengths))), None)


@pytest.fixture
def page(server, model):
    page = TracePage(server, model, steps_of(model, [3, 1, 2]), speed=20.0)
    yield page
    page.close()


def shown(server):
    return 1e3 * np.asarray(server.scene.get_handle_by_name("/block").position)


def test_every_moment_shows_the_block_where_it_lay_then(server, page):
    trace = page.trace
    for number in range(trace.moments):
        page.want(number)
        page.update(FRAME_S)
        moment = trace.moment(number)
        first = trace.steps[moment.first]
        expected = first.state if moment.done == 0 else trace.steps[moment.first + moment.done - 1].next_state
        np.testing.assert_allclose(shown(server)[:2], expected[:2])
        np.testing.assert_allclose(1e3 * server.scene.get_handle_by_name("/goal").position[:2], first.goal[:2])


def test_scrubbing_past_either_end_stays_there(server, page):
    for wanted, expected in ((-5, page.trace.steps[0].state), (99, page.trace.steps[-1].next_state)):
        page.want(wanted)
        page.update(FRAME_S)
        np.testing.assert_allclose(shown(server)[:2], expected[:2])


def test_a_viewer_plays_the_trace_to_its_end_and_jumps_to_an_episode(server, page):
    with Client(address(server)) as viewer:
        viewer.wait(lambda: len(server.get_clients()) == 1, 10)
        viewer.set("play", True)
        viewer.wait(lambda: page._playing, 10)
        seen = set()
        for _ in range(2_000):
            page.update(0.1)
            if page._moving is not None:
                page._moving.result(60)  # planned in another thread, for which the page does not wait but this test must
            seen.add(tuple(np.round(shown(server)[:2], 3)))
            if page._number == page.trace.moments - 1 and page._play.label == "play":
                break
        assert page._number == page.trace.moments - 1
        for step in page.trace.steps:
            assert tuple(np.round(step.next_state[:2], 3)) in seen
        viewer.set("episode", 1)
        viewer.wait(lambda: page._wanted == page.trace.start_of(1), 10)
        page.update(FRAME_S)
        viewer.wait(lambda: "Episode 1" in viewer.text() and "transfer **0 of 1**" in viewer.text(), 10)
        slider = viewer.input("moment")
        viewer.wait(lambda: viewer.panel[slider]["value"] == page.trace.start_of(1), 10)


def test_what_a_file_says_is_text_and_no_page(server, model, tmp_path):
    made = steps_of(model, [1])
    evil = made.steps[0]._replace(trouble="<script>alert(1)</script> <img src=x onerror=alert(1)> ![x](http://somewhere/x.png)")
    page = TracePage(server, model, Trace([evil], [0, 1], [0], None))
    try:
        page.want(1)
        page.update(FRAME_S)
        assert "alert" in page._text.content
        assert not any(sign in page._text.content for sign in ("<script", "<img", "!["))
    finally:
        page.close()


@pytest.mark.parametrize("nobody", [True, False])
def test_a_session_that_ends_as_nobody_is_to_move_is_not_told_to_have_had_too_many_transfers(model, rules_of, paper, nobody, tmp_path):
    """The entry is the loop's own; the other one is refused as an arm declines the last transfer there is time for."""
    rules = rules_of(paper)
    start, goal = (poses[0] for poses in random_problems(rules, 1, 5))
    backend = NoisyBackend(model, MotionConfig(), noise=NoiseConfig(), missed_grasps=0.0)
    [transfer] = ClosedLoop(Nobody(rules), MotionPlanner(model), backend).play(start, goal).transfers
    if not nobody:
        transfer = replace(transfer, command=transfer.command._replace(place_mm=goal[:2]))
    file = tmp_path / "trace.jsonl"
    file.write_text(json.dumps({"episode": 0, "step": 0, **transfer_row(transfer, rules)}) + "\n")
    trace = read_trace(file)
    text = moment_words(rules, trace, trace.moment(1), trace.steps)
    assert ("no arm to move**" in text) == nobody
    assert ("too many transfers" in text) == (not nobody)


def test_a_scrub_is_as_cheap_in_a_long_trace_as_in_a_short_one(server, model):
    buffer = server._websock_server.get_message_buffer()
    page = TracePage(server, model, steps_of(model, [4] * 2500))
    try:
        sent = []
        for number in (1, 6, 12_000, 7, 11_999, 8):
            before = buffer.message_counter
            page.want(number)
            page.update(FRAME_S)
            sent.append(buffer.message_counter - before)
        assert max(sent[1:]) < 60  # the first one made the ghosts
    finally:
        page.close()
