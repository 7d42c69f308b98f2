"""Searching for settings: spaces, storages, trials that fail, are ended early or killed."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from dataclasses import replace

import optuna
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from optuna.trial import TrialState, create_trial

from marl_handover.commands.train import resumed
from marl_handover.errors import CorruptFile, UnknownKey
from marl_handover.experiments import tune
from marl_handover.experiments.tune import ChangedStudy, Search, applied, load_space, prepare, run_trial, run_trials, value_of
from marl_handover.experiments.tune_storage import (
    TRIES,
    abandoned,
    claimed,
    counted,
    give_back,
    hidden,
    located,
    open_study,
    place_of,
    running,
)
from marl_handover.files import resource_path
from marl_handover.learning.settings import ALGORITHMS, OffPolicyConfig, TrainConfig
from marl_handover.learning.trainer import validation_score

SPACES = resource_path("configs") / "search"
SPACE = "algorithm.gamma: {type: float, low: 0.9, high: 0.99}\nalgorithm.batch_size: {type: categorical, choices: [32, 64]}\n"


def training(algorithm="sac"):
    config = TrainConfig(algorithm=ALGORITHMS[algorithm](), steps=256, num_envs=16, evaluation_interval=64, evaluation_episodes=20)
    config.algorithm.batch_size = 32
    if isinstance(config.algorithm, OffPolicyConfig):
        config.algorithm.learning_starts, config.algorithm.env_steps_per_gradient_step = 64, 32
    config.compile = "off"
    return config


@pytest.fixture
def search(tmp_path):
    """A search of seconds, in a journal file."""
    origin = tmp_path / "space.yaml"
    origin.write_text(SPACE)
    train = training()
    space = load_space(origin, train)
    return Search("study", str(tmp_path / "study.journal"), train, space, origin, tmp_path / "trials", trials=3, seed=5, pruner="none")


def carried_out(search):
    study, left = prepare(search)
    notes = list(run_trials(search, study, left, jobs=1, progress=False))
    return study, notes


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_every_algorithm_has_a_space_around_its_defaults(name):
    config = TrainConfig(algorithm=ALGORITHMS[name]())
    space = load_space(SPACES / f"{name}.yaml", config)
    assert len(space) > 5
    for parameter in space:
        assert parameter.contains(value_of(config, parameter.key)), parameter.key


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_what_is_drawn_lies_in_the_space_and_becomes_a_valid_configuration(name):
    config = TrainConfig(algorithm=ALGORITHMS[name]())
    space = load_space(SPACES / f"{name}.yaml", config)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    for _ in range(4):
        trial = study.ask()
        values = {parameter.key: parameter.suggest(trial) for parameter in space}
        assert all(parameter.contains(values[parameter.key]) for parameter in space)
        assert {parameter.key: parameter.stored(values[parameter.key]) for parameter in space} == trial.params
        assert {parameter.key: parameter.read(trial.params[parameter.key]) for parameter in space} == values
        changed = applied(config, values, SPACES)
        changed.validate()
        assert {key: value_of(changed, key) for key in values} == values
        study.tell(trial, 0.0)


def test_only_what_is_named_is_changed():
    config = training("td3")
    changed = applied(config, {"algorithm.hidden": [64, 32], "replay.symmetry": True}, SPACES)
    assert (changed.algorithm.hidden, changed.replay.symmetry) == ([64, 32], True)
    changed.algorithm.hidden, changed.replay.symmetry = config.algorithm.hidden, config.replay.symmetry
    assert changed == config


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("algorithm.gama: {type: float, low: 0.9, high: 0.99}", ("algorithm.gama", "gamma")),
        ("nowhere.gamma: {type: float, low: 0.9, high: 0.99}", ("nowhere",)),
        ("seed.gamma: {type: float, low: 0.9, high: 0.99}", ("seed.gamma", "no settings below")),
        ("algorithm.gamma: {type: float, low: 0.9, high: 1.5}", ("algorithm.gamma = 1.5", "between 0.001 and 1")),
        ("algorithm.gamma: {type: float, low: 0.99, high: 0.9}", ("algorithm.gamma", "low <= high")),
        ("algorithm.gamma: {type: float, low: 0.0, high: 0.9, log: true}", ("algorithm.gamma", "low > 0")),
        ("algorithm.gamma: {type: float, low: .nan, high: 0.9}", ("algorithm.gamma", "finite")),
        ("algorithm.gamma: {type: float, low: 0.9}", ("algorithm.gamma", "finite")),
        ("algorithm.gamma: {type: float, low: 0.9, high: 0.99, step: 1}", ("algorithm.gamma", "unknown step")),
        ("algorithm.gamma: {type: normal, low: 0.9, high: 0.99}", ("algorithm.gamma", "float, int, categorical")),
        ("algorithm.gamma: 0.9", ("algorithm.gamma", "type")),
        ("algorithm.harmonics: {type: int, low: 0.5, high: 3}", ("algorithm.harmonics", "int")),
        ("algorithm.hidden: {type: categorical, choices: []}", ("algorithm.hidden", "choices")),
        ("algorithm.gamma: {type: categorical, choices: [a]}", ("algorithm.gamma", "'a'")),
        ("algorithm.gamma: {type: categorical, choices: [0.9], low: 1}", ("algorithm.gamma", "nothing else")),
        ("", ("no key",)),
        ("- algorithm.gamma", ("key: value",)),
    ],
)
def test_a_space_that_makes_no_sense_is_refused(tmp_path, text, words):
    path = tmp_path / "space.yaml"
    path.write_text(text)
    with pytest.raises(CorruptFile) as error:
        load_space(path, TrainConfig())
    assert "\n" not in str(error.value)
    for word in (*words, str(path)):
        assert word in str(error.value)


def test_fixed_keys_leave_the_space(tmp_path):
    path = tmp_path / "space.yaml"
    path.write_text(SPACE)
    assert [parameter.key for parameter in load_space(path, TrainConfig(), ["algorithm.gamma"])] == ["algorithm.batch_size"]
    with pytest.raises(UnknownKey, match="algorithm.gama"):
        load_space(path, TrainConfig(), ["algorithm.gama"])


@given(st.text(st.characters(codec="utf-8", exclude_categories=["Z", "C"]), min_size=5).filter(lambda word: "*" not in word))
def test_no_password_is_ever_shown(password):
    for url in (f"postgresql://me:{password}@host/name", f"postgresql:me:{password}@host", f"error: sqlite://:{password}@host is bad"):
        assert hidden(url) != url
        assert f":{password}@" not in hidden(url)
        assert "host" in hidden(url)
    assert hidden("sqlite:////tmp/study.db") == "sqlite:////tmp/study.db"


def test_a_relative_journal_is_the_same_file_in_every_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert located("a.journal", tmp_path / "out") == str(tmp_path / "a.journal")
    assert located("", tmp_path / "out") == str(tmp_path / "out" / "study.journal")
    assert located("sqlite:///a.db", tmp_path) == f"sqlite:///{tmp_path / 'a.db'}"
    assert located("sqlite+pysqlite:////data/a.db?timeout=5", tmp_path) == "sqlite+pysqlite:////data/a.db?timeout=5"


def test_a_study_is_the_same_every_time_and_starts_with_the_settings_as_they_are(search, tmp_path):
    first, notes = carried_out(search)
    assert [note.state for note in notes] == ["COMPLETE"] * 3
    assert first.trials[0].params == {"algorithm.gamma": 0.95, "algorithm.batch_size": "32"}
    elsewhere = replace(search, storage=str(tmp_path / "again.journal"), folder=tmp_path / "again")
    second, _ = carried_out(elsewhere)
    assert [(trial.params, trial.value, trial.user_attrs["seed"]) for trial in first.trials] == [
        (trial.params, trial.value, trial.user_attrs["seed"]) for trial in second.trials
    ]
    assert len({trial.user_attrs["seed"] for trial in first.trials}) == 3


def test_a_second_call_does_what_is_left(search):
    few = replace(search, trials=1)
    carried_out(few)
    study, notes = carried_out(search)
    assert [note.number for note in notes] == [1, 2]
    assert carried_out(search)[1] == []
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 3


@pytest.mark.parametrize(("change", "key"), [({"seed": 6}, "seed"), ({"steps": 512}, "steps"), ({}, "search.algorithm.gamma")])
def test_a_study_keeps_to_the_settings_it_was_begun_with(search, change, key):
    prepare(search)
    space = search.space[1:] if not change else search.space
    with pytest.raises(ChangedStudy) as error:
        prepare(replace(search, train=replace(search.train, **change), space=space))
    assert error.value.key == key


def test_a_trial_is_judged_by_the_best_of_its_validations(search):
    study, _ = carried_out(replace(search, trials=1))
    trial = study.trials[0]
    with (search.folder / "0000" / "metrics.csv").open(newline="") as stream:
        rows = [{key: float(row[key] or "nan") for key in ("step", "success_rate", "steps_ratio")} for row in csv.DictReader(stream)]
    assert [row["step"] for row in rows] == [64, 128, 192, 256]
    assert list(trial.intermediate_values.values()) == pytest.approx([validation_score(row) for row in rows], rel=1e-4)
    assert trial.value == pytest.approx(max(map(validation_score, rows)), rel=1e-4)
    assert trial.user_attrs["success_rate"] in [row["success_rate"] for row in rows]


def test_the_score_weighs_success_and_transfers():
    assert validation_score({"success_rate": 0.9, "steps_ratio": 1.2}) == pytest.approx(0.9 - 0.05 * 0.2)
    assert validation_score({"success_rate": 0.0, "steps_ratio": float("nan")}) == 0


def test_a_hopeless_trial_is_ended_and_its_run_stays_whole(search):
    search = replace(search, trials=20, pruner="median")
    study, _ = prepare(search)
    params = {"algorithm.gamma": 0.95, "algorithm.batch_size": "32"}
    shape = {
        "algorithm.gamma": optuna.distributions.FloatDistribution(0.9, 0.99),
        "algorithm.batch_size": optuna.distributions.CategoricalDistribution(["32", "64"]),
    }
    for _ in range(6):
        good = create_trial(value=2.0, params=params, distributions=shape, intermediate_values=dict.fromkeys(range(1, 5), 2.0))
        study.add_trial(good)
    note = run_trial(search, "5/9")
    assert note.state == "PRUNED"
    folder = search.folder / f"{note.number:04d}"
    with (folder / "metrics.csv").open() as stream:
        assert [int(row["step"]) for row in csv.DictReader(stream)] == [64, 128]
    assert not list(folder.glob("*.tmp"))
    assert resumed(folder).run()["step"] == 256


def test_settings_that_cannot_be_trained_with_fail_their_trial_only(search):
    search.origin.write_text("cell.base_distance_mm: {type: categorical, choices: [360.0, 4000.0]}")
    search = replace(search, space=load_space(search.origin, search.train), trials=2)
    prepare(search)[0].enqueue_trial({"cell.base_distance_mm": "4000.0"})
    study, notes = carried_out(search)
    by_distance = {trial.params["cell.base_distance_mm"]: trial.state for trial in study.trials}
    assert by_distance == {"360.0": TrialState.COMPLETE, "4000.0": TrialState.FAIL}
    assert all(("4000" in note.error) == (note.state == "FAIL") for note in notes)
    assert counted(study) == 2


DYING = """
import os, signal, sys
from marl_handover.experiments.tune_storage import claimed, open_study
study = open_study(sys.argv[1], "study")
trial = study.ask()
trial.suggest_float("algorithm.gamma", 0.9, 0.99)
with claimed(trial, sys.argv[2]):
    os.kill(os.getpid(), signal.SIGKILL)
