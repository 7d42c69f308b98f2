"""All numbers of a suite in one dictionary, ``results.json``: what was asked, every run's own numbers, and the statistics over the runs.

Tables and figures are made of it and nothing else, so that a stored one can be read again without the runs.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.errors import HandoverError
from marl_handover.experiments import statistics
from marl_handover.experiments.provenance import REPORT_KEYS, TRAINED_KEYS, commits_of, fingerprint, read_record, settings_of
from marl_handover.experiments.runs import RUN_FOLDER, TRAINED, Task
from marl_handover.experiments.suite import BAR_MEASURES, PAIRED_MEASURES, REPORTED, RowSpec, Suite, TableSpec
from marl_handover.learning.recorder import Metrics, common_curve, read_metrics
from marl_handover.task.rules import Outcome

Tree = dict[str, Any]

NEVER = 1e18
"""Stands for the cost of a level that was not reached, where costs are compared."""

COMPARED_LEVEL = 0.95
THRESHOLDS = 101


def gather(suite: Suite, tasks: Sequence[Task], failures: Mapping[str, str], whole: Suite | None = None) -> Tree:
    """Read what the tasks left, and compute the statistics.

    A run that cannot be read is left out and told as failed.

    Args:
        suite: what was asked.
        tasks: of that suite.
        failures: name of a task -> what went wrong.
        whole: the suite before rows and seeds were chosen from it; what it has beyond ``suite``, or is not done, makes the results partial.
    """
    rows, missing, failed = [], [], dict(failures)
    for row in suite.rows:
        runs = []
        for task in (task for task in tasks if task.row == row.name):
            try:
                run = _run(task, suite)
            except HandoverError as error:
                failed.setdefault(task.name, f"cannot be read: {error}; overwrite=[{task.row}] makes it anew")
                run = {"seed": task.seed, "trained": None, "evaluations": {}}
            run["whole"] = not _unfinished(task, run)
            missing += [] if run["whole"] else [task.name]
            runs.append(run)
        own = [task for task in tasks if task.row == row.name]
        rows.append(_row(suite, row, own, [run for run in runs if run["trained"] or run["evaluations"]]))
    progress = _progress(whole or suite, rows)
    content = {
        "suite": suite.name,
        "title": suite.title,
        "size": suite.size,
        "partial": any(part["done"] < part["of"] for part in progress),
        "progress": progress,
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "commits": _commits(rows),
        "machines": _machines(rows),
        "interval": {"coverage": statistics.COVERAGE, "repetitions": statistics.REPETITIONS, "estimator": "interquartile mean"},
        "rows": rows,
        "evaluations": [asdict(spec) for spec in suite.evaluations],
        "figures": [asdict(spec) for spec in suite.figures],
        "tables": [asdict(spec) for spec in suite.tables],
        "missing": missing,
        "failures": failed,
    }
    content["comparisons"] = _comparisons(content)
    content["paired"] = [entry for spec in suite.tables if spec.kind == "paired" for entry in _paired(content, spec)]
    content["profiles"] = {spec.name: _profiles(content, spec.rows, spec.evaluations) for spec in suite.figures if spec.kind == "profiles"}
    return content


def _progress(whole: Suite, rows: Sequence[Tree]) -> list[Tree]:
    """Of each row of the whole suite, which of its seeds are done, of how many."""
    done = {row["name"]: [run["seed"] for run in row["runs"] if run["whole"]] for row in rows}
    found = []
    for row in whole.rows:
        seeds = [seed for seed in done.get(row.name, []) if seed in whole.seeds_of(row)]
        about = {"row": row.name, "label": row.label or row.name, "seeds": seeds}
        found.append({**about, "done": len(seeds), "of": len(whole.seeds_of(row))})
    return found


def measure_scores(row: Tree, evaluation: str, measure: str) -> list[float]:
    """A measure of each run that has it; a run without a success has no ratio to the optimum."""
    reports = [run["evaluations"].get(evaluation, {}) for run in row["runs"]]
    return [float(report[measure]) for report in reports if report.get(measure) is not None]


def _run(task: Task, suite: Suite) -> Tree:
    """One task's numbers; what is not there yet is left out."""
    trained = None if task.train is None else read_record(task.folder / TRAINED, TRAINED_KEYS)
    evaluations = {}
    for job in task.jobs:
        report = read_record(task.folder / f"{job.name}.json", REPORT_KEYS)
        if report is not None:
            about = report.pop("provenance")
            evaluations[job.name] = {**report, "policy": about["policy"], "commit": about["commit"], "machine": about["machine"]}
    run: Tree = {"seed": task.seed, "trained": trained, "evaluations": evaluations}
    if trained is not None:
        metrics = read_metrics(task.folder / RUN_FOLDER)
        run["metrics"] = {name: [_number(value) for value in metrics[name]] for name in ("step", "gradient_step", *_measures(suite))}
    return run


