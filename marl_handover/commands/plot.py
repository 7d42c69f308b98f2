"""``marl-handover plot``: a figure of training runs, of a cell, of a plan or of an evaluation."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marl_handover.config import CellConfig, require_choice
from marl_handover.errors import CorruptFile, InvalidSetting

Figure = Any
"""matplotlib's, which only :mod:`marl_handover.report` imports."""

KINDS = ("run", "workspace", "plan", "evaluation")


@dataclass
class PlotConfig:
    """Keys of ``plot``."""

    kind: str = "run"  # run, workspace, plan or evaluation
    run: str = ""  # kind=run: a run directory, or several seeds: [A,B]
    json: str = ""  # kind=plan, kind=evaluation: what that command wrote with json=FILE
    trace: str = ""  # kind=evaluation: its trace=FILE, for a histogram of transfers
    symmetry_order: int = 1  # of the block in the trace
    cell: CellConfig | None = None  # null: the plan's own, or paper
    out: str = ""  # .png, .pdf or .svg; learning.png in the run directory, or beside the json file


SCHEMA: type = PlotConfig
ALIASES: dict[str, str] = {}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: PlotConfig) -> int:
    """Draw one figure and say where it is."""
    from marl_handover.report.files import require_picture, save_figure

    require_choice("kind", config.kind, KINDS)
    if config.out:
        require_picture("out", config.out)
    makers = {"run": _run, "workspace": _workspace, "plan": _plan, "evaluation": _evaluation}
    figure, default = makers[config.kind](config)
    out = Path(config.out) if config.out else default
    save_figure(figure, out)
    print(f"written: {out}")
    return 0


def run_folders(text: str) -> list[Path]:
    """The run directories of ``run=DIR`` or ``run=[A,B]``; ``run`` is text, as a path may hold what means something in Hydra's grammar."""
    inner = text[1:-1] if text.startswith("[") and text.endswith("]") else None
    names = [text] if inner is None else inner.split(",")
    folders = [Path(name.strip().strip("'\"")) for name in names if name.strip()]
    if not folders:
        raise InvalidSetting("run", text, "a run directory, run=DIR, or several, run=[A,B]")
    return folders


def _run(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.report.learning import learning_figure
    from marl_handover.report.metrics import read_metrics

    folders = run_folders(config.run)
    figure = learning_figure({str(folder): read_metrics(folder) for folder in folders})
    homes = [folder if folder.is_dir() else folder.parent for folder in folders]
    home = homes[0] if len(homes) == 1 else Path(os.path.commonpath([path.resolve() for path in homes]))
    return figure, home / "learning.png"


def _workspace(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.cell import build_cell
    from marl_handover.report.workspace import workspace_figure

    return workspace_figure(build_cell(config.cell or CellConfig())), Path("runs/workspace/workspace.png")


def _plan(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.cell import load_cell
    from marl_handover.report.plan import check_plan, plan_figure

    path, plan = _json(config, "plan")
    check_plan(plan, path)
    settings = config.cell if config.cell is not None else _stored_cell(plan, path)
    return plan_figure(plan, load_cell(settings)), path.with_suffix(".png")


def _stored_cell(plan: dict[str, Any], path: Path) -> CellConfig:
    from marl_handover.compose import from_text

    if not isinstance(plan.get("cell_settings"), dict):
        raise CorruptFile("plan", path, "it lacks 'cell_settings'; name the cell: cell=paper")
    settings: CellConfig = from_text(CellConfig, json.dumps(plan["cell_settings"]), path)
    return settings


def _evaluation(config: PlotConfig) -> tuple[Figure, Path]:
    from marl_handover.report.evaluation import check_evaluation, evaluation_figure

    path, result = _json(config, "evaluation")
    check_evaluation(result, path)
    counts = _transfers(config, result) if config.trace else (None, None)
    return evaluation_figure(result, *counts), path.with_suffix(".png")


def _transfers(config: PlotConfig, result: dict[str, Any]) -> tuple[Any, Any]:
    """Transfers and optimal transfers of each successful episode of the trace, int (n,)."""
    from marl_handover.cell import load_cell
    from marl_handover.config import TaskConfig
    from marl_handover.report.evaluation import read_trace
    from marl_handover.task.planner import ExactPlanner
    from marl_handover.task.rules import Rules

    played = read_trace(Path(config.trace))
    if len(played.transfers) != result["outcomes"]["success"]:
        raise InvalidSetting(
            "trace",
            config.trace,
            f"of the same evaluation; it has {len(played.transfers)} successes, the json file {result['outcomes']['success']}",
        )
    cell = load_cell(config.cell or CellConfig())
    if not (cell.reaches(played.start).any(-1) & cell.reaches(played.goal).any(-1)).all():
        raise InvalidSetting("cell", cell.config.name, "the cell of the trace; some of its episodes are out of this one's reach")
    planner = ExactPlanner(Rules(cell, TaskConfig(epsilon_deg=float(result["epsilon_deg"]), symmetry_order=config.symmetry_order)))
    return played.transfers, planner.plan(played.start, played.goal).transfers


def _json(config: PlotConfig, what: str) -> tuple[Path, dict[str, Any]]:
    from marl_handover.report.files import read_json

    if not config.json:
        command = {"plan": "plan", "evaluation": "evaluate"}[what]
        raise InvalidSetting("json", config.json, f"the file that `marl-handover {command} json=FILE` wrote")
    path = Path(config.json)
    return path, read_json(path, what)
