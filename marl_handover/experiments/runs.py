"""Every task of a suite: planned and checked before anything runs, then trained, judged and written down, each part once."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from marl_handover.compose import Groups, compose
from marl_handover.control.evaluation import AssessmentConfig
from marl_handover.control.settings import twin_workcell
from marl_handover.errors import HandoverError, InvalidSetting, MissingFile, UnknownChoice, WorkFailed
from marl_handover.experiments import provenance
from marl_handover.experiments.provenance import fingerprint, read_record, settings_of, write_record
from marl_handover.experiments.suite import EVALUATION_SEED_OFFSET, RECORDS, RUN, RowSpec, Suite
from marl_handover.files import expanded
from marl_handover.learning.recorder import machine
from marl_handover.learning.settings import TrainConfig
from marl_handover.locks import held
from marl_handover.parsing import read_json
from marl_handover.policies.policy import SHIELDED
from marl_handover.policies.registry import names

ASKED, TRAINED, DONE = (f"{name}.json" for name in RECORDS)
RUN_FOLDER = "run"

UNKNOWN = "unknown"
"""Commit of a run that was trained elsewhere."""

GRACE_S = 20.0
"""So long a task waits for its lock: a worker whose machine has left the cluster may live on for some seconds."""


@dataclass(frozen=True)
class EvaluationJob:
    """One evaluation of a task. ``policy`` is as the suite has it, with ``{run}`` for the run directory; ``base`` is where paths start."""

    name: str
    config: AssessmentConfig
    arguments: tuple[str, ...]
    policy: str
    base: Path = field(default_factory=Path.cwd)

    def placed(self) -> AssessmentConfig:
        """The settings with absolute paths: a worker may stand in another folder."""
        problems = self.config.problems and str(self.base / expanded(self.config.problems))
        folder = self.config.calibration or (str(twin_workcell().folder()) if self.config.backend == "twin" else None)
        return replace(self.config, problems=problems, calibration=folder and str(self.base / expanded(folder)))

    def contents(self) -> dict[str, str]:
        """Hashes of the files that it reads, see :func:`marl_handover.experiments.provenance.contents_of`."""
        return provenance.contents_of(self.placed(), own_run=RUN in self.policy)


@dataclass(frozen=True)
class Task:
    """One seed of one row. ``train`` is None for a row that is not trained; ``commit`` is that of the call."""

    row: str
    seed: int
    folder: Path
    train: TrainConfig | None
    arguments: tuple[str, ...]
    jobs: tuple[EvaluationJob, ...]
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
    for job in task.jobs:
        name = f"{task.row}/{job.name}"
        path = task.folder / f"{job.name}.json"
        report = None if name in overwrite else read_record(path, provenance.REPORT_KEYS)
        if report is not None:
            about = report["provenance"]
            if about["policy"] != job.policy:
                raise ChangedRow(path, f"evaluation {name}", "policy", about["policy"], job.policy, name)
            _compare(path, about["settings"], job.config, f"evaluation {name}", name)
            stored, now = about.get("contents", {}), job.contents()
            for key in sorted(stored.keys() & now.keys()):
                if stored[key] != now[key]:
                    raise ChangedRow(path, f"evaluation {name}", f"content of {key}", stored[key], now[key], name)


def _compare_training(task: Task, config: TrainConfig) -> None:
    asked = read_record(task.folder / ASKED, provenance.ASKED_KEYS)
    if asked is not None:
        _compare(task.folder / ASKED, asked["settings"], config, f"row {task.row}", task.row)
    elif trained := read_record(task.folder / TRAINED, provenance.TRAINED_KEYS):
        now = fingerprint(settings_of(config))
        if trained["config_hash"] != now:
            raise ChangedRow(task.folder / TRAINED, f"row {task.row}", "config_hash", trained["config_hash"], now, task.row)


def _compare(path: Path, stored: provenance.Settings, config: TrainConfig | AssessmentConfig, what: str, overwrite: str) -> None:
    for key, before, now in provenance.differences(stored, config):
        raise ChangedRow(path, what, key, before, now, overwrite)


def is_named(task: Task, overwrite: Sequence[str]) -> bool:
    """Whether ``overwrite`` names the task's row, or one of its evaluations."""
    return task.row in overwrite or any(f"{task.row}/{job.name}" in overwrite for job in task.jobs)


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
    for job in task.jobs:
        if f"{task.row}/{job.name}" in overwrite:
            (task.folder / f"{job.name}.json").unlink(missing_ok=True)
            (task.folder / DONE).unlink(missing_ok=True)


