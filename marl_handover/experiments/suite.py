"""A suite: one YAML file that says which rows are trained, how they are evaluated, and which tables and figures come of it.

A row is one line: arguments of ``train``, or the name of a policy that needs no training. Keys and their meaning stand at the classes
below; a file holds no other keys.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from marl_handover.compose import option_file
from marl_handover.config import bounded, check_bounds, require_at_least, require_between, require_choice
from marl_handover.errors import CorruptFile, HandoverError, InvalidSetting, UnknownChoice
from marl_handover.files import resource_path
from marl_handover.parsing import read_yaml
from marl_handover.policies.policy import SHIELDED

RUN = "{run}"
"""Stands for a trained row's run directory in the name of a policy."""

CURVE_MEASURES = ("success_rate", "mean_steps", "steps_ratio", "training_success_rate", "training_mean_length")
REPORTED = ("mean_steps", "regret")
"""Measured besides, and not to be drawn as bars: mean steps mix in what failed, so that a policy that fails at once looks quick."""

BAR_MEASURES = (
    "success_rate",
    "success_in_the_end",
    "mean_steps_success",
    "steps_ratio",
    "path_mm",
    "executor_path_mm",
)
PAIRED_MEASURES = (
    "success_rate",
    "success_in_the_end",
    "transfer_error_mm.p50",
    "transfer_error_mm.p95",
    "transfer_error_mm.bias.0",
    "transfer_error_mm.bias.1",
    "transfer_error_deg.p50",
    "transfer_error_deg.p95",
    "transfer_error_deg.bias",
    "contact_events",
    "mean_time_s",
    "episode_s.p50",
)
"""What two evaluations of the same problems are held against each other by; dots lead into a report."""

CURVE_AXES = ("step", "share")
FIGURES = {
    "curves": ("rows", "measure", "x"),
    "bars": ("rows", "evaluations", "measure"),
    "end_states": ("rows", "evaluations"),
    "arms": ("rows", "evaluations"),
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
    "paired": ("rows", "evaluations"),
    "arms": ("rows", "evaluations"),
    "outage": ("rows", "evaluations"),
    "ladder": ("rows", "evaluations"),
}
"""The same of tables."""

OWN_TRAIN = ("seed", "out", "resume", "progress")
OWN_EVALUATE = ("policy", "seed")
"""Arguments that a suite sets itself for every run."""

MAX_SEEDS = 1000

RECORDS = ("task", "trained", "done")
"""Names of a run's own records, which stand beside one for each evaluation."""

_NAME = re.compile(r"[a-z0-9][a-z0-9_]*")

EVALUATION_SEED_OFFSET = 100
"""Run k of a row is judged on the problems of this seed plus k."""

SIZES = ("full", "quick")

Spec = TypeVar("Spec")


@dataclass
class RowSpec:
    """One thing that is compared."""

    name: str = ""  # of its folder; small letters, digits, underscores
    label: str = ""  # in tables and figures; the name if empty
    train: list[str] | None = None  # arguments of `train`; [] trains with the defaults; left out: nothing is trained
    policy: str = ""  # a policy by name, for a row that is not trained
    evaluate: list[str] = field(default_factory=list)  # arguments put after those of every evaluation
    seeds: int = bounded(0, 0, MAX_SEEDS)  # 0: the suite's
    only: list[str] = field(default_factory=list)  # evaluations that it can take; empty: all
    because: str = ""  # why not the others, which tables of the ladder tell


@dataclass
class EvaluationSpec:
    """One way of judging every row, or those in ``rows``."""

    name: str = ""
    label: str = ""
    arguments: list[str] = field(default_factory=list)  # of `evaluate`
    policy: str = ""  # instead of the row's own, such as shielded:{run}; {run} is the row's run directory
    rows: list[str] = field(default_factory=list)  # empty: all
    seeds: int = bounded(0, 0, MAX_SEEDS)  # the first so many of a row's runs; 0: all


@dataclass
class FigureSpec:
    """One picture, as PNG and PDF."""

    name: str = ""
    kind: str = ""  # curves, bars, end_states, profiles, workspace, arms: by the number of arms of random cells
    title: str = ""
    rows: list[str] = field(default_factory=list)  # empty: all that have such values
    evaluations: list[str] = field(default_factory=list)  # empty: all, unless only some of them are shielded
    measure: str = "success_rate"  # of curves and bars
    x: str = "step"  # of curves: step, or share of the run's training


