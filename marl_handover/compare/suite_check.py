"""What a suite may say: names are unique, references exist, every row has one source, and no key stands where nothing looks at it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING

from marl_handover.config import require_at_least, require_choice
from marl_handover.errors import HandoverError
from marl_handover.policies.shielded import SHIELDED

if TYPE_CHECKING:
    from marl_handover.compare.suite import FigureSpec, RowSpec, Suite, TableSpec

RUN = "{run}"
"""Stands for a trained row's run directory in the name of a policy."""

CURVE_MEASURES = ("success_rate", "mean_steps", "steps_ratio", "training_success_rate", "training_mean_length")
REPORTED = ("mean_steps",)
"""Measured besides, and not to be drawn as bars: mean steps mix in what failed, so that a policy that fails at once looks quick."""

BAR_MEASURES = (
    "success_rate",
    "success_in_the_end",
    "mean_steps_success",
    "steps_ratio",
    "path_mm",
    "executor_path_mm",
)
CURVE_AXES = ("step", "share")
FIGURES = {
    "curves": ("rows", "measure", "x"),
    "bars": ("rows", "evaluations", "measure"),
    "end_states": ("rows", "evaluations"),
    "profiles": ("rows", "evaluations"),
    "workspace": (),
}
"""Kinds of figures and the keys that each looks at, besides name, kind and title."""

TABLES = {
    "evaluation": ("rows", "evaluations", "paths"),
    "milestones": ("rows",),
    "runs": ("rows",),
    "comparison": ("evaluations", "pairs"),
    "range": ("rows", "evaluations"),
}
"""The same of tables."""

OWN_TRAIN = ("seed", "out", "resume", "progress")
OWN_EVALUATE = ("policy", "seed")
"""Arguments that a suite sets itself for every run."""

MAX_SEEDS = 1000

RECORDS = ("task", "trained", "done")
"""Names of a run's own records, which stand beside one for each evaluation."""

_NAME = re.compile(r"[a-z0-9][a-z0-9_]*")


class BadEntry(HandoverError):
    """An entry of a suite that makes no sense."""

    def __init__(self, where: str, reason: str) -> None:
        super().__init__(f"{where}: {reason}")
        self.where, self.reason = where, reason


def check(suite: Suite) -> None:
    """Raise a :class:`HandoverError` that names the first entry that cannot be meant."""
    require_at_least("number of rows", len(suite.rows), 1)
    for what in ("rows", "evaluations", "figures", "tables"):
        names: list[str] = []
        for spec in getattr(suite, what):
            if not _NAME.fullmatch(spec.name):
                raise BadEntry(f"{what}: name {spec.name!r}", "small letters, digits and underscores make a name")
            if spec.name in names:
                raise BadEntry(f"{what}: {spec.name}", "the name is taken")
            names.append(spec.name)
    for row in suite.rows:
        _check_row(row)
    _check_evaluations(suite)
    _check_arguments(suite)
    for figure in suite.figures:
        _check_shown(suite, f"figures: {figure.name}", figure, FIGURES)
        require_choice(f"figures: {figure.name}: measure", figure.measure, CURVE_MEASURES if figure.kind == "curves" else BAR_MEASURES)
        require_choice(f"figures: {figure.name}: x", figure.x, CURVE_AXES)
    for table in suite.tables:
        _check_shown(suite, f"tables: {table.name}", table, TABLES)
        if table.kind == "comparison":
            _check_pairs(suite, table)
    _check_shield(suite)
    _check_profiles(suite)


def _check_row(row: RowSpec) -> None:
    if (row.train is None) == (not row.policy):
        raise BadEntry(f"rows: {row.name}", "give `train`, a list that may be empty, or `policy`, one of the two")
    if RUN in row.policy:
        raise BadEntry(f"rows: {row.name}: policy", f"{RUN} belongs into an evaluation's policy; a row with a policy is not trained")


def _check_evaluations(suite: Suite) -> None:
    rows = tuple(row.name for row in suite.rows)
    for spec in suite.evaluations:
        if spec.name in RECORDS:
            raise BadEntry(f"evaluations: {spec.name}", f"a run's own records are called so; any name but {', '.join(RECORDS)}")
        for name in spec.rows:
            require_choice(f"evaluations: {spec.name}: rows", name, rows)
            if RUN in spec.policy and suite.row(name).train is None:
                raise BadEntry(f"evaluations: {spec.name}", f"row {name} is not trained, so it has no {RUN}")
    for name in suite.quick.evaluate:
        require_choice("quick.evaluate", name, tuple(spec.name for spec in suite.evaluations))


