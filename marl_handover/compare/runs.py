"""The runs of a suite: what each of them is, doing one, and knowing which are done.

A task is one seed of one row. Its folder ``<out>/<row>/seed<k>`` holds ``task.json`` (what was asked), the run directory ``run``,
``trained.json``, one ``<evaluation>.json`` each, and at last ``done.json``. Whatever of these is there is not made again, so a suite
that was interrupted goes on where it stopped, and a damaged record is made again. A task whose settings have changed since is refused by
name. Only one call at a time works at a task: ``seed<k>.lock`` beside its folder is locked meanwhile.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from marl_handover.compare import records, suite_check
from marl_handover.compare.records import fingerprint, read_record, settings_of, write_record
from marl_handover.errors import HandoverError, WorkFailed
from marl_handover.files import expanded
from marl_handover.learning.recorder import machine
from marl_handover.learning.settings import TrainConfig
from marl_handover.locks import held
from marl_handover.runtime.assessment import AssessmentConfig
from marl_handover.runtime.settings import twin_lab

ASKED, TRAINED, DONE = (f"{name}.json" for name in suite_check.RECORDS)
RUN_FOLDER = "run"

GRACE_S = 20.0
"""So long a task waits for its lock: a worker whose machine has left the cluster may live on for some seconds."""


@dataclass(frozen=True)
class Judgement:
    """One evaluation of a task. ``policy`` is as the suite has it, with ``{run}`` for the run directory; ``base`` is where paths start."""

    name: str
    config: AssessmentConfig
    arguments: tuple[str, ...]
    policy: str
    base: Path = field(default_factory=Path.cwd)

    def placed(self) -> AssessmentConfig:
        """The settings with absolute paths: a worker may stand in another folder."""
        problems = self.config.problems and str(self.base / expanded(self.config.problems))
        folder = self.config.calibration or (str(twin_lab().folder()) if self.config.backend == "twin" else None)
        return replace(self.config, problems=problems, calibration=folder and str(self.base / expanded(folder)))

    def contents(self) -> dict[str, str]:
        """Hashes of the files that it reads, see :func:`marl_handover.compare.records.contents_of`."""
        return records.contents_of(self.placed(), own_run=suite_check.RUN in self.policy)


@dataclass(frozen=True)
class Task:
    """One seed of one row. ``train`` is None for a row that is not trained; ``commit`` is that of the call."""

    row: str
    seed: int
    folder: Path
    train: TrainConfig | None
    arguments: tuple[str, ...]
    judgements: tuple[Judgement, ...]
    commit: str

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.row}/seed{self.seed}"


class ChangedRow(HandoverError):
    """A row that was run, wholly or in part, with other settings."""

    def __init__(self, folder: Path, what: str, key: str, stored: Any, asked: Any, overwrite: str) -> None:
        super().__init__(
            f"{what}: {folder} was made with {key} = {stored!r}, and now it is {asked!r}; "
            f"overwrite=[{overwrite}] throws that away and starts anew, another out= keeps both"
        )
        self.folder, self.what, self.key, self.stored, self.asked = folder, what, key, stored, asked


class IncompleteTask(WorkFailed):
    """A part of a task went wrong; the others are done."""


class Busy(WorkFailed):
    """Another call is at work at a task whose results were to be thrown away."""

    def __init__(self, task: Task) -> None:
        super().__init__(f"overwrite: another call is at work at {task.name}; nothing was thrown away")
        self.task = task


def check_unchanged(task: Task, overwrite: Sequence[str] = ()) -> None:
    """Compare what was asked with what is in the task's folder.

    A setting that the stored run does not know, because it is younger, had its default.

    Raises:
        ChangedRow: for a difference in a row, or in a row's evaluation, that is not named in ``overwrite``.
    """
    if task.row in overwrite:
        return
    if task.train is not None:
        _compare_training(task, task.train)
    for judgement in task.judgements:
        name = f"{task.row}/{judgement.name}"
        path = task.folder / f"{judgement.name}.json"
        report = None if name in overwrite else read_record(path, records.REPORT_KEYS)
        if report is not None:
            about = report["provenance"]
            if about["policy"] != judgement.policy:
                raise ChangedRow(path, f"evaluation {name}", "policy", about["policy"], judgement.policy, name)
            _compare(path, about["settings"], judgement.config, f"evaluation {name}", name)
            stored, now = about.get("contents", {}), judgement.contents()
            for key in sorted(stored.keys() & now.keys()):
                if stored[key] != now[key]:
                    raise ChangedRow(path, f"evaluation {name}", f"content of {key}", stored[key], now[key], name)


def _compare_training(task: Task, config: TrainConfig) -> None:
    asked = read_record(task.folder / ASKED, records.ASKED_KEYS)
    if asked is not None:
        _compare(task.folder / ASKED, asked["settings"], config, f"row {task.row}", task.row)
    elif trained := read_record(task.folder / TRAINED, records.TRAINED_KEYS):
        now = fingerprint(settings_of(config))
        if trained["config_hash"] != now:
            raise ChangedRow(task.folder / TRAINED, f"row {task.row}", "config_hash", trained["config_hash"], now, task.row)


def _compare(path: Path, stored: records.Settings, config: TrainConfig | AssessmentConfig, what: str, overwrite: str) -> None:
    for key, before, now in records.differences(stored, config):
        raise ChangedRow(path, what, key, before, now, overwrite)


def is_named(task: Task, overwrite: Sequence[str]) -> bool:
    """Whether ``overwrite`` names the task's row, or one of its evaluations."""
    return task.row in overwrite or any(f"{task.row}/{judgement.name}" in overwrite for judgement in task.judgements)


