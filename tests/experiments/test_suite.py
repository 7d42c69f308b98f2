"""Suites: the shipped ones hold together and compose; what is wrong in a file is refused by entry and key."""

from __future__ import annotations

from pathlib import Path

import pytest

from marl_handover.commands import evaluate, train
from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile, UnknownChoice
from marl_handover.experiments.runs import BadRow, Grammar, plan_tasks
from marl_handover.experiments.suite import Suite, load_suite, suite_folder

TRAIN, EVALUATE = Grammar(train.ALIASES, train.GROUPS), Grammar(evaluate.ALIASES, evaluate.GROUPS)
SHIPPED = sorted(path.stem for path in suite_folder().glob("*.yaml"))

MINIMAL = """
title: T
seeds: 3
train: [steps=1000]
rows:
  - {name: a, train: [architecture=A], seeds: 2}
  - {name: b, train: []}
  - {name: exact, policy: exact, evaluate: [architecture=A]}
evaluations:
  - {name: kinematic, arguments: [episodes=10]}
  - {name: shielded, policy: "shielded:{run}", seeds: 1}
  - {name: chosen, arguments: [epsilon_deg=2], rows: [a]}
quick: {seeds: 1, train: [steps=50], evaluate: {kinematic: [episodes=2]}}
"""


def written(tmp_path: Path, text: str) -> str:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return str(path)


@pytest.fixture
def suite(tmp_path) -> Suite:
    return load_suite(written(tmp_path, MINIMAL))


def test_nine_suites_are_shipped():
    assert SHIPPED == ["ablations", "charts", "engines", "ladder", "many_arms", "paper", "paper_steps", "seeds", "variants"]


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("size", ["full", "quick"])
def test_every_shipped_row_composes(name, size):
    suite, refused = load_suite(name).sized(size), []
    for row in suite.rows:
        try:
            tasks = plan_tasks(suite.with_rows([row.name]), Path("out"), TRAIN, EVALUATE)
            assert [task.seed for task in tasks] == list(suite.seeds_of(row))
            assert tasks[0].jobs
        except BadRow as error:
            refused.append(str(error))
    assert not refused


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_suite_has_its_seeds_and_pictures_of_each_kind_it_names(name):
    suite = load_suite(name)
    assert suite.seeds == {"seeds": 20, "paper_steps": 3}.get(name, 5)
    trained = any(row.train is not None for row in suite.rows)
    assert ({"evaluation", "milestones", "runs"} if trained else {"evaluation", "paired"}) <= {table.kind for table in suite.tables}
    assert ({"curves", "bars"} if trained else set()) <= {figure.kind for figure in suite.figures}


def test_tasks_are_rows_by_seeds_with_arguments_from_weak_to_strong(suite):
    tasks = plan_tasks(suite, Path("out"), TRAIN, EVALUATE)
    assert [task.name for task in tasks] == [
        "a/seed0",
        "a/seed1",
        "b/seed0",
        "b/seed1",
        "b/seed2",
        "exact/seed0",
        "exact/seed1",
        "exact/seed2",
    ]
    first = tasks[0]
    assert first.train is not None
    assert (first.train.steps, first.train.task.architecture, first.train.seed) == (1000, "A", 0)
    home = Path("out").absolute()  # workers may stand elsewhere
    assert first.train.out == str(home / "a/seed0/run")
    assert [(j.name, j.config.policy, j.config.seed, j.config.episodes) for j in first.jobs] == [
        ("kinematic", f"{home}/a/seed0/run", 100, 10),
        ("shielded", f"shielded:{home}/a/seed0/run", 100, 1000),
        ("chosen", f"{home}/a/seed0/run", 100, 1000),
    ]
    assert [j.name for j in tasks[1].jobs] == ["kinematic", "chosen"]
    untrained = tasks[-1]
    assert untrained.train is None
    assert [(j.name, j.config.policy, j.config.task.architecture, j.config.seed) for j in untrained.jobs] == [
        ("kinematic", "exact", "A", 102)
    ]


def test_the_smoke_size_has_the_last_word(suite):
    tasks = plan_tasks(suite.sized("quick"), Path("out"), TRAIN, EVALUATE)
    assert [task.name for task in tasks] == ["a/seed0", "b/seed0", "exact/seed0"]
    assert tasks[0].train is not None
    assert tasks[0].train.steps == 50
    assert tasks[0].jobs[0].config.episodes == 2
    assert suite.sized("full") == suite


