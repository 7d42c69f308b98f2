from __future__ import annotations

import numpy as np
import pytest
from viewer_client import Client

from marl_handover.viewer.server import address
from marl_handover.viewer.trace import TracePage
from marl_handover.viewer.trace_file import Step, Trace

FRAME_S = 0.02


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
        seen = set()
        for _ in range(20_000):
            page.update(0.1)
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
