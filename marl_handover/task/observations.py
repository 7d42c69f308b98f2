"""Named observation layouts: what a policy sees, as one float vector.

``raw`` is the paper's seven numbers; for N arms the arm that moved last is shown by N numbers, one an arm, instead of one. ``relative``,
for a pair, shows the same problem to each arm in its own mirrored frame, so that one network can
serve both arms. ``object`` is ``raw`` without the goal, for goal environments whose goal is a field of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from marl_handover.arrays import Array, namespace
from marl_handover.cell.symmetry import NO_ARM
from marl_handover.config import LAYOUTS
from marl_handover.task.rules import Rules

RAW_FIELDS = ("x", "y", "theta", "goal_x", "goal_y", "goal_theta", "previous_arm")
OBJECT_FIELDS = ("x", "y", "theta", "previous_arm")
ARM_FIELDS = (
    "x",
    "y",
    "goal_x",
    "goal_y",
    "reaches_object",
    "other_reaches_object",
    "reaches_goal",
    "other_reaches_goal",
    "cos_finish_error",
    "sin_finish_error",
    "finish_error_in_epsilons",
    "finish_margin",
    "cos_hand_over",
    "sin_hand_over",
    "other_finish_error_in_epsilons",
    "other_finish_margin",
    "was_previous",
    "other_was_previous",
    "log_epsilon",
)
"""Fields of one arm's block of ``relative``; the vector holds one block an arm, L first.

``finish_error`` is the orientation error this arm would leave if it placed the object at the goal now. ``hand_over`` is the hand-over angle
psi_own(p) - psi_other(p) at which passing the object at p would let the other arm finish exactly, counted so that the middle of those that
the shared space offers is pi. All are in the arm's own view: the frame of the shared space, or its image that has the arm's base at the
bottom (:attr:`~marl_handover.cell.cell.Cell.views`).
What an arm that does not reach the goal would leave has no bearing on the problem: its cosine, sine and error are 0, its margin -1.
"""

ODD_FIELDS = ("x", "goal_x", "sin_finish_error", "finish_error_in_epsilons", "sin_hand_over", "other_finish_error_in_epsilons")
"""The fields that change sign when the table is mirrored along the base line (M_x); the others stay."""

ERROR_CLIP = 3.0
"""Errors in units of epsilon are cut off here."""

MARGIN_SLOPE = 2.0
"""The margin, 1 for no error, crosses 0 at an error of epsilon with this slope, and ends at -1."""


class Layout(NamedTuple):
    """An observation layout; ``LAYOUTS.register("NAME")(Layout(...))`` adds one.

    ``observe``: (rules, pose (..., 3), goal (..., 3), previous_arm (...), epsilon_rad) -> (..., size), for numpy and torch alike;
    ``size``: the vector's length for a number of arms.
    """

    observe: Callable[[Rules, Array, Array, Array, Array | float], Array]
    size: Callable[[int], int]


def observation_size(layout: str, num_arms: int = 2) -> int:
    """Length of the layout's vector in a cell of ``num_arms``."""
    size: int = LAYOUTS[layout].size(num_arms)
    return size


def observe(rules: Rules, layout: str, pose: Array, goal: Array, previous_arm: Array, epsilon_rad: Array | float | None = None) -> Array:
    """Observations (..., observation_size(layout)) of a batch: pose and goal (..., 3), previous_arm int (...) with -1 for none.

    Where the task's ``previous_arm`` is off, they are those of an object that no arm has moved yet.
    """
    if not rules.config.previous_arm:
        previous_arm = 0 * previous_arm - 1
    seen: Array = LAYOUTS[layout].observe(rules, pose, goal, previous_arm, rules.epsilon_rad if epsilon_rad is None else epsilon_rad)
    return seen


def _scaled(rules: Rules, pose: Array) -> list[Array]:
    """Pose fields scaled to about [-1, 1]."""
    extent_x, extent_y = rules.cell.extent_mm
    return [pose[..., 0] / extent_x, pose[..., 1] / extent_y, pose[..., 2] / math.pi]


def _previous(rules: Rules, like: Array, previous_arm: Array) -> list[Array]:
    """Which arm moved last: of a pair -1 for L, +1 for R, 0 for none; else one number an arm, 1 for the one that did."""
    xp, count = namespace(like), rules.cell.num_arms
    one = xp.ones_like(like)
    if count == 2:
        return [xp.where(previous_arm < 0, 0 * one, xp.where(previous_arm > 0, one, -one))]
    return [xp.where(previous_arm == arm, one, 0 * one) for arm in range(count)]


