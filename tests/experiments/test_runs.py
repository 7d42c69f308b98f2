"""Tasks: done once, continued where they stopped, refused when they changed, independent of one another's failures."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from marl_handover.cell import load_cell
from marl_handover.commands import evaluate, train
from marl_handover.config import TaskConfig
from marl_handover.experiments import runs
from marl_handover.experiments.provenance import commits_of, fingerprint, read_record, settings_of, usual_settings
from marl_handover.experiments.runs import (
    Busy,
    ChangedRow,
    Grammar,
    IncompleteTask,
    Task,
    check_unchanged,
    clear,
    clear_all,
    execute,
    finished,
    plan_tasks,
)
from marl_handover.experiments.suite import load_suite
from marl_handover.files import package_path
from marl_handover.learning import trainer
from marl_handover.learning.evaluation import random_problems
from marl_handover.learning.settings import TrainConfig
from marl_handover.learning.trainer import Trainer
from marl_handover.task.rules import Rules

TRAIN, EVALUATE = Grammar(train.ALIASES, train.GROUPS), Grammar(evaluate.ALIASES, evaluate.GROUPS)
TINY = (
    "compile=off, steps=512, num_envs=16, evaluation_interval=128, evaluation_episodes=20, checkpoint_interval=256, "
    "algorithm.learning_starts=200, algorithm.batch_size=16, 'algorithm.actor_hidden=[16]', 'algorithm.critic_hidden=[16]'"
)
SUITE = f"""
train: [{TINY}]
rows:
  - {{name: b, train: []}}
  - {{name: exact, policy: exact}}
evaluations:
  - {{name: kinematic, arguments: [episodes=20]}}
  - {{name: shielded, arguments: [episodes=20], policy: "shielded:{{run}}"}}
"""


def planned(folder: Path, text: str = SUITE) -> dict[str, Task]:
    """Tasks by name, of one seed each."""
    (folder / "mine.yaml").write_text(text)
    suite = load_suite(str(folder / "mine.yaml")).with_seeds(1)
    return {task.row: task for task in plan_tasks(suite, folder / "out", TRAIN, EVALUATE)}


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A folder in which both tasks are done."""
    folder = tmp_path_factory.mktemp("suite")
    for task in planned(folder).values():
        assert not finished(task)
        assert execute(task)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_task_leaves_its_records(home):
    task = planned(home)["b"]
    assert finished(task)
    done = read_record(task.folder / "done.json")
    trained = read_record(task.folder / "trained.json")
    assert (done["row"], done["seed"], done["config_hash"]) == ("b", 0, fingerprint(settings_of(task.train)))
    assert done["arguments"] == list(task.arguments)
    assert done["commit"]
    assert done["machine"]["cores"] >= 1
    assert trained["step"] == 512
    assert done["wall_s"] > trained["wall_s"] > 0
    report = read_record(task.folder / "kinematic.json")
    assert (report["episodes"], report["seed"], report["policy"]) == (20, 100, str(task.folder / "run"))
    assert done["evaluations"] == {
        name: read_record(task.folder / f"{name}.json")["provenance"]["config_hash"] for name in ("kinematic", "shielded")
    }


def test_the_shields_figures_are_a_file_of_their_own(home):
    task = planned(home)["b"]
    shielded = read_record(task.folder / "shielded.json")
    assert shielded["policy"] == f"shielded:{task.folder / 'run'}"
    assert shielded["provenance"]["policy"] == "shielded:{run}"
    assert not (home / "out/exact/seed0/shielded.json").exists()


def test_what_is_done_is_not_done_again(home):
    before = contents(home / "out")
    for task in planned(home).values():
        execute(task)
    after = contents(home / "out")
    assert {name: text for name, text in after.items() if not name.endswith("done.json")} == {
        name: text for name, text in before.items() if not name.endswith("done.json")
    }


def test_a_run_that_was_interrupted_goes_on_from_its_checkpoint_and_lists_both_commits(home, tmp_path, monkeypatch):
    class Stopped(Exception):
        pass

    def stop(row):
        if row["step"] >= 384:
            raise Stopped

    task = replace(planned(tmp_path)["b"], commit="aaaaaaa")
    with monkeypatch.context() as patch:
        patch.setattr(trainer, "Trainer", partial(Trainer, on_evaluation=stop))
        with pytest.raises(Stopped):
            execute(task)
    assert not finished(task)
    begun = (task.folder / "run/metrics.csv").read_text().splitlines()
    execute(replace(task, commit="bbbbbbb"))
    assert finished(task)
    assert read_record(task.folder / "trained.json")["commits"] == ["aaaaaaa", "bbbbbbb"]
    assert read_record(task.folder / "kinematic.json")["provenance"]["commit"] == "bbbbbbb"
    whole = (task.folder / "run/metrics.csv").read_text().splitlines()
    assert whole[:3] == begun[:3]  # to the checkpoint at 256, the clock's readings included
    once = (home / "out/b/seed0/run/metrics.csv").read_text().splitlines()

    def timeless(lines):
        return [[value for index, value in enumerate(line.split(",")) if index != once[0].split(",").index("wall_s")] for line in lines]

    assert timeless(whole) == timeless(once)