def clear_all(tasks: Sequence[Task], overwrite: Sequence[str]) -> None:
    """Throw away what ``overwrite`` names of the tasks. Raises :class:`Busy`, before anything is, if another call is at one of them."""
    named = [task for task in tasks if is_named(task, overwrite)]
    with ExitStack() as locks:
        for task in named:
            if not locks.enter_context(held(task.folder)):
                raise Busy(task)
        for task in named:
            clear(task, overwrite)


def clear(task: Task, overwrite: Sequence[str]) -> None:
    """Throw away what ``overwrite`` names: a row with all it has, or one ``row/evaluation``."""
    if task.row in overwrite:
        shutil.rmtree(task.folder, ignore_errors=True)
    for judgement in task.judgements:
        if f"{task.row}/{judgement.name}" in overwrite:
            (task.folder / f"{judgement.name}.json").unlink(missing_ok=True)
            (task.folder / DONE).unlink(missing_ok=True)


def finished(task: Task) -> bool:
    """Whether nothing is left to do: every record is there and can be read."""
    needed = {f"{judgement.name}.json": records.REPORT_KEYS for judgement in task.judgements} | {DONE: records.DONE_KEYS}
    if task.train is not None:
        needed[TRAINED] = records.TRAINED_KEYS
    return all(read_record(task.folder / name, keys) is not None for name, keys in needed.items())


def execute(task: Task) -> bool:
    """Do what is left of a task: train, evaluate, say so. False if it was left alone, as another call is at work at it.

    Raises:
        IncompleteTask: an evaluation failed; the others were made.
        ChangedRow: another call did it with other settings, since this one looked.
        Exception: training failed, in any way it can.
    """
    with held(task.folder, GRACE_S) as mine:
        if mine and not finished(task):
            check_unchanged(task)
            _do(task)
    return mine


def _do(task: Task) -> None:
    task.folder.mkdir(parents=True, exist_ok=True)
    here = {"commit": task.commit, "machine": machine()}
    if task.train is not None and read_record(task.folder / TRAINED, records.TRAINED_KEYS) is None:
        _train(task, task.train, here)
    failed = []
    for judgement in task.judgements:
        if read_record(task.folder / f"{judgement.name}.json", records.REPORT_KEYS) is None:
            try:
                _judge(task, judgement, here)
            except Exception as error:  # whatever it is, the other evaluations go on
                failed.append(f"{judgement.name}: {type(error).__name__}: {' '.join(str(error).split())}")
    if failed:
        raise IncompleteTask("; ".join(failed))
    write_record(task.folder / DONE, _summary(task, here))


def _train(task: Task, config: TrainConfig, here: Mapping[str, Any]) -> None:
    """Start the run, or continue it from its checkpoint."""
    from marl_handover.learning.checkpoint import FILE
    from marl_handover.learning.trainer import Trainer

    settings = settings_of(config)
    folder = task.folder / RUN_FOLDER
    before = read_record(task.folder / ASKED, records.ASKED_KEYS)
    if before is None:
        # Nobody knows what a run without its record was asked.
        shutil.rmtree(folder, ignore_errors=True)
    commits = list(dict.fromkeys([*(records.commits_of(before) if before else []), task.commit]))
    asked = {"row": task.row, "seed": task.seed, "arguments": list(task.arguments), "config_hash": fingerprint(settings)}
    asked |= {**here, "commits": commits}
    write_record(task.folder / ASKED, {**asked, "settings": settings})
    trainer = Trainer(config, folder)
    if (folder / FILE).is_file():
        trainer.restore()
    summary = trainer.run()
    kept = {key: summary[key] for key in ("step", "gradient_step", "episodes", "wall_s", "best_step", "selection", "compile_state")}
    write_record(task.folder / TRAINED, {**asked, **kept})


def _judge(task: Task, judgement: Judgement, here: Mapping[str, Any]) -> None:
    from marl_handover.runtime.assessment import assess

    settings = settings_of(judgement.config)
    contents = judgement.contents()
    report = assess(judgement.placed()).report
    if report.pop("calibration", None) and judgement.config.calibration:
        report["calibration"] = judgement.config.calibration  # as asked for, not where it is on this machine
    about = {"policy": judgement.policy, "arguments": list(judgement.arguments), "config_hash": fingerprint(settings), "settings": settings}
    write_record(task.folder / f"{judgement.name}.json", {**report, "provenance": {**about, "contents": contents, **here}})


def _summary(task: Task, here: Mapping[str, Any]) -> dict[str, Any]:
    trained = None if task.train is None else read_record(task.folder / TRAINED)
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
