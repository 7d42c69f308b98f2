"""Pausing and stopping, and changes from several threads."""

from __future__ import annotations

import math
import sys
import threading

import numpy as np
import pytest
from interactive_fuzz import (
    DT_S,
    make,
    place,
    settle,
    some_pose,
    until,
)

from marl_handover import policies


@pytest.fixture
def cell(model):
    return make(model)


def test_a_stop_freezes_everything_until_it_is_cleared(cell):
    until(cell, "transfer", steps=5)
    cell.stop()
    frozen = cell.advance(DT_S)
    cell.resume()
    assert not cell.set_goal(place(cell, 190.0, 0.0))
    for _ in range(20):
        later = cell.advance(DT_S)
        assert later.state == "stopped"
        assert later.t_s == frozen.t_s
        assert all(np.array_equal(getattr(later, name), getattr(frozen, name)) for name in ("joints_rad", "T_world_block", "goal"))
    cell.clear()
    assert cell.advance(DT_S).state == "paused"
    assert cell.advance(DT_S).t_s == frozen.t_s
    cell.resume()
    later = cell.advance(DT_S)
    assert later.t_s > frozen.t_s
    assert np.array_equal(later.goal, frozen.goal)
    assert settle(cell)[-1].state == "done"


WISHES = {
    "goal": lambda cell: cell.set_goal(place(cell, 190.0, 0.0)),
    "block": lambda cell: cell.set_block(place(cell, 190.0, 0.0, arm=1)),
    "problem": lambda cell: cell.new_problem(),
    "policy": lambda cell: cell.set_policy(policies.load("random")),
}


@pytest.mark.parametrize("late", [False, True], ids=["before the stop", "after it"])
@pytest.mark.parametrize("wish", WISHES.values(), ids=WISHES)
def test_nothing_asked_for_before_a_stop_is_cleared_is_done_after_it(cell, wish, late):
    until(cell, "approach", steps=5)
    frozen = cell.advance(0.0)
    adapter = cell._controller.adapter
    if not late:
        assert wish(cell)
    cell.stop()
    assert not wish(cell)
    cell.clear()
    later = cell.advance(DT_S)
    assert later.state == "paused"
    assert all(np.array_equal(getattr(later, name), getattr(frozen, name)) for name in ("joints_rad", "T_world_block", "goal", "message"))
    assert cell._controller.adapter is adapter
    assert wish(cell)


def test_while_paused_time_stands_still_but_changes_are_taken_up(cell):
    before = until(cell, "approach", steps=10)
    cell.pause()
    cell.set_goal(goal := place(cell, 190.0, 20.0))
    after = cell.advance(DT_S)
    assert after.state == "paused"
    assert after.t_s == before.t_s
    assert np.array_equal(after.joints_rad, before.joints_rad)
    assert np.allclose(after.goal, goal)
    cell.resume()
    cell.advance(DT_S)
    assert math.isnan(cell.last_replan_ms)
    assert settle(cell)[-1].state == "done"


def test_threads_that_advance_it_take_turns(cell):
    """A thread that looks on while another one plays; switched between as often as can be."""
    errors, until_s, usual = [], 120.0, sys.getswitchinterval()

    def go():
        try:
            while (seen := cell.advance(DT_S)).t_s < until_s:
                if seen.state in ("done", "stuck"):
                    cell.new_problem()
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=go) for _ in range(2)]
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(usual)
    assert errors == []


def test_threads_may_change_everything_at_any_time(cell):
    """The last word of every thread counts, whoever had it; and when they are silent the block comes to the goal."""
    errors, said = [], {}

    def student(number):
        random = np.random.default_rng(number)
        try:
            for _ in range(60):
                said[number] = some_pose(cell.model.cell, random)
                (cell.set_goal if number < 2 else cell.set_block)(said[number])
                if number == 3:
                    cell.pause()
                    cell.resume()
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=student, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        cell.advance(DT_S)
    last = settle(cell)[-1]
    assert not errors
    assert last.state == "done"
    assert any(np.allclose(last.goal, said[number]) for number in (0, 1))


def test_after_a_stop_from_another_thread_nothing_moves(cell):
    until(cell, "approach", steps=3)
    going = threading.Event()
    seen = []

    def page():
        while not going.is_set():
            seen.append(cell.advance(DT_S))

    thread = threading.Thread(target=page)
    thread.start()
    while len(seen) < 5:
        pass
    cell.stop()
    here = cell._controller.world.joints_rad.copy()
    count = len(seen)
    while len(seen) < count + 20:
        pass
    going.set()
    thread.join()
    assert all(np.array_equal(it.joints_rad, here) for it in seen[count + 1 :])