@pytest.mark.parametrize(
    ("name", "text"),
    [("trained.json", "{"), ("done.json", "{}"), ("kinematic.json", '{"episodes": 20}'), ("kinematic.json", None), ("trained.json", "[]")],
)
def test_a_damaged_record_is_made_again_and_is_the_same(home, name, text):
    task = planned(home)["b"]
    path = task.folder / name
    before = read_record(path)
    kept = path.read_bytes()
    report = {**before, "provenance": {**before.get("provenance", {}), "settings": 3}}
    path.write_text(json.dumps(report) if text is None else text)
    assert not finished(task)
    check_unchanged(task)
    assert execute(task)
    assert finished(task)
    after = read_record(path)
    for key in ("step", "best_step", "success_rate", "outcomes", "evaluations", "config_hash"):
        assert after.get(key) == before.get(key)
    path.write_bytes(kept)


def test_a_run_of_which_nobody_knows_what_it_was_asked_is_begun_anew(tmp_path):
    task = planned(tmp_path)["b"]
    Trainer(replace(task.train, steps=256), Path(task.train.out)).run()
    assert execute(task)
    assert (read_record(task.folder / "trained.json")["step"], read_record(task.folder / "trained.json")["commits"]) == (512, [task.commit])


def test_records_of_before_commits_were_kept_are_whole(home):
    task = planned(home)["b"]
    for name in ("task.json", "trained.json"):
        stored = read_record(task.folder / name)
        del stored["commits"]
        (task.folder / name).write_text(json.dumps(stored))
    assert finished(task)
    check_unchanged(task)
    assert commits_of(read_record(task.folder / "trained.json")) == [task.commit]


