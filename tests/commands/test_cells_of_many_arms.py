"""``workspace``, ``plan`` and ``plot`` of cells with other than two arms, and of cells with obstacles."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.cell import build_cell, cell_config, layout_cell, load_cell
from marl_handover.cli import main
from marl_handover.commands.workspace import workspace_summary
from marl_handover.envs import handover_aec
from marl_handover.motion.executor import ExecutorAgent
from marl_handover.report.motion import read_motions
from tests.layouts import BLOCKED, SHIPPED
from tests.oracles.layouts import Layout


@pytest.fixture(scope="module", params=[*SHIPPED, "blocked"])
def model(request, tmp_path_factory):
    if request.param in SHIPPED:
        return build_cell(cell_config(request.param))
    path = tmp_path_factory.mktemp("cell") / "blocked.yaml"
    path.write_text(BLOCKED)
    return build_cell(cell_config(str(path)))


@pytest.mark.parametrize(("name", "count"), SHIPPED.items())
def test_neighbours_of_shipped_cells_share_a_place_and_bases_stand_apart(name, count):
    cell = build_cell(cell_config(name)).cell
    assert cell.num_arms == count
    apart = {pair: space.base_distance_mm for pair, space in cell.graph.edges.items()}
    assert len(apart) == {"triangle": 3, "line4": 3, "ring6": 6}[name]
    assert all(305 <= distance <= 441 for distance in apart.values())
    assert all(math.dist(one.position_mm, other.position_mm) >= 300 for one in cell.bases for other in cell.bases if one is not other)
    assert cell.config.chart is None


def test_the_workspace_file_makes_the_same_cell_again(model):
    """Its arms and obstacles are what a line of a problems file takes."""
    summary = json.loads(json.dumps(workspace_summary(model)))
    again = layout_cell(summary["arms"], summary["obstacles"])
    points = np.random.default_rng(0).uniform(-900, 900, (20_000, 2))
    np.testing.assert_array_equal(again.reaches(points), model.cell.reaches(points))
    np.testing.assert_array_equal(Layout(summary["arms"], summary["obstacles"]).reaches(points, 1e-3), again.reaches(points))
    assert [[again.names[i], again.names[j]] for i, j in again.graph.edges] == summary["shared"]
    assert set(summary["bases"]) == {*again.names} == {*summary["grid_points"]} - {"both"}
    assert len(summary["obstacles"]) == len(model.cell.config.obstacles)


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_a_plan_names_arms_and_receivers_and_plots_again(tmp_path, capsys, architecture):
    file, picture = tmp_path / "plan.json", tmp_path / "plan.png"
    ends = ["start=[-700,0,0]", "goal=[700,0,120]"]
    assert main(["plan", "cell=line4", *ends, f"architecture={architecture}", f"json={file}", f"picture={picture}"]) == 0
    said, plan = capsys.readouterr().out, json.loads(file.read_text())
    steps = [(step["arm"], step["receiver"], step["final"]) for step in plan["transfers"]]
    assert steps == [("first", "second", False), ("second", "third", False), ("third", "fourth", False), ("fourth", None, True)]
    assert all((step["alpha"] is None) == step["final"] for step in plan["transfers"])
    assert "towards third" in said
    assert main(["plot", "kind=plan", f"json={file}", f"out={tmp_path / 'again.png'}"]) == 0
    assert (tmp_path / "again.png").read_bytes() == picture.read_bytes()
    assert main(["plot", "kind=plan", f"json={file}", "cell=triangle"]) == 2
    assert "the cell of the file, with an arm 'first'; this one has north, west, east" in capsys.readouterr().err


def test_motions_of_three_arms_name_where_the_others_stand(tmp_path):
    file = tmp_path / "motion.json"
    assert main(["plan", "cell=triangle", "start=[-250,200,0]", "goal=[300,200,170]", f"motion={file}"]) == 0
    content = json.loads(file.read_text())
    names = ["north", "west", "east"]
    for row in content["transfers"]:
        assert list(row["other_arms_rad"]) == [name for name in names if name != row["arm"]]
        assert "parked_other_rad" not in row
    again = read_motions(content, file)
    assert [motion.arm for motion in again] == [names.index(row["arm"]) for row in content["transfers"]]
    assert main(["plot", "kind=motion", f"json={file}", f"out={tmp_path / 'motion.png'}"]) == 0


def test_a_problem_without_a_plan_is_told_why(tmp_path, capsys):
    """Hand-overs a hair from the base line turn a block by next to nothing."""
    file = tmp_path / "plan.json"
    settings = ["cell.base_distance_mm=459.9", "epsilon_deg=0.1", "start=[-120,-60,0]", "goal=[150,60,90]"]
    assert main(["plan", *settings, f"json={file}"]) == 1
    why = json.loads(file.read_text())["unsolvable_because"]
    assert why == "no sequence of up to 20 transfers turns the object by 90 deg to within 0.1 deg"
    assert f"unsolvable: {why}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["start=[2000,0,0]"], "start (2000, 0) mm is out of every arm's reach"),
        (["start=[0,-60,0]"], "start (0, -60) mm is inside an obstacle; it must be at least 43.3 mm from (0, -60) mm"),
        (["policy=pretrained_b"], "a trained policy is for two arms; this cell has 3: west, east, a rather"),
        (["policy=shielded:pretrained_a", "architecture=A"], "is for two arms; this cell has 3"),
        (["motion=m.json", "start=[-180,-200,0]", "goal=[180,-200,0]"], "cell.obstacles = '2 of them': must be none where arms move"),
        (["cell.chart=paper"], "cell.chart = 'paper'"),
        (["cell.arms=[{name: a},{name: a, x_mm: 400}]"], "cell.arms[1].name = 'a': must be a name that no other arm has"),
        (["cell.arms=[{name: a}]"], "cell.arms = 1: must be two arms at least"),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, arguments, words):
    path = tmp_path / "blocked.yaml"
    path.write_text(BLOCKED)
    ends = [] if any(each.startswith("start") for each in arguments) else ["start=[-180,-200,0]"]
    assert main(["plan", f"cell={path}", "goal=[180,-200,0]", *ends, *arguments, "progress=false"]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", SHIPPED)
def test_evaluate_plays_shipped_cells_and_plot_reads_its_trace(tmp_path, name):
    trace, report = tmp_path / "trace.jsonl", tmp_path / "report.json"
    assert main(["evaluate", f"cell={name}", "episodes=40", f"trace={trace}", f"json={report}", "progress=false"]) == 0
    names = set(build_cell(cell_config(name)).cell.names)
    rows, result = [json.loads(line) for line in trace.read_text().splitlines()], json.loads(report.read_text())
    assert {row["arm"] for row in rows} == names
    assert all((row["receiver"] is None) == row["final"] for row in rows)
    assert result["success_rate"] == result["steps_ratio"] == 1.0
    for kind in ("evaluation", "confusion"):
        files = [f"trace={trace}", *([f"json={report}"] if kind == "evaluation" else [])]
        assert main(["plot", f"kind={kind}", *files, f"cell={name}", f"out={tmp_path / 'picture.png'}"]) == 0


@pytest.mark.parametrize("command", ["evaluate", "simulate", "plan"])
def test_a_trained_policy_of_a_pair_takes_no_third_arm(command, capsys):
    assert main([command, "cell=triangle", "policy=shielded:pretrained_b"]) == 2
    assert "a trained policy is for two arms; this cell has 3: north, west, east" in capsys.readouterr().err


MIXED = """
name: mixed
arms:
  - {name: lynx, x_mm: 0.0, y_mm: 254.0, facing_deg: -90.0, robot: al5a}
  - {name: standard, x_mm: -220.0, y_mm: -127.0, facing_deg: 30.0, robot: so101}
  - {name: pincher, x_mm: 220.0, y_mm: -127.0, facing_deg: 150.0, robot: px100}
