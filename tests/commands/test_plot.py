"""``marl-handover plot``: every kind gives a picture, every bad input one line."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from marl_handover import cli
from marl_handover.commands.plot import run_folders

HEADER = "step,gradient_step,epsilon_low_deg,epsilon_high_deg,success_rate,steps_ratio"


def colours(path):
    image = (255 * matplotlib.image.imread(path)[::3, ::3, :3]).astype(np.uint32)
    return len(np.unique(image @ np.array([1, 256, 65536], np.uint32)))


@pytest.fixture
def make_run(tmp_path):
    def make(name, steps):
        folder = tmp_path / name
        folder.mkdir()
        rows = [f"{step},{step // 8},{15 if step < 300 else 5},15,{min(step / 500, 1)},{'' if step < 200 else 1.2}" for step in steps]
        (folder / "metrics.csv").write_text("\n".join([HEADER, *rows]) + "\n")
        return folder

    return make


@pytest.fixture
def evaluation(tmp_path):
    """An evaluation's JSON and its trace: two episodes, one solved."""
    result = {
        "policy": "runs/a", "architecture": "B", "epsilon_deg": 5.0, "success_rate": 0.5, "success_ci95": [0.1, 0.9], "mean_steps": 2.5,
        "mean_steps_success": 2.0, "optimal_mean_steps": 2.0, "steps_ratio": 1.0,
        "outcomes": {"success": 1, "wrong_orientation": 0, "wrong_position": 0, "timeout": 1},
    }  # fmt: skip
    rows = [
        {"episode": 0, "state": [-120, -60, 0], "goal": [150, 60, 0.0], "outcome": None, "arm": "R", "next_state": [0, 0, 0.3]},
        {"episode": 0, "state": [0, 0, 0.3], "goal": [150, 60, 0.0], "outcome": "success", "arm": "L", "next_state": [150, 60, 0.02]},
        {"episode": 1, "state": [-120, -60, 0], "goal": [150, 60, 1.5], "outcome": "timeout", "arm": "R", "next_state": [0, 0, 0.3]},
    ]
    rows = [{**row, "place": row["next_state"][:2], "final": row["outcome"] == "success", "epsilon_rad": 0.087} for row in rows]
    (tmp_path / "evaluation.json").write_text(json.dumps(result))
    (tmp_path / "trace.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return tmp_path / "evaluation.json", tmp_path / "trace.jsonl"


def test_one_run(make_run, capsys):
    folder = make_run("a=b,c", range(100, 700, 100))
    assert cli.main(["plot", f"run={folder.parent}/a=b", "kind=run"]) == 2
    folder = folder.rename(folder.parent / "a=b")
    capsys.readouterr()
    assert cli.main(["plot", f"run={folder}"]) == 0
    assert capsys.readouterr().out == f"written: {folder}/learning.png\n"
    assert colours(folder / "learning.png") > 20
    assert {path.name for path in folder.iterdir()} == {"metrics.csv", "learning.png"}


def test_seeds_and_runs_that_have_just_begun(make_run, tmp_path):
    first, second = make_run("a", range(100, 700, 100)), make_run("b", [150, 250])
    begun = make_run("c", [50])
    assert cli.main(["plot", f"run=[{first},{second}]"]) == 0
    assert colours(tmp_path / "learning.png") > 20
    assert cli.main(["plot", f"run=[{second}, {begun}]", f"out={tmp_path}/new/apart.pdf"]) == 0
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["apart.pdf"]


def test_run_folders():
    assert [str(path) for path in run_folders("[a, 'b=c',d]")] == ["a", "b=c", "d"]


def test_workspace_and_plan(tmp_path, capsys):
    assert cli.main(["plot", "kind=workspace", "cell=al5a", f"out={tmp_path / 'w.png'}"]) == 0
    assert colours(tmp_path / "w.png") > 20
    assert cli.main(["plan", "cell=al5a", f"json={tmp_path / 'plan.json'}", f"picture={tmp_path / 'same.png'}"]) == 0
    assert cli.main(["plot", "kind=plan", f"json={tmp_path / 'plan.json'}"]) == 0
    # The file holds the cell's settings, so the picture is the one that plan drew.
    np.testing.assert_array_equal(matplotlib.image.imread(tmp_path / "plan.png"), matplotlib.image.imread(tmp_path / "same.png"))


def test_evaluation(evaluation, tmp_path):
    result, trace = evaluation
    assert cli.main(["plot", "kind=evaluation", f"json={result}", f"trace={trace}", f"out={tmp_path / 'histogram.png'}"]) == 0
    assert colours(tmp_path / "histogram.png") > 20


def test_an_evaluation_without_a_success(evaluation):
    path, _ = evaluation
    result = json.loads(path.read_text())
    result |= {"mean_steps_success": None, "steps_ratio": None, "outcomes": {**result["outcomes"], "success": 0}}
    path.write_text(json.dumps(result))
    assert cli.main(["plot", "kind=evaluation", f"json={path}"]) == 0
    assert colours(path.with_suffix(".png")) > 20


def test_a_trace_of_something_else(evaluation, capsys):
    result, trace = evaluation
    whole = trace.read_text()
    for text, said in (
        (whole.replace("-120, -60", "-300, 200"), "must be the cell of the trace"),  # only the al5a cell reaches so far
        (whole.replace("timeout", "success"), "of the same evaluation"),
        ('{"episode": 0}\n', "line 1 is no step"),
        ("", "it holds no step"),
    ):
        trace.write_text(text)
        assert cli.main(["plot", "kind=evaluation", f"json={result}", f"trace={trace}"]) == 2
        assert said in capsys.readouterr().err


def test_errors_and_confusion_of_a_trace(evaluation, tmp_path, capsys):
    _, trace = evaluation
    for arguments, name in (
        (["kind=errors"], "trace_errors.png"),
        (["kind=errors", "scale=linear", "symmetry_order=4", f"out={tmp_path}/linear.pdf"], "linear.pdf"),
        (["kind=confusion"], "trace_confusion.png"),
    ):
        assert cli.main(["plot", f"trace={trace}", *arguments]) == 0
        assert capsys.readouterr().out == f"written: {tmp_path}/{name}\n"
    assert colours(tmp_path / "trace_errors.png") > 20
    assert colours(tmp_path / "trace_confusion.png") > 20
    assert cli.main(["plot", "kind=confusion", f"trace=[{trace},{trace}]", f"out={tmp_path / 'both.png'}"]) == 0
    assert colours(tmp_path / "both.png") > 20
    trace.write_text(trace.read_text().replace("150, 60", "-300, 200"))
    assert cli.main(["plot", "kind=confusion", f"trace={trace}"]) == 2
    assert "must be the cell of the trace" in capsys.readouterr().err


def test_errors_are_told_by_the_symmetry_that_the_trace_says(tmp_path, capsys):
    trace, picture = tmp_path / "trace.jsonl", tmp_path / "errors.png"
    done = ["evaluate", "policy=exact", "episodes=20", "task.symmetry_order=4", f"trace={trace}", "progress=false"]
    assert cli.main(done) == 0
    assert cli.main(["plot", "kind=errors", f"trace={trace}", f"out={picture}"]) == 0
    said = matplotlib.image.imread(picture)
    lines = [json.loads(line) for line in trace.read_text().splitlines()]
    # An old file says nothing: then the setting counts.
    trace.write_text("".join(json.dumps({key: value for key, value in row.items() if key != "symmetry_order"}) + "\n" for row in lines))
    for setting, same in ((["symmetry_order=4"], True), ([], False)):
        assert cli.main(["plot", "kind=errors", f"trace={trace}", f"out={picture}", *setting]) == 0
        assert np.array_equal(matplotlib.image.imread(picture), said) is same
    trace.write_text("".join(json.dumps(row) + "\n" for row in lines))
    for kind in ("errors", "confusion"):
        capsys.readouterr()
        assert cli.main(["plot", f"kind={kind}", f"trace={trace}", f"out={picture}", "symmetry_order=2"]) == 2
        assert "symmetry_order = 2: must be 4, as the trace says" in capsys.readouterr().err


def test_motions_as_plan_drew_them(tmp_path, capsys):
    files = [f"motion={tmp_path / 'motion.json'}", f"motion_picture={tmp_path / 'same.png'}"]
    assert cli.main(["plan", "start=[-120,60,0]", "goal=[60,0,-60]", "arm_motion.arm_clearance_mm=8", *files]) == 0
    assert cli.main(["plot", "kind=motion", f"json={tmp_path / 'motion.json'}"]) == 0
    # The file holds the cell's settings and the planner's.
    np.testing.assert_array_equal(matplotlib.image.imread(tmp_path / "motion.png"), matplotlib.image.imread(tmp_path / "same.png"))
    assert cli.main(["plot", "kind=motion", f"json={tmp_path / 'motion.json'}", "cell=al5a"]) == 2
    assert "must be the cell of the motions" in capsys.readouterr().err


def test_a_suites_figures(tmp_path, capsys):
    stored = Path(__file__).parents[2] / "bench" / "results" / "compare" / "variants"
    (tmp_path / "suite").mkdir()
    results = json.loads((stored / "results.json").read_text())
    results["figures"] = [spec for spec in results["figures"] if spec["name"] in ("learning", "success")]
    results["figures"].append({**results["figures"][0], "name": "nothing", "rows": ["nobody"]})
    (tmp_path / "suite" / "results.json").write_text(json.dumps(results))
    assert cli.main(["plot", "kind=compare", f"suite={tmp_path / 'suite'}"]) == 0
    assert "no values yet: nothing" in capsys.readouterr().out
    names = sorted(path.name for path in (tmp_path / "suite" / "figures").iterdir())
    assert names == ["learning.pdf", "learning.png", "success.pdf", "success.png"]
    assert cli.main(["plot", "kind=compare", f"suite={tmp_path / 'suite'}", "figure=success", f"out={tmp_path / 'one.png'}"]) == 0
    whole = matplotlib.image.imread(tmp_path / "suite" / "figures" / "success.png")
    np.testing.assert_array_equal(matplotlib.image.imread(tmp_path / "one.png"), whole)
    for figure, said in (("nothing", "must be one that has values already"), ("none", "choose one of: learning, success, nothing")):
        assert cli.main(["plot", "kind=compare", f"suite={tmp_path / 'suite'}", f"figure={figure}"]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["kind=runs"], "kind = 'runs' is not known; choose one of: run, workspace, plan, motion, evaluation, errors, confusion, compare"),
        ([], "run = '': must be a run directory"),
        (["run=[]"], "run = '[]': must be a run directory"),
        (["run=none"], "run directory not found: none"),
        (["run=."], "metrics not found: metrics.csv"),
        (["run=broken"], "metrics broken/metrics.csv cannot be read: line 2"),
        (["run=broken", "out=a.txt"], "out = 'a.txt': must be a file that ends in"),
        (["kind=plan"], "json = '': must be the file that `marl-handover plan json=FILE` wrote"),
        (["kind=plan", "json=none.json"], "plan not found: none.json"),
        (["kind=plan", "json=empty.json"], "plan empty.json cannot be read: it lacks 'start'"),
        (["kind=evaluation", "json=empty.json"], "evaluation empty.json cannot be read: it lacks 'outcomes'"),
        (["kind=evaluation", "json=broken/metrics.csv"], "evaluation broken/metrics.csv cannot be read"),
        (["run=broken", "colour=red"], "unknown key 'colour'"),
        (["kind=motion"], "json = '': must be the file that `marl-handover plan motion=FILE` wrote"),
        (["kind=motion", "json=none.json"], "motion not found: none.json"),
        (["kind=motion", "json=empty.json"], "motion empty.json cannot be read: it lacks 'transfers'"),
        (["kind=errors"], "trace = '': must be a file that `marl-handover evaluate trace=FILE` wrote"),
        (["kind=errors", "trace=[a,b]"], "trace = '[a,b]': must be a file that"),
        (["kind=errors", "trace=none"], "trace not found: none"),
        (["kind=errors", "trace=broken/metrics.csv"], "trace broken/metrics.csv cannot be read: line 1 is no step"),
        (["kind=errors", "trace=none", "scale=cubic"], "scale = 'cubic' is not known"),
        (["kind=errors", "trace=none", "symmetry_order=0"], "symmetry_order = 0"),
        (["kind=confusion"], "or two of the same problems, trace=[A,B]"),
        (["kind=confusion", "trace=[a,b,c]"], "or two of the same problems"),
        (["kind=compare"], "suite = '': must be a folder that `marl-handover compare` wrote"),
        (["kind=compare", "suite=broken"], "results of a suite not found: broken/results.json"),
        (["kind=compare", "suite=suite"], "results of a suite suite/results.json cannot be read"),
        (["kind=compare", "suite=suite", "figure=a", "out=a.doc"], "out = 'a.doc': must be a file that ends in"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "metrics.csv").write_text(HEADER + "\n1,2,3,x,5,6\n")
    (tmp_path / "empty.json").write_text("{}")
    (tmp_path / "suite").mkdir()
    (tmp_path / "suite" / "results.json").write_text('{"figures": [{"name": "a", "kind": "bars"}]}')
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(["plot", *arguments]) == 2
    err = capsys.readouterr().err
    assert err.startswith("marl-handover plot: ")
    assert said in err
    assert err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before
