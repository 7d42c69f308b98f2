"""``marl-handover plan``: the exact policy's plans are optimal, and every bad input is one line."""

from __future__ import annotations

import itertools
import json
import math
import re
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest
import torch

from marl_handover import cli
from marl_handover.cell import build_cell, cell_config
from marl_handover.commands.plan import solve
from marl_handover.policies import ExactPolicy


def colours(path):
    image = (255 * matplotlib.image.imread(path)[::3, ::3, :3]).astype(np.uint32)
    return len(np.unique(image @ np.array([1, 256, 65536], np.uint32)))


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_exact_plans_take_the_optimum(cell, rules_of, draw, assert_same_angle, architecture):
    rules = rules_of(cell, architecture)
    policy = ExactPolicy(rules)
    starts, goals, _, _ = draw(cell, 60, 5)
    lengths = set()
    for start, goal in zip(starts, goals, strict=True):
        plan = solve(policy, start, goal)
        steps = plan["transfers"]
        lengths.add(len(steps))
        assert plan["outcome"] == "success"
        assert len(steps) == plan["optimal_transfers"]
        assert [step["final"] for step in steps] == [False] * (len(steps) - 1) + [True]
        assert steps[0]["from"] == start.tolist()
        assert all(after["from"] == before["to"] for before, after in itertools.pairwise(steps))
        np.testing.assert_allclose(steps[-1]["to"][:2], goal[:2], atol=1e-9)
        assert abs(plan["orientation_error_deg"]) <= rules.config.epsilon_deg
        assert_same_angle(steps[-1]["to"][2] - goal[2], math.radians(plan["orientation_error_deg"]))
        lines = [math.dist(step["from"][:2], step["to"][:2]) for step in steps]
        assert [step["path_mm"] for step in steps] == pytest.approx(lines)
        assert plan["total_path_mm"] == pytest.approx(sum(lines))
        for step in steps[:-1]:
            np.testing.assert_allclose(cell.chart.to_table(np.float64(step["alpha"]), np.float64(step["beta"])), step["to"][:2], atol=1e-9)
    assert {2, 3, 4} <= lengths