def _measures(suite: Suite) -> list[str]:
    """What learning curves are wanted of."""
    return list(dict.fromkeys(["success_rate", *(spec.measure for spec in suite.figures if spec.kind == "curves")]))


def _unfinished(task: Task, run: Tree) -> bool:
    return (task.train is not None and run["trained"] is None) or len(run["evaluations"]) < len(task.jobs)


def _row(suite: Suite, row: RowSpec, tasks: Sequence[Task], runs: list[Tree]) -> Tree:
    settings = None if tasks[0].train is None else settings_of(tasks[0].train)
    content: Tree = {
        "name": row.name,
        "label": row.label or row.name,
        "arguments": None if row.train is None else list(tasks[0].arguments),
        "policy": row.policy,
        "only": row.only,
        "because": row.because,
        "settings": settings,
        "config_hash": None if settings is None else fingerprint(settings),
        "seeds": [run["seed"] for run in runs],
        "runs": runs,
    }
    names = [spec.name for spec in suite.evaluations]
    content["evaluations"] = {name: _evaluation(content, name) for name in names if any(name in run["evaluations"] for run in runs)}
    content["by_arms"] = {name: found for name in content["evaluations"] if (found := _by_arms(content, name))}
    content["outages"] = {name: told for name in content["evaluations"] if (told := _outage(content, name))}
    metrics: list[Metrics] = [_arrays(run["metrics"]) for run in runs if "metrics" in run]
    content["curves"] = _curves(metrics, _measures(suite)) if metrics else {}
    content["milestones"] = _milestones(metrics) if metrics else {}
    return content


def _evaluation(row: Tree, name: str) -> Tree:
    """One evaluation over the runs: each measure, and all endings."""
    reports = [run["evaluations"][name] for run in row["runs"] if name in run["evaluations"]]
    found: Tree = {"runs": len(reports), "true_coverage": statistics.true_coverage(len(reports))}
    found |= {"episodes": sum(report["episodes"] for report in reports), "backend": reports[0]["backend"]}
    found["outcomes"] = {key: sum(report["outcomes"][key] for report in reports) for key in _endings()}
    columns = {measure: np.array(scores) for measure in (*BAR_MEASURES, *REPORTED) if (scores := measure_scores(row, name, measure))}
    for runs in sorted({len(scores) for scores in columns.values()}):
        # One bootstrap for all measures that the same number of runs have: it is what takes time here.
        measures = [measure for measure, scores in columns.items() if len(scores) == runs]
        table = np.stack([columns[measure] for measure in measures], -1)
        for measure, interval in zip(measures, statistics.summarised(table[:, None, :]), strict=True):
            found[measure] = {**interval._asdict(), "mean": float(columns[measure].mean()), "runs": runs}
    return found


def _by_arms(row: Tree, name: str) -> Tree:
    """One evaluation in random cells, by the number of arms: shares and means over the runs, and the median time of a decision."""
    reports = [run["evaluations"][name].get("by_arms", {}) for run in row["runs"] if name in run["evaluations"]]
    found: Tree = {}
    for arms in sorted({arms for report in reports for arms in report}, key=int):
        parts = [report[arms] for report in reports if arms in report]
        episodes, ratios = [part["episodes"] for part in parts], [part["steps_ratio"] for part in parts if part["steps_ratio"] is not None]
        found[arms] = {
            "runs": len(parts),
            "episodes": sum(episodes),
            "unsolvable": sum(part["unsolvable"] for part in parts),
            "success_rate": statistics.share_interval([part["success_rate"] for part in parts], episodes)._asdict(),
            "steps_ratio": statistics.mean_interval(ratios)._asdict() if ratios else None,
            "decision_ms": float(np.median([part["decision_us"]["p50"] for part in parts])) / 1e3,
        }
    return found


