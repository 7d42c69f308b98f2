"""``evaluate ladder=RUNG`` and ``compare suite=ladder``: the rung's problems, the regret that its trace shows, one line for bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from marl_handover.cli import main
from marl_handover.commands import evaluate, train
from marl_handover.errors import CorruptFile
from marl_handover.experiments.runs import Grammar, plan_tasks
from marl_handover.experiments.suite import load_suite
from marl_handover.experiments.tables import csv_text, make_tables, markdown
from marl_handover.task.ladder import rung, rungs

NAMES = [each.name for each in rungs()]


def evaluated(folder, *arguments):
    command = ["evaluate", *arguments, f"json={folder / 'report.json'}", f"trace={folder / 'trace.jsonl'}", "progress=false"]
    assert main(command) == 0
    trace = [json.loads(line) for line in (folder / "trace.jsonl").read_text().splitlines()]
    return json.loads((folder / "report.json").read_text()), trace


@pytest.mark.parametrize(
    ("name", "policy", "count"), [("pair", "greedy", 60), ("triangle_discs", "greedy", 60), ("pair_1deg", "pretrained_b", 40)]
)
def test_the_regret_is_what_the_trace_shows(name, policy, count, tmp_path, capsys):
    report, trace = evaluated(tmp_path, f"ladder={name}", f"policy={policy}", f"episodes={count}")
    of, each = rung(name), []
    for number in range(count):
        steps = [row for row in trace if row["episode"] == number]
        assert steps[0]["state"] == of.fixed.start[number].tolist()
        assert steps[0]["goal"] == of.fixed.goal[number].tolist()
        each.append((len(steps) if steps[-1]["outcome"] == "success" else 20) - of.fixed.optimum[number])
    assert report["regret"] == pytest.approx(np.mean(each))
    low, high = report["regret_ci95"]
    assert low <= report["regret"] <= high
    assert high - low == pytest.approx(2 * 1.96 * np.std(each) / np.sqrt(count), rel=1e-3)
    assert report["ladder"] == {"rung": name, "id": of.id, "sha256": of.sha256, "max_steps": 20}
    assert report["optimal_mean_steps"] == of.fixed.optimum[:count].mean()
    assert (report["epsilon_deg"], report["episodes"]) == (of.epsilon_deg, count)
    assert {"commit", "machine"} <= set(report)
    assert f"regret of a problem {report['regret']:.4f}" in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
def test_the_exact_policy_has_no_regret_where_arms_are_exact(name, tmp_path):
    report, _ = evaluated(tmp_path, f"ladder={name}", "policy=exact", "episodes=100")
    assert report["optimal_mean_steps"] == rung(name).fixed.optimum[:100].mean()
    if rung(name).is_noisy:
        assert report["noise"] == {"position_mm": 1.0, "yaw_deg": 0.5}
        assert 0 <= report["regret"] < 2
    else:
        assert report["regret"] == 0
        assert "noise" not in report


def test_a_policy_of_architecture_a_climbs_too(tmp_path):
    report, _ = evaluated(tmp_path, "ladder=pair", "policy=pretrained_a", "episodes=100")
    assert report["architecture"] == "A"
    assert 0 <= report["regret"] < 0.2


def test_the_loop_plays_a_rung_on_noisy_arms(tmp_path):
    report, _ = evaluated(tmp_path, "ladder=pair_noisy", "policy=exact", "episodes=3", "backend=noisy")
    assert report["ladder"]["rung"] == "pair_noisy"
    assert report["noise"]["position_mm"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["ladder=pears"], "ladder = 'pears' is not known; choose one of: pair, pair_1deg, pair_noisy, pair_discs"),
        (["ladder=pair", "cell=al5a"], "cell = 'al5a': must be left out with ladder=pair"),
        (["ladder=pair", "epsilon_deg=2"], "task.epsilon_deg = 2.0: must be left out with ladder=pair"),
        (["ladder=pair", "problems=mine.jsonl"], "problems = 'mine.jsonl': must be left out"),
        (["ladder=pair", "layouts.count=3"], "layouts = "),
        (["ladder=pair_noisy", "backend=bullet"], "backend = 'bullet': must be kinematic or noisy for ladder=pair_noisy"),
        (["ladder=triangle", "policy=pretrained_b"], "this cell has 3: north, west, east"),
    ],
)
def test_bad_input_is_one_line(arguments, told, capsys):
    assert main(["evaluate", *arguments, "progress=false"]) == 2
    said = capsys.readouterr().err.strip()
    assert told in said
    assert "\n" not in said
    assert len(said) <= 340


def test_a_file_that_was_changed_is_one_line(tmp_path, monkeypatch, capsys):
    from marl_handover.task import ladder

    (tmp_path / "pair.jsonl").write_text("{}\n")
    monkeypatch.setattr(ladder, "rung", lambda name: ladder.replace(rung(name)))
    monkeypatch.setattr("marl_handover.control.evaluation.rung", ladder.rung)
    monkeypatch.setattr(ladder.Rung, "path", tmp_path / "pair.jsonl")
    assert main(["evaluate", "ladder=pair", "progress=false"]) == 2
    assert "pair.jsonl was changed: its SHA-256 is" in capsys.readouterr().err


def test_the_suite_judges_every_row_on_each_rung_that_it_takes():
    suite = load_suite("ladder")
    assert [spec.name for spec in suite.evaluations] == NAMES
    assert [spec.arguments for spec in suite.evaluations] == [[f"ladder={name}"] for name in NAMES]
    taken: dict[str, list[str]] = {}
    for row in suite.rows:
        taken.setdefault(row.label, []).extend(spec.name for spec in suite.evaluations_of(row, 0))
    pairs = [name for name in NAMES if rung(name).chart == "paper"]
    assert all(rung(name).load_cell().num_arms == 2 for name in pairs)
    for label, names in taken.items():
        of_two = label in ("DQN", "the paper's SAC, A", "the paper's SAC, B", "ours for the pair, shipped")
        assert sorted(names) == sorted(pairs if of_two else NAMES), label
    own = [row for row in suite.rows if row.label == "ours for the one cell"]
    grammars = Grammar(train.ALIASES, train.GROUPS), Grammar(evaluate.ALIASES, evaluate.GROUPS)
    for task in plan_tasks(suite.with_rows([row.name for row in own]), Path("out"), *grammars):
        for name in suite.row(task.row).only:
            assert task.train.cell.arms == rung(name).cell_config.arms
            assert task.train.cell.obstacles == rung(name).cell_config.obstacles


SUITE = """
seeds: 2
rows:
  - {name: greedy, policy: greedy}
  - {name: two, label: for two, policy: pretrained_b, only: [pair], because: it has two arms, seeds: 1}
  - {name: later, label: not yet, train: [], only: [pair], because: it has two arms}
