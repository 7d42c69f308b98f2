"""The observation layout ``graph``: one block an arm and one block an ordered pair of arms, for any number of arms anywhere.

Every number is the same after a motion of the whole table, and a permutation of the arms permutes the blocks. Under a reflection the odd
fields (:data:`ODD_ARM_FIELDS`, :data:`ODD_PAIR_FIELDS`) change sign. The vector holds the arms' blocks (N, :data:`ARM_FIELDS`), then the
pairs' (N, N, :data:`PAIR_FIELDS`), from the giver's row to the receiver's column. An arm that is not there has a block of zeros.
"""

from __future__ import annotations

import math

from marl_handover.arrays import Array, namespace, select, wrap
from marl_handover.task.observations import ERROR_CLIP, MARGIN_SLOPE, Layout
from marl_handover.task.rules import Rules

ARM_FIELDS = (
    "is_there",
    "reaches_object",
    "reaches_goal",
    "was_previous",
    "finish_margin",
    "finish_error_in_epsilons",
    "cos_finish_error",
    "sin_finish_error",
    "object_radius",
    "goal_radius",
    "object_yaw",
    "goal_yaw",
    "log_epsilon",
)
"""``finish_error`` is the orientation error that the arm leaves if it places the object at the goal now. Radii and yaws are where in the
arm's ring and range of yaw object and goal are, -0.5 at the lower limit and 0.5 at the upper one, and are cut off at 1 and -1."""

PAIR_FIELDS = (
    "is_shared",
    "cos_angle",
    "sin_angle",
    "half_width",
    "arcs",
    "cos_needed",
    "sin_needed",
    "slack",
    "slack_in_epsilons",
)
"""Of the hand-over angles that two arms offer: middle and half width (in half turns) of the widest interval, how many there are (a third of
them), the angle that lets the receiver finish if the giver picks the object now and hands it over, and how far inside the nearest interval
that is, in half turns and in epsilons; without an interval it is cut off below."""

ODD_ARM_FIELDS = ("finish_error_in_epsilons", "sin_finish_error", "object_yaw", "goal_yaw")
ODD_PAIR_FIELDS = ("sin_angle", "sin_needed")

_FAR = 2.0


def observe_graph(rules: Rules, pose: Array, goal: Array, previous_arm: Array, epsilon_rad: Array | float) -> Array:
    """Observations (..., N * 13 + N * N * 9); shapes as :class:`~marl_handover.task.observations.Layout` has them."""
    xp, cell, k = namespace(pose), rules.cell, rules.config.symmetry_order
    square, yaw = cell.polar(pose)
    goal_square, goal_yaw = cell.polar(goal)
    reached, goal_reached = cell.reached(square, yaw, pose), cell.reached(goal_square, goal_yaw, goal)
    one = xp.ones_like(yaw)
    epsilon = (epsilon_rad + 0 * pose[..., 0])[..., None]
    turn = (goal[..., 2] - pose[..., 2])[..., None]
    error = rules.orientation_error(goal_yaw - yaw, turn)
    reach, goal_reach = reached * one, goal_reached * one
    relative = error / epsilon
    margin = goal_reach * (1 + xp.clip(MARGIN_SLOPE * (1 - abs(relative)), -1.0, 1.0)) - 1
    (radius, turned), (goal_radius, goal_turned) = cell.in_sector(square, yaw), cell.in_sector(goal_square, goal_yaw)
    there = cell.standing(yaw) * one
    moved = xp.stack([(previous_arm == arm) + 0 * pose[..., 0] for arm in range(cell.num_arms)], -1)
    arm_fields = [
        there,
        reach,
        goal_reach,
        moved,
        margin,
        goal_reach * xp.clip(relative, -ERROR_CLIP, ERROR_CLIP) / ERROR_CLIP,
        goal_reach * xp.cos(error * k),
        goal_reach * xp.sin(error * k),
        *(xp.clip(each, -_FAR, _FAR) / _FAR for each in (radius, goal_radius, turned, goal_turned)),
        xp.log(epsilon) / 4 * one,
    ]
    arms = xp.stack(arm_fields, -1) * there[..., None]
    psi, goal_psi = cell.gripper_yaw(yaw), cell.gripper_yaw(goal_yaw)
    needed = (turn + psi)[..., :, None] - goal_psi[..., None, :]
    pairs = _pairs(rules, needed, epsilon[..., None])
    batch = arms.shape[:-2]
    return xp.concat([arms.reshape(*batch, -1), pairs.reshape(*batch, -1)], -1)


def _pairs(rules: Rules, needed: Array, epsilon: Array) -> Array:
    """Blocks (..., N, N, 9) of the angles ``needed`` (..., N, N); ``epsilon`` (..., 1, 1)."""
    xp, k = namespace(needed), rules.config.symmetry_order
    middle, half = rules.cell.hand_over_arcs(needed)
    apart = abs(wrap((needed[..., None] - middle) * k)) / k
    slack = xp.amax(xp.where(half >= 0, half - apart, -math.pi + 0 * apart), -1)
    angle, width = select(middle, xp.argmax(half, -1)), xp.amax(half, -1)
    shared = (width >= 0) + 0 * needed
    fields = [
        shared,
        shared * xp.cos(angle),
        shared * xp.sin(angle),
        shared * width / math.pi,
        (half >= 0).sum(-1) / 3 + 0 * needed,
        shared * xp.cos(needed * k),
        shared * xp.sin(needed * k),
        slack / math.pi,
        xp.clip(slack / epsilon / 4, -1.0, 1.0),
    ]
    return xp.stack(fields, -1)


GRAPH = Layout(observe_graph, lambda num_arms: num_arms * len(ARM_FIELDS) + num_arms**2 * len(PAIR_FIELDS))
