"""``evaluate problems=FILE`` whose lines bring arms and obstacles: each problem in its own cell, and bad lines named."""

from __future__ import annotations

import copy
import json
import math

import numpy as np
import pytest

from marl_handover.cli import main
from marl_handover.report.traces import errors_at_end, read_trace
from tests.oracles.layouts import Layout, random_layout
from tests.oracles.trace_referee import judged_exact, referee

SECTOR = {"r_min_mm": 150.0, "r_max_mm": 230.0, "yaw_range_rad": [-1.6, 1.6]}
ARMS = [
    {"name": "west", "x_mm": -180.0, "y_mm": 0.0, "facing_rad": 0.0, **SECTOR},
    {"name": "east", "x_mm": 180.0, "y_mm": 0.0, "facing_rad": math.pi, **SECTOR},
    {"name": "north", "x_mm": 0.0, "y_mm": 310.0, "facing_rad": -math.pi / 2, **SECTOR},
]
START, GOAL = [-180.0, 190.0, 0.3], [180.0, -190.0, 2.0]
PAIR = Layout(
    [
        {"name": "L", "x_mm": 0.0, "y_mm": 180.0, "facing_rad": -math.pi / 2, **SECTOR, "yaw_range_rad": [-math.pi / 2, math.pi / 2]},
        {"name": "R", "x_mm": 0.0, "y_mm": -180.0, "facing_rad": math.pi / 2, **SECTOR, "yaw_range_rad": [-math.pi / 2, math.pi / 2]},
    ],
    [],
)


def problem(**changes):
    """A line that can be solved, with some of it replaced; None leaves a key out."""
    line = {"state": START, "goal": GOAL, "arms": copy.deepcopy(ARMS), **changes}
    return {key: value for key, value in line.items() if value is not None}


def changed(arm, **values):
    """The arms, one of them with other values."""
    arms = copy.deepcopy(ARMS)
    arms[arm].update(values)
    return arms


def written(folder, lines):
    path = folder / "problems.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def played(folder, lines, *arguments):
    """Trace and report."""
    trace, report = folder / "trace.jsonl", folder / "report.json"
    path = written(folder, lines)
    assert main(["evaluate", "progress=false", f"problems={path}", f"trace={trace}", f"json={report}", *arguments]) == 0
    return [json.loads(line) for line in trace.read_text().splitlines()], json.loads(report.read_text())


@pytest.fixture(scope="module")
def problems():
    """Problems of layouts of 2 to 8 arms, with and without discs, in no order; several of each layout."""
    draw, lines = np.random.default_rng(5), []
    for count in range(2, 9):
        layout = random_layout(draw, count, mixed=count % 2 == 0, close=count % 3 == 0, discs=(0, 1, 3)[count % 3])
        for start, goal in zip(*layout.sample_problems(4, draw), strict=True):
            lines.append({"state": start.tolist(), "goal": goal.tolist(), "arms": layout.arms, "obstacles": layout.obstacles, "seen": "x"})
    return [lines[index] for index in draw.permutation(len(lines))]


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_a_referee_finds_the_exact_policy_right_and_optimal_in_every_layout(tmp_path, problems, architecture):
    trace, report = played(tmp_path, problems, "policy=exact", f"architecture={architecture}")
    verdicts = referee(problems, trace)
    assert judged_exact(verdicts) == []
    assert verdicts.ratio == report["steps_ratio"] == report["success_rate"] == 1.0
    assert report["episodes"] == len(problems) == 28


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize("policy", ["random", "greedy", "shielded:random"])
def test_other_policies_play_by_the_rules_of_every_layout(tmp_path, problems, policy, architecture):
    trace, report = played(tmp_path, problems, f"policy={policy}", f"architecture={architecture}")
    assert referee(problems, trace).wrong == []
    assert report.get("repaired_decisions", 1) > 0


def test_lines_with_and_without_arms_and_obstacles_mix_in_their_order(tmp_path):
    """Arms by name where the line names them; L and R where it is the shipped pair, an obstacle of its own or not."""
    obstacles = [{"x_mm": 40.0, "y_mm": 0.0, "radius_mm": 10.0, "height_mm": 60.0}]
    bare = {"state": [200.0, 180.0, 0.0], "goal": [-200.0, -180.0, 3.0]}
    lines = [bare, problem(), {**bare, "obstacles": obstacles}, problem(obstacles=obstacles), {**bare, "arms": None, "obstacles": []}]
    trace, report = played(tmp_path, lines, "policy=exact")
    assert sorted({row["episode"] for row in trace}) == list(range(5))
    assert [row["episode"] for row in trace] == sorted(row["episode"] for row in trace)
    names = {number: {row["arm"] for row in trace if row["episode"] == number} for number in range(5)}
    assert names[0] | names[2] | names[4] == {"L", "R"}
    assert names[1] | names[3] <= {"west", "east", "north"}
    assert all(("receiver" in row) == (row["episode"] in (1, 3)) for row in trace)
    posed = [{**line, "arms": line.get("arms") or PAIR.arms} for line in lines]
    assert judged_exact(referee(posed, trace)) == []
    assert report["outcomes"]["success"] == 5