def finished(task: Task) -> bool:
    """Whether nothing is left to do: every record is there and can be read."""
    needed = {f"{job.name}.json": provenance.REPORT_KEYS for job in task.jobs} | {DONE: provenance.DONE_KEYS}
    if task.train is not None:
        needed[TRAINED] = provenance.TRAINED_KEYS
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
    if task.train is not None and read_record(task.folder / TRAINED, provenance.TRAINED_KEYS) is None:
        _train(task, task.train, here)
    failed = []
    for job in task.jobs:
        if read_record(task.folder / f"{job.name}.json", provenance.REPORT_KEYS) is None:
            try:
                _judge(task, job, here)
            except Exception as error:  # whatever it is, the other evaluations go on
                failed.append(f"{job.name}: {type(error).__name__}: {' '.join(str(error).split())}")
    if failed:
        raise IncompleteTask("; ".join(failed))
    write_record(task.folder / DONE, _summary(task, here))


def _train(task: Task, config: TrainConfig, here: Mapping[str, Any]) -> None:
    """Start the run, or continue it from its checkpoint."""
    from marl_handover.learning.checkpoint import FILE
    from marl_handover.learning.trainer import Trainer

    settings = settings_of(config)
    folder = task.folder / RUN_FOLDER
    before = read_record(task.folder / ASKED, provenance.ASKED_KEYS)
    if before is None:
        # Nobody knows what a run without its record was asked.
        shutil.rmtree(folder, ignore_errors=True)
    commits = list(dict.fromkeys([*(provenance.commits_of(before) if before else []), task.commit]))
    asked = {"row": task.row, "seed": task.seed, "arguments": list(task.arguments), "config_hash": fingerprint(settings)}
    asked |= {**here, "commits": commits}
    write_record(task.folder / ASKED, {**asked, "settings": settings})
    trainer = Trainer(config, folder)
    if (folder / FILE).is_file():
        trainer.restore()
    summary = trainer.run()
    write_record(task.folder / TRAINED, {**asked, **{key: summary[key] for key in KEPT}})


KEPT = ("step", "gradient_step", "episodes", "wall_s", "best_step", "selection", "compile_state")
"""What a task keeps of a run's summary."""


def take_trained(tasks: Sequence[Task], row: str, folder: Path) -> None:
    """Give the tasks of a row the finished runs that ``train`` left in a folder: each the one with its settings, its seed included.

    A task that is trained already is left as it is, and so is the folder.

    Raises:
        MissingFile: the folder has no finished run with the seed and settings of a task; the message says what is nearest.
    """
    runs = _finished_runs(folder)
    for task in (task for task in tasks if task.row == row and task.train is not None):
        with held(task.folder, GRACE_S) as mine:
            if mine and read_record(task.folder / TRAINED, provenance.TRAINED_KEYS) is None:
                _take(task, _fitting(task, runs, folder))


def _finished_runs(folder: Path) -> dict[Path, TrainConfig]:
    from marl_handover.learning.checkpoint import train_config

    if not folder.is_dir():
        raise MissingFile("folder of run directories", folder)
    found = [path.parent / "config.yaml" for path in sorted(folder.glob("*/summary.json"))]
    return {path.parent: train_config(path.read_text(encoding="utf-8"), path) for path in found}


def _fitting(task: Task, runs: Mapping[Path, TrainConfig], folder: Path) -> Path:
    """The run with the task's settings."""
    assert task.train is not None
    wrong = []
    for path, config in runs.items():
        key, stored, asked = next(iter(provenance.differences(settings_of(config), task.train)), ("", None, None))
        if not key:
            return path
        if config.seed == task.seed:
            wrong.append(f"{path.name} has {key} = {stored!r}, not {asked!r}")
    raise MissingFile(f"finished run for {task.name}", folder, "; ".join(wrong) or f"train seed={task.seed} there first")


def _take(task: Task, run: Path) -> None:
    assert task.train is not None
    settings = settings_of(task.train)
    summary = read_json(run / "summary.json", "summary")
    task.folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(task.folder / RUN_FOLDER, ignore_errors=True)
    shutil.copytree(run, task.folder / RUN_FOLDER)
    asked = {"row": task.row, "seed": task.seed, "arguments": list(task.arguments), "config_hash": fingerprint(settings)}
    asked |= {"commit": UNKNOWN, "machine": summary["machine"], "commits": [UNKNOWN]}
    write_record(task.folder / ASKED, {**asked, "settings": settings})
    write_record(task.folder / TRAINED, {**asked, **{key: summary[key] for key in KEPT}})