def test_without_arguments(capsys):
    assert cli.main(["plan"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("success: 4 transfers (optimum 4)")
    assert len(lines) == 2 + 1 + 4 + 1 + 1
    assert "-0.0 " not in "\n".join(lines)


def test_json_and_picture(tmp_path):
    json_file, picture = tmp_path / "plan.json", tmp_path / "plan.png"
    arguments = ["start=[-120,-70,20]", "goal=[150,60,-100]", "cell.chart_inset=0.9", "architecture=A", "epsilon_deg=1", "symmetry_order=2"]
    assert cli.main(["plan", *arguments, f"json={json_file}", f"picture={picture}"]) == 0
    plan = json.loads(json_file.read_text())
    assert plan["policy"] == "exact"
    assert (plan["architecture"], plan["epsilon_deg"], plan["symmetry_order"]) == ("A", 1, 2)
    assert plan["start"] == pytest.approx([-120, -70, math.radians(20)])
    assert plan["cell_settings"]["chart_inset"] == 0.9
    assert {"arm", "final", "from", "to", "alpha", "beta", "path_mm"} <= set(plan["transfers"][0])
    assert colours(picture) > 20
    assert set(tmp_path.iterdir()) == {json_file, picture}


def test_a_policy_that_fails_says_how_and_still_writes(tmp_path, capsys):
    json_file = tmp_path / "plan.json"
    arguments = ["plan", "policy=random", "architecture=A", "epsilon_deg=0.001", f"json={json_file}", f"picture={tmp_path / 'p.pdf'}"]
    assert cli.main(arguments) == 1
    captured = capsys.readouterr()
    assert captured.err == "marl-handover plan: policy 'random' did not reach the goal: timeout after 20 transfers\n"
    assert "refused" in captured.out
    plan = json.loads(json_file.read_text())
    assert plan["outcome"] == "timeout"
    refused = [step for step in plan["transfers"] if step["refused"]]
    assert refused
    assert all(step["from"] == step["to"] and step["alpha"] is None for step in refused)
    assert (tmp_path / "p.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["start=[1,2]"], "start = [1.0, 2.0]: must be 3 numbers: x [mm], y [mm], orientation [deg]; this has 2"),
        (["goal=[]"], "goal = []: must be 3 numbers"),
        (["start=[nan,0,0]"], "start[0] = nan: every number must be finite"),
        (["goal=[0,0,-inf]"], "every number must be finite"),
        (["start=[a,0,0]"], "cannot read 'start=[a,0,0]'"),
        (["goal=[0,180,0]"], "goal (0, 180) mm is out of every arm's reach; it must lie 150 to 230 mm"),
        (["start=[1e5,0,0]"], "out of every arm's reach"),
        (["start=[1e200,0,0]"], "start[0] = 1e+200: must be between -1e+06 and 1e+06"),
        (["policy=exakt"], "policy = 'exakt' is not known"),
        (["policy=no/such/run"], "not found: no/such/run"),
        (["architecture=C"], "choose one of: A, B"),
        (["epsilon_deg=0"], "epsilon_deg = 0.0"),
        (["symmetry_order=0"], "symmetry_order = 0"),
        (["cell=papr"], "paper"),
        (["picture=plan.gif"], ".png, .pdf or .svg"),
        (["end=[0,0,0]"], "unknown key 'end'"),
        (["motion=m.json", "arm_motion.lift_mm=-5"], "arm_motion.lift_mm = -5.0"),
        (["motion=m.json", "arm_motion.method=magic"], "arm_motion.method = 'magic' is not known"),
        (["motion=m.json", "arm_motion.parked_deg=[0,0,0,0,0]"], "arm_motion.parked_deg = [0.0, 0.0, 0.0, 0.0, 0.0]"),
        (["arm_motion.lift_mm=50"], "arm_motion.lift_mm = 50.0: must be left out without motion=FILE"),
    ],
)
def test_bad_input_is_one_line(capsys, recwarn, arguments, said):
    assert cli.main(["plan", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("marl-handover plan: ")
    assert said in captured.err
    assert captured.err.count("\n") == 1
    assert not [warning for warning in recwarn if issubclass(warning.category, RuntimeWarning)]


@pytest.mark.parametrize("key", ["json", "picture", "motion", "motion_picture"])
def test_a_folder_is_no_file(tmp_path, capsys, key):
    """Said before anything is planned."""
    folder = tmp_path / "folder.png"
    folder.mkdir()
    assert cli.main(["plan", f"{key}={folder}"]) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", f"marl-handover plan: {key} = '{folder}': must be a file, not a folder\n")
    assert not list(folder.iterdir())


@pytest.fixture(scope="module")
def policy_file(tmp_path_factory):
    """An untrained network of architecture A for the al5a cell, made for epsilon = 7 deg."""
    from marl_handover.cell import cell_config, load_cell
    from marl_handover.config import TaskConfig
    from marl_handover.learning.checkpoint import policy_arrays, save_policy
    from marl_handover.learning.settings import TrainConfig
    from marl_handover.learning.variant import Variant
    from marl_handover.task.rules import Rules

    config = TrainConfig(cell=cell_config("al5a"), task=TaskConfig(architecture="A", epsilon_deg=7.0), compile="off")
    algorithm = Variant().algorithm(Rules(load_cell(config.cell), config.task), config, torch.Generator().manual_seed(0))
    path = tmp_path_factory.mktemp("policy") / "a.npz"
    save_policy(path, policy_arrays(algorithm, config, "a test"))
    return path


def test_a_trained_policy_brings_its_own_cell_and_task(policy_file, tmp_path):
    problem = ["start=[-250,-60,0]", "goal=[-250,-60,3]"]  # solved at the start, so that any network solves it
    for extra, cell, epsilon in (([], "al5a", 7), (["epsilon_deg=5"], "al5a", 5)):
        assert cli.main(["plan", f"policy={policy_file}", *problem, f"json={tmp_path / 'p.json'}", *extra]) == 0
        plan = json.loads((tmp_path / "p.json").read_text())
        assert (plan["cell"], plan["architecture"], plan["epsilon_deg"]) == (cell, "A", epsilon)
        assert len(plan["transfers"]) == plan["optimal_transfers"] == 1


def test_a_trained_policy_under_other_settings(policy_file, capsys):
    assert cli.main(["plan", f"policy={policy_file}", "cell=paper", "start=[-250,-60,0]"]) == 2
    assert "start (-250, -60) mm is out of every arm's reach" in capsys.readouterr().err
    assert cli.main(["plan", f"policy={policy_file}", "architecture=B"]) == 2
    assert "has architecture = 'A', but 'B' was asked for" in capsys.readouterr().err


MOTION_KEYS = {"arm", "from", "to", "phases", "parked_other_rad", "path_length_mm", "min_clearance_mm", "planning_ms"}


def test_motions_of_every_transfer(tmp_path, capsys):
    motion, plan, picture = tmp_path / "new" / "motion.json", tmp_path / "plan.json", tmp_path / "motion.png"
    assert cli.main(["plan", f"motion={motion}", f"motion_picture={picture}", f"json={plan}"]) == 0
    out = capsys.readouterr().out
    transfers, planned = (json.loads(path.read_text())["transfers"] for path in (motion, plan))
    assert [row["arm"] for row in transfers] == [row["arm"] for row in planned]
    for row, command in zip(transfers, planned, strict=True):
        assert set(row) == MOTION_KEYS
        assert (row["from"], row["to"]) == (command["from"][:2], command["to"][:2])
        assert all(set(phase) == {"name", "t_s", "joints_rad"} for phase in row["phases"])
        assert all(len(joints) == 5 for phase in row["phases"] for joints in phase["joints_rad"])
    assert out.count("motion ") == len(transfers) == 4
    sequential, overlapped = map(float, re.search(r"one after another ([\d.]+) s; .* ([\d.]+) s, \d+ % less", out).groups())
    assert sequential == pytest.approx(sum(row["phases"][-1]["t_s"][-1] for row in transfers), abs=0.01)
    assert overlapped < sequential
    assert colours(picture) > 50


def test_a_policy_that_fails_has_motions_of_what_was_not_refused(tmp_path):
    motion, plan = tmp_path / "motion.json", tmp_path / "plan.json"
    assert cli.main(["plan", "policy=random", "architecture=A", "epsilon_deg=0.001", f"motion={motion}", f"json={plan}"]) == 1
    made = [row for row in json.loads(plan.read_text())["transfers"] if not row["refused"]]
    assert [row["from"] for row in json.loads(motion.read_text())["transfers"]] == [row["from"][:2] for row in made]


@pytest.mark.parametrize("lift_mm", [20.0, 60.0])
def test_the_arms_move_as_they_are_told_to(tmp_path, lift_mm):
    """The block travels as high as was asked for; over a long way, as over a short one all is smaller."""
    motion = tmp_path / "motion.json"
    assert cli.main(["plan", "start=[-120,60,0]", "goal=[60,0,-60]", f"motion={motion}", f"arm_motion.lift_mm={lift_mm}"]) == 0
    arm = build_cell(cell_config("paper")).arm
    row = max(json.loads(motion.read_text())["transfers"], key=lambda row: math.dist(row["from"], row["to"]))
    joints = np.concatenate([phase["joints_rad"] for phase in row["phases"] if phase["name"] == "transfer"])
    assert arm.fk(joints)[:, 2, 3].max() == pytest.approx(45.0 + lift_mm, abs=2.0)


def test_the_papers_method_by_name(tmp_path, capsys):
    """The same problem with both: the paper's B-spline has its ways too, and they are not the optimiser's."""
    problem = ["start=[-120,60,0]", "goal=[60,0,-60]"]
    rows = {}
    for method in ("optimised", "paper"):
        motion = tmp_path / f"{method}.json"
        assert cli.main(["plan", *problem, f"motion={motion}", f"arm_motion.method={method}"]) == 0
        rows[method] = json.loads(motion.read_text())["transfers"]
    out = capsys.readouterr().out
    assert out.count("clearance to the other arm ") == sum(map(len, rows.values()))
    for optimised, paper in zip(*rows.values(), strict=True):
        assert (paper["from"], paper["to"]) == (optimised["from"], optimised["to"])
        assert paper["path_length_mm"] != optimised["path_length_mm"]
        assert paper["path_length_mm"] == pytest.approx(optimised["path_length_mm"], rel=0.2)


def test_a_transfer_without_a_motion_is_one_line_and_nothing_is_written(tmp_path, capsys):
    """A hand that holds the pin is nearer to the table than it may be."""
    names = {"motion": "m.json", "motion_picture": "m.png", "json": "p.json", "picture": "p.png"}
    assert cli.main(["plan", "arm_motion.ground_clearance_mm=30", *(f"{key}={tmp_path / name}" for key, name in names.items())]) == 1
    assert capsys.readouterr().err.startswith("marl-handover plan: transfer 1, arm R, has no motion: the start pose is ")
    assert list(tmp_path.iterdir()) == []


def test_a_block_that_hits_the_arm_that_holds_it_is_too_wide(capsys):
    assert cli.main(["plan", "cell.block.side_mm=200"]) == 2
    assert "cell.block.side_mm = 200.0: must be so small that 'forearm' and 'block' do not touch" in capsys.readouterr().err


def test_motions_are_planned_only_when_asked_for():
    code = "import sys; from marl_handover import cli; cli.main(['plan']); print('marl_handover.motion.planner' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()[-1] == "False"


@pytest.mark.parametrize("argument", ["motion_picture=motion.gif", "motion=/proc/nowhere/motion.json"])
def test_a_motion_file_that_cannot_be_is_bad_input(capsys, argument):
    assert cli.main(["plan", argument]) == 2
    assert capsys.readouterr().err.count("\n") == 1