def test_a_trace_of_many_layouts_is_read_back(tmp_path, problems):
    trace, _ = played(tmp_path, problems, "policy=greedy")
    again = read_trace(tmp_path / "trace.jsonl")
    assert again.arm.tolist() == [rows[-1]["arm"] for rows in ([r for r in trace if r["episode"] == n] for n in again.episode)]
    assert (errors_at_end(again, 1)[0][again.solved] < 1e-2).all()


def test_one_layout_is_one_cell_and_a_seed_decides(tmp_path):
    """The same problem twice: one cell, and the random policy goes on drawing."""
    first, _ = played(tmp_path, [problem(), problem()], "policy=random", "seed=3")
    again, _ = played(tmp_path, [problem(), problem()], "policy=random", "seed=3")
    assert first == again
    by_episode = [[row["place"] for row in first if row["episode"] == number] for number in (0, 1)]
    assert by_episode[0] != by_episode[1]


DISC = {"x_mm": -180.0, "y_mm": 200.0, "radius_mm": 20.0, "height_mm": 60.0}
BAD_LINES = {
    "unconnected": (problem(arms=changed(2, y_mm=900.0)), "the arms fall into groups that share no place: (west, east) and (north)"),
    "unreached goal": (problem(goal=[900.0, 0.0, 0.0]), "goal in line 2 of {file} (900, 0) mm is out of every arm's reach"),
    "start in a disc": (problem(obstacles=[DISC]), "state in line 2 of {file} (-180, 190) mm"),
    "no shared place left": (
        problem(arms=ARMS[:2], obstacles=[{"x_mm": 0.0, "y_mm": 0.0, "radius_mm": 300.0, "height_mm": 9.0}], state=[-180.0, 190.0, 0.0]),
        "shared",
    ),
    "one arm": (problem(arms=ARMS[:1]), "arms = 1: must be a list of 2 to 8"),
    "nine arms": (problem(arms=3 * ARMS), "arms = 9: must be a list of 2 to 8"),
    "no arms": (problem(arms=[]), "arms = 0: must be a list of 2 to 8"),
    "no name": (problem(arms=[{k: v for k, v in arm.items() if k != "name"} for arm in ARMS]), "arms[0].name = None"),
    "equal names": (problem(arms=changed(1, name="west")), "arms[1].name = 'west': must be a name that no other arm has"),
    "touching bases": (problem(arms=changed(1, x_mm=-175.0)), "the base of arm 'east', 5.0 mm away"),
    "NaN base": (problem(arms=changed(1, x_mm=math.nan)), "arms[1].x_mm = nan: every number must be finite"),
    "NaN start": (problem(state=[math.nan, 0.0, 0.0]), "state in line 2 of {file} = [nan, 0.0, 0.0]: every number must be finite"),
    "reversed yaws": (problem(arms=changed(0, yaw_range_rad=[1.6, -1.6])), "arms[0].yaw_range_rad = [1.6, -1.6]: must be the lower first"),
    "reversed ring": (problem(arms=changed(0, r_min_mm=240.0)), "arms[0].r_min_mm, r_max_mm = [240.0, 230.0]"),
    "no number": (problem(arms=changed(0, x_mm="x")), "arms[0].x_mm = 'x': must be a number"),
    "no list": (problem(arms="west"), "arms"),
    "no records": (problem(arms=[1, 2]), "arms[0]"),
    "no disc": (problem(obstacles=[{"x_mm": 0.0, "y_mm": 500.0}]), "obstacles[0].radius_mm"),
    "negative disc": (problem(obstacles=[{**DISC, "radius_mm": -1.0}]), "obstacles[0].radius_mm = -1.0"),
    "no start": (problem(state=None), "line 2 is not {{'state': [3 numbers], 'goal': [3 numbers]}}"),
    "eight rings, goal unreached": (
        problem(
            arms=[{**ARMS[0], "name": f"a quite long name {k}", "x_mm": 100.0 * k, "r_max_mm": 230.5 + k} for k in range(8)],
            goal=[5000.0, 0.0, 0.0],
        ),
        "out of every arm's reach",
    ),
}


@pytest.mark.parametrize(("line", "words"), BAD_LINES.values(), ids=BAD_LINES)
def test_a_bad_line_is_named_in_one_line(tmp_path, capsys, line, words):
    path = written(tmp_path, [problem(), line, problem()])
    assert main(["evaluate", "policy=exact", f"problems={path}", f"trace={tmp_path / 'trace.jsonl'}"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert len(error) <= 301
    assert words.format(file=path) in error
    assert "line 2" in error
    assert not (tmp_path / "trace.jsonl").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["policy=pretrained_b"], "which line 2 has, for policy=pretrained_b; policy=exact, greedy and random take them"),
        (["policy=shielded:pretrained_a"], "for policy=shielded:pretrained_a"),
        (["policy=exact", "backend=noisy"], "which line 2 has, for backend=noisy"),
        (["policy=exact", "task.reward.motion_weight=1"], "task.reward.motion_weight = 1.0: must be 0"),
    ],
)
def test_what_needs_one_cell_for_all_says_so(tmp_path, capsys, arguments, words):
    path = written(tmp_path, [{"state": [200.0, 180.0, 0.0], "goal": [-200.0, -180.0, 3.0]}, problem()])
    assert main(["evaluate", "progress=false", f"problems={path}", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