def test_seeds_and_rows_from_the_command_line(suite):
    more = suite.with_seeds(7)
    assert [len(more.seeds_of(row)) for row in more.rows] == [7, 7, 7]
    assert [len([seed for seed in range(7) if spec in more.evaluations_of(more.row("a"), seed)]) for spec in more.evaluations] == [7, 1, 7]
    assert [row.name for row in suite.with_rows(["exact", "a"]).rows] == ["a", "exact"]
    with pytest.raises(UnknownChoice, match="a, b, exact"):
        suite.with_rows(["c"])
    with pytest.raises(UnknownChoice, match="full, quick"):
        suite.sized("small")
    with pytest.raises(InvalidSetting, match="seeds"):
        suite.with_seeds(0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("title: T", "titel: T", "unknown key 'titel'"),
        ("{name: b, train: []}", "{name: b, trian: []}", r"rows\[1\] \(b\): unknown key 'trian'; keys: name"),
        ("{name: b, train: []}", "{name: b, train: 3}", r"rows\[1\] \(b\)"),
        ("{name: b, train: []}", "b", r"rows\[1\]: expected key: value"),
        ("{name: b, train: []}", "{name: a, train: []}", "rows: a: the name is taken"),
        ("{name: b, train: []}", "{name: ../b, train: []}", "small letters"),
        ("{name: b, train: []}", "{name: b}", "give `train`"),
        ("{name: b, train: []}", "{name: b, train: [], policy: exact}", "give `train`"),
        ("{name: b, train: []}", "{name: b, policy: 'shielded:{run}'}", "is not trained"),
        ("{name: b, train: []}", "{name: b, train: [], seeds: -1}", r"\(b\): seeds = -1"),
        ("rows: [a]", "rows: [z]", "'z' is not known; choose one of: a, b, exact"),
        ("seeds: 1}\n", "rows: [exact]}\n", "row exact is not trained"),
        ("{kinematic: [episodes=2]}", "{bullet: [episodes=2]}", "quick.evaluate = 'bullet'"),
        ("quick: {seeds: 1", "quick: {seeds: 0", "quick: seeds = 0"),
        ("quick:", "figures: [{name: f, kind: pie}]\nquick:", "curves, bars"),
        ("quick:", "figures: [{name: f, kind: curves, rows: [z]}]\nquick:", "figures: f: rows"),
        ("quick:", "figures: [{name: f, kind: curves, measure: loss}]\nquick:", "figures: f: measure"),
        ("quick:", "figures: [{name: f, kind: curves, x: days}]\nquick:", "figures: f: x"),
        ("quick:", "figures: 3\nquick:", "figures: expected a list"),
        ("{name: b, train: []}", "{name: b, train: [seed=3]}", "rows: b: train: seed=3 would be ignored"),
        ("train: [steps=1000]", "train: [out=here]", "train: out=here would be ignored"),
        ("train: [steps=50]", "train: [resume=runs/a]", "quick.train: resume=runs/a would be ignored"),
        ("arguments: [episodes=10]", "arguments: [policy=exact]", "evaluations: kinematic: arguments: policy=exact would be ignored"),
        ("evaluate: [architecture=A]", "evaluate: [seed=4]", "rows: exact: evaluate: seed=4 would be ignored"),
        ("quick:", "figures: [{name: f, kind: end_states, measure: mean_steps}]\nquick:", "figures: f: measure: the kind end_states"),
        ("quick:", "figures: [{name: f, kind: bars, measure: mean_steps}]\nquick:", "figures: f: measure"),
        ("quick:", "figures: [{name: f, kind: bars, x: share}]\nquick:", "figures: f: x: the kind bars"),
        ("quick:", "figures: [{name: f, kind: curves, evaluations: [kinematic]}]\nquick:", "figures: f: evaluations: the kind curves"),
        ("quick:", "tables: [{name: t, kind: runs, pairs: [[a, b]]}]\nquick:", "tables: t: pairs: the kind runs"),
        ("quick:", "tables: [{name: t, kind: comparison}]\nquick:", "a comparison needs some"),
        ("quick:", "tables: [{name: t, kind: comparison, pairs: [[a]]}]\nquick:", "a pair has two rows"),
        ("quick:", "tables: [{name: t, kind: paired, evaluations: [kinematic]}]\nquick:", "two of them are held against each other"),
        ("quick:", "tables: [{name: t, kind: comparison, pairs: [[a, z]]}]\nquick:", "tables: t: pairs"),
        ("seeds: 3", "seeds: 99999999999", "seeds = 99999999999: must be between 1 and 1000"),
        ("{name: b, train: []}", "{name: b, train: [], seeds: 1001}", r"\(b\): seeds = 1001"),
        ("{name: chosen", "{name: done", "evaluations: done: a run's own records are called so"),
        ("quick:", "figures: [{name: f, kind: bars}]\nquick:", r"figures: f: evaluations: shielded ones \(shielded\) would be mixed"),
        ("quick:", "tables: [{name: t, kind: evaluation}]\nquick:", "tables: t: evaluations: .* with kinematic, chosen"),
        ("quick:", "figures: [{name: f, kind: profiles, rows: [b], evaluations: [chosen]}]\nquick:", "f: rows: b would be left out"),
        ("quick:", "figures: [{name: f, kind: profiles, evaluations: [kinematic, shielded]}]\nquick:", "mixed with kinematic; name"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path, old, new, words):
    assert old in MINIMAL
    with pytest.raises(CorruptFile, match=words):
        load_suite(written(tmp_path, MINIMAL.replace(old, new, 1)))


def test_a_suite_needs_rows_and_a_file(tmp_path):
    with pytest.raises(CorruptFile, match="number of rows"):
        load_suite(written(tmp_path, "title: nothing"))
    with pytest.raises(UnknownChoice, match="paper"):
        load_suite("papper")
    with pytest.raises(MissingFile):
        load_suite(str(tmp_path / "none.yaml"))


def test_both_kinds_of_evaluation_stand_side_by_side_where_the_suite_names_them(tmp_path):
    text = MINIMAL.replace("quick:", "figures: [{name: f, kind: bars, evaluations: [kinematic, shielded]}]\nquick:")
    assert load_suite(written(tmp_path, text)).figures[0].evaluations == ["kinematic", "shielded"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("{name: b, train: []}", "{name: b, policy: rndom}", "row b: policy = 'rndom' is not known; choose one of: exact, random"),
        ("{name: b, train: []}", "{name: b, train: [], evaluate: [architecture=A]}", "kinematic: task.architecture = 'A': must be B"),
        (
            "{name: b, train: []}",
            "{name: b, train: [variant=centralised], evaluate: [backend=bullet]}",
            "kinematic for variant=centralised",
        ),
        ("{name: b, train: []}", "{name: b, train: [variant=decentralised, algorithm=td3]}", "'td3' is not known; choose one of: sac"),
        ("{name: b, train: []}", "{name: b, train: [algorithm.layout=raw]}", "algorithm.layout = 'raw'"),
    ],
)
def test_what_could_never_be_done_is_told_before_anything_is(tmp_path, old, new, words):
    suite = load_suite(written(tmp_path, MINIMAL.replace(old, new, 1)))
    with pytest.raises(BadRow, match=words):
        plan_tasks(suite, Path("out"), TRAIN, EVALUATE)


