"""Motions as ``plan … motion=FILE`` writes them, their clearances, and the motion figure.

The figure has the grip's paths from above and from the side, and joints and clearances over time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.config import MotionConfig
from marl_handover.errors import CorruptFile, InvalidSetting, WorkFailed
from marl_handover.geometry.capsules import Capsule, block_capsules, capsule_pairs, ground_clearance_mm, segment_distance
from marl_handover.geometry.se3 import apply
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import LOADED_PHASES, PHASES, Phase, PickPlacePaths, TransferMotion
from marl_handover.report.arm_labels import stored_labels
from marl_handover.report.figure_style import BLUE, FAINT, GREY, INK, PAPER, RED, YELLOW, arm_colour, ruled
from marl_handover.report.table import Axes, draw_bases, draw_sectors, frame_table

JOINT_STYLES: tuple[tuple[str, Any], ...] = ((BLUE, "-"), (RED, (0, (6, 1.5))), (YELLOW, "-."), (INK, "--"), (GREY, ":"))
"""Colour and line of each joint: told apart without colours too."""

SHOWN_MM = 150.0
"""Clearances above this are not told apart."""

_FIT_MM, _LABEL_MM = 2.0, 30.0


def read_motions(content: Mapping[str, Any], path: Path) -> list[TransferMotion]:
    """The motions that ``plan motion=FILE`` wrote to ``path``; control points and fingers, which the file does not hold, are empty.

    Raises:
        CorruptFile: for anything else.
    """
    try:
        labels = stored_labels(content)
        motions = [_motion(row, labels) for row in content["transfers"]]
    except KeyError as error:
        raise CorruptFile("motion", path, f"it lacks {error.args[0]!r}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise CorruptFile("motion", path, str(error)) from error
    if not motions:
        raise CorruptFile("motion", path, "it has no transfers")
    return motions


def require_fit(motions: Sequence[TransferMotion], model: CellModel) -> None:
    """Raise :class:`InvalidSetting` unless the hand is at the block where the motions take it: they are of another cell."""
    for motion in motions:
        taken = next(phase.joints_rad[0] for phase in motion.phases if phase.name in LOADED_PHASES)
        if np.linalg.norm(grip_mm(model, motion.arm, taken)[:2] - motion.from_mm) > _FIT_MM:
            raise InvalidSetting("cell", model.cell.config.name, "the cell of the motions; this one's arms would miss the block with them")


def _motion(row: Mapping[str, Any], labels: Sequence[str]) -> TransferMotion:
    arm = labels.index(row["arm"])
    phases = tuple(_phase(part) for part in row["phases"])
    if not any(phase.name in LOADED_PHASES for phase in phases):
        raise ValueError("a transfer has no phase in which the block is carried")
    none = np.empty((0, 5))
    if len(labels) == 2:
        other = _numbers(row["parked_other_rad"], 5)
    else:
        other = _numbers([row["other_arms_rad"][label] for label in _others(labels, arm)], len(labels) - 1, 5)
    return TransferMotion(
        arm=arm,
        from_mm=_numbers(row["from"], 2),
        to_mm=_numbers(row["to"], 2),
        paths=PickPlacePaths(none, none, none),
        phases=phases,
        other_joints_rad=other,
        path_length_mm=float(row["path_length_mm"]),
        min_clearance_mm=float(row["min_clearance_mm"]),
        planning_ms=float(row["planning_ms"]),
    )


def _phase(part: Mapping[str, Any]) -> Phase:
    name, t_s = str(part["name"]), np.asarray(part["t_s"], float)
    if name not in PHASES or t_s.ndim != 1 or not len(t_s):
        raise ValueError(f"{name!r} is no phase of a motion")
    return Phase(name, t_s, _numbers(part["joints_rad"], len(t_s), 5), np.empty(0))


def _numbers(values: Any, *shape: int) -> Floats:
    array = np.asarray(values, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{' x '.join(map(str, shape))} finite numbers were expected")
    return array


def motion_figure(motions: Sequence[TransferMotion], model: CellModel, settings: MotionConfig) -> Figure:
    """A figure of transfers that follow each other; ``settings`` are the planner's.

    Carried paths are drawn strong, those of the empty hand thin. Times run on over the transfers.
    """
    figure = Figure(figsize=(11.5, 8.2), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.35), height_ratios=(1.0, 1.0, 1.0))
    side = figure.add_subplot(grid[2, 0])
    above = figure.add_subplot(grid[:2, 0])
    joints = figure.add_subplot(grid[:2, 1])
    clearance = figure.add_subplot(grid[2, 1], sharex=joints)
    _draw_above(above, motions, model)
    _draw_side(side, motions, model)
    _draw_joints(joints, motions, model.cell.labels)
    _draw_clearance(clearance, motions, model, settings)
    total = sum(motion.duration_s for motion in motions)
    path = sum(motion.path_length_mm for motion in motions)
    count = f"{len(motions)} transfer{'' if len(motions) == 1 else 's'}"
    figure.suptitle(f"{count}, {total:.1f} s, {path:.0f} mm of carried path", fontsize=11)
    return figure


def _pieces(motion: TransferMotion, model: CellModel) -> list[tuple[bool, Floats]]:
    """The grip's path (n, 3) in each phase, and whether the block is carried in it."""
    return [(phase.name in LOADED_PHASES, grip_mm(model, motion.arm, phase.joints_rad)) for phase in motion.phases]