def last_arm(shown: Array) -> Array:
    """Which arm moved last, int (...), -1 for none, of vectors (..., size) in the layout ``object``."""
    xp, last = namespace(shown), shown[..., len(OBJECT_FIELDS) - 1 :]
    if last.shape[-1] == 1:
        return xp.where(last[..., 0] == 0, NO_ARM, xp.where(last[..., 0] > 0, 1, 0))
    return xp.where((last > 0).any(-1), xp.argmax(last, -1), NO_ARM)


def _raw(rules: Rules, pose: Array, goal: Array, previous_arm: Array, epsilon_rad: Array | float) -> Array:
    fields = [*_scaled(rules, pose), *_scaled(rules, goal), *_previous(rules, pose[..., 0], previous_arm)]
    return namespace(pose).stack(fields, -1)


def _object(rules: Rules, pose: Array, goal: Array, previous_arm: Array, epsilon_rad: Array | float) -> Array:
    return namespace(pose).stack([*_scaled(rules, pose), *_previous(rules, pose[..., 0], previous_arm)], -1)


def _relative(rules: Rules, pose: Array, goal: Array, previous_arm: Array, epsilon_rad: Array | float) -> Array:
    """One block an arm. Both arms' quantities are computed at once, with the arms on the last axis."""
    xp, cell = namespace(pose), rules.cell
    cell.require_pair("task.layout=relative")
    scale = max(arm.r_max_mm for arm in cell.arms)
    views, space, skew = cell.views, cell.shared, cell.chart.skew_rad
    at, goal_at = space.in_frame(pose), space.in_frame(goal)
    reached, yaw = cell.seen(pose)
    one = xp.ones_like(yaw)
    goal_reached, goal_yaw = cell.seen(goal)
    reach, goal_reach = reached + 0.0 * yaw, goal_reached + 0.0 * yaw
    mirror = xp.stack([view.turn_sign + 0 * pose[..., 0] for view in views], -1)
    across, along = one, mirror
    if any(view.x_sign < 0 for view in views):
        across, along = (xp.stack([view[axis] + 0 * pose[..., 0] for view in views], -1) for axis in range(2))
    turn = (pose[..., 2] - goal[..., 2])[..., None]
    finish = rules.orientation_error(turn + goal_yaw - yaw, 0 * turn)
    other_goal_psi = xp.flip(cell.gripper_yaw(goal_yaw), (-1,))
    angle = cell.gripper_yaw(yaw) - turn - other_goal_psi
    if skew:
        angle = xp.stack([angle[..., 0] - skew, angle[..., 1] + skew], -1)
    hand_over = angle * rules.config.symmetry_order
    epsilon = epsilon_rad + 0 * pose[..., 0]
    relative_error = mirror * finish / epsilon[..., None]
    in_epsilons = goal_reach * xp.clip(relative_error, -ERROR_CLIP, ERROR_CLIP) / ERROR_CLIP
    margin = goal_reach * (1 + xp.clip(MARGIN_SLOPE * (1 - abs(relative_error)), -1.0, 1.0)) - 1
    other_goal_reach = xp.flip(goal_reach, (-1,))
    was_previous = xp.stack([(previous_arm == index) + 0 * pose[..., 0] for index in range(cell.num_arms)], -1)
    fields = [
        at[..., 0:1] / scale * across,
        along * at[..., 1:2] / scale,
        goal_at[..., 0:1] / scale * across,
        along * goal_at[..., 1:2] / scale,
        reach,
        xp.flip(reach, (-1,)),
        goal_reach,
        other_goal_reach,
        goal_reach * xp.cos(finish * rules.config.symmetry_order),
        goal_reach * mirror * xp.sin(finish * rules.config.symmetry_order),
        in_epsilons,
        margin,
        other_goal_reach * xp.cos(hand_over),
        other_goal_reach * mirror * xp.sin(hand_over),
        xp.flip(in_epsilons, (-1,)) * -1,
        xp.flip(margin, (-1,)),
        was_previous,
        xp.flip(was_previous, (-1,)),
        xp.log(epsilon)[..., None] / 4 * one,
    ]
    blocks = xp.stack(fields, -1)
    return blocks.reshape(*blocks.shape[:-2], -1)


def _previous_size(num_arms: int) -> int:
    return 1 if num_arms == 2 else num_arms


RAW = Layout(_raw, lambda num_arms: len(RAW_FIELDS) - 1 + _previous_size(num_arms))
OBJECT = Layout(_object, lambda num_arms: len(OBJECT_FIELDS) - 1 + _previous_size(num_arms))
RELATIVE = Layout(_relative, lambda num_arms: num_arms * len(ARM_FIELDS))
