"""A pause holds the arms at every moment at which one could set out, and what happened meanwhile is seen before one does."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.arrays import wrap
from marl_handover.control.closed_loop import make_loop
from marl_handover.control.events import Event
from marl_handover.control.remote_control import CommandQueue, Response
from marl_handover.control.session import GivenGoal, Session
from marl_handover.control.settings import twin_workcell

START, PLACE_MM, ELSEWHERE = np.array([-60.0, 20.0, 0.7]), np.array([50.0, 25.0]), np.array([-70.0, -15.0, 0.2])


@pytest.fixture
def workcell(twin_calibration, tmp_path):
    config = twin_workcell()
    config.calibration, config.hardware.stop_file = str(twin_calibration), str(tmp_path / "stop")
    command_queue, rows = CommandQueue(), []
    with make_loop(policies.adapted("exact"), "hardware", config=config) as loop:
        loop.backend.log.show(rows.append)
        session = Session(loop, {}, command_queue)
        cell = loop.rules.cell
        turn = cell.polar(PLACE_MM)[1][0] - cell.polar(START[:2])[1][0]
        goal = np.array([*PLACE_MM, float(wrap(START[2] + turn))])
        yield SimpleNamespace(
            session=session, command_queue=command_queue, rows=rows, loop=loop, goal=goal, twin=loop.backend.workcell.twin
        )


def say(workcell, word, goal=None):
    workcell.command_queue.take(Response(1, word, goal, None))


def kinds(workcell):
    return [row["event"] for row in workcell.rows]


def while_paused(workcell, act):
    """Do ``act`` in the pause that the first decision falls into, then go on."""
    decide, done = workcell.loop.policy.act, []

    def pausing(*problem):
        if not done:
            done.append(1)
            say(workcell, "pause")
        return decide(*problem)

    workcell.loop.policy.act = pausing

    def person():
        while Event.PAUSED not in kinds(workcell):
            time.sleep(0.01)
        act()
        say(workcell, "resume")

    thread = threading.Thread(target=person)
    thread.start()
    episode = workcell.session.play(START, GivenGoal(workcell.goal))
    thread.join()
    return episode


def test_a_pause_after_the_decision_holds_the_arm_and_then_the_order_stands(workcell):
    episode = while_paused(workcell, lambda: None)
    assert episode.solved
    assert len(episode.transfers) == 1
    seen = kinds(workcell)
    assert seen.index("paused") < seen.index("resumed") < seen.index("motion")


def test_a_block_moved_in_a_pause_is_looked_for_before_an_arm_sets_out(workcell):
    episode = while_paused(workcell, lambda: workcell.twin.set_object_pose(ELSEWHERE))
    assert episode.solved
    seen = kinds(workcell)
    assert seen.index("resumed") < seen.index("block_moved") < seen.index("motion")
    first = episode.transfers[0].result
    assert first.refusal == "missed_grasp"
    np.testing.assert_allclose(first.pose[:2], ELSEWHERE[:2], atol=3.0)


def test_a_goal_from_the_page_holds_for_the_episode(workcell):
    say(workcell, "goal", workcell.goal.tolist())
    episode = workcell.session.play(START, GivenGoal([-100.0, 50.0, 0.0]))
    assert episode.solved
    np.testing.assert_allclose(episode.goal, workcell.goal)
    assert workcell.command_queue.goal is None
    assert [row["command"] for row in workcell.rows if row["event"] == "control"] == ["goal"]
