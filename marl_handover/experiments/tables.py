"""Tables of a suite's results, as Markdown and CSV, and the page of results that shows them and its figures.

The page: ``<!-- table:SUITE/NAME -->`` or ``<!-- figure:SUITE/NAME -->`` opens a block, ``<!-- end -->`` closes it. What stands between is
replaced by what stored evidence says.
"""

from __future__ import annotations

import csv
import io
import re
import shutil
import statistics
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from marl_handover.config import require_choice
from marl_handover.errors import HandoverError
from marl_handover.parsing import read_json

Tree = Mapping[str, Any]
NONE = "–"
SOLVED = (("mean_steps_success", "steps (solved)", "{:.2f}"), ("steps_ratio", "steps ÷ optimum (solved)", "{:.3f}"))
"""Measures of solved episodes alone, which a run without any does not have: name, heading, form."""
PATHS = (("path_mm", "path, mm"), ("executor_path_mm", "executors' on the same way, mm"))


class Cell(NamedTuple):
    """``text`` is shown; ``values`` are what the CSV has, one for each part of the column."""

    text: str
    values: tuple[Any, ...]


class Column(NamedTuple):
    """A heading, and the CSV's heading of each part; one part of the same name unless given."""

    title: str
    parts: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The CSV's headings."""
        return self.parts or (self.title,)


class Table(NamedTuple):
    """A table by name; ``notes``, each a sentence, stand below it in Markdown."""

    name: str
    title: str
    columns: list[Column]
    rows: list[list[Cell]]
    notes: Sequence[str] = ()


def make_tables(results: Tree) -> list[Table]:
    """The tables that the suite asked for, those without a row left out.

    Args:
        results: content of ``results.json``.
    """
    makers: dict[str, Callable[[Tree, Tree], tuple[list[Column], list[list[Cell]]]]] = {
        "evaluation": _evaluation,
        "milestones": _milestones,
        "runs": _runs,
        "comparison": _comparison,
        "range": _range,
        "paired": _paired,
        "arms": _arms,
        "outage": _outage,
        "ladder": _ladder,
    }
    tables = [
        Table(spec["name"], spec["title"] or spec["name"], *makers[spec["kind"]](results, spec), _notes(results, spec))
        for spec in results["tables"]
    ]
    return [table for table in tables if table.rows]


def markdown(table: Table) -> str:
    """The table in Markdown, without its title, and its notes."""
    lines = [[column.title for column in table.columns], ["---"] * len(table.columns)]
    lines += [[cell.text.replace("|", "\\|") for cell in row] for row in table.rows]
    notes = "".join(f"\n{note}\n" for note in table.notes)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n" + notes


def csv_text(table: Table) -> str:
    """The table as CSV, numbers in full."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([name for column in table.columns for name in column.names])
    for row in table.rows:
        writer.writerow(["" if value is None else value for cell in row for value in cell.values])
    return stream.getvalue()


def _wanted(results: Tree, names: Sequence[str]) -> list[Tree]:
    """Rows in the order asked for, or all."""
    rows = {row["name"]: row for row in results["rows"]}
    return [rows[name] for name in names or rows if name in rows]


def _text(value: Any) -> Cell:
    return Cell(str(value), (value,))


def _plain(value: float | None, form: str = "{:,.0f}", scale: float = 1.0) -> Cell:
    return Cell(NONE if value is None else form.format(scale * value), (value,))


def _interval(found: Tree | None, form: str, scale: float = 1.0) -> Cell:
    """``value [low, high]``; CSV: value, low, high, all in the JSON's own units."""
    if found is None:
        return Cell(NONE, (None, None, None))
    value, low, high = found["value"], found["low"], found["high"]
    ends = "" if low is None else f" [{form.format(scale * low)}, {form.format(scale * high)}]"
    return Cell(form.format(scale * value) + ends, (value, low, high))


def _seeds(runs: int, coverage: float | None) -> Cell:
    """How many runs, and how much their intervals really cover."""
    return Cell(str(runs) if coverage is None else f"{runs} (≈ {100 * coverage:.0f} %)", (runs, coverage))


