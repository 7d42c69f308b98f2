"""Where on the table each arm can pick and place: a grid computed from the URDF, and the annulus that is fitted to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import wrap
from marl_handover.cell.arm import lateral_rad
from marl_handover.config import BlockConfig, CellConfig, MotionConfig, RobotConfig, check_bounds, require_at_least
from marl_handover.errors import InvalidSetting, UrdfError
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.capsules import block_capsules, grasp_margins_mm
from marl_handover.geometry.closed_form import Bools, Floats
from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.urdf import ARM_JOINTS

LENGTH_TOLERANCE_MM = 1e-6
MOST_POINTS = 10**6
"""Of a grid; the paper cell has 39 thousand."""
ANGLE_TOLERANCE_RAD = 1e-9


@dataclass(frozen=True, eq=False)
class ManipulationGrid:
    """World points on the table and who can reach them.

    ``x_mm`` (nx,) and ``y_mm`` (ny,) are multiples of the grid step; ``masks`` (num_arms, nx, ny) is True where that arm can pick and
    place, its grip ``pick_heights_mm`` (num_arms) over it. All arrays are read-only.
    """

    x_mm: Floats
    y_mm: Floats
    masks: Bools
    bases: tuple[SE2, ...]
    pick_heights_mm: tuple[float, ...]

    def points_base_mm(self, arm_index: int) -> Floats:
        """The grid points (nx, ny, 2) in the base frame of one arm."""
        return self.bases[arm_index].to_local(np.stack(np.meshgrid(self.x_mm, self.y_mm, indexing="ij"), axis=-1))


@dataclass(frozen=True)
class AnnulusFit:
    """The sector of an annulus that stands for an arm's manipulation space.

    Yaw is about the arm's facing. ``false_inside_rate`` is the share of the grid points inside the fit that the arm cannot reach,
    ``missed_rate`` the share of the points it can reach that lie outside.
    """

    r_min_mm: float
    r_max_mm: float
    yaw_lower_rad: float
    yaw_upper_rad: float
    false_inside_rate: float
    missed_rate: float


def grasps(arm: ArmModel, points_base_mm: ArrayLike, pick_height_mm: float) -> tuple[Floats, Bools]:
    """Joint vectors (..., 5) that hold the pin at table points (..., 2) of the base frame with pitch = roll = 0, and where there are some.

    The one that motions take: elbow up where both branches are within the joint limits.
    """
    points = np.asarray(points_base_mm, dtype=float)
    q = arm.ik(np.concatenate([points, np.full((*points.shape[:-1], 1), float(pick_height_mm))], axis=-1))
    good = arm.within_limits(q)
    chosen = np.take_along_axis(q, good.argmax(axis=-1)[..., None, None], axis=-2)[..., 0, :]
    return chosen, np.asarray(good.any(axis=-1))


def feasible(arm: ArmModel, points_base_mm: ArrayLike, pick_height_mm: float, block: BlockConfig | None = None) -> Bools:
    """Whether the arm can hold the pin of ``block`` at table points (..., 2) of its base frame with pitch = roll = 0; shape (...).

    That is so if the joints are within their limits, and the links, with the block in the hand, keep the clearances that motion planning
    demands by default, from each other and from the table.
    """
    q, good = grasps(arm, points_base_mm, pick_height_mm)
    # Collision is the dear part: only what passed the limits is looked at.
    margins = grasp_margins_mm(arm, q[good], MotionConfig(), block_capsules(block or BlockConfig(), pick_height_mm))
    good[good] = np.min([np.full(int(good.sum()), np.inf), *margins.values()], axis=0) >= 0
    return good


def bound_by(arm: ArmModel, radius_mm: float, pick_height_mm: float, block: BlockConfig) -> str:
    """What keeps the arm from picking and placing ``radius_mm`` from its base at all yaws: joints, two links, a link and the table.

    Empty where nothing does.
    """
    yaws = np.linspace(arm.lower_rad[0], arm.upper_rad[0], 73)[1:-1]
    points = radius_mm * np.stack([np.cos(yaws), np.sin(yaws)], axis=-1)
    q, good = grasps(arm, points, pick_height_mm)
    if not good.all():
        branches = arm.ik([*points[~good][0], pick_height_mm])
        if np.isnan(branches).any():
            return "the length of the arm"
        over = np.maximum(branches - arm.upper_rad, arm.lower_rad - branches)
        nearest = over[over.max(axis=-1).argmin()]
        return f"the limits of {ARM_JOINTS[int(nearest.argmax())]}"
    margins = grasp_margins_mm(arm, q, MotionConfig(), block_capsules(block, pick_height_mm))
    pair = min(margins, key=lambda pair: float(margins[pair].min()), default=None)
    return f"{pair[0]} and {pair[1]}" if pair and margins[pair].min() < 0 else ""


def require_grasps(arm: ArmModel, pick_height_mm: float, block: BlockConfig) -> None:
    """Raise :class:`UrdfError`, which names two bodies, if the joints could take the grip to the table but shapes are always in the way.

    Where the held block is one of them, :class:`InvalidSetting` on its size.
    """
    points = np.stack([np.arange(1.0, arm.reach_mm), np.zeros(int(arm.reach_mm - 1e-9))], axis=-1)
    q, good = grasps(arm, points, pick_height_mm)
    margins = grasp_margins_mm(arm, q[good], MotionConfig(), block_capsules(block, pick_height_mm))
    if not good.any() or not margins:
        return
    (one, other), _ = max(margins.items(), key=lambda item: float(np.mean(item[1] < 0)))
    where = f"in every posture that holds the pin at pick_height_mm = {pick_height_mm:g}"
    if "block" in (one, other):
        limit = f"so small that {one!r} and {other!r} do not touch {where}"
        raise InvalidSetting("cell.block.side_mm", block.side_mm, limit)
    what = f"{one!r} and {other!r} are too near to each other {where}; mend their shapes, or set shapes=links"
    raise UrdfError(arm.description.path, what)


def manipulation_grid(
    arms: Sequence[ArmModel], cell: CellConfig, bases: Sequence[SE2], pick_heights_mm: Sequence[float] | None = None
) -> ManipulationGrid:
    """The grid of world points that covers the reach of ``arms``, each standing on its base.

    ``pick_heights_mm`` (num_arms); None: the cell's, or what robots usually have.

    Raises :class:`InvalidSetting` if ``grid_mm`` is not above 0 or ``pick_height_mm`` is not a finite number of at least 0.
    """
    check_bounds(cell)
    _require_moderate(arms, cell, bases)
    axes: list[Floats] = []
    for axis in range(2):
        low = math.floor(min(base.position_mm[axis] - arm.reach_mm for arm, base in zip(arms, bases, strict=True)) / cell.grid_mm)
        high = math.ceil(max(base.position_mm[axis] + arm.reach_mm for arm, base in zip(arms, bases, strict=True)) / cell.grid_mm)
        axes.append(cell.grid_mm * np.arange(low, high + 1, dtype=np.float64))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    usual = RobotConfig.pick_height_mm if cell.pick_height_mm is None else cell.pick_height_mm
    heights = tuple(float(height) for height in pick_heights_mm or [usual] * len(arms))
    masks = np.stack(
        [feasible(arm, base.to_local(points), height, cell.block) for arm, base, height in zip(arms, bases, heights, strict=True)]
    )
    for array in (*axes, masks):
        array.setflags(write=False)
    return ManipulationGrid(axes[0], axes[1], masks, tuple(bases), heights)


def _require_moderate(arms: Sequence[ArmModel], cell: CellConfig, bases: Sequence[SE2]) -> None:
    """Raise for a grid of more than :data:`MOST_POINTS` points."""
    farthest_mm = max(arm.reach_mm for arm in arms)
    sides_mm = np.ptp(np.array([base.position_mm for base in bases]), axis=0) + 2 * farthest_mm
    least_mm = math.sqrt(sides_mm[0] * sides_mm[1] / MOST_POINTS)
    if cell.grid_mm < least_mm:
        limit = f"at least {least_mm:.3g} for these arms, which reach {farthest_mm:.4g} mm: the grid has at most {MOST_POINTS} points"
        raise InvalidSetting("grid_mm", cell.grid_mm, limit)


def fit_annulus(
    grid: ManipulationGrid,
    rounding_mm: float = 0.0,
    weight: float = 1000.0,
    arms: Sequence[int] | None = None,
    lateral_mm: float = 0.0,
    within_mm: tuple[float | None, float | None] = (None, None),
) -> AnnulusFit:
    """Fit one sector of an annulus to the points of ``arms`` (None: all) together, seen from their bases.

    The radii, then the yaws, are the contiguous run that maximises (reachable points - ``weight`` x unreachable points), in turn until
    nothing changes. Then the radii are rounded inwards to a multiple of ``rounding_mm`` (0: not at all), and kept ``within_mm``, beyond
    which no point counts. Yaws are those of the joint, of arms whose grip is ``lateral_mm`` to the left of their plane.

    Raises :class:`InvalidSetting` on ``pick_height_mm`` if no point can be reached, on ``fit_rounding_mm`` if rounding leaves nothing, and
    on ``r_min_mm`` or ``r_max_mm`` if nothing is within them.
    """
    require_at_least("fit_rounding_mm", rounding_mm, 0)
    chosen = list(range(len(grid.bases))) if arms is None else list(arms)
    points = np.concatenate([grid.points_base_mm(index).reshape(-1, 2) for index in chosen])
    good = grid.masks[chosen].reshape(-1)
    if not good.any():
        limit = "a height at which the arm, its gripper level, reaches part of the table; here it reaches no grid point"
        raise InvalidSetting("pick_height_mm", grid.pick_heights_mm[chosen[0]], limit)
    radius, yaw = np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])
    if lateral_mm:
        yaw = wrap(yaw - lateral_rad(lateral_mm, radius))
    score = np.where(good, 1.0, -weight)
    yaws = (float(yaw[good].min()), float(yaw[good].max()))
    radii: tuple[float, float] | None = None
    for _ in range(20):  # both steps only ever raise the score, so this ends long before
        inside = _between(yaw, yaws, ANGLE_TOLERANCE_RAD)
        new_radii = _best_run(radius[inside], score[inside], LENGTH_TOLERANCE_MM)
        inside = _between(radius, new_radii, LENGTH_TOLERANCE_MM)
        new_yaws = _best_run(yaw[inside], score[inside], ANGLE_TOLERANCE_RAD)
        if new_radii == radii and new_yaws == yaws:
            break
        radii, yaws = new_radii, new_yaws
    r_min, r_max = _kept_within(_rounded_inwards(new_radii, rounding_mm), within_mm)
    good &= _between(radius, (within_mm[0] or 0.0, within_mm[1] or math.inf), LENGTH_TOLERANCE_MM)
    inside = _between(radius, (r_min, r_max), LENGTH_TOLERANCE_MM) & _between(yaw, yaws, ANGLE_TOLERANCE_RAD)
    false_inside = float(np.mean(~good[inside])) if inside.any() else 0.0
    missed = float(np.mean(~inside[good])) if good.any() else 0.0
    return AnnulusFit(r_min, r_max, yaws[0], yaws[1], false_inside, missed)


def _kept_within(radii: tuple[float, float], within_mm: tuple[float | None, float | None]) -> tuple[float, float]:
    least, most = within_mm
    low, high = max(radii[0], least or 0.0), min(radii[1], most or math.inf)
    if low >= high:
        name, value = ("cell.r_max_mm", most) if most is not None and most <= radii[0] else ("cell.r_min_mm", least)
        raise InvalidSetting(name, value, f"so that some of {radii[0]:g} to {radii[1]:g} mm, where the arm reaches, is left")
    return low, high


def _between(values: Floats, interval: tuple[float, float], tolerance: float) -> Bools:
    return np.asarray((values >= interval[0] - tolerance) & (values <= interval[1] + tolerance))


def _best_run(values: Floats, score: Floats, tolerance: float) -> tuple[float, float]:
    """The interval between two of ``values`` (n,) whose points have the largest sum of ``score`` (n,); equal values stay together."""
    order = np.argsort(values)
    values, score = values[order], score[order]
    first = np.flatnonzero(np.concatenate([[True], np.diff(values) > tolerance]))
    last = np.concatenate([first[1:] - 1, [len(values) - 1]])
    total = np.concatenate([[0.0], np.cumsum(np.add.reduceat(score, first))])
    before = np.minimum.accumulate(total[:-1])
    end = int(np.argmax(total[1:] - before))
    start = int(np.argmin(total[: end + 1]))
    return float(values[first[start]]), float(values[last[end]])


def _rounded_inwards(radii: tuple[float, float], rounding_mm: float) -> tuple[float, float]:
    if rounding_mm == 0:
        return radii
    low = rounding_mm * math.ceil((radii[0] - LENGTH_TOLERANCE_MM) / rounding_mm)
    high = rounding_mm * math.floor((radii[1] + LENGTH_TOLERANCE_MM) / rounding_mm)
    if low >= high:
        raise InvalidSetting("fit_rounding_mm", rounding_mm, f"small against the annulus of {radii[0]:g} to {radii[1]:g} mm")
    return low, high