def _check_arguments(suite: Suite) -> None:
    """Refuse arguments that every run gets from the suite itself."""
    train = {"train": suite.train, "quick.train": suite.quick.train}
    train |= {f"rows: {row.name}: train": row.train or [] for row in suite.rows}
    evaluate = {f"evaluations: {spec.name}: arguments": spec.arguments for spec in suite.evaluations}
    evaluate |= {f"rows: {row.name}: evaluate": row.evaluate for row in suite.rows}
    evaluate |= {f"quick.evaluate: {name}": arguments for name, arguments in suite.quick.evaluate.items()}
    for places, own, instead in (
        (train, OWN_TRAIN, "seeds count from 0, and a run's folder follows from its row"),
        (evaluate, OWN_EVALUATE, "`policy` is a key of rows and of evaluations, and problems follow from the run's seed"),
    ):
        for where, arguments in places.items():
            _refuse(where, arguments, own, instead)


def _refuse(where: str, arguments: Sequence[str], own: Sequence[str], instead: str) -> None:
    for argument in arguments:
        if argument.partition("=")[0].strip() in own:
            raise BadEntry(where, f"{argument} would be ignored: {instead}")


def _check_shown(suite: Suite, where: str, spec: FigureSpec | TableSpec, kinds: dict[str, tuple[str, ...]]) -> None:
    """A figure or table is of a known kind, names what there is, and sets nothing that its kind does not look at."""
    require_choice(f"{where}: kind", spec.kind, tuple(kinds))
    for item in fields(spec):
        usual = item.default_factory() if item.default_factory is not MISSING else item.default
        if item.name not in ("name", "kind", "title", *kinds[spec.kind]) and getattr(spec, item.name) != usual:
            raise BadEntry(f"{where}: {item.name}", f"the kind {spec.kind} has none")
    for key, known in (("rows", suite.rows), ("evaluations", suite.evaluations)):
        for name in getattr(spec, key):
            require_choice(f"{where}: {key}", name, tuple(entry.name for entry in known))


def _check_shield(suite: Suite) -> None:
    """The shield knows the rule book: what it mended never passes for what was learned.

    Evaluations of both kinds stand beside one another only where the suite names them; in a profile, where scores are pooled, never.
    """
    every = [entry.name for entry in suite.evaluations]
    mended = [entry.name for entry in suite.evaluations if entry.policy.startswith(SHIELDED)]
    for what, specs, kinds in (("figures", suite.figures, FIGURES), ("tables", suite.tables, TABLES)):
        for spec in specs:
            shown = (spec.evaluations or every) if "evaluations" in kinds[spec.kind] else []
            shielded, others = [name for name in shown if name in mended], [name for name in shown if name not in mended]
            if shielded and others and (spec.kind == "profiles" or not spec.evaluations):
                reason = f"shielded ones ({', '.join(shielded)}) would be mixed with {', '.join(others)}; name those that are meant"
                raise BadEntry(f"{what}: {spec.name}: evaluations", reason)


def _check_profiles(suite: Suite) -> None:
    """A profile pools the evaluations it shows, so that a row that lacks one has none."""
    for spec in suite.figures:
        shown = spec.evaluations or [entry.name for entry in suite.evaluations]
        for name in spec.rows if spec.kind == "profiles" else ():
            judged = [entry.name for entry in suite.evaluations_of(suite.row(name), 0)]
            if lacking := [entry for entry in shown if entry not in judged]:
                raise BadEntry(f"figures: {spec.name}: rows", f"{name} would be left out: it is not judged by {', '.join(lacking)}")


def _check_pairs(suite: Suite, table: TableSpec) -> None:
    if not table.pairs:
        raise BadEntry(f"tables: {table.name}: pairs", "a comparison needs some: [[better?, than], ...]")
    for pair in table.pairs:
        if len(pair) != 2:
            raise BadEntry(f"tables: {table.name}: pairs: {pair}", "a pair has two rows")
        for name in pair:
            require_choice(f"tables: {table.name}: pairs", name, tuple(row.name for row in suite.rows))