"""


def kill_a_trial(search, slot="elsewhere"):
    subprocess.run([sys.executable, "-c", DYING, search.storage, slot], check=False, timeout=60)


def test_a_trial_of_a_killed_process_is_done_again_with_its_settings_and_seed(search):
    search = replace(search, trials=2)
    prepare(search)
    kill_a_trial(search)
    study, notes = carried_out(search)
    states = [trial.state for trial in study.trials]
    assert states == [TrialState.FAIL, TrialState.COMPLETE, TrialState.COMPLETE]
    again = next(trial for trial in study.trials if trial.user_attrs.get("again_of") == 0)
    assert again.params["algorithm.gamma"] == study.trials[0].params["algorithm.gamma"] == 0.95
    undisturbed, _ = carried_out(replace(search, storage=search.storage + "2", folder=search.folder / "2"))
    assert again.user_attrs["seed"] == undisturbed.trials[0].user_attrs["seed"]
    assert again.value == undisturbed.trials[0].value
    assert len(notes) == counted(study) == 2


def test_a_trial_that_is_under_way_is_left_alone(search):
    study, _ = prepare(search)
    trial = study.ask()
    with claimed(trial, "somebody"):
        assert prepare(search)[1] == search.trials - 1
        assert [other.number for other in running(study)] == [trial.number]


def test_a_slot_takes_over_what_its_dead_worker_left(search):
    study, _ = prepare(search)
    kill_a_trial(search, slot="5/0")
    note = run_trial(search, "5/0")
    assert (note.number, note.state) == (1, "COMPLETE")
    assert study.trials[1].user_attrs["again_of"] == 0


def test_another_calls_live_trial_of_the_same_place_is_left_alone(search):
    study, _ = prepare(search)
    other = study.ask()
    with claimed(other, "5/0/theirs"):
        note = run_trial(search, "5/0/ours")
        again = run_trial(search, "5/0/theirs")
        assert [trial.number for trial in running(study)] == [other.number]
    assert [(told.number, told.state) for told in (note, again)] == [(1, "COMPLETE"), (2, "COMPLETE")]
    assert len({str(trial.params) for trial in study.trials}) == 3


def test_the_launchers_word_counts_for_another_machine_and_not_for_a_live_process_here(search):
    study, _ = prepare(search)
    trial = study.ask()
    with claimed(trial, "slot"):
        (seen,) = running(study)
        assert not abandoned(seen, told=True)
        elsewhere = {**seen.user_attrs["worker"], "host": "elsewhere"}
        trial.set_user_attr("worker", elsewhere)
        (seen,) = running(study)
        assert (abandoned(seen), abandoned(seen, told=True)) == (False, True)


def test_a_trial_that_somebody_ended_meanwhile_ends_without_harm(search, monkeypatch):
    study, _ = prepare(search)

    def interrupted(search, trial):
        give_back(study, study.trials[trial.number])
        return 0.9

    monkeypatch.setattr(tune, "_train", interrupted)
    note = run_trial(search, "5/0/ours")
    assert (note.state, note.value) == ("FAIL", None)
    assert "counts for nothing" in note.error
    assert [trial.state for trial in study.trials[1:]] == [TrialState.WAITING]


def test_every_call_has_slots_of_its_own(search):
    study, _ = carried_out(replace(search, trials=1))
    carried_out(replace(search, trials=2))
    slots = [trial.user_attrs["slot"] for trial in study.trials]
    assert [slot.rpartition("/")[0] for slot in slots] == ["5/0", "5/1"]
    assert len({slot.rpartition("/")[2] for slot in slots}) == 2


def test_places_are_counted_without_those_given_back(search):
    study, _ = prepare(search)
    for _ in range(2):
        study.ask()
    give_back(study, study.trials[0])
    assert [place_of(study, number) for number in (1, 2, 3)] == [0, 1, 2]


def test_a_trial_that_kills_its_process_is_given_up(search):
    study, _ = prepare(search)
    for number in range(TRIES):
        kill_a_trial(search)
        prepare(search)
        assert study.trials[number].state == TrialState.FAIL
    assert [trial.user_attrs.get("tries") for trial in study.trials] == [None, *range(2, TRIES + 1)]
    assert counted(study) == 1


def test_giving_back_twice_queues_once(search):
    study, _ = prepare(search)
    trial = study.ask()
    (left,) = running(study)
    give_back(study, left)
    give_back(study, left)
    assert [other.user_attrs.get("again_of") for other in study.trials] == [None, trial.number]


@pytest.mark.slow
def test_trials_run_side_by_side_on_sqlite(search, tmp_path):
    search = replace(search, storage=f"sqlite:///{tmp_path}/study.db", trials=3)
    study, left = prepare(search)
    notes = list(run_trials(search, study, left, jobs=2, progress=False))
    assert sorted(note.number for note in notes) == [0, 1, 2]
    workers = {trial.user_attrs["worker"]["pid"] for trial in open_study(search.storage, "study").trials}
    assert os.getpid() not in workers
    assert len({str(trial.params) for trial in study.trials}) == 3


def test_a_trial_writes_the_settings_it_was_trained_with(search):
    study, _ = carried_out(replace(search, trials=2))
    for trial in study.trials:
        stored = yaml.safe_load((search.folder / f"{trial.number:04d}" / "config.yaml").read_text())
        assert stored["algorithm"]["gamma"] == trial.params["algorithm.gamma"]
        assert stored["algorithm"]["batch_size"] == int(trial.params["algorithm.batch_size"])
        assert (stored["seed"], stored["steps"]) == (trial.user_attrs["seed"], 256)
