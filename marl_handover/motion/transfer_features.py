"""What a motion's numbers are chosen by and judged from: both ends of the way, in the acting arm's own frame, numpy or torch."""

from __future__ import annotations

import math

from marl_handover.arrays import Array, length, namespace, select
from marl_handover.cell import Cell

FIELDS = ("from_radius", "from_cos", "from_sin", "to_radius", "to_cos", "to_sin", "turn", "distance")
"""Radius and direction of both ends from the arm's base, the yaw between them, and their distance; all scaled to about [-1, 1]."""

JOINTS = 4
"""Numbers of a control point: base yaw, shoulder, elbow, wrist pitch."""


def transfer_features(cell: Cell, arm: Array, from_mm: Array, to_mm: Array, fold: bool) -> tuple[Array, Array]:
    """Features (..., 8) of ways between world positions (..., 2) as the arms (...) see them, and the sign (...) of their base yaw.

    ``fold``: M_x mirrors an arm's own frame, so a way that turns right is seen as its image, which turns left; the sign is then -1, and
    the base yaws of a motion that belongs to these features are those of the arm times the sign.
    """
    xp = namespace(from_mm)
    (square_1, yaw_1), (square_2, yaw_2) = cell.polar(from_mm), cell.polar(to_mm)
    radius_1, radius_2 = xp.sqrt(select(square_1, arm)), xp.sqrt(select(square_2, arm))
    yaw_1, yaw_2 = select(yaw_1, arm), select(yaw_2, arm)
    one = xp.ones_like(yaw_1)
    sign = xp.where(yaw_2 < yaw_1, -one, one) if fold else one
    middle, half = (cell.r_max_mm + cell.r_min_mm) / 2, (cell.r_max_mm - cell.r_min_mm) / 2
    distance = length(to_mm - from_mm)
    fields = [
        xp.clip((radius_1 - middle) / half, -3.0, 3.0),
        xp.cos(yaw_1),
        sign * xp.sin(yaw_1),
        xp.clip((radius_2 - middle) / half, -3.0, 3.0),
        xp.cos(yaw_2),
        sign * xp.sin(yaw_2),
        sign * (yaw_2 - yaw_1) / math.pi,
        distance / (2 * cell.r_max_mm),
    ]
    return xp.stack(fields, -1), sign


def mirrored_numbers(numbers: Array, sign: Array) -> Array:
    """A motion's numbers (..., M), their base yaws times ``sign`` (...)."""
    xp = namespace(numbers)
    points = numbers.reshape(*numbers.shape[:-1], -1, JOINTS)
    turned = xp.concat([points[..., :1] * sign[..., None, None], points[..., 1:]], -1)
    return turned.reshape(*numbers.shape)