def test_a_task_that_another_process_is_at_is_left_alone_until_that_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "GRACE_S", 0.0)
    tasks = planned(tmp_path, SUITE.replace("{name: b, train: []}", "{name: greedy, policy: greedy}"))
    task = tasks["greedy"]
    code = (
        "import sys; from pathlib import Path; from marl_handover.locks import held\n"
        "with held(Path(sys.argv[1])) as mine: print(mine, flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(task.folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "True\n"
        assert execute(task) is False
        assert not task.folder.exists()
        execute(tasks["exact"])
        with pytest.raises(Busy, match="greedy/seed0"):
            clear_all(list(tasks.values()), ["exact", "greedy"])
        assert finished(tasks["exact"])
        monkeypatch.setattr(runs, "GRACE_S", 60.0)
        threading.Timer(0.5, other.kill).start()
        assert execute(task) is True, "a dying worker's lock is waited for"
    finally:
        other.kill()
        other.wait()
    clear_all(list(tasks.values()), ["exact"])
    assert (finished(task), finished(tasks["exact"])) == (True, False)


def test_what_another_call_did_with_other_settings_meanwhile_is_not_taken_for_ours(home):
    task = planned(home)["b"]
    (task.folder / "done.json").rename(task.folder / "kept")
    with pytest.raises(ChangedRow, match="steps = 512"):
        execute(replace(task, train=replace(task.train, steps=640)))
    (task.folder / "kept").rename(task.folder / "done.json")


@pytest.mark.parametrize(
    ("old", "new", "what", "key"),
    [
        ("steps=512", "steps=640", "row b", "steps = 512, and now it is 640"),
        ("{name: b, train: []}", "{name: b, train: [algorithm.gamma=0.9]}", "row b", "algorithm.gamma = 0.95"),
        ("{name: b, train: []}", "{name: b, train: [algorithm=td3]}", "row b", "algorithm.name = 'sac'"),
        ("arguments: [episodes=20]}", "arguments: [episodes=30]}", "evaluation b/kinematic", "episodes = 20"),
        ('"shielded:{run}"', '"{run}"', "evaluation b/shielded", "policy = 'shielded:{run}'"),
    ],
)
def test_a_changed_row_is_refused_by_name_and_key(home, old, new, what, key):
    text = SUITE.replace("'algorithm.actor_hidden=[16]', 'algorithm.critic_hidden=[16]'", "") if "td3" in new else SUITE
    assert old in text
    task = planned(home, text.replace(old, new, 1))["b"]
    with pytest.raises(ChangedRow) as caught:
        check_unchanged(task)
    assert what in str(caught.value)
    assert key in str(caught.value)
    name = what.split()[1]
    assert f"overwrite=[{name}]" in str(caught.value)
    check_unchanged(task, [name])


def test_a_setting_that_is_taken_back_is_a_change(tmp_path):
    """The whole section is left out then, and its settings are no longer asked about."""
    quiet = SUITE.replace("  - {name: b, train: []}\n", "")
    noisy = quiet.replace("{name: kinematic, arguments: [episodes=20]}", "{name: kinematic, arguments: [episodes=20, NOISE]}")
    noisy = noisy.replace("NOISE", '"task.noise={position_mm:2,yaw_deg:2}"')
    execute(planned(tmp_path, noisy)["exact"])
    for text, key in ((quiet, r"task\.noise\.position_mm = 2"), (noisy.replace("position_mm:2", "position_mm:0"), "and now it is 0")):
        with pytest.raises(ChangedRow, match=key):
            check_unchanged(planned(tmp_path, text)["exact"])
    check_unchanged(planned(tmp_path, noisy)["exact"])


def test_another_file_of_the_same_name_is_a_change(tmp_path, monkeypatch):
    """A worker may stand in another folder, and who reads the report may have none of the files."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(package_path("pretrained/b.npz"), "mine.npz")
    rules = Rules(load_cell(), TaskConfig())
    problems = [
        json.dumps({"state": start.tolist(), "goal": goal.tolist()}) for start, goal in zip(*random_problems(rules, 3, 0), strict=True)
    ]
    Path("mine.jsonl").write_text("\n".join(problems[:2]))
    text = "rows: [{name: mine, policy: ./mine.npz}]\nevaluations: [{name: chosen, arguments: [problems=mine.jsonl]}]"
    task = planned(tmp_path, text)["mine"]
    monkeypatch.chdir("/")
    execute(task)
    assert read_record(task.folder / "chosen.json")["episodes"] == 2
    monkeypatch.chdir(tmp_path)
    check_unchanged(planned(tmp_path, text)["mine"])
    Path("mine.jsonl").write_text("\n".join(problems))
    with pytest.raises(ChangedRow, match="content of problems"):
        check_unchanged(planned(tmp_path, text)["mine"])
    Path("mine.jsonl").unlink()
    shutil.copy(package_path("pretrained/twin.npz"), "mine.npz")
    with pytest.raises(ChangedRow, match=r"content of policy.*overwrite=\[mine/chosen\]"):
        check_unchanged(planned(tmp_path, text)["mine"])
    Path("mine.npz").unlink()
    check_unchanged(planned(tmp_path, text)["mine"])


def test_an_unchanged_row_passes_and_so_does_one_older_than_a_setting(home):
    for task in planned(home).values():
        check_unchanged(task)
    task = planned(home)["b"]
    path = task.folder / "task.json"
    stored = json.loads(path.read_text())
    del stored["settings"]["algorithm.tau"]
    kept = path.read_text()
    path.write_text(json.dumps(stored))
    check_unchanged(task)
    other = replace(task, train=replace(task.train, algorithm=replace(task.train.algorithm, tau=0.5)))
    with pytest.raises(ChangedRow, match=r"algorithm\.tau = 0\.01, and now it is 0\.5"):
        check_unchanged(other)
    path.write_text(kept)


def test_fresh_throws_away_what_it_names_and_nothing_else(tmp_path):
    tasks = planned(tmp_path, SUITE.replace("{name: b, train: []}", "{name: greedy, policy: greedy}"))
    for task in tasks.values():
        execute(task)
        clear(task, ["greedy"])
    assert not tasks["greedy"].folder.exists()
    assert finished(tasks["exact"])
    clear(tasks["exact"], ["exact/kinematic"])
    assert not finished(tasks["exact"])
    assert list(tasks["exact"].folder.iterdir()) == []


def test_an_evaluation_that_fails_does_not_stop_the_others(tmp_path):
    text = SUITE.replace("{name: b, train: []}", "{name: greedy, policy: greedy}").replace(
        'policy: "shielded:{run}"', "policy: nowhere/run, rows: [exact]"
    )
    text = text.replace("  - {name: kinematic", "  - {name: broken, policy: nowhere/run}\n  - {name: kinematic")
    task = planned(tmp_path, text)["exact"]
    with pytest.raises(IncompleteTask, match=r"broken: MissingFile: .*nowhere/run.*; shielded: MissingFile"):
        execute(task)
    assert read_record(task.folder / "kinematic.json")["episodes"] == 20
    assert not finished(task)


def test_settings_are_told_apart_by_what_they_are_not_by_where():
    here, there = TrainConfig(out="a", progress=False), TrainConfig(out="b", resume="c")
    assert settings_of(here) == settings_of(there) == usual_settings(here)
    assert fingerprint(settings_of(here)) != fingerprint(settings_of(TrainConfig(seed=1)))
    assert settings_of(here)["curriculum"][-1] == {"epsilon_low_deg": 0.7, "epsilon_high_deg": 12.0, "until_step": 0, "until_success": 1.0}


def test_a_record_that_is_not_whole_counts_as_none(tmp_path):
    for text in ("", "{", "[1]"):
        (tmp_path / "a.json").write_text(text)
        assert read_record(tmp_path / "a.json") is None
    assert read_record(tmp_path / "none.json") is None