@dataclass
class TableSpec:
    """One table, as Markdown and CSV."""

    name: str = ""
    kind: str = ""  # evaluation, milestones, runs, comparison, range, arms, outage, ladder, paired: two evaluations of the same problems
    title: str = ""
    rows: list[str] = field(default_factory=list)
    evaluations: list[str] = field(default_factory=list)  # as of figures
    pairs: list[list[str]] = field(default_factory=list)  # of comparison: [better?, than]
    paths: bool = False  # of evaluation: also how far the grip travels in a transfer


@dataclass
class QuickSpec:
    """The smoke size: arguments put after all others."""

    seeds: int = bounded(2, 1, MAX_SEEDS)
    train: list[str] = field(default_factory=list)
    evaluate: dict[str, list[str]] = field(default_factory=dict)  # by evaluation


@dataclass
class Suite:
    """A suite as read and checked."""

    name: str
    title: str = ""
    seeds: int = bounded(5, 1, MAX_SEEDS)
    train: list[str] = field(default_factory=list)  # arguments put before every row's own
    rows: list[RowSpec] = field(default_factory=list)
    evaluations: list[EvaluationSpec] = field(default_factory=list)
    figures: list[FigureSpec] = field(default_factory=list)
    tables: list[TableSpec] = field(default_factory=list)
    quick: QuickSpec = field(default_factory=QuickSpec)
    size: str = "full"

    def row(self, name: str) -> RowSpec:
        """The row of that name."""
        return next(row for row in self.rows if row.name == name)

    def seeds_of(self, row: RowSpec) -> range:
        """Training seeds of a row."""
        return range(row.seeds or self.seeds)

    def evaluations_of(self, row: RowSpec, seed: int) -> list[EvaluationSpec]:
        """The evaluations that run ``seed`` of a row gets."""
        return [spec for spec in self.evaluations if _applies(spec, row) and seed < (spec.seeds or seed + 1)]

    def train_arguments(self, row: RowSpec) -> list[str]:
        """Arguments of ``train`` for a row, weak ones first."""
        assert row.train is not None
        return [*self.train, *row.train, *(self.quick.train if self.size == "quick" else [])]

    def evaluate_arguments(self, row: RowSpec, spec: EvaluationSpec) -> list[str]:
        """Arguments of ``evaluate`` for a row, weak ones first, policy and seed left out."""
        quick = self.quick.evaluate.get(spec.name, []) if self.size == "quick" else []
        return [*spec.arguments, *row.evaluate, *quick]

    def policy_of(self, row: RowSpec, spec: EvaluationSpec) -> str:
        """Name of the policy that is judged, which may hold :data:`RUN`."""
        return spec.policy or row.policy or RUN

    def sized(self, size: str) -> Suite:
        """This suite in full, or in its smoke size: fewer seeds, shorter runs.

        Raises:
            UnknownChoice: another size.
        """
        require_choice("preset", size, SIZES)
        if size == "full":
            return self
        return self.with_seeds(self.quick.seeds, at_most=True, size="quick")

    def with_seeds(self, count: int, at_most: bool = False, **changes: Any) -> Suite:
        """This suite with ``count`` seeds for every row, or with no more than those. An evaluation of fewer runs keeps to its number."""
        require_between("seeds", count, 1, MAX_SEEDS)

        def less(own: int) -> int:
            return min(own or self.seeds, count) if at_most else count

        rows = [replace(row, seeds=less(row.seeds)) for row in self.rows]
        evaluations = [replace(spec, seeds=min(spec.seeds, count)) for spec in self.evaluations]
        return replace(self, seeds=less(self.seeds), rows=rows, evaluations=evaluations, **changes)

    def with_rows(self, names: Sequence[str]) -> Suite:
        """This suite with some of its rows; all if ``names`` is empty. Raises :class:`UnknownChoice`."""
        for name in names:
            if name not in [row.name for row in self.rows]:
                raise UnknownChoice("rows", name, [row.name for row in self.rows])
        return replace(self, rows=[row for row in self.rows if not names or row.name in names])


def suite_folder() -> Path:
    """Where the shipped suites are."""
    return resource_path("configs") / "suite"