def _judge(task: Task, job: EvaluationJob, here: Mapping[str, Any]) -> None:
    from marl_handover.control.evaluation import assess

    settings = settings_of(job.config)
    contents = job.contents()
    report = assess(job.placed()).report
    if report.pop("calibration", None) and job.config.calibration:
        report["calibration"] = job.config.calibration  # as asked for, not where it is on this machine
    about = {"policy": job.policy, "arguments": list(job.arguments), "config_hash": fingerprint(settings), "settings": settings}
    write_record(task.folder / f"{job.name}.json", {**report, "provenance": {**about, "contents": contents, **here}})


def _summary(task: Task, here: Mapping[str, Any]) -> dict[str, Any]:
    trained = None if task.train is None else read_record(task.folder / TRAINED)
    reports = {job.name: read_record(task.folder / f"{job.name}.json") or {} for job in task.jobs}
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


Config = TypeVar("Config", TrainConfig, AssessmentConfig)


class Grammar(NamedTuple):
    """What the arguments of a command may say beyond its schema: short keys, and options that are code."""

    aliases: Mapping[str, str]
    groups: Groups


class BadRow(HandoverError):
    """A row whose settings do not hold."""

    def __init__(self, row: str, error: HandoverError) -> None:
        super().__init__(f"row {row}: {error}")
        self.row = row


def plan_tasks(suite: Suite, out: Path, train: Grammar, evaluate: Grammar) -> list[Task]:
    """Every task of the suite, row by row, with all settings composed and checked.

    Args:
        suite: what to do.
        out: folder of all results; workers may stand in another folder, so it is made absolute, and so are policies that are paths.
        train: what arguments of ``train`` may say.
        evaluate: what arguments of ``evaluate`` may say.

    Raises:
        HandoverError: bad settings; the message names the row.
    """
    tasks: list[Task] = []
    # Asked here and once: in a worker, later, the files may be newer than the code that it runs.
    commit = provenance.commit()
    for row in suite.rows:
        try:
            tasks += _row_tasks(suite, row, out.absolute(), train, evaluate, commit)
        except HandoverError as error:
            raise BadRow(row.name, error) from error
    return tasks


def _row_tasks(suite: Suite, row: RowSpec, out: Path, train: Grammar, evaluate: Grammar, commit: str) -> list[Task]:
    """A row's tasks. Settings are composed once and differ in seed and place."""
    arguments = () if row.train is None else tuple(suite.train_arguments(row))
    config = None if row.train is None else _composed(TrainConfig, arguments, train)
    asked = {}
    for spec in suite.evaluations_of(row, 0):
        wanted = tuple(suite.evaluate_arguments(row, spec))
        judged = _composed(AssessmentConfig, wanted, evaluate)
        _check_fits(spec.name, judged, config, suite.policy_of(row, spec))
        asked[spec.name] = EvaluationJob(spec.name, judged, wanted, suite.policy_of(row, spec))
    tasks = []
    for seed in suite.seeds_of(row):
        folder = out / row.name / f"seed{seed}"
        run = str(folder / RUN_FOLDER)
        jobs = []
        for job in (asked[spec.name] for spec in suite.evaluations_of(row, seed)):
            policy = _placed(job.policy.replace(RUN, run))
            own = replace(deepcopy(job.config), policy=policy, seed=EVALUATION_SEED_OFFSET + seed)
            jobs.append(replace(job, config=own))
        placed = None if config is None else replace(deepcopy(config), seed=seed, out=run, progress=False)
        tasks.append(Task(row.name, seed, folder, placed, arguments, tuple(jobs), commit))
    return tasks


def _check_fits(name: str, judged: AssessmentConfig, trained: TrainConfig | None, policy: str) -> None:
    """Refuse what an evaluation of a trained row would find out after the training. Raises :class:`InvalidSetting`."""
    if trained is None or RUN not in policy:
        return
    architecture = judged.task.architecture
    if architecture not in (None, trained.task.architecture):
        raise InvalidSetting(f"{name}: task.architecture", architecture, f"{trained.task.architecture}, which the row is trained for")
    if trained.variant == "centralised" and judged.backend != "kinematic":
        raise InvalidSetting(f"{name}: backend", judged.backend, "kinematic for variant=centralised, whose motions are its own")


def _placed(policy: str) -> str:
    """A policy's name, its path absolute if it is one."""
    if policy.startswith(SHIELDED):
        return SHIELDED + _placed(policy.removeprefix(SHIELDED))
    if policy in names():
        return policy
    path = expanded(policy)
    if path.parent == Path() and path.suffix != ".npz" and not path.exists():
        raise UnknownChoice("policy", policy, (*names(), f"{SHIELDED}NAME", "a run directory", "a policy file (.npz)"))
    return str(path.absolute())


def _composed(schema: type[Config], arguments: Sequence[str], grammar: Grammar) -> Config:
    config: Config = compose(schema, arguments, groups=grammar.groups, aliases=grammar.aliases)
    config.validate()
    return config
