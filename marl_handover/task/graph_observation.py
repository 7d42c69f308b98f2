"""The observation layout ``graph``: one block an arm and one block an ordered pair of arms, for any number of arms anywhere.

What counts in a hand-over problem is angles. Arm i that carries an object keeps ``u_i``, the object's yaw in its gripper as it would be
seen from the goal; handing over to arm j changes it by a hand-over angle that the two offer, and an arm that reaches the goal can finish
if its ``u`` is its ``goal_angle`` to within epsilon. All are counted from the middle of an arm's own facing, so that every number is the
same after a motion of the whole table; a permutation of the arms permutes the blocks; under a reflection the odd fields
(:data:`ODD_ARM_FIELDS`, :data:`ODD_PAIR_FIELDS`) change sign.

The vector holds the arms' blocks (N, :data:`ARM_FIELDS`), then the pairs' (N, N, :data:`PAIR_FIELDS`), from the giver's row to the
receiver's column. An arm that is not there has a block of zeros. Keep-out discs and limits of reach are in it by what they leave: who
reaches what, and which angles two arms offer. For a block of symmetry order k all angles, and epsilon, are k times as large: a full turn of
them is what brings the block back onto itself.
"""

from __future__ import annotations

import math

from marl_handover.arrays import Array, ascending, namespace, taken, wrap
from marl_handover.task.observations import Layout
from marl_handover.task.rules import Rules

ARM_FIELDS = ("is_there", "reaches_object", "reaches_goal", "was_previous", "angle", "goal_angle", "log_epsilon")
"""Angles in half turns. Every arm has an ``angle``, also one that does not reach the object: what it would carry it at if it took it."""

LOG_SCALE = 4.0
"""The logarithm of epsilon in rad is so many times what is shown."""

ARCS = 4
"""Intervals of hand-over angles of an ordered pair that are shown: its widest, in their order. More are rare: two discs make three."""

PAIR_FIELDS = tuple(f"{what}_{number}" for number in range(ARCS) for what in ("middle", "half"))
"""Of each interval of hand-over angles: middle and half width in half turns, from facing to facing; a half width of -1: there is none."""

ODD_ARM_FIELDS = ("angle", "goal_angle")
ODD_PAIR_FIELDS = tuple(name for name in PAIR_FIELDS if name.startswith("middle"))


def observe_graph(rules: Rules, pose: Array, goal: Array, previous_arm: Array, epsilon_rad: Array | float) -> Array:
    """Observations (..., N * 7 + N * N * 8); shapes as :class:`~marl_handover.task.observations.Layout` has them."""
    xp, cell, k = namespace(pose), rules.cell, rules.config.symmetry_order
    square, yaw = cell.polar(pose)
    goal_square, goal_yaw = cell.polar(goal)
    one = xp.ones_like(yaw)
    there = cell.standing(yaw) * one
    moved = xp.stack([(previous_arm == arm) + 0 * pose[..., 0] for arm in range(cell.num_arms)], -1)
    fields = [
        there,
        cell.reached(square, yaw, pose) * one,
        cell.reached(goal_square, goal_yaw, goal) * one,
        moved,
        wrap(k * ((pose[..., 2] - goal[..., 2])[..., None] - yaw)) / math.pi,
        wrap(-k * goal_yaw) / math.pi,
        xp.log(k * (epsilon_rad + 0 * pose[..., 0]))[..., None] / LOG_SCALE * one,
    ]
    arms = xp.stack(fields, -1) * there[..., None]
    middle, half = shown_arcs(rules, yaw[..., None] + 0 * yaw[..., None, :])
    facing = cell.gripper_yaw(0 * yaw)
    apart = (facing[..., :, None] - facing[..., None, :])[..., None]
    none = half < 0
    pairs = xp.stack(
        [xp.where(none, 0 * half, wrap(k * (middle - apart)) / math.pi), xp.where(none, half, xp.clip(k * half / math.pi, None, 1))], -1
    )
    batch = arms.shape[:-2]
    return xp.concat([arms.reshape(*batch, -1), pairs.reshape(*batch, -1)], -1)


def shown_arcs(rules: Rules, like: Array) -> tuple[Array, Array]:
    """Middle and half [rad] of the intervals that are shown (..., N, N, :data:`ARCS`), as ``hand_over_arcs`` has them.

    ``like`` is any array (..., N, N); half is -1 where there is none.
    """
    xp = namespace(like)
    middle, half = rules.cell.hand_over_arcs(like)
    if half.shape[-1] > ARCS:
        order = ascending(xp.argsort(-half, stable=True)[..., :ARCS])
        middle, half = taken(middle, order), taken(half, order)
    parts, none = [], -xp.ones_like(like)
    for table, empty in ((middle, 0 * like), (half, none)):
        columns = [table[..., number] + 0 * like for number in range(table.shape[-1])]
        parts.append(xp.stack(columns + [empty] * (ARCS - len(columns)), -1))
    return parts[0], parts[1]


GRAPH = Layout(observe_graph, lambda num_arms: num_arms * len(ARM_FIELDS) + num_arms**2 * len(PAIR_FIELDS))