def _outage(row: Tree, name: str) -> Tree | None:
    """What became of episodes in which an arm failed; of those that stayed solvable, the share that was solved."""
    parts = [run["evaluations"][name]["outage"] for run in row["runs"] if "outage" in run["evaluations"].get(name, {})]
    parts = [part for part in parts if part["solvable"]]
    if not parts:
        return None
    solved = statistics.share_interval([part["solved_share"] for part in parts], [part["solvable"] for part in parts])
    counts = {key: sum(part[key] for part in parts) for key in ("episodes", "solvable", "solved")}
    return {"runs": len(parts), **counts, "solved_share": solved._asdict()}


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


def _paired(content: Tree, spec: TableSpec) -> list[Tree]:
    """Each measure of each row in both evaluations, and what the second has more, over the runs that were judged by both."""
    found = []
    for row in content["rows"]:
        pairs = [
            [run["evaluations"][name] for name in spec.evaluations]
            for run in row["runs"]
            if set(spec.evaluations) <= set(run["evaluations"])
        ]
        if not pairs or (spec.rows and row["name"] not in spec.rows):
            continue
        values = [[[_part(report, measure) for measure in PAIRED_MEASURES] for report in pair] for pair in pairs]
        known = [index for index in range(len(PAIRED_MEASURES)) if all(side[index] is not None for pair in values for side in pair)]
        table = np.array(values, float)[..., known]  # (runs, 2, measures)
        sides = [*table.transpose(1, 0, 2), table[:, 1] - table[:, 0]]
        first, second, more = (statistics.summarised(side[:, None, :], statistics.mean) for side in sides)
        for index, one, other, difference in zip(known, first, second, more, strict=True):
            about = {"table": spec.name, "row": row["name"], "measure": PAIRED_MEASURES[index], "runs": len(pairs)}
            found.append({**about, "first": one._asdict(), "second": other._asdict(), "difference": difference._asdict()})
    return found


def _part(report: Tree, measure: str) -> float | None:
    """A measure whose name leads into a report, as ``transfer_error_mm.bias.0`` does; None where there is none."""
    found: Any = report
    for word in measure.split("."):
        try:
            found = found[int(word)] if isinstance(found, list) else found[word]
        except (KeyError, TypeError, IndexError):
            return None
    return None if found is None else float(found)


def _sooner(first: Tree, second: Tree) -> Tree | None:
    """Probability that a run of the first row is at the level with fewer transfers than one of the second.

    What happened after the end of the shorter training is left out, as the other row was not watched for so long: two runs of which
    neither was there by then are a tie.
    """
    if first["settings"] is None or second["settings"] is None:
        return None
    until = min(row["settings"]["steps"] for row in (first, second))
    costs = []
    for row in (first, second):
        found = _costs([_arrays(run["metrics"]) for run in row["runs"] if "metrics" in run], COMPARED_LEVEL)
        # The last validation may lie a few transfers after the end that was asked for.
        ended = [NEVER if cost is None else min(cost, row["settings"]["steps"]) for cost in found]
        costs.append(np.array([[-NEVER if cost > until else -cost] for cost in ended]))
    return {**statistics.improvement(*costs)._asdict(), "until_step": until} if all(len(column) for column in costs) else None


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


def _commits(rows: Sequence[Tree]) -> list[str]:
    """All commits under which something was trained or judged."""
    runs = [run for row in rows for run in row["runs"]]
    trained = [commit for run in runs if run["trained"] for commit in commits_of(run["trained"])]
    return list(dict.fromkeys([*trained, *(report["commit"] for run in runs for report in run["evaluations"].values())]))


def _machines(rows: Sequence[Tree]) -> list[Tree]:
    """All machines on which something was trained or judged."""
    found: list[Tree] = []
    for run in (run for row in rows for run in row["runs"]):
        for part in (run["trained"], *run["evaluations"].values()):
            if part is not None and part["machine"] not in found:
                found.append(part["machine"])
    return found


def _arrays(metrics: Mapping[str, Sequence[float | None]]) -> dict[str, Floats]:
    return {name: np.array([np.nan if value is None else value for value in values]) for name, values in metrics.items()}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
