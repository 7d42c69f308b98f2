"""Motions as ``plan … motion=FILE`` writes them, and the clearances along them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.build import CellModel
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.config import MotionConfig
from marl_handover.errors import WorkFailed
from marl_handover.geometry.capsules import Capsule, capsule_pairs, ground_clearance_mm, segment_distance
from marl_handover.geometry.se3 import apply
from marl_handover.motion.collision_model import block_capsules
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import LOADED_PHASES, TransferMotion

Floats = NDArray[np.float64]


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
    parked, motions = planner.home_rad, []
    for number, (arm, start, end) in enumerate(transfers, start=1):
        try:
            motions.append(planner.pick_place(arm, start, end, parked, parked))
        except WorkFailed as failure:
            raise NoMotion(number, ARM_LETTERS[arm], str(failure)) from failure
    return motions


def motion_row(motion: TransferMotion) -> dict[str, Any]:
    """One entry of ``transfers`` in the motion file: mm, rad, s; ``min_clearance_mm`` is the moving arm's to the other one."""
    phases = [{"name": p.name, "t_s": p.t_s.tolist(), "joints_rad": p.joints_rad.tolist()} for p in motion.phases]
    return {
        "arm": ARM_LETTERS[motion.arm],
        "from": motion.from_mm.tolist(),
        "to": motion.to_mm.tolist(),
        "phases": phases,
        "parked_other_rad": motion.other_joints_rad.tolist(),
        "path_length_mm": motion.path_length_mm,
        "min_clearance_mm": motion.min_clearance_mm,
        "planning_ms": motion.planning_ms,
    }


def grip_mm(model: CellModel, arm: int, joints_rad: Floats) -> Floats:
    """World position (..., 3) of an arm's grip."""
    return model.cell.bases[arm].to_world(model.arm.grip_mm(joints_rad))


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
        to_table.append(ground_clearance_mm(model.arm, phase.joints_rad))
    return np.concatenate(to_arm), np.concatenate(to_table)


_Shapes = Sequence[tuple[Floats, Floats, float]]
"""Capsules in the world: start (..., 3), end (..., 3), radius, all in mm."""


def _capsules(model: CellModel, settings: MotionConfig, arm: int, joints_rad: Floats, holding: bool) -> _Shapes:
    frames = model.arm.link_transforms(joints_rad, settings.finger_travel_mm)
    pieces: list[tuple[Floats, Capsule]] = [(frames[capsule.link], capsule) for capsule in capsule_pairs(model.arm.description)[0]]
    if holding:
        config = model.cell.config
        pieces += [(model.arm.fk(joints_rad), capsule) for capsule in block_capsules(config.block, config.pick_height_mm)]
    world = model.cell.bases[arm].to_world
    return [(world(apply(T, c.start_mm)), world(apply(T, c.end_mm)), c.radius_mm) for T, c in pieces]


def _least_gap(own: _Shapes, other: _Shapes) -> Floats:
    gaps = [segment_distance(a, b, c, d) - (r + s) for a, b, r in own for c, d, s in other]
    return np.min(gaps, axis=0)
