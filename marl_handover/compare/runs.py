"""The runs of a suite: what each of them is, doing one, and knowing which are done.

A task is one seed of one row. Its folder ``<out>/<row>/seed<k>`` holds ``task.json`` (what was asked), the run directory ``run``,
``trained.json``, one ``<evaluation>.json`` each, and at last ``done.json``. Whatever of these is there is not made again, so a suite
that was interrupted goes on where it stopped. A task whose settings have changed since is refused by name.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from marl_handover.compare.records import commit, fingerprint, machine, read_record, settings_of, usual_settings, write_record
from marl_handover.compare.suite import EVALUATION_SEED_OFFSET, RUN, RowSpec, Suite
from marl_handover.compose import compose
from marl_handover.compose_schema import Groups
from marl_handover.errors import HandoverError, WorkFailed
from marl_handover.learning.settings import TrainConfig
from marl_handover.runtime.assessment import AssessmentConfig

ASKED, TRAINED, DONE, RUN_FOLDER = "task.json", "trained.json", "done.json", "run"

Config = TypeVar("Config", TrainConfig, AssessmentConfig)


class Grammar(NamedTuple):
    """What the arguments of a command may say beyond its schema: short keys, and options that are code."""

    aliases: Mapping[str, str]
    groups: Groups


@dataclass(frozen=True)
class Judgement:
    """One evaluation of a task. ``policy`` is as the suite has it, with :data:`RUN` for the run directory."""

    name: str
    config: AssessmentConfig
    arguments: tuple[str, ...]
    policy: str


@dataclass(frozen=True)
class Task:
    """One seed of one row. ``train`` is None for a row that is not trained."""

    row: str
    seed: int
    folder: Path
    train: TrainConfig | None
    arguments: tuple[str, ...]
    judgements: tuple[Judgement, ...]

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.row}/seed{self.seed}"


class ChangedRow(HandoverError):
    """A row that was run, wholly or in part, with other settings."""

    def __init__(self, folder: Path, what: str, key: str, stored: Any, asked: Any, fresh: str) -> None:
        super().__init__(
            f"{what}: {folder} was made with {key} = {stored!r}, and now it is {asked!r}; "
            f"fresh=[{fresh}] throws that away and starts anew, another out= keeps both"
        )
        self.folder, self.what, self.key, self.stored, self.asked = folder, what, key, stored, asked


class IncompleteTask(WorkFailed):
    """A part of a task went wrong; the others are done."""


def plan_tasks(suite: Suite, out: Path, train: Grammar, evaluate: Grammar) -> list[Task]:
    """Every task of the suite, row by row, with all settings composed and checked.

    Args:
        suite: what to do.
        out: folder of all results.
        train: what arguments of ``train`` may say.
        evaluate: what arguments of ``evaluate`` may say.

    Raises:
        HandoverError: bad settings; the message names the row.
    """
    tasks: list[Task] = []
    for row in suite.rows:
        try:
            tasks += _row_tasks(suite, row, out, train, evaluate)
        except HandoverError as error:
            raise BadRow(row.name, error) from error
    return tasks


def _row_tasks(suite: Suite, row: RowSpec, out: Path, train: Grammar, evaluate: Grammar) -> list[Task]:
    """A row's tasks. Settings are composed once and differ in seed and place."""
    arguments = () if row.train is None else tuple(suite.train_arguments(row))
    config = None if row.train is None else _composed(TrainConfig, arguments, train)
    asked = {}
    for spec in suite.evaluations_of(row, 0):
        wanted = tuple(suite.evaluate_arguments(row, spec))
        asked[spec.name] = Judgement(spec.name, _composed(AssessmentConfig, wanted, evaluate), wanted, suite.policy_of(row, spec))
    tasks = []
    for seed in suite.seeds_of(row):
        folder = out / row.name / f"seed{seed}"
        run = str(folder / RUN_FOLDER)
        judgements = []
        for judgement in (asked[spec.name] for spec in suite.evaluations_of(row, seed)):
            policy = judgement.policy.replace(RUN, run)
            own = replace(deepcopy(judgement.config), policy=policy, seed=EVALUATION_SEED_OFFSET + seed)
            judgements.append(replace(judgement, config=own))
        placed = None if config is None else replace(deepcopy(config), seed=seed, out=run, progress=False)
        tasks.append(Task(row.name, seed, folder, placed, arguments, tuple(judgements)))
    return tasks


class BadRow(HandoverError):
    """A row whose settings do not hold."""

    def __init__(self, row: str, error: HandoverError) -> None:
        super().__init__(f"row {row}: {error}")
        self.row = row


def _composed(schema: type[Config], arguments: Sequence[str], grammar: Grammar) -> Config:
    config: Config = compose(schema, arguments, groups=grammar.groups, aliases=grammar.aliases)
    config.validate()
    return config


