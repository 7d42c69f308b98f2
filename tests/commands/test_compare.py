"""``marl-handover compare``: a whole small suite, done once, resumed, reported, with failures that stay apart."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from marl_handover.cell import cell_config
from marl_handover.cli import main
from marl_handover.commands import calibrate, compare
from marl_handover.compose import from_yaml
from marl_handover.control.evaluation import AssessmentConfig
from marl_handover.experiments import runs
from marl_handover.files import resource_path
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.locks import held

SUITE = """
title: Small
seeds: 2
train: [compile=off, steps=768, num_envs=16, evaluation_interval=256, evaluation_episodes=30, checkpoint_interval=768,
        algorithm.learning_starts=200, algorithm.batch_size=16]
rows:
  - {name: b, label: learned, train: []}
  - {name: exact, label: exact planner, policy: exact}
  - {name: random, policy: random}
evaluations:
  - {name: kinematic, arguments: [episodes=40]}
  - {name: noise, label: with noise, arguments: [episodes=40, "task.noise={position_mm:2,yaw_deg:2}"], rows: [b, exact], seeds: 1}
figures:
  - {name: learning, kind: curves}
  - {name: length, kind: curves, measure: training_mean_length, x: share}
  - {name: success, kind: bars}
  - {name: endings, kind: end_states, evaluations: [kinematic]}
  - {name: profiles, kind: profiles, evaluations: [kinematic]}
  - {name: workspace, kind: workspace}
tables:
  - {name: success, kind: evaluation, paths: true}
  - {name: costs, kind: milestones}
  - {name: pairs, kind: comparison, pairs: [[exact, b], [b, random]]}
  - {name: runs, kind: runs}
