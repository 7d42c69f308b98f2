"""``marl-handover workspace``: what the arms of a cell reach, as numbers and a picture."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from marl_handover.cell import Cell, CellModel, PaperChart, build_cell
from marl_handover.cell.reach import bound_by
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
    """What ``workspace.json`` holds: mm and rad. What is said of the cell as a whole is None where its arms differ in it."""
    cell, masks = model.cell, model.grid.masks
    arms = [_arm(model, index) for index in range(cell.num_arms)]
    points = {label: int(mask.sum()) for label, mask in zip(cell.labels, masks, strict=True)}
    common = ("r_min_mm", "r_max_mm", "yaw_range_rad", "pick_height_mm", "bound_by", "ignored_pairs", "fit")
    return {
        "cell": cell.config.name,
        **{key: arms[0][key] if all(arm[key] == arms[0][key] for arm in arms) else None for key in common},
        **_shared(cell),
        "bases": {label: [base.x_mm, base.y_mm] for label, base in zip(cell.labels, cell.bases, strict=True)},
        "arms": arms,
        "obstacles": [asdict(obstacle) for obstacle in cell.config.obstacles],
        "grid_mm": cell.config.grid_mm,
        "grid_points": {**points, "both": int((masks.sum(0) > 1).sum())},
    }


def _arm(model: CellModel, index: int) -> dict[str, Any]:
    arm, fit, cell = model.cell.arms[index], model.fits[index], model.cell.config
    ends = {"r_min": (arm.r_min_mm, -cell.grid_mm), "r_max": (arm.r_max_mm, cell.grid_mm)}
    return {
        "name": arm.name,
        "robot": arm.robot,
        "x_mm": arm.base.x_mm,
        "y_mm": arm.base.y_mm,
        "facing_rad": arm.base.facing_rad,
        "r_min_mm": arm.r_min_mm,
        "r_max_mm": arm.r_max_mm,
        "yaw_range_rad": list(arm.yaw_rad),
        "lateral_mm": arm.lateral_mm,
        "pick_height_mm": arm.pick_height_mm,
        "bound_by": {end: _bound(model, index, *at, f"{end}_mm") for end, at in ends.items()},
        "ignored_pairs": [list(pair) for pair in model.arms[index].description.ignored],
        "fit": {"false_inside_rate": fit.false_inside_rate, "missed_rate": fit.missed_rate},
    }


def _bound(model: CellModel, index: int, radius_mm: float, beyond_mm: float, key: str) -> str:
    """What an arm's ring ends at: a setting of the cell, or whatever keeps the arm from going a step ``beyond_mm``."""
    cell = model.cell.config
    if radius_mm == getattr(cell, key):
        return f"cell.{key}"
    return bound_by(model.arms[index], radius_mm + beyond_mm, model.cell.pick_heights_mm[index], cell.block)


def _shared(cell: Cell) -> dict[str, Any]:
    """Who shares a place with whom; of a pair also how far apart it stands, its hand-over angles, and how long and wide a lens is."""
    summary: dict[str, Any] = {"shared": [[cell.names[i], cell.names[j]] for i, j in cell.graph.edges]}
    summary |= dict.fromkeys(("base_distance_mm", "hand_over_rad", "x_max_mm", "y_max_at_0_mm"))
    if cell.num_arms == 2:
        chart = cell.chart
        summary["base_distance_mm"] = cell.base_distance_mm
        if isinstance(chart, PaperChart):
            summary |= {"x_max_mm": chart.x_max_mm, "y_max_at_0_mm": float(chart.y_max_mm(np.float64(0.0)))}
        else:
            summary["hand_over_rad"] = [[arc.low_rad, arc.low_rad + arc.width_rad] for arc in chart.arcs]
    return {**summary, "chart_inset": cell.config.chart_inset}


def _text(summary: dict[str, Any]) -> str:
    points, arms = summary["grid_points"], summary["arms"]
    alike = all(summary[key] is not None for key in ("r_min_mm", "yaw_range_rad", "pick_height_mm", "bound_by", "ignored_pairs"))
    rows = [("cell", summary["cell"])]
    for arm in arms[:1] if alike else arms:
        rows += [] if alike else [("arm", f"{arm['name']}: {arm['robot']}")]
        rows += _arm_rows(arm)
    if summary["base_distance_mm"] is not None:
        rows.append(("base distance", f"{summary['base_distance_mm']:g} mm"))
    rows.append(("shared space", f"{_space(summary)}, chart inset {summary['chart_inset']:g}"))
    if summary["obstacles"]:
        rows.append(("obstacles", f"{len(summary['obstacles'])}, taken out of what the arms reach and share, not out of the grid"))
    rows.append(("grid points", ", ".join(f"{name} {count}" for name, count in points.items()) + f", every {summary['grid_mm']:g} mm"))
    return "\n".join(f"{name:<14} {value}" for name, value in rows)


def _arm_rows(arm: dict[str, Any]) -> list[tuple[str, str]]:
    (low, high), fit = (math.degrees(value) for value in arm["yaw_range_rad"]), arm["fit"]
    rows = [
        ("annulus", f"{arm['r_min_mm']:g} to {arm['r_max_mm']:g} mm"),
        ("ends at", f"{arm['bound_by']['r_min'] or 'the fit'} (inside), {arm['bound_by']['r_max'] or 'the fit'} (outside)"),
        ("base yaw", f"{low:.1f} to {high:.1f} deg"),
        ("pick height", f"{arm['pick_height_mm']:g} mm"),
        ("fit", f"{fit['false_inside_rate']:.2%} of the points inside out of reach, {fit['missed_rate']:.2%} missed"),
    ]
    if arm["lateral_mm"]:
        rows.append(("lateral", f"the grip is {arm['lateral_mm']:g} mm to the left of the arm's plane"))
    if arm["ignored_pairs"]:
        rows.append(("ignored pairs", "; ".join(" and ".join(pair) for pair in arm["ignored_pairs"]) + ", which touch in every posture"))
    return rows


def _space(summary: dict[str, Any]) -> str:
    if summary["x_max_mm"] is not None:
        return f"|x| <= {summary['x_max_mm']:.1f} mm, |y| <= {summary['y_max_at_0_mm']:.1f} mm at x = 0"
    if summary["hand_over_rad"] is not None:
        arcs = [f"{math.degrees(low):.1f} to {math.degrees(high):.1f}" for low, high in summary["hand_over_rad"]]
        return f"hand-over angles {' and '.join(arcs)} deg"
    return ", ".join(" and ".join(pair) for pair in summary["shared"]) or "none"