@pytest.mark.parametrize("argument", ["steps=0", "stepz=3", "architecture=C"])
def test_bad_settings_are_told_with_their_row(tmp_path, argument):
    suite = load_suite(written(tmp_path, MINIMAL.replace("train: []", f"train: ['{argument}']")))
    with pytest.raises(BadRow, match="^row b: "):
        plan_tasks(suite, Path("out"), TRAIN, EVALUATE)


def test_bad_evaluation_settings_too(tmp_path):
    suite = load_suite(written(tmp_path, MINIMAL.replace("epsilon_deg=2", "json=x")))
    with pytest.raises(BadRow, match="row a: unknown key 'json"):
        plan_tasks(suite, Path("out"), TRAIN, EVALUATE)


def test_policies_that_are_paths_are_found_from_everywhere(tmp_path):
    rows = "{name: mine, policy: 'shielded:runs/x'}\n  - {name: b, policy: greedy}"
    suite = load_suite(written(tmp_path, MINIMAL.replace("{name: b, train: []}", rows)))
    policies = {task.row: task.jobs[0].config.policy for task in plan_tasks(suite, Path("out"), TRAIN, EVALUATE)}
    assert policies["mine"] == f"shielded:{Path('runs/x').absolute()}"
    assert (policies["b"], policies["exact"]) == ("greedy", "exact")


def test_what_the_papers_suite_compares_knows_nothing_of_the_shield():
    for table in load_suite("paper").tables:
        assert table.kind != "comparison" or (table.evaluations and "shielded" not in table.evaluations)
