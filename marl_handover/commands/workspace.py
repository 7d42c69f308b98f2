"""``marl-handover workspace``: what the arms of a cell reach, as numbers and a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from marl_handover.cell import CellModel, build_cell
from marl_handover.cell.reach import bound_by
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.config import CELL_ALIASES, CellConfig, path_field

FILE, PICTURE = "workspace.json", "workspace.png"


@dataclass
class WorkspaceConfig:
    """Keys of ``workspace``."""

    cell: CellConfig = field(default_factory=CellConfig)
    out: str = path_field("runs/workspace")  # folder of workspace.json and workspace.png


SCHEMA: type = WorkspaceConfig
ALIASES = CELL_ALIASES
GROUPS: dict[str, dict[str, type]] = {}


def run(config: WorkspaceConfig) -> int:
    """Compute the cell, write both files, print the summary."""
    from marl_handover.report.figure_style import save_figure, write_json
    from marl_handover.report.plan import workspace_figure

    model = build_cell(config.cell)
    summary = workspace_summary(model)
    out = Path(config.out)
    write_json(out / FILE, summary)
    save_figure(workspace_figure(model), out / PICTURE)
    print(_text(summary))
    print(f"written: {out / FILE}, {out / PICTURE}")
    return 0


def workspace_summary(model: CellModel) -> dict[str, Any]:
    """What ``workspace.json`` holds: mm and rad."""
    cell, fit, masks = model.cell, model.fit, model.grid.masks
    points = {letter: int(mask.sum()) for letter, mask in zip(ARM_LETTERS, masks, strict=True)}
    return {
        "cell": cell.config.name,
        "r_min_mm": fit.r_min_mm,
        "r_max_mm": fit.r_max_mm,
        "base_distance_mm": cell.config.base_distance_mm,
        "yaw_range_rad": [fit.yaw_lower_rad, fit.yaw_upper_rad],
        "x_max_mm": cell.paper_chart("the summary").x_max_mm,
        "y_max_at_0_mm": float(cell.paper_chart("the summary").y_max_mm(np.float64(0.0))),
        "chart_inset": cell.chart.inset,
        "pick_height_mm": cell.pick_height_mm,
        "bases": {letter: [base.x_mm, base.y_mm] for letter, base in zip(ARM_LETTERS, cell.bases, strict=True)},
        "grid_mm": cell.config.grid_mm,
        "grid_points": {**points, "both": int(masks.all(0).sum())},
        "bound_by": {
            "r_min": _bound(model, fit.r_min_mm, -cell.config.grid_mm, "r_min_mm"),
            "r_max": _bound(model, fit.r_max_mm, cell.config.grid_mm, "r_max_mm"),
        },
        "ignored_pairs": [list(pair) for pair in model.arm.description.ignored],
        "fit": {"false_inside_rate": fit.false_inside_rate, "missed_rate": fit.missed_rate},
    }


def _bound(model: CellModel, radius_mm: float, beyond_mm: float, key: str) -> str:
    """What the ring ends at: a setting of the cell, or whatever keeps the arm from going a step ``beyond_mm``."""
    if radius_mm == getattr(model.cell.config, key):
        return f"cell.{key}"
    return bound_by(model.arm, radius_mm + beyond_mm, model.cell.pick_height_mm, model.cell.config.block)


def _text(summary: dict[str, Any]) -> str:
    low, high = (math.degrees(value) for value in summary["yaw_range_rad"])
    points = summary["grid_points"]
    rows = {
        "cell": summary["cell"],
        "annulus": f"{summary['r_min_mm']:g} to {summary['r_max_mm']:g} mm",
        "ends at": f"{summary['bound_by']['r_min'] or 'the fit'} (inside), {summary['bound_by']['r_max'] or 'the fit'} (outside)",
        "base yaw": f"{low:.1f} to {high:.1f} deg",
        "base distance": f"{summary['base_distance_mm']:g} mm",
        "shared space": f"|x| <= {summary['x_max_mm']:.1f} mm, |y| <= {summary['y_max_at_0_mm']:.1f} mm at x = 0, "
        f"chart inset {summary['chart_inset']:g}",
        "pick height": f"{summary['pick_height_mm']:g} mm",
        "grid points": ", ".join(f"{name} {count}" for name, count in points.items()) + f", every {summary['grid_mm']:g} mm",
        "fit": f"{summary['fit']['false_inside_rate']:.2%} of the points inside out of reach, {summary['fit']['missed_rate']:.2%} missed",
    }
    if summary["ignored_pairs"]:
        rows["ignored pairs"] = "; ".join(" and ".join(pair) for pair in summary["ignored_pairs"]) + ", which touch in every posture"
    return "\n".join(f"{name:<14} {value}" for name, value in rows.items())
