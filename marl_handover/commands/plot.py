"""``marl-handover plot``: a figure of training runs, of a cell, of a plan, of its motions, of an evaluation, of a suite."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marl_handover.config import CELL_ALIASES, SYMMETRY_ORDER, CellConfig, MotionConfig, bounded, check_bounds, chosen, path_field
from marl_handover.errors import CorruptFile, InvalidSetting, UnknownChoice
from marl_handover.files import expanded

Figure = Any
"""matplotlib's, which only :mod:`marl_handover.report` imports."""

KINDS = ("run", "workspace", "plan", "motion", "evaluation", "errors", "confusion", "compare")
WROTE = {"plan": "plan json=FILE", "motion": "plan motion=FILE", "evaluation": "evaluate json=FILE"}
"""Which command wrote the json file of a kind."""


@dataclass
class PlotConfig:
    """Keys of ``plot``."""

    kind: str = chosen("run", KINDS)  # run, workspace, plan, motion, evaluation, errors, confusion or compare
    run: str = path_field()  # kind=run: a run directory, or several seeds: [A,B]
    json: str = path_field()  # kind=plan, motion, evaluation: what that command wrote with json=FILE or motion=FILE
    trace: str = path_field()  # kind=errors, confusion: trace=FILE of evaluate; of confusion also [A,B]; kind=evaluation: adds a histogram
    suite: str = path_field()  # kind=compare: folder of a suite that compare wrote
    figure: str = ""  # kind=compare: one of its figures; all if empty
    scale: str = chosen("log", ("log", "linear"))  # kind=errors: log or linear
    symmetry_order: int | None = bounded(None, *SYMMETRY_ORDER)  # of the block in the trace; null: as the file says, or 1
    cell: CellConfig | None = None  # null: the file's own, or paper
    out: str = path_field()  # .png, .pdf or .svg; learning.png in the run directory, or beside the file; of a whole suite: a folder


SCHEMA: type = PlotConfig
ALIASES = CELL_ALIASES
GROUPS: dict[str, dict[str, type]] = {}


def run(config: PlotConfig) -> int:
    """Draw one figure, or those of a suite, and say where it is."""
    drawn(config, print)
    return 0


def drawn(config: PlotConfig, say: Callable[[str], None]) -> Path:
    """Draw one figure, or those of a suite, say where it is, and return that: a file, or a suite's folder."""
    from marl_handover.report.figure_style import require_picture, save_figure

    check_bounds(config)
    whole_suite = config.kind == "compare" and not config.figure
    if config.out and not whole_suite:
        require_picture("out", config.out)
    if whole_suite:
        return _whole_suite(config, say)
    makers = {
        "run": _run,
        "workspace": _workspace,
        "plan": _plan,
        "motion": _motion,
        "evaluation": _evaluation,
        "errors": _errors,
        "confusion": _confusion,
        "compare": _suite_figure,
    }
    figure, default = makers[config.kind](config)
    out = Path(config.out) if config.out else default
    save_figure(figure, out)
    say(f"written: {out}")
    return out


def run_folders(text: str) -> list[Path]:
    """The run directories of ``run=DIR`` or ``run=[A,B]``; ``run`` is text, as a path may hold what means something in Hydra's grammar."""
    folders = _paths(text)
    if not folders:
        raise InvalidSetting("run", text, "a run directory, run=DIR, or several, run=[A,B]")
    return folders


def _paths(text: str) -> list[Path]:
    inner = text[1:-1] if text.startswith("[") and text.endswith("]") else None
    names = [text] if inner is None else inner.split(",")
    return [expanded(name.strip().strip("'\"")) for name in names if name.strip()]


