"""``marl-handover view``: modes, bad input, and a page that ends well on Ctrl-C."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys

import pytest

pytest.importorskip("viser", reason="the view extra is not installed")

from marl_handover import cli
from marl_handover.commands.view import ViewCommand, _trace, mode_of
from marl_handover.errors import HandoverError
from marl_handover.viewer.server import open_server


@pytest.mark.parametrize(
    ("settings", "mode"),
    [
        ({}, "play"),
        ({"trace": "t.jsonl"}, "trace"),
        ({"live": "folder"}, "live"),
        ({"mode": "play"}, "play"),
        ({"mode": "trace", "trace": "t.jsonl"}, "trace"),
    ],
)
def test_the_mode_follows_from_what_is_given(settings, mode):
    assert mode_of(ViewCommand(**settings)) == mode


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"mode": "fly"}, "play, trace, live"),
        ({"mode": "trace"}, "trace=FILE"),
        ({"mode": "live"}, "live=FOLDER"),
        ({"mode": "play", "trace": "t.jsonl"}, "mode"),
        ({"trace": "t.jsonl", "live": "folder"}, "one of them"),
    ],
)
def test_modes_that_do_not_fit_what_is_given_are_refused(settings, words):
    with pytest.raises(HandoverError, match=words):
        mode_of(ViewCommand(**settings))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["port=70000"], "port"),
        (["port=-1"], "port"),
        (["speed=0"], "speed"),
        (["speed=19"], "speed"),
        (["seed=-1"], "seed"),
        (["policy=nonsense"], "nonsense"),
        (["host=0.0.0.0"], "unknown key"),
        (["trace=/nowhere/t.jsonl"], "not found"),
        (["live=/nowhere"], "not found"),
        (["motion.grasp_s=0"], "motion.grasp_s"),
        (["policy=pretrained_a", "architecture=B"], "architecture"),
        (["trace=/nowhere/t.jsonl", "policy=nonsense"], "policy"),
        (["trace=/nowhere/t.jsonl", "seed=4"], "seed"),
        (["live=/nowhere", "policy=pretrained_b"], "policy"),
        (["live=/nowhere", "seed=4"], "seed"),
        (["live=/nowhere", "speed=2"], "speed"),
        (["live=/nowhere", "epsilon_deg=3"], "task.epsilon_deg"),
        (["live=/nowhere", "motion.grasp_s=0.7"], "motion.grasp_s"),
        (["live=/nowhere", "task.noise.position_mm=0.5"], "task.noise.position_mm"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, words, capsys):
    assert cli.main(["view", "port=0", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error


def test_a_bad_line_of_a_trace_is_named(tmp_path, capsys):
    path = tmp_path / "t.jsonl"
    path.write_text("{}\n")
    assert cli.main(["view", "port=0", f"trace={path}"]) == 2
    assert "line 1" in capsys.readouterr().err


def test_a_trace_is_not_played_faster_or_slower_than_its_slider_goes(tmp_path, capsys):
    (tmp_path / "t.jsonl").write_text("{}\n")
    assert cli.main(["view", "port=0", "speed=21", f"trace={tmp_path / 't.jsonl'}"]) == 2
    assert "speed" in capsys.readouterr().err


def test_a_trace_is_told_by_the_symmetry_that_it_says(tmp_path, capsys):
    path = tmp_path / "t.jsonl"
    done = ["evaluate", "policy=exact", "episodes=2", "task.symmetry_order=4", f"trace={path}", "progress=false"]
    assert cli.main(done) == 0
    with open_server(0, "test") as server, _trace(ViewCommand(trace=str(path)), server) as page:
        page.update(0.0)
        assert page.update.__self__.rules.config.symmetry_order == 4
    assert cli.main(["view", "port=0", f"trace={path}", "task.symmetry_order=2"]) == 2
    assert "task.symmetry_order = 2: must be 4, as the trace says" in capsys.readouterr().err


def test_a_port_that_is_taken_is_one_line_with_the_way_out(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert cli.main(["view", f"port={taken.getsockname()[1]}"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "port=0" in error


def test_without_viser_the_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in [name for name in sys.modules if name.startswith("marl_handover.viewer")]:
        monkeypatch.delitem(sys.modules, name)
    assert cli.main(["view", "port=0"]) == 2
    assert "pip install 'viser>=" in capsys.readouterr().err


def test_ctrl_c_ends_the_page_without_a_complaint():
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "marl_handover.cli", "view", "port=0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        line = process.stdout.readline()
        match = re.search(r"http://127\.0\.0\.1:(\d+)", line)
        with socket.create_connection(("127.0.0.1", int(match[1])), timeout=5):
            pass
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=30)
    assert (error, out, process.returncode) == ("", "closed\n", 0)
