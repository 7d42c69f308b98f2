"""All numbers of a suite in one dictionary, ``results.json``: what was asked, every run's own numbers, and the statistics over the runs.

Tables and figures are made of it and nothing else, so that a stored one can be read again without the runs.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.compare import statistics
from marl_handover.compare.records import fingerprint, read_record, settings_of
from marl_handover.compare.runs import RUN_FOLDER, TRAINED, Task
from marl_handover.compare.suite import BAR_MEASURES, RowSpec, Suite
from marl_handover.report.metrics import Metrics, common_curve, read_metrics
from marl_handover.task.rules import Outcome

Floats = NDArray[np.float64]
Tree = dict[str, Any]

NEVER = 1e18
"""Stands for the cost of a level that was not reached, where costs are compared."""

COMPARED_LEVEL = 0.95
THRESHOLDS = 101


def gather(suite: Suite, tasks: Sequence[Task], failures: Mapping[str, str]) -> Tree:
    """Read what the tasks left, and compute the statistics.

    Args:
        suite: what was asked.
        tasks: of that suite.
        failures: name of a task -> what went wrong.
    """
    rows, missing = [], []
    for row in suite.rows:
        own = [task for task in tasks if task.row == row.name]
        runs = [_run(task, suite) for task in own]
        missing += [task.name for task, run in zip(own, runs, strict=True) if _unfinished(task, run)]
        rows.append(_row(suite, row, own, [run for run in runs if run["trained"] or run["evaluations"]]))
    content = {
        "suite": suite.name,
        "title": suite.title,
        "size": suite.size,
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "commits": _distinct("commit", rows),
        "machines": _distinct("machine", rows),
        "interval": {"coverage": statistics.COVERAGE, "repetitions": statistics.REPETITIONS, "estimator": "interquartile mean"},
        "rows": rows,
        "evaluations": [asdict(spec) for spec in suite.evaluations],
        "figures": [asdict(spec) for spec in suite.figures],
        "tables": [asdict(spec) for spec in suite.tables],
        "missing": missing,
        "failures": dict(failures),
    }
    content["comparisons"] = _comparisons(content)
    content["profiles"] = {spec.name: _profiles(content, spec.rows, spec.evaluations) for spec in suite.figures if spec.kind == "profiles"}
    return content


def measure_scores(row: Tree, evaluation: str, measure: str) -> list[float]:
    """A measure of each run that has it; a run without a success has no ratio to the optimum."""
    reports = [run["evaluations"].get(evaluation, {}) for run in row["runs"]]
    return [float(report[measure]) for report in reports if report.get(measure) is not None]


def _run(task: Task, suite: Suite) -> Tree:
    """One task's numbers; what is not there yet is left out."""
    trained = read_record(task.folder / TRAINED)
    evaluations = {}
    for judgement in task.judgements:
        report = read_record(task.folder / f"{judgement.name}.json")
        if report is not None:
            about = report.pop("provenance")
            evaluations[judgement.name] = {**report, "policy": about["policy"], "commit": about["commit"], "machine": about["machine"]}
    run: Tree = {"seed": task.seed, "trained": trained, "evaluations": evaluations}
    if trained is not None:
        metrics = read_metrics(task.folder / RUN_FOLDER)
        run["metrics"] = {name: [_number(value) for value in metrics[name]] for name in ("step", "gradient_step", *_measures(suite))}
    return run


def _measures(suite: Suite) -> list[str]:
    """What learning curves are wanted of."""
    return list(dict.fromkeys(["success_rate", *(spec.measure for spec in suite.figures if spec.kind == "curves")]))


def _unfinished(task: Task, run: Tree) -> bool:
    return (task.train is not None and run["trained"] is None) or len(run["evaluations"]) < len(task.judgements)


def _row(suite: Suite, row: RowSpec, tasks: Sequence[Task], runs: list[Tree]) -> Tree:
    settings = None if tasks[0].train is None else settings_of(tasks[0].train)
    content: Tree = {
        "name": row.name,
        "label": row.label or row.name,
        "arguments": None if row.train is None else list(tasks[0].arguments),
        "policy": row.policy,
        "settings": settings,
        "config_hash": None if settings is None else fingerprint(settings),
        "seeds": [run["seed"] for run in runs],
        "runs": runs,
    }
    names = [spec.name for spec in suite.evaluations]
    content["evaluations"] = {name: _evaluation(content, name) for name in names if any(name in run["evaluations"] for run in runs)}
    metrics: list[Metrics] = [_arrays(run["metrics"]) for run in runs if "metrics" in run]
    content["curves"] = _curves(metrics, _measures(suite)) if metrics else {}
    content["milestones"] = _milestones(metrics) if metrics else {}
    return content


