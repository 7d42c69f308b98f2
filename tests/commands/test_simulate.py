"""``simulate``: an episode is played, printed and filmed; bad input is one clear error."""

import contextlib
import itertools
import math
import re
import subprocess
import sys

import imageio.v2 as imageio
import numpy as np
import pytest

from marl_handover.commands.simulate import ALIASES, GROUPS, SCHEMA, run
from marl_handover.compose import compose
from marl_handover.errors import HandoverError, MissingFile, WorkFailed
from marl_handover.simulation import film
from marl_handover.simulation.backend import PhysicsBackend


def simulate(*arguments):
    return run(compose(SCHEMA, list(arguments), groups=GROUPS, aliases=ALIASES))


def test_an_episode_is_played_and_filmed(tmp_path, capsys, engine):
    video = tmp_path / "a.gif"
    # One arm reaches both places, and the goal is turned by what that transfer turns the block: one transfer.
    arguments = [
        "start=[60,-10,0]",
        "goal=[-60,-10,-35.1]",
        f"video={video}",
        "fps=2",
        "size=[64,36]",
        "grasp=constraint",
        f"engine={engine}",
    ]
    assert simulate(*arguments, "progress=false") == 0
    out = capsys.readouterr().out
    assert "success after" in out
    assert "1 of 1 episode reached the goal" in out
    assert len(list(imageio.get_reader(video))) > 5
    # Words and colours are for the eye alone: what happens is the same without them.
    assert simulate(*arguments, "progress=false", "captions=false") == 0
    assert [line.split(";")[:2] for line in capsys.readouterr().out.splitlines()[:3]] == [
        line.split(";")[:2] for line in out.splitlines()[:3]
    ]


def test_three_arms_are_filmed_with_words_and_colours(tmp_path, capsys, engine):
    video = tmp_path / "three.gif"
    more = [f"video={video}", "fps=2", "size=[64,48]", f"engine={engine}", "progress=false"]
    assert simulate("cell=triangle", "start=[-250,100,0]", "goal=[250,100,90]", *more) == 0
    out = capsys.readouterr().out
    assert "1 of 1 episode reached the goal" in out
    assert any(name in out for name in ("north to", "west to", "east to"))
    assert len(list(imageio.get_reader(video))) > 5


@pytest.mark.parametrize(
    ("argument", "says"),
    [
        ("video=a.avi", ".mp4 or .gif"),
        ("video=/no/such/folder/a.mp4", "/no/such/folder"),
        ("size=[3,4]", "size"),
        ("size=[640,24]", "room for the words below the picture; or captions=false"),
        ("grasp=glue", "glue"),
        ("view=side", "side"),
        ("start=[0,0]", "start"),
        ("start=[900,0,0]", "start.*reach"),
        ("goal=[500,0,0]", "goal.*reach"),
        ("start=[nan,0,0]", "start.*finite"),
        ("goal=[0,inf,0]", "goal.*finite"),
        ("task.noise.position_mm=2", "task.noise"),
        ("motion.lift_mm=-5", "motion.lift_mm"),
        ("episodes=0", "episodes"),
        ("gui=true", "display"),
    ],
)
def test_bad_input_is_named(argument, says, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(HandoverError, match=says):
        simulate(argument, "progress=false")


def test_a_videos_folder_is_not_made(tmp_path):
    with pytest.raises(MissingFile, match="make it first"):
        simulate(f"video={tmp_path / 'new' / 'a.mp4'}")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("argument", "status", "says"),
    [("goal=[500,0,0]", 2, "goal (500, 0) mm"), ("task.max_steps=1", 1, "did not reach the goal")],
)
def test_an_error_is_one_line(argument, status, says):
    """Without PyBullet's greeting, which C code prints."""
    command = [sys.executable, "-m", "marl_handover.cli", "simulate", argument, "progress=false"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == status
    assert done.stderr.startswith("marl-handover simulate: ")
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert "pybullet" not in done.stdout


@pytest.fixture
def said(monkeypatch):
    """What is said below each picture that is drawn, and where the block is then: pairs, in order."""
    pairs, draw, render = [], film.captioned, PhysicsBackend.render
    poses = []

    def rendered(backend):
        poses.append(backend.cell.object_pose())
        return render(backend)

    def drawn(picture, caption, size):
        pairs.append((caption, poses[-1]))
        return draw(picture, caption, size)

    monkeypatch.setattr(PhysicsBackend, "render", rendered)
    monkeypatch.setattr(film, "captioned", drawn)
    return pairs


@pytest.mark.parametrize(("settings", "outcome"), [(["task.symmetry_order=2"], "success"), (["max_steps=1"], "timeout")])
def test_a_film_says_what_happens(tmp_path, capsys, said, settings, outcome):
    goal, order = np.array([60.0, 0.0, math.radians(-150)]), 2 if outcome == "success" else 1
    problem = ["start=[-120,60,0]", "goal=[60,0,-150]", "grasp=constraint", "episodes=2", "progress=false", *settings]
    with contextlib.nullcontext() if outcome == "success" else pytest.raises(WorkFailed):
        simulate(*problem, f"video={tmp_path / 'a.gif'}", "fps=2", "size=[64,36]")
    # As it is printed: for each episode its transfers, as arm and place, then how it ended.
    printed = capsys.readouterr().out
    transfers = re.findall(r"^  ([LR]) to \((-?[\d.]+) mm, (-?[\d.]+) mm\)", printed, re.MULTILINE)
    ends = re.findall(r"^(\w+) after (\d+) transfers?\b", printed, re.MULTILINE)
    assert {end[0] for end in ends} == {outcome}
    begins = [number for number, (caption, _) in enumerate(said) if caption.arm < 0]
    assert len(begins) == len(ends) == 2
    expected = []
    for _, count in ends:
        deeds, transfers = transfers[: int(count)], transfers[int(count) :]
        expected.append((0, -1, False))
        for number, (arm, *place) in enumerate(deeds, start=1):
            expected.append((number, "LR".index(arm), np.allclose(np.array(place, float), goal[:2], atol=0.1)))
    told = [(caption.transfer, caption.arm, caption.final) for caption, _ in said]
    assert [deed for deed, _ in itertools.groupby(told)] == expected
    last = {begins[1] - 1, len(said) - 1}
    for number, (caption, pose) in enumerate(said):
        assert caption.outcome == (outcome if number in last else "")
        assert caption.away_mm == pytest.approx(math.hypot(*(pose[:2] - goal[:2])))
        assert abs(caption.turned_rad) <= math.pi / order + 1e-9
        turned_rad = pose[2] - goal[2]
        assert math.remainder(caption.turned_rad - turned_rad, 2 * math.pi / order) == pytest.approx(0, abs=1e-6)  # goals are float32
    if outcome == "success":
        assert max(said[number][0].away_mm for number in last) < 5 < said[0][0].away_mm