def _draw_above(axes: Axes, motions: Sequence[TransferMotion], model: CellModel) -> None:
    draw_sectors(axes, model.cell, strength=0.05, width=0.5)
    for motion in motions:
        _draw_path(axes, motion, model, (0, 1))
        axes.plot(*motion.from_mm, "o", color=arm_colour(motion.arm), markerfacecolor="none", markersize=7, zorder=8)
        axes.plot(*motion.to_mm, "o", color=arm_colour(motion.arm), markersize=5, zorder=8)
    for place, at in _numbered(motions):
        label = axes.annotate(", ".join(at), place, xytext=(6, 6), textcoords="offset points", fontsize=9, zorder=13)
        label.set_path_effects([withStroke(linewidth=2.5, foreground=PAPER)])
    draw_bases(axes, model.cell, size=12)
    frame_table(axes, model.cell)
    axes.set_title("the grip's path from above", fontsize=9, pad=20)
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    handles = [
        Line2D([], [], color=INK, linewidth=2.0, label="carrying"),
        Line2D([], [], color=INK, linewidth=0.8, linestyle="--", label="empty hand"),
        Line2D([], [], color=INK, marker="o", markerfacecolor="none", linestyle="none", label="pick"),
        Line2D([], [], color=INK, marker="o", linestyle="none", label="place"),
    ]
    style: dict[str, Any] = {"fontsize": 8, "frameon": False, "columnspacing": 1.0, "handletextpad": 0.4}
    axes.legend(handles=handles, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), **style)


def _numbered(motions: Sequence[TransferMotion]) -> list[tuple[Floats, list[str]]]:
    """Places (2,) and the numbers of the transfers that go there; places too near for labels of their own share one."""
    found: list[tuple[Floats, list[str]]] = []
    for number, motion in enumerate(motions, start=1):
        near = next((at for place, at in found if np.linalg.norm(place - motion.to_mm) < _LABEL_MM), None)
        if near is None:
            found.append((motion.to_mm, [str(number)]))
        else:
            near.append(str(number))
    return found


def _draw_side(axes: Axes, motions: Sequence[TransferMotion], model: CellModel) -> None:
    axes.axhline(0.0, color=INK, linewidth=1.2)
    height = min(model.cell.pick_heights_mm)
    axes.axhline(height, color=GREY, linewidth=0.7, linestyle=":")
    axes.annotate("pick height", (1.0, height), xycoords=("axes fraction", "data"), xytext=(-3, 3), textcoords="offset points", fontsize=8,
                  color=GREY, ha="right")  # fmt: skip
    for motion in motions:
        _draw_path(axes, motion, model, (1, 2))
    axes.set_aspect("equal")
    axes.set_ylim(bottom=-10)
    axes.set_title("and from the side, along x", fontsize=9)
    axes.set_xlabel("y [mm]")
    axes.set_ylabel("z [mm]")
    ruled(axes)


def _draw_path(axes: Axes, motion: TransferMotion, model: CellModel, plane: tuple[int, int]) -> None:
    for carrying, path in _pieces(motion, model):
        style: dict[str, Any] = {"linewidth": 2.0, "zorder": 7} if carrying else {"linewidth": 0.8, "linestyle": "--", "zorder": 6}
        axes.plot(path[:, plane[0]], path[:, plane[1]], color=arm_colour(motion.arm), **style)


