"""``marl-handover compare``: a suite of runs, its statistics, tables and figures."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marl_handover.errors import InvalidSetting, UnknownChoice, WorkFailed

if TYPE_CHECKING:
    from marl_handover.compare.runs import Task
    from marl_handover.compare.suite import Suite


@dataclass
class CompareConfig:
    """Keys of ``compare``."""

    suite: str = "paper"  # paper, variants, ablations, or a YAML file
    preset: str = "full"  # full or quick, a smoke size
    rows: list[str] = field(default_factory=list)  # some of its rows; []: all
    seeds: int = 0  # of every row; 0: as the suite has it
    out: str = ""  # folder of runs and results, shared by all machines; runs/compare/<suite>, with -quick
    fresh: list[str] = field(default_factory=list)  # rows, or row/evaluation, whose results are thrown away and made anew
    report_only: bool = False  # run nothing: tables and figures of what is there
    launcher: str = "loky"  # loky: the cores of this machine; ray: a cluster
    address: str = ""  # of the Ray cluster: auto, host:port or local
    jobs: int = 0  # runs at the same time; 0: one a core
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
    from marl_handover.compare.runs import Grammar, check_unchanged, plan_tasks
    from marl_handover.compare.statistics import require_statistics
    from marl_handover.compare.suite import load_suite

    require_statistics()
    suite = load_suite(config.suite).sized(config.preset).with_rows(config.rows)
    if config.seeds:
        suite = suite.with_seeds(config.seeds)
    _check_fresh(suite, config.fresh)
    out = Path(config.out or f"runs/compare/{suite.name}{'' if suite.size == 'full' else '-' + suite.size}")
    if out.exists() and not out.is_dir():
        raise InvalidSetting("out", str(out), "a folder; this is a file")
    tasks = plan_tasks(suite, out, Grammar(train.ALIASES, train.GROUPS), Grammar(evaluate.ALIASES, evaluate.GROUPS))
    for task in tasks:
        check_unchanged(task, config.fresh)
    failures = {} if config.report_only else _run_tasks(config, tasks)
    _report(suite, tasks, failures, out)
    if failures:
        told = "; ".join(f"{name}: {reason}" for name, reason in failures.items())
        raise WorkFailed(f"{len(failures)} of {len(tasks)} runs failed, the others are done and reported: {told}")
    return 0


def _check_fresh(suite: Suite, fresh: Sequence[str]) -> None:
    rows = [row.name for row in suite.rows]
    known = rows + [f"{row}/{spec.name}" for row in rows for spec in suite.evaluations]
    for name in fresh:
        if name not in known:
            raise UnknownChoice("fresh", name, known)


def _run_tasks(config: CompareConfig, tasks: Sequence[Task]) -> dict[str, str]:
    """Run what is not finished; name and reason of what failed."""
    from marl_handover.compare.launch import Failure, fan_out
    from marl_handover.compare.runs import clear, execute, finished

    for task in tasks:
        clear(task, config.fresh)
    todo = [task for task in tasks if not finished(task)]
    if len(todo) < len(tasks):
        print(f"{len(tasks) - len(todo)} of {len(tasks)} runs are done already", file=sys.stderr)
    failures = {}
    options: dict[str, Any] = {"launcher": config.launcher, "address": config.address, "jobs": config.jobs, "progress": config.progress}
    for task, result in fan_out(execute, todo, label=lambda task: task.name, **options):
        if isinstance(result, Failure):
            failures[task.name] = result.error
    return failures


def _report(suite: Suite, tasks: Sequence[Task], failures: dict[str, str], out: Path) -> None:
    """Write all numbers, tables and figures; print the tables."""
    from marl_handover.compare.results import gather
    from marl_handover.compare.tables import csv_text, make_tables, markdown
    from marl_handover.learning.recorder import write_whole
    from marl_handover.report.compare import make_figures
    from marl_handover.report.files import save_figure, write_json

    results = gather(suite, tasks, failures)
    write_json(out / "results.json", results, "out")
    (out / "tables").mkdir(exist_ok=True)
    for table in make_tables(results):
        write_whole(out / "tables" / f"{table.name}.md", markdown(table))
        write_whole(out / "tables" / f"{table.name}.csv", csv_text(table))
        print(f"{table.title}\n\n{markdown(table)}")
    empty = []
    for name, figure in make_figures(results):
        if figure is None:
            empty.append(name)
            continue
        for suffix in ("png", "pdf"):
            save_figure(figure, out / "figures" / f"{name}.{suffix}")
    if results["missing"]:
        print(f"not done yet: {', '.join(results['missing'])}")
    if empty:
        print(f"no values yet for the figures: {', '.join(empty)}")
    print(f"written: {out / 'results.json'}, {out / 'tables'}, {out / 'figures'}")