evaluations:
  - {name: pair, label: the pair, arguments: [ladder=pair, episodes=20]}
  - {name: three, arguments: [ladder=triangle, episodes=20]}
tables: [{name: regret, kind: ladder}]
"""


def compared(folder, text, *arguments):
    (folder / "mine.yaml").write_text(text)
    return main(["compare", f"suite={folder / 'mine.yaml'}", f"out={folder / 'out'}", "jobs=1", "progress=false", *arguments])


def test_the_table_says_what_was_not_run_and_what_has_no_place_there(tmp_path):
    assert compared(tmp_path, SUITE, "rows=[greedy,two]") == 0
    assert compared(tmp_path, SUITE, "report_only=true") == 0
    results = json.loads((tmp_path / "out/results.json").read_text())
    (table,) = make_tables(results)
    lines = markdown(table).splitlines()
    assert lines[0] == "| rung | optimum | greedy | for two | not yet |"
    pair, three = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:4])
    reports = [json.loads((tmp_path / f"out/greedy/seed{seed}/pair.json").read_text()) for seed in (0, 1)]
    each = [report["regret"] for report in reports]
    assert pair[:2] == ["the pair", f"{rung('pair').fixed.optimum[:20].mean():.3f}"]
    assert pair[2].startswith(f"{np.mean(each):.3f} [{min(each):.3f}, {max(each):.3f}], ")
    assert pair[4] == "not run"
    assert three[3:] == ["–", "–"]
    assert "– *for two*: it has two arms." in lines
    assert reports[0]["provenance"]["contents"]["ladder"] == rung("pair").sha256[:12]
    assert csv_text(table).splitlines()[2].endswith("," * 8)


@pytest.mark.parametrize(
    ("found", "put", "told"),
    [
        ("only: [pair], because: it has two arms, seeds", "only: [pair], seeds", "`only` some evaluations and `because` go together"),
        ("only: [pair], because: it has two arms, seeds", "only: [pears], because: no, seeds", "pears"),
        ("arguments: [ladder=triangle, episodes=20]", "arguments: [cell=triangle]", "three is not on a rung"),
    ],
)
def test_a_suite_that_makes_no_sense_is_refused(found, put, told, tmp_path):
    (tmp_path / "mine.yaml").write_text(SUITE.replace(found, put))
    with pytest.raises(CorruptFile, match=told):
        load_suite(str(tmp_path / "mine.yaml"))