def _run(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.learning.recorder import read_metrics
    from marl_handover.report.learning import learning_figure

    folders = run_folders(config.run)
    figure = learning_figure({str(folder): read_metrics(folder) for folder in folders})
    homes = [folder if folder.is_dir() else folder.parent for folder in folders]
    home = homes[0] if len(homes) == 1 else Path(os.path.commonpath([path.resolve() for path in homes]))
    return figure, home / "learning.png"


def _workspace(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.cell import build_cell
    from marl_handover.report.plan import workspace_figure

    return workspace_figure(build_cell(config.cell or CellConfig())), Path("runs/workspace/workspace.png")


def _plan(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.cell import load_cell
    from marl_handover.report.plan import check_plan, plan_figure

    path, plan = _json(config)
    check_plan(plan, path)
    if config.cell is None and "cell_settings" not in plan:
        raise CorruptFile("plan", path, "it lacks 'cell_settings'; name the cell: cell=paper")
    return plan_figure(plan, load_cell(config.cell or _stored(CellConfig, plan, "cell_settings", path))), path.with_suffix(".png")


def _motion(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.cell import build_cell
    from marl_handover.report.motion import motion_figure, read_motions, require_fit

    path, content = _json(config)
    motions = read_motions(content, path)
    model = build_cell(config.cell or _stored(CellConfig, content, "cell_settings", path))
    require_fit(motions, model)
    return motion_figure(motions, model, _stored(MotionConfig, content, "motion_settings", path)), path.with_suffix(".png")


def _stored(schema: type, content: dict[str, Any], key: str, path: Path) -> Any:
    """The settings that a file holds under ``key``; the defaults if it has none."""
    from marl_handover.compose import from_text

    return from_text(schema, json.dumps(content.get(key, {})), path)


def _evaluation(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.report.evaluation import check_evaluation, evaluation_figure

    path, result = _json(config)
    check_evaluation(result, path)
    counts = _transfers(config, result) if config.trace else (None, None)
    return evaluation_figure(result, *counts), path.with_suffix(".png")


def _transfers(config: PlotConfig, result: dict[str, Any]) -> tuple[Any, Any]:
    """Transfers and optimal transfers of each successful episode of the trace, int (n,)."""
    from marl_handover.report.traces import as_seen, read_trace
    from marl_handover.task.planner import ExactPlanner

    trace = read_trace(Path(config.trace))
    played = trace.take(trace.solved)
    wanted = result["outcomes"]["success"]
    # A simulated cell knows better than the loop whether the block is at the goal, so there the trace may differ.
    if len(played.episode) != wanted and result.get("backend", "kinematic") == "kinematic":
        raise InvalidSetting(
            "trace", config.trace, f"of the same evaluation; it has {len(played.episode)} successes, the json file {wanted}"
        )
    rules = _rules(config, played, epsilon_deg=float(result["epsilon_deg"]))
    return played.transfers, ExactPlanner(rules).plan(as_seen(rules.cell, played.start), played.goal).transfers


def _errors(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.report.evaluation import errors_figure
    from marl_handover.report.traces import symmetry_of

    path, trace = _traces(config, 1)[0]
    order = symmetry_of(trace, config.symmetry_order)
    return errors_figure(trace, order, config.scale, path.stem), path.with_name(f"{path.stem}_errors.png")


def _confusion(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.report.evaluation import endings_against, meant_figure

    (path, trace), *more = _traces(config, 2)
    default = path.with_name(f"{path.stem}_confusion.png")
    if more:
        return endings_against(trace, more[0][1], (path.stem, more[0][0].stem)), default
    return meant_figure(trace, _rules(config, trace), path.stem), default


def _traces(config: PlotConfig, most: int) -> list[tuple[Path, Any]]:
    from marl_handover.report.traces import read_trace

    paths = _paths(config.trace)
    if not 1 <= len(paths) <= most:
        more = "" if most == 1 else ", or two of the same problems, trace=[A,B]"
        raise InvalidSetting("trace", config.trace, f"a file that `marl-handover evaluate trace=FILE` wrote{more}")
    return [(path, read_trace(path)) for path in paths]


def _rules(config: PlotConfig, trace: Any, epsilon_deg: float = 5.0) -> Any:
    """The rule book of the trace's cell. Raises :class:`InvalidSetting` for a cell in which nobody reaches its problems."""
    from marl_handover.cell import load_cell
    from marl_handover.config import TaskConfig
    from marl_handover.report.traces import as_seen, symmetry_of
    from marl_handover.task.rules import Rules

    cell = load_cell(config.cell or CellConfig())
    if not (cell.reaches(as_seen(cell, trace.start)).any(-1) & cell.reaches(trace.goal).any(-1)).all():
        raise InvalidSetting("cell", cell.config.name, "the cell of the trace; some of its episodes are out of this one's reach")
    return Rules(cell, TaskConfig(epsilon_deg=epsilon_deg, symmetry_order=symmetry_of(trace, config.symmetry_order)))


def _suite_figure(config: PlotConfig) -> tuple[Figure, Path]:
    folder, figures = _suite(config)
    if config.figure not in figures:
        raise UnknownChoice("figure", config.figure, figures)
    if figures[config.figure] is None:
        raise InvalidSetting("figure", config.figure, "one that has values already; this suite has none for it yet")
    return figures[config.figure], folder / "figures" / f"{config.figure}.png"


def _whole_suite(config: PlotConfig, say: Callable[[str], None]) -> Path:
    """All figures of a suite, each as PNG and PDF."""
    from marl_handover.report.figure_style import save_figure

    folder, figures = _suite(config)
    out = Path(config.out) if config.out else folder / "figures"
    for name, figure in figures.items():
        if figure is None:
            say(f"no values yet: {name}")
            continue
        for suffix in ("png", "pdf"):
            save_figure(figure, out / f"{name}.{suffix}")
        say(f"written: {out / name}.png, .pdf")
    return out


def _suite(config: PlotConfig) -> tuple[Path, dict[str, Figure | None]]:
    """Folder and figures of a suite, from its stored numbers alone."""
    from marl_handover.parsing import read_json
    from marl_handover.report.compare import make_figures

    if not config.suite:
        raise InvalidSetting("suite", config.suite, "a folder that `marl-handover compare` wrote, such as runs/compare/paper")
    folder = Path(config.suite)
    path = folder / "results.json"
    results = read_json(path, "results of a suite")
    try:
        return folder, dict(make_figures(results))
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise CorruptFile("results of a suite", path, f"{type(error).__name__}: {error}") from error


def _json(config: PlotConfig) -> tuple[Path, dict[str, Any]]:
    from marl_handover.parsing import read_json

    if not config.json:
        raise InvalidSetting("json", config.json, f"the file that `marl-handover {WROTE[config.kind]}` wrote")
    path = Path(config.json)
    return path, read_json(path, config.kind)
