"""``simulate``: an episode is played, printed and filmed; bad input is one clear error."""

import imageio.v2 as imageio
import pytest

from marl_handover.commands.simulate import ALIASES, GROUPS, SCHEMA, run
from marl_handover.compose import compose
from marl_handover.errors import HandoverError


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


@pytest.mark.parametrize(
    ("argument", "says"),
    [
        ("video=a.avi", ".mp4 or .gif"),
        ("video=/no/such/folder/a.mp4", "/no/such/folder"),
        ("size=[3,4]", "size"),
        ("grasp=glue", "glue"),
        ("view=side", "side"),
        ("start=[0,0]", "start"),
        ("start=[900,0,0]", "reach"),
        ("episodes=0", "episodes"),
        ("gui=true", "display"),
    ],
)
def test_bad_input_is_named(argument, says, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(HandoverError, match=says):
        simulate(argument, "progress=false")