quick: {seeds: 1, train: [steps=256], evaluate: {kinematic: [episodes=5]}}
"""
FIGURES = ("learning", "length", "success", "endings", "profiles", "workspace")
TABLES = ("success", "costs", "pairs", "runs")


def compared(folder: Path, *arguments: str) -> int:
    return main(["compare", f"suite={folder / 'small.yaml'}", f"out={folder / 'out'}", "jobs=1", "progress=false", *arguments])


def results_at(out: Path):
    return json.loads((out / "results.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def results(folder: Path):
    return results_at(folder / "out")


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("compare")
    (folder / "small.yaml").write_text(SUITE)
    assert compared(folder) == 0
    return folder


def test_every_figure_and_table_is_there(home):
    assert {path.name for path in (home / "out/figures").iterdir()} == {f"{name}.{kind}" for name in FIGURES for kind in ("png", "pdf")}
    assert {path.name for path in (home / "out/tables").iterdir()} == {f"{name}.{kind}" for name in TABLES for kind in ("md", "csv")}


def test_results_hold_settings_seeds_and_commits_beside_the_numbers(home):
    found = results(home)
    assert (found["suite"], found["size"], found["missing"], found["failures"]) == ("small", "full", [], {})
    rows = {row["name"]: row for row in found["rows"]}
    assert rows["b"]["settings"]["steps"] == 768
    assert rows["b"]["seeds"] == [0, 1]
    assert rows["exact"]["settings"] is None
    for row in rows.values():
        for run in row["runs"]:
            for name, report in run["evaluations"].items():
                stored = json.loads((home / f"out/{row['name']}/seed{run['seed']}/{name}.json").read_text())
                assert (report["success_rate"], report["seed"]) == (stored["success_rate"], 100 + run["seed"])
                assert report["commit"] == stored["provenance"]["commit"]
    assert found["commits"]
    kinematic = rows["random"]["evaluations"]["kinematic"]
    own = [run["evaluations"]["kinematic"] for run in rows["random"]["runs"]]
    assert kinematic["success_rate"]["mean"] == pytest.approx(np.mean([report["success_rate"] for report in own]))
    assert kinematic["outcomes"] == {key: sum(report["outcomes"][key] for report in own) for key in kinematic["outcomes"]}
    assert rows["exact"]["evaluations"]["kinematic"]["success_rate"]["value"] == 1.0
    assert (rows["exact"]["evaluations"]["noise"]["runs"], "noise" in rows["random"]["evaluations"]) == (1, False)
    assert rows["b"]["curves"]["success_rate"]["step"] == [256, 512, 768]
    assert rows["b"]["milestones"]["99"]["runs"] == 2


def test_tables_say_what_the_results_say(home):
    found = results(home)
    with (home / "out/tables/success.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert [(line["row"], line["evaluation"]) for line in lines] == [
        *(("learned", "kinematic"), ("exact planner", "kinematic"), ("random", "kinematic")),
        *(("learned", "with noise"), ("exact planner", "with noise")),
    ]
    for line in lines:
        row = next(row for row in found["rows"] if row["label"] == line["row"])
        told = row["evaluations"]["kinematic" if line["evaluation"] == "kinematic" else "noise"]
        assert float(line["success_rate"]) == told["success_rate"]["value"]
        assert line["mean_steps_high"] == ("" if told["mean_steps"]["high"] is None else str(told["mean_steps"]["high"]))
    text = (home / "out/tables/success.md").read_text()
    assert "| exact planner | kinematic | 2 (≈ 50 %) | 80 | 100.00 [100.00, 100.00] | 100.00 |" in text
    assert "0 of 2" in (home / "out/tables/costs.md").read_text()
    assert "exact planner – learned | 1.00 [0.34, 1.00]" in (home / "out/tables/pairs.md").read_text()


def test_a_second_call_runs_nothing(home, capsys):
    before = {path: path.stat().st_mtime_ns for path in (home / "out").rglob("done.json")}
    assert len(before) == 6
    assert compared(home) == 0
    assert "6 of 6 runs are done already" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in (home / "out").rglob("done.json")} == before


@pytest.mark.slow
def test_an_interrupted_suite_does_what_is_left(home):
    lost = home / "out/exact/seed1"
    kept = {path: path.stat().st_mtime_ns for path in (home / "out").rglob("done.json") if lost not in path.parents}
    for name in ("done.json", "kinematic.json"):
        (lost / name).unlink()
    assert compared(home, "report_only=true") == 0
    assert (results(home)["missing"], results(home)["partial"]) == (["exact/seed1"], True)
    assert compared(home) == 0
    assert (results(home)["missing"], results(home)["partial"]) == ([], False)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept


@pytest.mark.slow
def test_a_changed_row_is_refused_and_made_anew_on_request(home, tmp_path, capsys):
    text = SUITE.replace("{name: kinematic, arguments: [episodes=40]}", "{name: kinematic, arguments: [episodes=50]}")
    (tmp_path / "small.yaml").write_text(text)
    arguments = ["compare", f"suite={tmp_path / 'small.yaml'}", f"out={home / 'out'}", "jobs=1", "progress=false", "rows=[random]"]
    before = results(home)
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    for word in ("random/kinematic", "episodes = 40", "now it is 50", "overwrite=[random/kinematic]"):
        assert word in err
    assert results(home) == before
    assert main([*arguments, "overwrite=[random/kinematic]"]) == 0
    assert [run["evaluations"]["kinematic"]["episodes"] for run in results(home)["rows"][0]["runs"]] == [50, 50]
    assert compared(home, "overwrite=[random]") == 0


def test_a_failing_row_does_not_stop_the_others(tmp_path, capsys):
    text = SUITE.replace("{name: random, policy: random}", "{name: random, policy: nowhere/run}")
    (tmp_path / "small.yaml").write_text(text)
    assert compared(tmp_path, "rows=[exact,random]") == 1
    err = capsys.readouterr().err.splitlines()[-1]
    for word in ("2 of 4 runs failed", "random/seed0", "random/seed1", "nowhere/run"):
        assert word in err
    found = results(tmp_path)
    assert set(found["failures"]) == {"random/seed0", "random/seed1"}
    assert found["rows"][0]["evaluations"]["kinematic"]["success_rate"]["value"] == 1.0
    assert (tmp_path / "out/figures/success.png").exists()


def test_the_smoke_size_has_a_folder_and_fewer_seeds_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").write_text(SUITE)
    assert main(["compare", "suite=./small.yaml", "preset=quick", "jobs=1", "progress=false", "rows=[exact]"]) == 0
    found = json.loads((tmp_path / "runs/compare/small-quick/results.json").read_text())
    assert (found["size"], found["rows"][0]["seeds"]) == ("quick", [0])
    assert found["rows"][0]["evaluations"]["kinematic"]["episodes"] == 5


@pytest.mark.parametrize(
    ("argument", "word"),
    [
        ("preset=small", "full, quick"),
        ("rows=[c]", "b, exact, random"),
        ("overwrite=[c]", "exact, exact/kinematic, exact/noise"),
        ("overwrite=[exact/shielded]", "exact/noise"),
        ("seeds=-1", "seeds"),
        ("address=auto", "launcher=loky"),
        ("launcher=slurm", "loky, ray"),
        ("suite=papper", "paper"),
        ("suite=./none.yaml", "none.yaml"),
        ("suit=x", "suite"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(tmp_path, capsys, argument, word):
    (tmp_path / "small.yaml").write_text(SUITE)
    assert compared(tmp_path, "rows=[exact]", argument) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1), err
    assert "Traceback" not in err
    assert word in err


def test_fresh_knows_which_evaluations_a_row_has(tmp_path, capsys):
    (tmp_path / "small.yaml").write_text(SUITE)
    assert compared(tmp_path, "overwrite=[random/noise]") == 2
    assert "random/kinematic" in capsys.readouterr().err
    assert compared(tmp_path, "overwrite=[random]", "report_only=true") == 2
    assert "makes nothing anew" in capsys.readouterr().err


@pytest.mark.parametrize("wrong", ["launcher=rya", "jobs=-1", "launcher=ray address=127.0.0.1:1"])
def test_nothing_is_thrown_away_before_there_is_somebody_to_make_it_anew(tmp_path, capsys, wrong):
    if "address" in wrong:
        pytest.importorskip("ray", reason="the ray extra is not installed")
    (tmp_path / "small.yaml").write_text(SUITE)
    assert compared(tmp_path, "rows=[exact]", "seeds=1") == 0
    before = (tmp_path / "out/exact/seed0/kinematic.json").read_bytes()
    assert compared(tmp_path, "rows=[exact]", "seeds=1", "overwrite=[exact]", *wrong.split()) != 0
    assert (tmp_path / "out/exact/seed0/kinematic.json").read_bytes() == before
    assert "Traceback" not in capsys.readouterr().err


def test_all_rows_get_their_first_seed_before_any_gets_its_second(tmp_path, monkeypatch):
    (tmp_path / "small.yaml").write_text(SUITE)
    done = []
    monkeypatch.setattr(runs, "_do", lambda task, do=runs._do: (done.append(task.name), do(task)))
    assert compared(tmp_path, "rows=[exact,random]") == 0
    assert done == ["exact/seed0", "random/seed0", "exact/seed1", "random/seed1"]


def test_a_part_of_a_suite_says_so_and_leaves_no_pictures_of_another_time(tmp_path, capsys):
    (tmp_path / "small.yaml").write_text(SUITE)
    for folder in ("tables", "figures"):
        (tmp_path / "out" / folder).mkdir(parents=True)
    for old in ("figures/learning.png", "figures/learning.pdf", "tables/costs.md", "figures/mine.txt"):
        (tmp_path / "out" / old).write_text("of another time")
    assert compared(tmp_path, "rows=[exact]", "seeds=1") == 0
    assert "partial" in capsys.readouterr().out
    found = results(tmp_path)
    assert found["partial"]
    assert [(part["row"], part["done"], part["of"], part["seeds"]) for part in found["progress"]] == [
        ("b", 0, 2, []),
        ("exact", 1, 2, [0]),
        ("random", 0, 2, []),
    ]
    assert found["missing"] == []
    assert set(found["empty_figures"]) == {"learning", "length"}
    assert {path.name for path in (tmp_path / "out/figures").iterdir()} == {
        "mine.txt",
        *(f"{name}.{kind}" for name in FIGURES for kind in ("png", "pdf") if name not in ("learning", "length")),
    }
    assert {path.stem for path in (tmp_path / "out/tables").iterdir()} == {"success"}


@pytest.mark.slow
def test_a_run_that_cannot_be_read_is_told_and_the_others_are_reported(home, capsys):
    metrics = home / "out/b/seed0/run/metrics.csv"
    kept = metrics.read_bytes()
    metrics.write_bytes(kept + kept)
    assert compared(home) == 1
    err = capsys.readouterr().err
    for word in ("1 of 6 runs failed", "b/seed0: cannot be read", "metrics.csv", "overwrite=[b]"):
        assert word in err
    found = results(home)
    assert (list(found["failures"]), found["missing"]) == (["b/seed0"], ["b/seed0"])
    assert found["rows"][0]["seeds"] == [1]
    metrics.write_bytes(kept)
    assert compared(home) == 0


@pytest.mark.slow
def test_two_calls_at_one_folder_do_each_run_once(tmp_path):
    (tmp_path / "small.yaml").write_text(SUITE)
    call = [sys.executable, "-m", "marl_handover.cli", "compare", f"suite={tmp_path / 'small.yaml'}", f"out={tmp_path / 'out'}"]
    calls = [
        subprocess.Popen([*call, "jobs=1", "progress=false", "rows=[b]", "seeds=1"], stderr=subprocess.PIPE, text=True) for _ in range(2)
    ]
    told = [(process.communicate(timeout=120)[1], process.returncode) for process in calls]
    assert 0 in [code for _, code in told]
    assert all(code == 0 or "another call is at work at b/seed0" in err for err, code in told)
    assert len((tmp_path / "out/b/seed0/run/metrics.csv").read_text().splitlines()) == 4
    assert compared(tmp_path, "rows=[b]", "seeds=1") == 0


@pytest.mark.slow
def test_out_may_be_relative_and_what_is_not_done_is_no_success(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runs, "GRACE_S", 0.0)
    (tmp_path / "small.yaml").write_text(SUITE)
    with held(tmp_path / "mine/exact/seed0") as mine:
        assert mine
        assert main(["compare", "suite=./small.yaml", "out=mine", "jobs=1", "progress=false", "rows=[exact]"]) == 1
    assert "another call is at work at exact/seed0" in capsys.readouterr().err
    assert results_at(tmp_path / "mine")["missing"] == ["exact/seed0"]
    assert main(["compare", "suite=./small.yaml", "out=mine", "jobs=1", "progress=false", "rows=[exact]"]) == 0


def test_a_file_in_place_of_the_folder_is_refused(tmp_path, capsys):
    (tmp_path / "small.yaml").write_text(SUITE)
    (tmp_path / "out").write_text("mine")
    assert compared(tmp_path) == 2
    assert "a folder; this is a file" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.slow
def test_the_papers_suite_in_its_smoke_size(tmp_path):
    """Every figure and table of the paper, in minutes."""
    assert main(["compare", "suite=paper", "preset=quick", f"out={tmp_path}", "jobs=2", "progress=false"]) == 0
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["missing"] == []
    for part, kinds in (("figures", ("png", "pdf")), ("tables", ("md", "csv"))):
        assert {path.name for path in (tmp_path / part).iterdir()} == {f"{item['name']}.{kind}" for item in found[part] for kind in kinds}


def test_a_twin_of_more_arms_is_calibrated_in_its_own_folder_and_cell(tmp_path, monkeypatch):
    """Once for all rows, and not again where somebody has done it; a pair's is that of the shipped twin."""
    asked = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(calibrate, "run", lambda config: asked.append((str(config.folder()), config.cell.name)))
    three = from_yaml(HardwareConfig, resource_path("configs/hardware/triangle.yaml"))
    jobs = [
        AssessmentConfig(backend="twin", cell=cell_config("triangle"), hardware=three),
        AssessmentConfig(backend="twin"),
        AssessmentConfig(backend="twin", calibration="elsewhere"),
        AssessmentConfig(backend="kinematic"),
    ]
    compare._calibrate_twin([SimpleNamespace(jobs=[SimpleNamespace(config=job)]) for job in jobs])
    assert asked == [("runs/calibration/triangle_twin", "triangle"), ("runs/calibration/twin", "paper")]