def check_unchanged(task: Task, fresh: Sequence[str] = ()) -> None:
    """Compare what was asked with what is in the task's folder.

    A setting that the stored run does not know, because it is younger, had its default.

    Raises:
        ChangedRow: for a difference in a row, or in a row's evaluation, that is not named in ``fresh``.
    """
    if task.row in fresh:
        return
    if task.train is not None:
        _compare(task.folder / ASKED, task.train, f"row {task.row}", task.row)
    for judgement in task.judgements:
        name = f"{task.row}/{judgement.name}"
        if name not in fresh:
            _compare(task.folder / f"{judgement.name}.json", judgement.config, f"evaluation {name}", name, judgement.policy)


def _compare(path: Path, config: TrainConfig | AssessmentConfig, what: str, fresh: str, policy: str | None = None) -> None:
    stored = read_record(path)
    if stored is None:
        return
    about = stored if policy is None else stored["provenance"]
    if policy is not None and about["policy"] != policy:
        raise ChangedRow(path, what, "policy", about["policy"], policy, fresh)
    usual = usual_settings(config)
    for key, value in settings_of(config).items():
        before = about["settings"].get(key, usual.get(key))
        if before != value:
            raise ChangedRow(path, what, key, before, value, fresh)


def clear(task: Task, fresh: Sequence[str]) -> None:
    """Throw away what ``fresh`` names: a row with all it has, or one ``row/evaluation``."""
    if task.row in fresh:
        shutil.rmtree(task.folder, ignore_errors=True)
    for judgement in task.judgements:
        if f"{task.row}/{judgement.name}" in fresh:
            (task.folder / f"{judgement.name}.json").unlink(missing_ok=True)
            (task.folder / DONE).unlink(missing_ok=True)


def finished(task: Task) -> bool:
    """Whether nothing is left to do."""
    names = [f"{judgement.name}.json" for judgement in task.judgements] + [DONE]
    return all((task.folder / name).is_file() for name in names)


def execute(task: Task) -> str:
    """Do what is left of a task: train, evaluate, say so. Returns the task's name.

    Raises:
        IncompleteTask: an evaluation failed; the others were made.
        Exception: training failed, in any way it can.
    """
    task.folder.mkdir(parents=True, exist_ok=True)
    here = {"commit": commit(), "machine": machine()}
    if task.train is not None and read_record(task.folder / TRAINED) is None:
        _train(task, task.train, here)
    failed = []
    for judgement in task.judgements:
        if read_record(task.folder / f"{judgement.name}.json") is None:
            try:
                _judge(task, judgement, here)
            except Exception as error:  # whatever it is, the other evaluations go on
                failed.append(f"{judgement.name}: {type(error).__name__}: {' '.join(str(error).split())}")
    if failed:
        raise IncompleteTask("; ".join(failed))
    write_record(task.folder / DONE, _summary(task, here))
    return task.name


def _train(task: Task, config: TrainConfig, here: Mapping[str, Any]) -> None:
    """Start the run, or continue it from its checkpoint."""
    from marl_handover.learning.checkpoint import FILE
    from marl_handover.learning.trainer import Trainer

    logging.getLogger("torchrl").setLevel(logging.WARNING)
    settings = settings_of(config)
    asked = {"row": task.row, "seed": task.seed, "arguments": list(task.arguments), "config_hash": fingerprint(settings)}
    if read_record(task.folder / ASKED) is None:
        write_record(task.folder / ASKED, {**asked, **here, "settings": settings})
    folder = task.folder / RUN_FOLDER
    trainer = Trainer(config, folder)
    if (folder / FILE).is_file():
        trainer.restore()
    summary = trainer.run()
    kept = {key: summary[key] for key in ("step", "gradient_step", "episodes", "wall_s", "best_step")}
    write_record(task.folder / TRAINED, {**asked, **here, **kept})


def _judge(task: Task, judgement: Judgement, here: Mapping[str, Any]) -> None:
    from marl_handover.runtime.assessment import assess

    settings = settings_of(judgement.config)
    report = assess(judgement.config).report
    about = {"policy": judgement.policy, "arguments": list(judgement.arguments), "config_hash": fingerprint(settings), "settings": settings}
    write_record(task.folder / f"{judgement.name}.json", {**report, "provenance": {**about, **here}})


def _summary(task: Task, here: Mapping[str, Any]) -> dict[str, Any]:
    trained = read_record(task.folder / TRAINED)
    reports = {judgement.name: read_record(task.folder / f"{judgement.name}.json") or {} for judgement in task.judgements}
    return {
        "row": task.row,
        "seed": task.seed,
        "arguments": list(task.arguments),
        "config_hash": trained["config_hash"] if trained else None,
        **here,
        "wall_s": (trained["wall_s"] if trained else 0.0) + sum(report.get("wall_s", 0.0) for report in reports.values()),
        "evaluations": {name: report["provenance"]["config_hash"] for name, report in reports.items()},
        "ended": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