def load_suite(name: str) -> Suite:
    """A suite by name, or by the path of a YAML file.

    Raises:
        UnknownChoice, MissingFile: there is none.
        CorruptFile: it is no suite; names the entry.
    """
    path = option_file("suite", name, suite_folder(), None)
    tree = read_yaml(path, "suite")
    lists = {"rows": RowSpec, "evaluations": EvaluationSpec, "figures": FigureSpec, "tables": TableSpec}
    parts: dict[str, Any] = {}
    for key, schema in lists.items():
        entries = tree.pop(key, None) or []
        if not isinstance(entries, list):
            raise CorruptFile("suite", path, f"{key}: expected a list, one entry a line")
        parts[key] = [_fitted(schema, entry, path, f"{key}[{number}]") for number, entry in enumerate(entries)]
    parts["quick"] = _fitted(QuickSpec, tree.pop("quick", None) or {}, path, "quick")
    head = _fitted(_Head, tree, path, "the file", also=(*lists, "quick"))
    suite = Suite(path.stem, head.title or path.stem, head.seeds, head.train, **parts)
    try:
        check(suite)
    except HandoverError as error:
        raise CorruptFile("suite", path, str(error)) from error
    return suite


@dataclass
class _Head:
    title: str = ""
    seeds: int = bounded(5, 1, MAX_SEEDS)
    train: list[str] = field(default_factory=list)


def _fitted(schema: type[Spec], tree: Any, path: Path, where: str, also: Iterable[str] = ()) -> Spec:
    """An instance of ``schema``. Raises :class:`CorruptFile` that names the entry and the key."""
    if not isinstance(tree, Mapping):
        raise CorruptFile("suite", path, f"{where}: expected key: value pairs, got {tree!r}")
    where += f" ({tree['name']})" if tree.get("name") else ""
    known = [item.name for item in fields(schema)]  # type: ignore[arg-type]  # a dataclass
    for key in tree:
        if key not in known:
            raise CorruptFile("suite", path, f"{where}: unknown key {key!r}; keys: {', '.join([*known, *also])}")
    try:
        made: Any = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.create(dict(tree))))
        check_bounds(made)
    except (OmegaConfBaseException, InvalidSetting) as error:
        raise CorruptFile("suite", path, f"{where}: {str(error).splitlines()[0]}") from error
    fitted: Spec = made
    return fitted


def _applies(spec: EvaluationSpec, row: RowSpec) -> bool:
    """Whether the row is judged so: it is named, or all are, except that an untrained one has no run to name."""
    if row.only and spec.name not in row.only:
        return False
    return row.name in spec.rows if spec.rows else row.train is not None or RUN not in spec.policy


if TYPE_CHECKING:
    from marl_handover.experiments.suite import FigureSpec, RowSpec, Suite, TableSpec


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
        _check_by_arms(suite, f"figures: {figure.name}", figure)
    for table in suite.tables:
        _check_shown(suite, f"tables: {table.name}", table, TABLES)
        if table.kind == "comparison":
            _check_pairs(suite, table)
        _check_by_arms(suite, f"tables: {table.name}", table)
        if table.kind == "ladder":
            _check_on_rungs(suite, table)
        if table.kind == "paired" and len(table.evaluations) != 2:
            raise BadEntry(f"tables: {table.name}: evaluations", "two of them are held against each other: [one, other]")
    _check_shield(suite)
    _check_profiles(suite)


def _check_row(row: RowSpec) -> None:
    if (row.train is None) == (not row.policy):
        raise BadEntry(f"rows: {row.name}", "give `train`, a list that may be empty, or `policy`, one of the two")
    if RUN in row.policy:
        raise BadEntry(f"rows: {row.name}: policy", f"{RUN} belongs into an evaluation's policy; a row with a policy is not trained")


def _check_evaluations(suite: Suite) -> None:
    rows = tuple(row.name for row in suite.rows)
    for row in suite.rows:
        for name in row.only:
            require_choice(f"rows: {row.name}: only", name, tuple(spec.name for spec in suite.evaluations))
        if bool(row.only) != bool(row.because):
            raise BadEntry(f"rows: {row.name}", "`only` some evaluations and `because` go together")
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


def _check_by_arms(suite: Suite, where: str, spec: FigureSpec | TableSpec) -> None:
    """What goes by the number of arms names evaluations in random cells."""
    if spec.kind != "arms":
        return
    random = [each.name for each in suite.evaluations if any(argument.startswith("layouts.") for argument in each.arguments)]
    if not spec.evaluations:
        raise BadEntry(f"{where}: evaluations", f"the kind arms names some in random cells: {', '.join(random) or 'there is none'}")
    for name in spec.evaluations:
        require_choice(f"{where}: evaluations", name, tuple(random))


def _check_on_rungs(suite: Suite, table: TableSpec) -> None:
    """A table of the ladder shows evaluations on its rungs alone."""
    for spec in suite.evaluations:
        if spec.name in (table.evaluations or [spec.name]) and not any(argument.startswith("ladder=") for argument in spec.arguments):
            raise BadEntry(f"tables: {table.name}: evaluations", f"{spec.name} is not on a rung: it has no argument ladder=RUNG")


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
