"""``simulate``: an episode is played, printed and filmed; bad input is one clear error."""

import subprocess
import sys

import imageio.v2 as imageio
import pytest

from marl_handover.commands.simulate import ALIASES, GROUPS, SCHEMA, run
from marl_handover.compose import compose
from marl_handover.errors import HandoverError, MissingFile


def simulate(*arguments):
    return run(compose(SCHEMA, list(arguments), groups=GROUPS, aliases=ALIASES))


def test_an_episode_is_played_and_filmed(tmp_path, capsys):
    video = tmp_path / "a.gif"
    # One arm reaches both places, and the goal is turned by what that transfer turns the block: one transfer.
    arguments = ["start=[60,-10,0]", "goal=[-60,-10,-35.1]", f"video={video}", "fps=2", "size=[64,36]", "grasp=constraint"]
    assert simulate(*arguments, "progress=false") == 0
    out = capsys.readouterr().out
    assert "success after" in out
    assert "1 of 1 episodes reached the goal" in out
    assert len(list(imageio.get_reader(video))) > 5
    # Words and colours are for the eye alone: what happens is the same without them.
    assert simulate(*arguments, "progress=false", "captions=false") == 0
    assert [line.split(";")[:2] for line in capsys.readouterr().out.splitlines()[:3]] == [
        line.split(";")[:2] for line in out.splitlines()[:3]
    ]


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
    [("goal=[500,0,0]", 2, "goal (500, 0) mm"), ("motion.arm_clearance_mm=300", 1, "did not reach the goal")],
)
def test_an_error_is_one_line(argument, status, says):
    """Neither PyBullet's greeting, which C code prints, nor the rest of a bar."""
    command = [sys.executable, "-m", "marl_handover.cli", "simulate", argument]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == status
    assert done.stderr.startswith("marl-handover simulate: ")
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert "pybullet" not in done.stdout