def _solved(found: Tree | None, runs: int, form: str) -> Cell:
    """What only solved episodes have, and of how many runs if not of all."""
    cell = _interval(found, form)
    known = 0 if found is None else found["runs"]
    return Cell(cell.text + (f" ({known} of {runs} runs)" if 0 < known < runs else ""), (*cell.values, known))


def _interval_column(title: str, name: str) -> Column:
    return Column(title, (name, f"{name}_low", f"{name}_high"))


def _evaluation(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """Success and steps of each row on each evaluation."""
    labels = {item["name"]: item["label"] or item["name"] for item in results["evaluations"]}
    wanted = spec["evaluations"] or list(labels)
    shown = [(row, name) for name in wanted for row in _wanted(results, spec["rows"]) if name in row["evaluations"]]
    in_the_end = any("success_in_the_end" in row["evaluations"][name] for row, name in shown)
    columns = [
        Column("row"),
        Column("evaluation"),
        Column("seeds (intervals cover)", ("seeds", "true_coverage")),
        Column("episodes"),
        _interval_column("success, %", "success_rate"),
        *([_interval_column("in the end, %", "success_in_the_end")] if in_the_end else []),
        Column("mean, %", ("success_rate_mean",)),
        _interval_column("mean steps, failed ones too", "mean_steps"),
        *(Column(title, (name, f"{name}_low", f"{name}_high", f"{name}_runs")) for name, title, _ in SOLVED),
        *(_interval_column(title, name) for name, title in PATHS if spec["paths"]),
    ]
    rows = []
    for row, name in shown:
        found = row["evaluations"][name]
        rows.append(
            [
                _text(row["label"]),
                _text(labels[name]),
                _seeds(found["runs"], found["true_coverage"]),
                _plain(found["episodes"]),
                _interval(found["success_rate"], "{:.2f}", 100),
                *([_interval(found.get("success_in_the_end"), "{:.2f}", 100)] if in_the_end else []),
                _plain(found["success_rate"]["mean"], "{:.2f}", 100),
                _interval(found["mean_steps"], "{:.2f}"),
                *(_solved(found.get(measure), found["runs"], form) for measure, _, form in SOLVED),
                *(_interval(found.get(measure), "{:,.0f}") for measure, _ in PATHS if spec["paths"]),
            ]
        )
    return columns, rows


def _milestones(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """Transfers until the validation success is at a level: median over the runs, its interval, how many got there."""
    shown = [row for row in _wanted(results, spec["rows"]) if row["milestones"]]
    levels = list(shown[0]["milestones"]) if shown else []
    parts = ("median", "low", "high", "reached", "runs")
    columns = [Column("row"), Column("transfers in all", ("transfers",))]
    columns += [Column(f"to {level} %", tuple(f"to_{level}_{part}" for part in parts)) for level in levels]
    rows = [
        [_text(row["label"]), _plain(row["settings"]["steps"]), *(_cost(row["milestones"][level], parts) for level in levels)]
        for row in shown
    ]
    return columns, rows


def _cost(found: Tree, parts: Sequence[str]) -> Cell:
    def number(value: float | None) -> str:
        return "never" if value is None else f"{value:,.0f}"

    ends = f" [{number(found['low'])}, {number(found['high'])}]" if found["runs"] > 1 else ""
    return Cell(f"{number(found['median'])}{ends}, {found['reached']} of {found['runs']}", tuple(found[part] for part in parts))


def _runs(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """What was trained: arguments, size, where each run was at its best, time, commits."""
    titles = ("row", "arguments", "seeds", "transfers", "gradient steps", "best step", "minutes a run", "commits")
    rows = []
    for row in _wanted(results, spec["rows"]):
        done = [run["trained"] for run in row["runs"] if run["trained"]]
        if not done:
            continue
        minutes = sum(run["wall_s"] for run in done) / len(done) / 60
        gradient_steps = sum(run["gradient_step"] for run in done) / len(done)
        arguments = " ".join(row["arguments"]) or "(defaults)"
        commits = ", ".join(dict.fromkeys(commit for run in done for commit in run.get("commits", [run["commit"]])))
        best = ", ".join(NONE if run.get("best_step") is None else f"{run['best_step']:,}" for run in done)
        sizes = (_text(len(done)), _plain(row["settings"]["steps"]), _plain(gradient_steps), _text(best), _plain(minutes, "{:.1f}"))
        rows.append([_text(row["label"]), Cell(f"`{arguments}`", (arguments,)), *sizes, _text(commits)])
    return [Column(title) for title in titles], rows


def _ladder(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """The regret of a problem on each rung, a line a rung and a column for all rows of one label; below it is told what has no place."""
    shown = _wanted(results, spec["rows"])
    labels = list(dict.fromkeys(row["label"] for row in shown))
    columns = [Column("rung"), Column("optimum")]
    columns += [Column(label, tuple(f"{label} {part}" for part in ("regret", "low", "high", "success"))) for label in labels]
    lines = []
    for name, title in ((each["name"], each["label"] or each["name"]) for each in results["evaluations"]):
        able = {row["label"]: row for row in shown if name in (row["only"] or [name])}
        reports = {label: [run["evaluations"][name] for run in row["runs"] if name in run["evaluations"]] for label, row in able.items()}
        known = [report for each in reports.values() for report in each]
        if known and name in (spec["evaluations"] or [name]):
            cells = [_regret(reports.get(label)) for label in labels]
            lines.append([_text(title), _plain(known[0]["optimal_mean_steps"], "{:.3f}"), *cells])
    return columns, lines


def _regret(reports: Sequence[Tree] | None) -> Cell:
    """Mean regret, its interval over the problems or, of more runs than one, its ends over the runs, and the share of problems solved.

    ``reports``: of the runs that there are; None for what has no place on the rung.
    """
    if not reports:
        return Cell(NONE if reports is None else "not run", (None, None, None, None))
    each = [report["regret"] for report in reports]
    low, high = reports[0]["regret_ci95"] if len(each) == 1 else (min(each), max(each))
    mean, success = statistics.fmean(each), statistics.fmean(report["success_rate"] for report in reports)
    told = [f"{round(value, 3) + 0.0:.3f}" for value in (mean, low, high)]  # no minus before a zero
    return Cell(f"{told[0]} [{told[1]}, {told[2]}], {100 * success:.1f} %", (mean, low, high, success))


def _notes(results: Tree, spec: Tree) -> list[str]:
    """Of a table of the ladder: why rows are not on every rung that it shows."""
    if spec["kind"] != "ladder":
        return []
    shown = spec["evaluations"] or [each["name"] for each in results["evaluations"]]
    reasons, taken = {}, set()
    for row in _wanted(results, spec["rows"]):
        reasons[row["label"]] = row["because"]
        taken |= {(row["label"], name) for name in row["only"] or shown}
    return [f"{NONE} *{label}*: {reason}." for label, reason in reasons.items() if any((label, name) not in taken for name in shown)]


RANGED = (("success_rate", "success, %", "{:.2f}", 100.0, min), ("steps_ratio", "steps ÷ optimum (solved)", "{:.3f}", 1.0, max))
"""Measures of the table of ranges: name, heading, form, scale, which end is the worst."""


def _range(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """What a run may bring: the worst, the median and the best of the runs, each measure for itself."""
    labels = {item["name"]: item["label"] or item["name"] for item in results["evaluations"]}
    ends = ("worst", "median", "best")
    columns = [Column("row"), Column("evaluation"), Column("seeds"), Column("problems a run")]
    columns += [Column(f"{title}: {' / '.join(ends)}", tuple(f"{name}_{end}" for end in ends)) for name, title, *_ in RANGED]
    columns += [Column("seconds a run: median", ("wall_s",)), Column("processor")]
    rows = []
    for name in spec["evaluations"] or list(labels):
        for row in (row for row in _wanted(results, spec["rows"]) if name in row["evaluations"]):
            runs = [run for run in row["runs"] if name in run["evaluations"]]
            reports = [run["evaluations"][name] for run in runs]
            cells = [_text(row["label"]), _text(labels[name]), _text(len(runs)), _plain(reports[0]["episodes"])]
            cells += [_ends([report[key] for report in reports], form, scale, worst) for key, _, form, scale, worst in RANGED]
            seconds = [run["trained"]["wall_s"] for run in runs if run["trained"]]
            cells.append(_plain(statistics.median(seconds) if seconds else None))
            rows.append([*cells, _text(", ".join(dict.fromkeys(report["machine"]["cpu"] for report in reports)))])
    return columns, rows


PAIRED = {
    "success_rate": ("success at the first verdict, %", "{:.1f}", 100.0),
    "success_in_the_end": ("success in the end, %", "{:.1f}", 100.0),
    "transfer_error_mm.p50": ("a transfer off, median, mm", "{:.3f}", 1.0),
    "transfer_error_mm.p95": ("the same, 95th percentile, mm", "{:.3f}", 1.0),
    "transfer_error_mm.bias.0": ("bias away from the arm's base, mm", "{:+.3f}", 1.0),
    "transfer_error_mm.bias.1": ("bias to its left, mm", "{:+.3f}", 1.0),
    "transfer_error_deg.p50": ("turned off, median, °", "{:.3f}", 1.0),
    "transfer_error_deg.p95": ("the same, 95th percentile, °", "{:.3f}", 1.0),
    "transfer_error_deg.bias": ("bias counter-clockwise, °", "{:+.3f}", 1.0),
    "contact_events": ("missed, dropped, tipped, collided, of 100 transfers", "{:.2f}", 1.0),
    "mean_time_s": ("an episode on the cell's clock, s", "{:.2f}", 1.0),
    "episode_s.p50": ("an episode to compute, median, s", "{:.2f}", 1.0),
}
"""Measures of the table of pairs: heading, form, scale."""


def _paired(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """The same problems in two evaluations: each measure in both, and what the second has more."""
    labels = {item["name"]: item["label"] or item["name"] for item in results["evaluations"]}
    names = {row["name"]: row["label"] for row in results["rows"]}
    one, other = spec["evaluations"]
    columns = [Column("row"), Column("measure"), _interval_column(labels[one], one), _interval_column(labels[other], other)]
    columns.append(_interval_column(f"{labels[other]} less {labels[one]}", "difference"))
    rows = []
    for found in (found for found in results["paired"] if found["table"] == spec["name"]):
        title, form, scale = PAIRED[found["measure"]]
        signed = form if "+" in form else form.replace("{:", "{:+")
        values = [_interval(found["first"], form, scale), _interval(found["second"], form, scale)]
        rows.append([_text(names[found["row"]]), _text(title), *values, _interval(found["difference"], signed, scale)])
    return columns, rows


def _arms(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """Success, steps and the time of one decision by the number of arms, in the random cells of the evaluations together."""
    columns = [
        Column("arms"),
        Column("row"),
        Column("seeds"),
        Column("problems", ("episodes",)),
        Column("unsolvable, left out", ("unsolvable",)),
    ]
    columns += [_interval_column("success, %", "success_rate"), _interval_column("steps ÷ optimum (solved)", "steps_ratio")]
    columns.append(Column("one decision, ms", ("decision_ms",)))
    rows = []
    for row in _wanted(results, spec["rows"]):
        for name in spec["evaluations"]:
            for arms, found in row["by_arms"].get(name, {}).items():
                counts = [_plain(found[key]) for key in ("runs", "episodes", "unsolvable")]
                cells = [_interval(found["success_rate"], "{:.2f}", 100), _interval(found["steps_ratio"], "{:.3f}")]
                rows.append([_text(int(arms)), _text(row["label"]), *counts, *cells, _plain(found["decision_ms"], "{:.2f}")])
    return columns, sorted(rows, key=lambda cells: cells[0].values[0])


def _outage(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """Episodes in which an arm went out of order: how many stayed solvable, and what share of these was solved."""
    labels = {item["name"]: item["label"] or item["name"] for item in results["evaluations"]}
    columns = [Column("row"), Column("evaluation"), Column("seeds")]
    columns += [Column("an arm failed", ("episodes",)), Column("stayed solvable", ("solvable",))]
    columns.append(_interval_column("of these solved, %", "solved_share"))
    rows = []
    for row in _wanted(results, spec["rows"]):
        for name in (name for name in spec["evaluations"] or labels if name in row["outages"]):
            found = row["outages"][name]
            counts = [_plain(found[key]) for key in ("runs", "episodes", "solvable")]
            rows.append([_text(row["label"]), _text(labels[name]), *counts, _interval(found["solved_share"], "{:.2f}", 100)])
    return columns, rows


def expected_lines(results: Tree, name: str, found: Tree) -> list[str]:
    """What a run brought, beside what the runs of a row did: one line for each measure.

    Args:
        results: content of ``results.json`` of a suite with that row.
        name: of the row.
        found: report of the run's own evaluation, as ``evaluate json=FILE`` has it.

    Raises:
        UnknownChoice: no such row.
    """
    require_choice("row", name, [row["name"] for row in results["rows"]])
    (row,) = _wanted(results, [name])
    reports = [report for run in row["runs"] for report in run["evaluations"].values()]
    processors = ", ".join(dict.fromkeys(report["machine"]["cpu"] for report in reports))
    lines = [f"To expect: worst / median / best of {len(row['runs'])} seeds on {processors}"]
    for key, title, form, scale, worst in RANGED:
        value = found.get(key)
        brought = NONE if value is None else form.format(scale * value)
        lines.append(f"{title + ':':<27}{brought:>8}   to expect: {_ends([report[key] for report in reports], form, scale, worst).text}")
    return lines


def _ends(values: Sequence[float | None], form: str, scale: float, worst: Callable[[Sequence[float]], float]) -> Cell:
    """Worst, median and best of a measure that every run has; without that, nothing can be said of the worst."""
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return Cell(NONE, (None, None, None))
    found = (worst(known), statistics.median(known), max(known) if worst is min else min(known))
    return Cell(" / ".join(form.format(scale * value) for value in found), found)


def _comparison(results: Tree, spec: Tree) -> tuple[list[Column], list[list[Cell]]]:
    """Probability that a run of the first row beats one of the second."""
    labels = {row["name"]: row["label"] for row in results["rows"]}
    names = {item["name"]: item["label"] or item["name"] for item in results["evaluations"]}
    entries = [entry for entry in results["comparisons"] if entry["table"] == spec["name"]]
    wanted = [name for name in names if any(name in entry["evaluations"] for entry in entries)]
    columns = [Column("P(first beats second)", ("first", "second"))]
    columns += [_interval_column(f"success, {names[name]}", f"better_{name}") for name in wanted]
    columns += [_interval_column("sooner at 95 %", "sooner_at_95")]
    rows = []
    for entry in entries:
        first, second = entry["first"], entry["second"]
        cells = [Cell(f"{labels[first]} – {labels[second]}", (first, second))]
        cells += [_interval(entry["evaluations"].get(name), "{:.2f}") for name in wanted]
        rows.append([*cells, _interval(entry["sooner"], "{:.2f}")])
    return columns, rows


NOT_RUN = "Not run yet."
RESULTS = "results.json"

_BLOCK = re.compile(r"(<!-- (table|figure):([a-z0-9_]+)/([a-z0-9_]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


class UnknownBlock(HandoverError):
    """A mark on the page for a table or figure that the stored results do not have."""

    def __init__(self, kind: str, suite: str, name: str) -> None:
        super().__init__(f"the page asks for the {kind} {name!r} of suite {suite!r}, which its stored results do not have")
        self.kind, self.suite, self.name = kind, suite, name


class UnfitEvidence(HandoverError):
    """Results that the page must not show."""

    def __init__(self, out: Path, reason: str) -> None:
        super().__init__(f"{out}: {reason}")
        self.out, self.reason = out, reason


class Block(NamedTuple):
    """One block of a page: ``kind`` table or figure, and what stands in it."""

    kind: str
    suite: str
    name: str
    content: str


def blocks(page: str) -> list[Block]:
    """All blocks of a page, in order."""
    return [Block(match[2], match[3], match[4], match[5]) for match in _BLOCK.finditer(page)]


def read_evidence(folder: Path) -> dict[str, dict[str, Any]]:
    """Stored results by suite, of the folders in ``folder`` that have them."""
    return {path.parent.name: read_json(path, "stored results") for path in sorted(folder.glob(f"*/{RESULTS}"))}


def filled(page: str, evidence: Mapping[str, Mapping[str, Any]], pictures: str) -> str:
    """The page with every block made anew; a suite without evidence says that it was not run.

    Args:
        page: Markdown.
        evidence: content of ``results.json`` by suite.
        pictures: where the page finds the folders ``SUITE/figures``, relative to itself.

    Raises:
        UnknownBlock: evidence without the table or figure.
    """

    def replaced(match: re.Match[str]) -> str:
        """A block with its content as the evidence has it."""
        kind, suite, name = match[2], match[3], match[4]
        content = NOT_RUN + "\n"
        if suite in evidence:
            results = evidence[suite]
            shown = _table(results, suite, name) if kind == "table" else _figure(results, suite, name, pictures)
            content = (partial_line(results) + "\n\n" if results["partial"] else "") + shown
        return match[1] + "\n" + content + "\n" + match[6]

    return _BLOCK.sub(replaced, page)


def partial_line(results: Mapping[str, Any]) -> str:
    """How many seeds of which rows partial results have: ``2 of 5 seeds so far: ...``."""
    groups: dict[str, list[str]] = {}
    for part in results["progress"]:
        labels = groups.setdefault(f"{part['done']} of {part['of']} seeds so far", [])
        labels += [label] if (label := f"*{part['label']}*") not in labels else []
    if len(groups) == 1:
        return f"Partial: {next(iter(groups))}, of all rows."
    return "Partial: " + "; ".join(f"{count}: {', '.join(labels)}" for count, labels in groups.items()) + "."


def _table(results: Mapping[str, Any], suite: str, name: str) -> str:
    for table in make_tables(results):
        if table.name == name:
            return markdown(table)
    if results["partial"] and name in [spec["name"] for spec in results["tables"]]:
        return NOT_RUN + "\n"
    raise UnknownBlock("table", suite, name)


def _figure(results: Mapping[str, Any], suite: str, name: str, pictures: str) -> str:
    for spec in results["figures"]:
        if spec["name"] == name:
            return (
                NOT_RUN + "\n"
                if name in results["empty_figures"]
                else f"![{spec['title'] or name}]({pictures}/{suite}/figures/{name}.png)\n"
            )
    raise UnknownBlock("figure", suite, name)


def store_evidence(out: Path, folder: Path, partial: bool = False) -> Path:
    """Put what the page needs of a suite's results from ``out`` in place of what ``folder``/SUITE holds; returns that folder.

    Args:
        out: folder that ``compare`` filled.
        folder: of all evidence.
        partial: take results that do not have all rows and seeds of the suite, too.

    Raises:
        MissingFile, CorruptFile: ``out`` holds no results.
        UnfitEvidence: they are partial, of the smoke size, have failures, or their tables or pictures are not all there.
    """
    results = read_json(out / RESULTS, "results")
    files = _required(results, out, partial)
    home = folder / str(results["suite"])
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as temporary:
        new = Path(temporary) / home.name
        for name in files:
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(out / name, new / name)
        if home.exists():
            home.rename(Path(temporary) / "old")
        new.rename(home)
    return home


def _required(results: Mapping[str, Any], out: Path, partial: bool) -> list[str]:
    """The files to keep, all of them there."""
    again = "make them again with report_only=true"
    if not {"partial", "progress", "empty_figures"} <= set(results):
        raise UnfitEvidence(out, f"its results are of an older version; {again}")
    if results["size"] != "full":
        raise UnfitEvidence(out, f"its results are of the size {results['size']}")
    if results["failures"]:
        raise UnfitEvidence(out, f"its results have failures: {', '.join(results['failures'])}")
    if results["partial"] and not partial:
        raise UnfitEvidence(out, f"its results are not the whole suite ({partial_line(results)}); partial=true takes them all the same")
    tables = [f"tables/{table.name}.{suffix}" for table in make_tables(results) for suffix in ("md", "csv")]
    drawn = [spec["name"] for spec in results["figures"] if spec["name"] not in results["empty_figures"]]
    files = [RESULTS, *tables, *(f"figures/{name}.png" for name in drawn)]
    if lacking := [name for name in files if not (out / name).is_file()]:
        raise UnfitEvidence(out, f"it lacks {', '.join(lacking)}; {again}")
    return files
