"""What people may ask of a session: only fresh, well-formed commands to this session count, everything else is refused and said."""

from __future__ import annotations

import itertools
import json
import math
import os
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.control.remote_control import MAX_AGE_S, CommandQueue, ControlFolder, SessionCommand, control_name

SESSION = "abc"
LAID = itertools.count()


def far(goal):
    return "too far" if math.hypot(goal[0], goal[1]) > 300 else None


@pytest.fixture
def control(tmp_path):
    return ControlFolder(tmp_path, SESSION, far)


def command(number=1, command="pause", age_s=0.0, **fields):
    return {"session": SESSION, "number": number, "time": time.time() - age_s, "command": command, **fields}


def put(control, content):
    """As a page does it: a file for each, whole when it appears."""
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    path = control._folder / control_name(next(LAID))
    path.with_suffix(".new").write_bytes(text)
    path.with_suffix(".new").replace(path)


def test_good_commands_are_taken_once(control):
    command_queue = CommandQueue()
    assert control.poll() is None
    for number, (word, paused) in enumerate([("pause", True), ("resume", False), ("pause", True), ("start", False)], 1):
        put(control, command(number, word))
        command_queue.take(control.poll())
        assert command_queue.paused is paused
        assert control.poll() is None, "what was taken is gone"
    put(control, command(5, "goal", goal=[10.0, -20.0, 0.5]))
    command_queue.take(control.poll())
    np.testing.assert_array_equal(command_queue.goal, [10.0, -20.0, 0.5])
    assert [answer.number for answer in command_queue.responses()] == [1, 2, 3, 4, 5]
    assert command_queue.responses() == []


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (dict(session="other"), "another session"),
        ({"age_s": 3600}, "older than this session"),
        (dict(time=None), "when it was given"),
        (dict(time=float("nan")), "when it was given"),
        (dict(time=True), "when it was given"),
        ({"age_s": -3600}, "future"),
        (dict(number=1.5), "needs a number"),
        (dict(number=True), "needs a number"),
        (dict(command="park"), "one of: start, pause, resume, goal"),
        (dict(command="stop"), "one of"),
        (dict(command=["pause"]), "one of"),
        (dict(command="goal"), "x_mm, y_mm, theta_rad"),
        (dict(command="goal", goal=[1, 2]), "x_mm, y_mm, theta_rad"),
        (dict(command="goal", goal=[1, 2, float("inf")]), "x_mm, y_mm, theta_rad"),
        (dict(command="goal", goal=[1, 2, 10**400]), "401 digits"),
        (dict(command="goal", goal=[400, 0, 0]), "too far"),
        ([], "needs a number"),
        (b"{", "cannot be read"),
        (b"\xff\x00", "cannot be read"),
        (b"", "cannot be read"),
        (b"[" * 4000, "cannot be read"),
    ],
)
def test_what_is_refused_says_why_and_changes_nothing(control, content, word):
    command_queue = CommandQueue()
    put(control, command(**content) if isinstance(content, dict) else content)
    answer = control.poll()
    assert word in answer.refused
    command_queue.take(answer)
    assert not command_queue.paused
    assert command_queue.goal is None


def test_a_command_that_lay_too_long_is_refused(control):
    control._began_s -= 60
    put(control, command(age_s=MAX_AGE_S + 1))
    assert "s old" in control.poll().refused


def test_a_number_is_taken_once_and_never_an_earlier_one(control):
    put(control, command(7))
    assert control.poll().refused is None
    for number in (7, 6):
        put(control, command(number, "resume"))
        assert "later command" in control.poll().refused


def test_commands_given_between_two_looks_are_all_taken_in_their_order(control):
    for number, word in enumerate(("pause", "goal", "start"), 1):
        put(control, command(number, word, goal=[1.0, 2.0, 3.0]))
    assert [control.poll().command for _ in range(3)] == ["pause", "goal", "start"]
    assert control.poll() is None
    assert list(control._folder.iterdir()) == []


def test_what_cannot_be_removed_is_read_once(control):
    (control._folder / control_name(3)).mkdir()
    assert "it is a folder, not a regular file" in control.poll().refused
    assert control.poll() is None
    put(control, command(9))
    assert control.poll().refused is None


def test_a_file_of_somebody_else_is_refused(control, monkeypatch):
    put(control, command())
    monkeypatch.setattr("os.geteuid", lambda: 12345)
    assert "another user" in control.poll().refused


def test_a_pipe_in_place_of_the_file_is_refused_at_once(control):
    os.mkfifo(control._folder / control_name(1))
    assert "it is a FIFO, not a regular file" in control.poll().refused


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)


@given(
    fields=st.fixed_dictionaries(
        {},
        optional={
            "session": st.sampled_from([SESSION, ""]) | json_values,
            "number": json_values,
            "time": json_values,
            "command": st.sampled_from(list(SessionCommand)) | json_values,
            "goal": json_values,
        },
    )
    | json_values
)
def test_whatever_json_says_nothing_is_raised_and_only_a_fresh_command_is_taken(tmp_path_factory, fields):
    control = ControlFolder(tmp_path_factory.getbasetemp(), SESSION, far)
    put(control, fields)
    answer = control.poll()
    assert answer.refused is not None, "no drawn time is of now"


@given(content=st.binary(max_size=200))
def test_whatever_bytes_say_nothing_is_raised(tmp_path_factory, content):
    control = ControlFolder(tmp_path_factory.getbasetemp(), SESSION, far)
    put(control, content)
    assert control.poll().refused is not None


def test_whoever_waits_obeys_meanwhile_and_goes_on_when_told():
    command_queue, obeyed = CommandQueue(paused=True), []
    other = threading.Timer(0.1, lambda: command_queue.take(control_answer("start")))
    other.start()
    command_queue.wait(lambda: obeyed.append(1))
    assert obeyed
    assert not command_queue.paused
    command_queue.wait(lambda: pytest.fail("it is not paused"))


def test_whoever_waits_can_be_stopped():
    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        CommandQueue(paused=True).wait(stop)


def control_answer(word):
    from marl_handover.control.remote_control import Response

    return Response(1, word, None, None)
