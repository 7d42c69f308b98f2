"""The discretised shared space: a square grid of places on the table, and how far exact search gets on it.

Nothing here needs torch unless it is given tensors.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Array, Floats, namespace, wrap
from marl_handover.cell.chart import PaperChart
from marl_handover.cell.symmetry import LEFT, RIGHT
from marl_handover.errors import InvalidSetting
from marl_handover.task.observations import ARM_FIELDS, RAW_FIELDS
from marl_handover.task.rules import Rules

RESOLUTION_RAD = 1e-5
"""Turns that differ by less are the same to :func:`grid_transfers`."""


def grid_points(chart: PaperChart, grid_mm: float) -> Floats:
    """Places (p, 2) in mm of a square grid of that spacing around the middle of the table, as far as they lie in the chart.

    Raises:
        InvalidSetting: the grid holds no place but the middle, at which every hand-over turns the object by the same angle.
    """
    count = int(chart.x_max_mm // grid_mm)
    steps = np.arange(-count, count + 1) * grid_mm
    points = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
    x_mm, y_mm = abs(points).T
    inside = (x_mm <= chart.inset * chart.x_max_mm) & (y_mm <= chart.inset * chart.y_max_mm(x_mm))
    if inside.sum() < 2:
        raise InvalidSetting("algorithm.grid_mm", grid_mm, f"at most {chart.inset * chart.x_max_mm:.1f}, or the grid holds a single place")
    return points[inside]


def grid_actions(chart: PaperChart, points_mm: Floats, can_finish: bool) -> Floats:
    """Actions (n, 4) of the choices: arm by place, L first; then, if the policy says when to finish, one for each arm.

    Places outside the chart, if it became smaller since, are brought back to its edge.
    """
    alpha, beta = (np.clip(part, -1.0, 1.0) for part in chart.from_table(points_mm))
    one = np.ones_like(alpha)
    rows = [np.stack([-one, side * one, alpha, beta], -1) for side in (-1.0, 1.0)]
    finals = np.array([[1.0, -1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]])
    return np.concatenate([*rows, finals] if can_finish else rows)


def seen_by_finishers(rules: Rules, layout: str, observation: Array) -> Array:
    """What each of architecture A's two policies sees, (..., arms, size), of observations (..., size) of ``raw`` or ``relative``.

    Of ``raw``, the goal's x, y, theta give way to where the arm that is to finish has it: distance, base yaw, and its orientation in the
    gripper. Of ``relative``, that arm's block comes first.
    """
    xp = namespace(observation)
    if layout == "relative":
        blocks = observation.reshape(*observation.shape[:-1], -1, len(ARM_FIELDS))
        return xp.stack([xp.concat([blocks[..., arm, :], blocks[..., 1 - arm, :]], -1) for arm in (LEFT, RIGHT)], -2)
    cell = rules.cell
    first = RAW_FIELDS.index("goal_x")
    extent = cell.r_max_mm, cell.r_max_mm + cell.base_distance_mm / 2
    goal = xp.stack([observation[..., first] * extent[0], observation[..., first + 1] * extent[1]], -1)
    square, yaw = cell.polar(goal)
    held = wrap(observation[..., first + 2, None] * math.pi - cell.gripper_yaw(yaw))
    own = xp.stack([xp.sqrt(square) / cell.r_max_mm, yaw / math.pi, held / math.pi], -1)
    rest = observation[..., None, :] + 0 * own[..., :1]
    return xp.concat([rest[..., :first], own, rest[..., first + 3 :]], -1)


def goal_reach(rules: Rules, layout: str, observation: Array) -> Array:
    """Which arms reach the goal, bool (..., arms), from observations of ``raw`` or ``relative``."""
    if layout == "relative":
        blocks = observation.reshape(*observation.shape[:-1], -1, len(ARM_FIELDS))
        return blocks[..., ARM_FIELDS.index("reaches_goal")] > 0.5
    cell, first = rules.cell, RAW_FIELDS.index("goal_x")
    extent = cell.r_max_mm, cell.r_max_mm + cell.base_distance_mm / 2
    goal = namespace(observation).stack([observation[..., first] * extent[0], observation[..., first + 1] * extent[1]], -1)
    return cell.reaches(goal)


def finishing_potential(rules: Rules, pose: Array, goal: Array) -> Array:
    """How near each arm is to finishing, (..., arms): minus the orientation error it would leave, in half turns; -1 out of reach."""
    finishing = rules.finishing(pose, goal, math.pi)
    error = abs(finishing.error_rad) / math.pi
    return -namespace(pose).where(finishing.able, error, 1 + 0 * error)


def grid_transfers(rules: Rules, points_mm: Floats, pose: Floats, goal: Floats) -> NDArray[np.int64]:
    """Fewest transfers (n,) that solve problems, pose and goal (n, 3), with hand-overs on the grid only; 0: none within ``max_steps``.

    Breadth first over the turns that hand-overs on the grid add up to: an object that an arm holds is turned against its gripper only by
    where it is handed over, not by where it came from.
    """
    cell = rules.cell
    period = 2 * math.pi / rules.config.symmetry_order
    psi = cell.gripper_yaw(cell.polar(points_mm)[1])
    gamma = psi[:, LEFT] - psi[:, RIGHT]
    yaw, goal_yaw = (cell.gripper_yaw(cell.polar(end)[1]) for end in (pose, goal))
    start_in, goal_in = cell.reaches(pose), cell.reaches(goal)
    best = np.zeros(len(pose), np.int64)
    sums = {LEFT: np.zeros(1), RIGHT: np.zeros(1)}
    for transfers in range(1, rules.config.max_steps + 1):
        for first in (LEFT, RIGHT):
            last = (first + transfers - 1) % 2
            needed = goal[:, 2] - pose[:, 2] + yaw[:, first] - goal_yaw[:, last]
            near = _distance(sums[first], needed, period) <= rules.epsilon_rad
            best[(best == 0) & near & start_in[:, first] & goal_in[:, last]] = transfers
        if best.all():
            break
        for first in (LEFT, RIGHT):
            sign = 1.0 if (first + transfers - 1) % 2 == LEFT else -1.0
            sums[first] = _distinct(sums[first][:, None] + sign * gamma, period)
    return best


def _distinct(turns_rad: Floats, period_rad: float) -> Floats:
    """The different ones, sorted, in [0, period)."""
    turns = np.remainder(turns_rad.ravel(), period_rad)
    return np.sort(turns[np.unique(np.round(turns / RESOLUTION_RAD), return_index=True)[1]])


def _distance(turns_rad: Floats, needed_rad: Floats, period_rad: float) -> Floats:
    """Distance of each needed turn from the nearest of sorted ``turns_rad`` in [0, period)."""
    needed = np.remainder(needed_rad, period_rad)
    around = np.concatenate([turns_rad[-1:] - period_rad, turns_rad, turns_rad[:1] + period_rad])
    upper = np.searchsorted(around, needed).clip(1, len(around) - 1)
    return np.minimum(abs(around[upper] - needed), abs(needed - around[upper - 1]))
