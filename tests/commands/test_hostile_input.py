"""Settings and files that nobody means: exit 2 and one short line, before any work. The fuzz finds more; these were faults."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from marl_handover import cli
from marl_handover.files import resource_path

URDF = Path(resource_path("urdf/al5a.urdf")).read_text()
STEP = {"episode": 0, "step": 0, "state": [-120, -60, 0], "goal": [150, 60, 1], "arm": "L", "final": False, "place": [-44, 0]}
LINE = json.dumps({**STEP, "next_state": [-44, 0, 0], "outcome": None, "epsilon_rad": 0.08, "refusal": None})
LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 9)}]\n" for i in range(9))
FILES = {
    "laughs.yaml": LAUGHS,
    "loop.yaml": "a: &a\n  b: *a\n",
    "deep.jsonl": "[" * 100_000,
    "deep.json": "[" * 100_000,
    "digits.jsonl": LINE.replace('"episode": 0', '"episode": 1' + "0" * 400),
    "order.jsonl": LINE[:-1] + ', "symmetry_order": 1' + "0" * 30 + "}",
    "bare.urdf": re.sub(r"(?s)<collision>.*?</collision>", "", URDF),
    "huge.urdf": URDF.replace("0.106", "1e300"),
    "far.urdf": URDF.replace("0.106", "1000"),
    "links.urdf": URDF.replace("</robot>", "".join(f'<link name="x{i}"/>' for i in range(2000)) + "</robot>"),
    "mesh.urdf": URDF.replace("<visual>", "<visual><geometry><mesh filename='/etc/passwd'/></geometry></visual><visual>", 1),
    "still.urdf": re.sub(r'velocity="[^"]*"', 'velocity="0"', URDF),
}
TUNE = ["tune", "algorithm=td3", "trials=1", "jobs=1", "out=t", "steps=64", "compile=off", "progress=false"]
LINES = [
    (["plan", "seed=" + "1" * 4000], "a number of 4000 digits"),
    (["plan", "seed=" + "1" * 50_000], "has 50005 characters"),
    (["plan", "start=" + "[" * 2000 + "]" * 2000], "nest deeper"),
    (["plan", "goal={" + "a:{" * 60 + "}" * 61], "nest deeper"),
    (["plan", "cell.grid_mm=0.0001"], "cell.grid_mm = 0.0001"),
    (["plan", "cell.urdf=huge.urdf"], "no number may be beyond"),
    (["plan", "cell.urdf=far.urdf"], "grid_mm"),
    (["plan", "cell.urdf=bare.urdf", "motion=m.json"], "collision shape"),
    (["workspace", "cell.urdf=links.urdf"], "links and joints"),
    (["workspace", "cell.urdf=still.urdf"], "velocity 0"),
    (["workspace", "cell=laughs.yaml"], "aliases"),
    (["workspace", "cell=loop.yaml"], "contains itself"),
    (["compare", "suite=./laughs.yaml", "out=o"], "aliases"),
    (["evaluate", "episodes=1e12"], "episodes = 1000000000000"),
    (["evaluate", "policy=" + "shielded:" * 400 + "exact"], "shielded once"),
    (["evaluate", "problems=deep.jsonl"], "line 1"),
    (["plot", "kind=errors", "trace=deep.jsonl", "out=p.png"], "line 1"),
    (["plot", "kind=errors", "trace=digits.jsonl", "out=p.png"], "line 1"),
    (["plot", "kind=errors", "trace=order.jsonl", "out=p.png"], "line 1"),
    (["plot", "kind=plan", "json=deep.json", "out=p.png"], "nests deeper"),
    (["plot", "kind=" + "a" * 3000], "kind"),
    (["train", "replay.capacity=1000000000000", "out=r"], "replay.capacity"),
    (["train", "num_envs=1000000", "out=r"], "num_envs"),
    (["train", "threads=1000000000", "out=r"], "threads"),
    (["train", "device=meta", "out=r"], "device = 'meta'"),
    (["train", "replay.capacity=10000000", "out=r"], "replay.capacity = 10000000: must be at most"),
    (["train", "algorithm.actor_hidden=[4096,4096,4096,4096]", "out=r"], "algorithm.actor_hidden"),
    (["train", "algorithm.batch_size=65536", "algorithm.critic_hidden=[1024]", "out=r"], "algorithm.batch_size"),
    (["train", "evaluation_episodes=1000000", "out=r"], "evaluation_episodes"),
    ([*TUNE, "device=/"], "device = '/'"),
    ([*TUNE, "cell.urdf=''"], "URDF"),
    ([*TUNE, "cell.base_distance_mm=5000"], "base_distance_mm"),
    ([*TUNE, "storage=/dev/full"], "no regular file"),
    (["tune", "study=../..", "trials=1"], "study = '../..': must be a name"),
    (["calibrate", "what=sheets", "hardware.name=../.."], "hardware.name = '../..': must be a name"),
    (["calibrate", "what=sheets", "hardware=twin", "calibration=c", "hand_markers.ids=[[1,2],[3]]"], "hand_markers.ids"),
    (["calibrate", "what=sheets", "hardware=twin", "calibration=c", "target.goal_mm=1e9"], "target.goal_mm"),
    (["simulate", "cell.block.pin_diameter_mm=-1"], "cell.block.pin_diameter_mm"),
    (["workspace", "out=~no-such-user-here/x"], "no such home"),
]


@pytest.mark.parametrize(("line", "words"), LINES, ids=[" ".join(argument[:40] for argument in line) for line, _ in LINES])
def test_one_short_line_and_exit_2(tmp_path, monkeypatch, capsys, line, words):
    assert_refused(tmp_path, monkeypatch, capsys, line, words)


def test_a_mesh_that_is_none_is_refused_by_the_engine_that_reads_it(tmp_path, monkeypatch, capsys):
    """PyBullet draws a file's meshes; MuJoCo takes the shapes that were read before, so nothing is amiss there."""
    pytest.importorskip("pybullet")
    line = ["simulate", "engine=bullet", "cell.urdf=mesh.urdf", "seed=1", "progress=false"]
    assert_refused(tmp_path, monkeypatch, capsys, line, "every mesh it names")


def assert_refused(tmp_path, monkeypatch, capsys, line, words):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        Path(name).write_text(text)
    assert cli.main(line) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1
    assert len(captured.err) <= 300
    assert set(path.name for path in tmp_path.iterdir()) - set(FILES) <= {"t", "o"}


def test_paths_expand_the_home_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    assert cli.main(["evaluate", "episodes=2", "json=~/e.json", "trace=~/t.jsonl", "progress=false"]) == 0
    assert cli.main(["workspace", "out=~/w"]) == 0
    assert cli.main(["plot", "kind=errors", "trace=[~/t.jsonl]", "out=~/p.png"]) == 0
    assert cli.main(["evaluate", "policy=shielded:~/none.npz"]) == 2
    assert str(tmp_path / "home" / "none.npz") in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["home"]
    assert {path.name for path in (tmp_path / "home").iterdir()} >= {"e.json", "p.png", "t.jsonl", "w"}


def test_control_characters_of_an_argument_are_not_printed(capsys):
    assert cli.main(["plan", "policy=\x1b[31mred"]) == 2
    assert "\x1b" not in capsys.readouterr().err
