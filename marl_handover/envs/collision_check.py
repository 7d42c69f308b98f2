"""Whether a commanded cycle touches anything: for kinematic arms, which would go through the table. Imports the compiled planner."""

from __future__ import annotations

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell import CellModel
from marl_handover.config import MotionConfig
from marl_handover.envs.cycle_check import CycleCheck
from marl_handover.motion.executor import ROLL_RAD
from marl_handover.motion.path_optimizer import DENSE_SAMPLES, Segment
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import PickPlacePaths, sampled_basis

SHORT_MM = 0.05
"""How far a path may fall short of a clearance: planned ones keep it exactly, but commands are float32, 1e-7 rad off, and paths are joined
where the cycle check lets them be 1e-4 rad apart, which is 0.03 mm at the end of an outstretched arm."""


class CollisionFinder:
    """Says whether a cycle of an arm comes nearer to anything than the clearances of ``motion``.

    It looks at the table, the other arm where it stands, the arm itself, the standing block while the hand is empty, and the lower edges
    of the block that is carried; at the samples that planned paths are checked at. The lift-over height is no matter of touching. A block
    that would be pushed into the table touches it, be it by less than the cycle check's millimetre. The shapes are those of a hand that
    does not roll; a path that rolls more than :data:`ROLL_RAD` is taken for one that touches.

    Args:
        model: the cell.
        motion: clearances and the splines' degree.

    Raises:
        InvalidSetting: for a setting under which nothing can be planned.
    """

    def __init__(self, model: CellModel, motion: MotionConfig) -> None:
        self._cell, self._check = model.cell, CycleCheck(model, motion)
        self._planner = MotionPlanner(model, motion)
        self._planner.warm_up()
        self._dense = np.array(sampled_basis(DENSE_SAMPLES, motion.control_points, motion.degree))

    def __call__(self, arm: int, paths: PickPlacePaths, joints_rad: Floats) -> bool:
        """Whether the cycle ``paths`` of ``arm`` touches anything, all arms being at ``joints_rad`` (num_arms, 5) before it."""
        if max(float(abs(points[:, 4]).max()) for points in paths) > ROLL_RAD:
            return True
        planner, other, parked = self._planner, np.delete(joints_rad, arm, 0), self._planner.homes_rad[arm]
        pick_mm, place_mm = (self._within_reach(arm, paths.transfer[end]) for end in (0, -1))
        segments = (
            planner.reaching(arm, parked, pick_mm, other, leaving=False)[0],
            planner.carrying(arm, pick_mm, place_mm, other)[0],
            planner.reaching(arm, parked, place_mm, other, leaving=True)[0],
        )
        return any(self._short_mm(segment, points) > SHORT_MM for segment, points in zip(segments, paths, strict=True))

    def _short_mm(self, segment: Segment, points: Floats) -> float:
        """By how much the spline falls short of what is demanded, the lift-over left out."""
        margins, _ = segment.check(self._dense @ points[:, :4])
        return -min(margins._replace(lift=np.inf))

    def _within_reach(self, arm: int, joints_rad: Floats) -> Floats:
        """Where the grip is (2,); at the edge of the annulus, if that is as far outside as the cycle check lets pass."""
        centre = self._cell.bases[arm].position_mm
        gap = self._check.grip_mm(arm, joints_rad)[:2] - centre
        radius = float(np.hypot(*gap))
        ring = self._cell.arms[arm]
        return np.asarray(centre + gap / radius * min(max(radius, ring.r_min_mm), ring.r_max_mm))
