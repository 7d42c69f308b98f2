"""``marl-handover compare``: a suite of runs, its statistics, tables and figures."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marl_handover.config import bounded, check_bounds, chosen, path_field, require_choice
from marl_handover.errors import InvalidSetting, UnknownChoice, WorkFailed
from marl_handover.files import expanded

if TYPE_CHECKING:
    from marl_handover.experiments.runs import Task
    from marl_handover.experiments.suite import Suite


@dataclass
class CompareConfig:
    """Keys of ``compare``."""

    suite: str = path_field("paper")  # paper, paper_steps, variants, ablations, seeds, engines, charts, many_arms, ladder, or a YAML file
    preset: str = "full"  # full or quick, a smoke size
    rows: list[str] = field(default_factory=list)  # some of its rows; []: all
    seeds: int = bounded(0, 0, 1000)  # of every row; 0: as the suite has it; an evaluation that the suite gives fewer keeps to those
    out: str = path_field()  # folder of runs and results, shared by all machines; runs/compare/<suite>, with -quick
    trained: dict[str, str] = field(default_factory=dict)  # row: folder with run directories of `train`, one a seed, taken as its runs
    overwrite: list[str] = field(default_factory=list)  # rows, or row/evaluation, whose results are thrown away and made anew
    report_only: bool = False  # run nothing: tables and figures of what is there
    launcher: str = chosen("loky", ("loky", "ray"))  # loky: the cores of this machine; ray: a cluster
    address: str = ""  # of the Ray cluster: auto, host:port or local
    jobs: int = bounded(0, 0, 1024)  # runs at the same time; 0: one a core
    progress: bool = True


SCHEMA: type = CompareConfig
ALIASES: dict[str, str] = {}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: CompareConfig) -> int:
    """Do what is left to do, then write ``results.json``, tables and figures.

    Raises:
        ChangedRow: a row was run with other settings.
        WorkFailed: some tasks failed; the others are done and reported.
    """
    from marl_handover.commands import evaluate, train
    from marl_handover.experiments.runs import Grammar, check_unchanged, plan_tasks, take_trained
    from marl_handover.experiments.statistics import require_statistics
    from marl_handover.experiments.suite import load_suite

    require_statistics()
    check_bounds(config)
    whole = load_suite(config.suite).sized(config.preset)
    suite = whole.with_rows(config.rows)
    if config.seeds:
        suite = suite.with_seeds(config.seeds)
    _check(config, suite)
    out = Path(config.out or f"runs/compare/{suite.name}{'' if suite.size == 'full' else '-' + suite.size}").absolute()
    if out.exists() and not out.is_dir():
        raise InvalidSetting("out", str(out), "a folder; this is a file")
    tasks = plan_tasks(suite, out, Grammar(train.ALIASES, train.GROUPS), Grammar(evaluate.ALIASES, evaluate.GROUPS))
    for task in tasks:
        check_unchanged(task, config.overwrite)
    for row, folder in config.trained.items():
        take_trained(tasks, row, expanded(folder))
    failures, others = ({}, []) if config.report_only else _run_tasks(config, tasks)
    results = _report(suite, whole, tasks, failures, out)
    _require_done(results, len(tasks), others, config.report_only)
    return 0


def _check(config: CompareConfig, suite: Suite) -> None:
    """Refuse keys that name nothing, or that nothing would look at."""
    known = [row.name for row in suite.rows]
    for row in suite.rows:
        specs = [spec for seed in suite.seeds_of(row) for spec in suite.evaluations_of(row, seed)]
        known += dict.fromkeys(f"{row.name}/{spec.name}" for spec in specs)
    for name in config.trained:
        require_choice("trained", name, [row.name for row in suite.rows if row.train is not None])
    for name in config.overwrite:
        if name not in known:
            raise UnknownChoice("overwrite", name, known)
    if config.report_only and config.overwrite:
        raise InvalidSetting("overwrite", config.overwrite, "left out with report_only=true, which makes nothing anew")
    if config.address and config.launcher == "loky":
        raise InvalidSetting("address", config.address, "left out with launcher=loky; it is that of a Ray cluster")


def _require_done(results: dict[str, Any], tasks: int, others: Sequence[str], report_only: bool) -> None:
    """Raise :class:`WorkFailed` that tells what failed, what another call is at, and what is not done for no known reason."""
    failures = results["failures"]
    told = [f"{name}: {reason}" for name, reason in failures.items()]
    if failures:
        raise WorkFailed(f"{len(failures)} of {tasks} runs failed, the others are reported: {'; '.join(told)}")
    if report_only:
        return
    if left := [name for name in others if name in results["missing"]]:
        raise WorkFailed(f"another call is at work at {', '.join(left)}; call again when it is done")
    if results["missing"]:
        raise WorkFailed(f"not done, though no worker failed: {', '.join(results['missing'])}; do all machines share out=?")


def _calibrate_twin(tasks: Sequence[Task]) -> None:
    """Calibrate every twin that a task is to be judged on, if nobody has done so yet."""
    from marl_handover.commands import calibrate
    from marl_handover.config import CellConfig
    from marl_handover.control.settings import twin_workcell
    from marl_handover.control.workcell import is_calibrated
    from marl_handover.hardware.settings import ARMS

    for config in (job.config for task in tasks for job in task.jobs):
        if config.backend != "twin" or config.calibration is not None:
            continue
        workcell, cell = twin_workcell(config.hardware), config.cell or CellConfig()
        arms = tuple(workcell.hardware.for_arms().arms)
        if arms == ARMS:  # all twins of pairs share the calibration of the one that is shipped
            workcell, cell = twin_workcell(), CellConfig()
        if not is_calibrated(workcell.folder(), arms):
            print(f"calibrating the twin first, into {workcell.folder()}", file=sys.stderr)
            calibrate.run(calibrate.CalibrateCommand(**vars(workcell), cell=cell))


def _run_tasks(config: CompareConfig, tasks: Sequence[Task]) -> tuple[dict[str, str], list[str]]:
    """Run what is not finished; name and reason of what failed, and names of what another call is at."""
    from marl_handover.experiments.executor import Failure, fan_out
    from marl_handover.experiments.runs import clear_all, execute, finished, is_named

    # In the order of their seeds, so that what is there after half of the time compares all rows.
    todo = sorted((task for task in tasks if not finished(task) or is_named(task, config.overwrite)), key=lambda task: task.seed)
    if len(todo) < len(tasks):
        print(f"{len(tasks) - len(todo)} of {len(tasks)} runs are done already", file=sys.stderr)
    _calibrate_twin(todo)
    failures, others = {}, []
    options: dict[str, Any] = {"launcher": config.launcher, "address": config.address, "jobs": config.jobs, "progress": config.progress}
    # Nothing is thrown away before there is somebody who can make it anew.
    options["ready"] = lambda: clear_all(todo, config.overwrite)
    for task, result in fan_out(execute, todo, label=lambda task: task.name, **options):
        if isinstance(result, Failure):
            failures[task.name] = result.error
        elif not result:
            others.append(task.name)
    return failures, others


def _report(suite: Suite, whole: Suite, tasks: Sequence[Task], failures: dict[str, str], out: Path) -> dict[str, Any]:
    """Write all numbers, tables and figures; print the tables. What an earlier report left and this one does not have goes away."""
    from marl_handover.experiments.results import gather
    from marl_handover.experiments.tables import csv_text, make_tables, markdown
    from marl_handover.files import write_whole
    from marl_handover.report.compare import make_figures
    from marl_handover.report.figure_style import save_figure, write_json

    results = gather(suite, tasks, failures, whole)
    figures = dict(make_figures(results))
    results["empty_figures"] = [name for name, figure in figures.items() if figure is None]
    write_json(out / "results.json", results)
    tables = make_tables(results)
    (out / "tables").mkdir(exist_ok=True)
    for table in tables:
        write_whole(out / "tables" / f"{table.name}.md", markdown(table))
        write_whole(out / "tables" / f"{table.name}.csv", csv_text(table))
        print(f"{table.title}\n\n{markdown(table)}")
    drawn = {name: figure for name, figure in figures.items() if figure is not None}
    for name, figure in drawn.items():
        for suffix in ("png", "pdf"):
            save_figure(figure, out / "figures" / f"{name}.{suffix}")
    _remove_old(out / "tables", [table.name for table in tables], (".md", ".csv"))
    _remove_old(out / "figures", list(drawn), (".png", ".pdf"))
    if results["missing"]:
        print(f"not done yet: {', '.join(results['missing'])}")
    if results["empty_figures"]:
        print(f"no values yet for the figures: {', '.join(results['empty_figures'])}")
    if results["partial"]:
        print("partial: results.json says under progress how much of the suite this is")
    print(f"written: {out / 'results.json'}, {out / 'tables'}, {out / 'figures'}")
    return results


def _remove_old(folder: Path, names: Sequence[str], suffixes: Sequence[str]) -> None:
    for path in folder.glob("*") if folder.is_dir() else ():
        if path.suffix in suffixes and path.stem not in names:
            path.unlink()