def _evaluation(row: Tree, name: str) -> Tree:
    """One evaluation over the runs: each measure, and all endings."""
    reports = [run["evaluations"][name] for run in row["runs"] if name in run["evaluations"]]
    found: Tree = {"runs": len(reports), "episodes": sum(report["episodes"] for report in reports)}
    found["backend"] = reports[0]["backend"]
    found["outcomes"] = {key: sum(report["outcomes"][key] for report in reports) for key in _endings()}
    columns = {measure: np.array(scores) for measure in BAR_MEASURES if (scores := measure_scores(row, name, measure))}
    for runs in sorted({len(scores) for scores in columns.values()}):
        # One bootstrap for all measures that the same number of runs have: it is what takes time here.
        measures = [measure for measure, scores in columns.items() if len(scores) == runs]
        table = np.stack([columns[measure] for measure in measures], -1)
        for measure, interval in zip(measures, statistics.summarised(table[:, None, :]), strict=True):
            found[measure] = {**interval._asdict(), "mean": float(columns[measure].mean()), "runs": runs}
    return found


def _endings() -> list[str]:
    return [kind.name.lower() for kind in Outcome if kind is not Outcome.NONE]


def _curves(metrics: list[Metrics], measures: Sequence[str]) -> Tree:
    """Interquartile mean and band of each measure over the steps that all runs have; one bootstrap for those with the same steps."""
    axes: dict[tuple[float, ...], dict[str, Floats]] = {}
    for measure in measures:
        steps, values = common_curve(metrics, measure)
        if len(steps):
            axes.setdefault((len(values), *steps.tolist()), {})[measure] = values
    curves: Tree = {}
    for (runs, *shared), group in axes.items():
        band = statistics.band_of(np.concatenate(list(group.values()), -1)[:, None, :])
        for index, measure in enumerate(group):
            own = slice(index * len(shared), (index + 1) * len(shared))
            curves[measure] = {"step": shared, "runs": runs, **{name: part[own].tolist() for name, part in band._asdict().items()}}
    return curves


def _costs(metrics: Sequence[Metrics], level: float) -> list[float | None]:
    return [statistics.first_reaching(run["step"], run["success_rate"], level) for run in metrics]


def _milestones(metrics: list[Metrics]) -> Tree:
    return {f"{100 * level:.0f}": statistics.milestone(_costs(metrics, level))._asdict() for level in statistics.LEVELS}


def _comparisons(content: Tree) -> list[Tree]:
    """Every pair of the comparison tables: is one better, on each evaluation, and sooner?"""
    rows = {row["name"]: row for row in content["rows"]}
    found = []
    for table in content["tables"]:
        for first, second in table["pairs"]:
            if first in rows and second in rows:
                pair = (rows[first], rows[second])
                wanted = table["evaluations"] or [spec["name"] for spec in content["evaluations"]]
                entry = {"table": table["name"], "first": first, "second": second, "evaluations": {}, "sooner": _sooner(*pair)}
                for name in wanted:
                    scores = [np.array(measure_scores(row, name, "success_rate"))[:, None] for row in pair]
                    if all(len(column) for column in scores):
                        entry["evaluations"][name] = statistics.improvement(*scores)._asdict()
                found.append(entry)
    return found


def _sooner(first: Tree, second: Tree) -> Tree | None:
    """Probability that a run of the first row is at the level with fewer transfers than one of the second."""
    costs = []
    for row in (first, second):
        found = _costs([_arrays(run["metrics"]) for run in row["runs"] if "metrics" in run], COMPARED_LEVEL)
        costs.append(np.array([[-NEVER if cost is None else -cost] for cost in found]))
    return statistics.improvement(*costs)._asdict() if all(len(column) for column in costs) else None


def _profiles(content: Tree, rows: Sequence[str], evaluations: Sequence[str]) -> Tree:
    """Performance profiles of success over the evaluations that every shown row has; from the lowest score to 1."""
    wanted = evaluations or [spec["name"] for spec in content["evaluations"]]
    tables = {}
    for row in content["rows"]:
        columns = [measure_scores(row, name, "success_rate") for name in wanted]
        runs = min((len(column) for column in columns), default=0)
        if runs and (not rows or row["name"] in rows):
            tables[row["name"]] = np.array([column[:runs] for column in columns]).T
    if not tables:
        return {"thresholds": [], "rows": {}}
    lowest = min(float(table.min()) for table in tables.values())
    thresholds = np.linspace(max(0.0, lowest - 0.02), 1.0, THRESHOLDS)
    bands = {name: statistics.profile(table, thresholds)._asdict() for name, table in tables.items()}
    lists = {name: {key: part.tolist() for key, part in band.items()} for name, band in bands.items()}
    return {"thresholds": thresholds.tolist(), "rows": lists}


def _distinct(key: str, rows: Sequence[Tree]) -> list[Any]:
    """The values of ``key`` over all trainings and evaluations, each once."""
    found = []
    for row in rows:
        for run in row["runs"]:
            for part in (run["trained"], *run["evaluations"].values()):
                if part is not None and part[key] not in found:
                    found.append(part[key])
    return found


def _arrays(metrics: Mapping[str, Sequence[float | None]]) -> dict[str, Floats]:
    return {name: np.array([np.nan if value is None else value for value in values]) for name, values in metrics.items()}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