def _starts(motions: Sequence[TransferMotion]) -> Floats:
    """When each transfer begins, (n + 1,), the end of the last included: one follows the other."""
    return np.concatenate([[0.0], np.cumsum([motion.duration_s for motion in motions])])


def _draw_joints(axes: Axes, motions: Sequence[TransferMotion], labels: Sequence[str]) -> None:
    starts = _starts(motions)
    for motion, begin_s in zip(motions, starts, strict=False):
        t_s = begin_s + np.concatenate([phase.t_s for phase in motion.phases]) - motion.phases[0].t_s[0]
        degrees = np.degrees(np.concatenate([phase.joints_rad for phase in motion.phases]))
        for joint, (colour, line) in enumerate(JOINT_STYLES):
            axes.plot(t_s, degrees[:, joint], color=colour, linestyle=line, linewidth=1.3)
    _shade(axes, motions, starts, labels)
    handles = [
        Line2D([], [], color=colour, linestyle=line, label=name.replace("_", " "))
        for name, (colour, line) in zip(ARM_JOINTS, JOINT_STYLES, strict=True)
    ]
    axes.legend(handles=handles, fontsize=8, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.03), frameon=False, columnspacing=1.2)
    axes.set_ylabel("joint of the moving arm [deg]")
    ruled(axes)


def _draw_clearance(axes: Axes, motions: Sequence[TransferMotion], model: CellModel, settings: MotionConfig) -> None:
    starts = _starts(motions)
    for motion, begin_s in zip(motions, starts, strict=False):
        t_s = begin_s + np.concatenate([phase.t_s for phase in motion.phases]) - motion.phases[0].t_s[0]
        to_arm, to_table = clearances_mm(model, settings, motion)
        axes.plot(t_s, np.minimum(to_arm, SHOWN_MM), color=BLUE, linewidth=1.3)
        axes.plot(t_s, np.minimum(to_table, SHOWN_MM), color=RED, linewidth=1.3, linestyle="--")
    for demanded, colour in ((settings.arm_clearance_mm, BLUE), (settings.ground_clearance_mm, RED)):
        axes.axhline(demanded, color=colour, linewidth=0.7, linestyle=":")
    _shade(axes, motions, starts)
    handles = [
        Line2D([], [], color=BLUE, label=f"to {'the other arm' if model.cell.num_arms == 2 else 'other arms'}, block included"),
        Line2D([], [], color=RED, linestyle="--", label="arm to the table"),
        Line2D([], [], color=GREY, linestyle=":", label="demanded"),
    ]
    axes.legend(handles=handles, fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, columnspacing=1.2)
    axes.set_ylim(0.0, SHOWN_MM * 1.03)
    axes.set_ylabel(f"clearance, up to {SHOWN_MM:.0f} [mm]")
    axes.set_xlabel("t [s]")
    ruled(axes)


def _shade(axes: Axes, motions: Sequence[TransferMotion], starts: Floats, labels: Sequence[str] = ()) -> None:
    """A band where the block is carried, in the arm's colour, and a line between transfers, with the arms' ``labels``, if given."""
    for number, (motion, begin_s) in enumerate(zip(motions, starts, strict=False), start=1):
        carried = [phase for phase in motion.phases if phase.name in LOADED_PHASES]
        zero = motion.phases[0].t_s[0]
        axes.axvspan(begin_s + carried[0].t_s[0] - zero, begin_s + carried[-1].t_s[-1] - zero, color=arm_colour(motion.arm), alpha=0.08)
        axes.axvline(begin_s + motion.duration_s, color=FAINT, linewidth=0.8)
        if labels:
            axes.annotate(
                f"{number}: {labels[motion.arm]}", (begin_s + motion.duration_s / 2, 1.0), xycoords=("data", "axes fraction"),
                xytext=(0, 2), textcoords="offset points", fontsize=8, ha="center", color=arm_colour(motion.arm),
            )  # fmt: skip
    axes.set_xlim(0.0, starts[-1])


class NoMotion(WorkFailed):
    """A transfer of a sequence has no collision-free motion."""

    def __init__(self, number: int, arm: str, reason: str) -> None:
        self.number, self.arm, self.reason = number, arm, reason
        super().__init__(f"transfer {number}, arm {arm}, has no motion: {reason}")