"""


@pytest.mark.parametrize(("backend", "policy"), [("noisy", "exact"), ("bullet", "exact"), ("mujoco", "pretrained_any")])
def test_three_robots_of_three_makers_pass_a_block_on(tmp_path, backend, policy):
    """Each by its own kinematics, shapes and hand, past the two others where these truly are."""
    pytest.importorskip({"bullet": "pybullet", "mujoco": "mujoco"}.get(backend, "numpy"))
    (tmp_path / "mixed.yaml").write_text(MIXED)
    report, trace = tmp_path / "report.json", tmp_path / "trace.jsonl"
    more = ["episodes=4", "seed=3", f"json={report}", f"trace={trace}", "progress=false"]
    assert main(["evaluate", f"policy={policy}", f"cell={tmp_path / 'mixed.yaml'}", f"backend={backend}", *more]) == 0
    result = json.loads(report.read_text())
    assert result["success_in_the_end"] == 1.0
    assert len({json.loads(line)["arm"] for line in trace.read_text().splitlines()}) >= 2


@pytest.mark.parametrize(("cell", "backend"), [("triangle", "bullet"), ("line4", "mujoco"), ("ring6", "noisy")])
def test_agents_of_many_arms_solve_an_episode_on_every_backend(cell, backend):
    """The AEC environment's supervisor and executors, one an arm, without the loop."""
    pytest.importorskip({"bullet": "pybullet", "mujoco": "mujoco"}.get(backend, "numpy"))
    env = handover_aec.env(cell=cell, backend=backend)
    supervisor, built = policies.load("exact", load_cell(cell)), build_cell(cell_config(cell))
    arms = {agent: ExecutorAgent(agent, built) for agent in env.possible_agents[1:]}
    env.reset(seed=2)
    for agent in env.agent_iter(40):
        observation, _, terminated, truncated, info = env.last()
        if agent == "supervisor" and terminated:
            assert info["outcome"] == "success"
        acts = arms[agent].act if agent in arms else supervisor
        env.step(None if terminated or truncated else acts(observation))
    assert not env.agents, "the episode is over"
    env.close()