def plan_motions(planner: MotionPlanner, transfers: Iterable[tuple[int, Floats, Floats]]) -> list[TransferMotion]:
    """The cycles of transfers (arm, from_mm (2,), to_mm (2,)), one after the other, each from and to the parked pose.

    Raises:
        NoMotion: if one of them is not possible.
    """
    motions = []
    for number, (arm, start, end) in enumerate(transfers, start=1):
        try:
            others = planner.others_home_rad(arm)
            motions.append(planner.pick_place(arm, start, end, planner.homes_rad[arm], others[0] if len(others) == 1 else others))
        except WorkFailed as failure:
            raise NoMotion(number, planner.model.cell.labels[arm], str(failure)) from failure
    return motions


def motion_row(motion: TransferMotion, labels: Sequence[str] = ARM_LETTERS) -> dict[str, Any]:
    """One entry of ``transfers`` in the motion file: mm, rad, s; ``min_clearance_mm`` is the moving arm's to the other ones.

    Where the other arms hold still is ``parked_other_rad`` (5,) of a pair, else ``other_arms_rad``, (5,) of each by its label.
    """
    phases = [{"name": p.name, "t_s": p.t_s.tolist(), "joints_rad": p.joints_rad.tolist()} for p in motion.phases]
    still = motion.other_joints_rad.tolist()
    return {
        "arm": labels[motion.arm],
        "from": motion.from_mm.tolist(),
        "to": motion.to_mm.tolist(),
        "phases": phases,
        **(
            {"parked_other_rad": still}
            if len(labels) == 2
            else {"other_arms_rad": dict(zip(_others(labels, motion.arm), still, strict=True))}
        ),
        "path_length_mm": motion.path_length_mm,
        "min_clearance_mm": motion.min_clearance_mm,
        "planning_ms": motion.planning_ms,
    }


def _others(labels: Sequence[str], arm: int) -> list[str]:
    return [label for index, label in enumerate(labels) if index != arm]


def grip_mm(model: CellModel, arm: int, joints_rad: Floats) -> Floats:
    """World position (..., 3) of an arm's grip."""
    return model.cell.bases[arm].to_world(model.arms[arm].grip_mm(joints_rad))


def clearances_mm(model: CellModel, settings: MotionConfig, motion: TransferMotion) -> tuple[Floats, Floats]:
    """Distance (n,) of the moving arm, with the block while it holds it, to the other arm; and (n,) of the bare arm to the table.

    Over all samples, phase by phase. Fingers count as open.
    """
    standing = zip(np.delete(np.arange(model.cell.num_arms), motion.arm), np.atleast_2d(motion.other_joints_rad), strict=True)
    other = [shape for arm, joints_rad in standing for shape in _capsules(model, settings, int(arm), joints_rad, False)]
    to_arm, to_table = [], []
    for phase in motion.phases:
        own = _capsules(model, settings, motion.arm, phase.joints_rad, phase.name in LOADED_PHASES)
        to_arm.append(_least_gap(own, other))
        to_table.append(ground_clearance_mm(model.arms[motion.arm], phase.joints_rad))
    return np.concatenate(to_arm), np.concatenate(to_table)


_Shapes = Sequence[tuple[Floats, Floats, float]]
"""Capsules in the world: start (..., 3), end (..., 3), radius, all in mm."""


def _capsules(model: CellModel, settings: MotionConfig, arm: int, joints_rad: Floats, holding: bool) -> _Shapes:
    kinematics = model.arms[arm]
    frames = kinematics.link_transforms(joints_rad, settings.finger_travel_mm)
    pieces: list[tuple[Floats, Capsule]] = [(frames[capsule.link], capsule) for capsule in capsule_pairs(kinematics.description)[0]]
    if holding:
        config = model.cell.config
        pieces += [(kinematics.fk(joints_rad), capsule) for capsule in block_capsules(config.block, model.cell.pick_heights_mm[arm])]
    world = model.cell.bases[arm].to_world
    return [(world(apply(T, c.start_mm)), world(apply(T, c.end_mm)), c.radius_mm) for T, c in pieces]


def _least_gap(own: _Shapes, other: _Shapes) -> Floats:
    gaps = [segment_distance(a, b, c, d) - (r + s) for a, b, r in own for c, d, s in other]
    return np.min(gaps, axis=0)
