"""An arm and what is around it as packed arrays for the kernels: capsules, self pairs, obstacles, the held block."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.errors import UrdfError
from marl_handover.geometry.capsules import COVER_MM, block_capsules, capsule_pairs, joints_before, segment_distance
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.kernels import can_meet, world_shapes
from marl_handover.geometry.se3 import apply, flat_pose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MARGIN_MM = 3.0
"""The optimiser asks for up to this much more clearance than is demanded; pairs that never come so near are left out."""

GRID_RAD = math.radians(4.0)

TURNS, GRASP_SLACK_MM = 24, 0.1
"""At so many orientations of the block, over half a turn, its distance to the hand that grasps it is looked at."""


@dataclass(frozen=True, eq=False)
class CollisionModel:
    """The packed shapes of one arm, bare and holding the block; layouts as in :mod:`marl_handover.geometry.kernels`.

    ``pairs`` index capsules that must not touch and might, within the joint ``limits`` (4, 2); the others are proved apart. ``edges``
    (2, 2) are the held block's lower front and rear edge in the wrist's frame. ``reach_mm``: nothing of the arm, or held by it, is ever
    farther from the yaw axis; ``levers_mm`` (4,): the same of each joint's axis, of what it moves. ``block_clearance_mm`` (B,): demanded
    between the hand and each shape of the standing block: as set, or what a grasp leaves where hand or fingers are as near as that.
    """

    planar: Floats
    capsules: Floats
    pairs: Ints
    held: Floats
    held_pairs: Ints
    edges: Floats
    limits: Floats
    reach_mm: float
    levers_mm: Floats
    block_clearance_mm: Floats


class Scene(NamedTuple):
    """One arm, what it holds and what stands around it. Lengths in mm; layouts of the rows: :mod:`marl_handover.geometry.kernels`.

    Attributes:
        planar: (15,) the arm's links.
        capsules: (K, 9) its shapes, sorted by level, then those of the held block.
        carried: index of the first shape that is held.
        pairs: (P, 2) indices of shapes that must not touch; first those of base or turret with the hand.
        obstacles: (M, 9) of what stands around, the other arm's first.
        arm_rows: how many of them are the other arm's.
        group: (5,) a ball around all obstacles (x, y, z, radius), and the greatest clearance they demand.
        clearance: (2,) demanded to itself and to the table.
        pick_height: of the grip at both ends.
        edges: (E, 2) the held block's lower edges (x, z) in the wrist's frame.
        profile: (8,) of the lift-over: the two ends (x, y), the length scale of each end (0: it asks for nothing), lift, ground clearance.
    """

    planar: Floats
    capsules: Floats
    carried: int
    pairs: Ints
    obstacles: Floats
    arm_rows: int
    group: Floats
    clearance: Floats
    pick_height: float
    edges: Floats
    profile: Floats


def collision_models(model: CellModel, motion: MotionConfig) -> tuple[CollisionModel, ...]:
    """The shapes of each of a cell's arms; arms of one robot share theirs."""
    made: dict[int, CollisionModel] = {}
    for index, arm in enumerate(model.arms):
        if id(arm) not in made:
            made[id(arm)] = arm_collision_model(model, motion, index)
    return tuple(made[id(arm)] for arm in model.arms)


def arm_collision_model(model: CellModel, motion: MotionConfig, index: int) -> CollisionModel:
    """The shapes of a cell's arm ``index``, its fingers opened by ``finger_travel_mm``."""
    arm = model.arms[index]
    planar = arm.planar
    shapes, first, second = capsule_pairs(arm.description)
    if not shapes:
        raise UrdfError(arm.description.path, "no link has a collision shape, and motions need them; set shapes=links")
    pivots = np.array([[0.0, 0.0], [0.0, 0.0], arm.shoulder_mm, arm.shoulder_mm + arm.upper_arm_mm])
    pivots = np.concatenate([pivots, [pivots[3] + arm.forearm_mm]])
    frames = arm.link_transforms(np.zeros(5), motion.finger_travel_mm)
    before = joints_before(arm.description)
    rows = []
    for shape in shapes:
        level = min(before[shape.link], 4)
        T_base_link = frames[shape.link]
        ends = [apply(T_base_link, end) for end in (shape.start_mm, shape.end_mm)]
        offset = np.array([pivots[level][0], 0.0, pivots[level][1]])
        rows.append([level, *(ends[0] - offset), *(ends[1] - offset), shape.radius_mm])
    shaped = _with_half_lengths(rows, 1)
    order = np.argsort([row[0] for row in rows], kind="stable")
    rank = np.argsort(order)
    capsules = shaped[order]
    pairs = np.array(sorted((rank[i], rank[j]) for i, j in zip(first, second, strict=True)), np.int64).reshape(-1, 2)
    tool = arm.tool_mm
    grip_to_table = model.cell.pick_heights_mm[index]
    block = [
        [4.0, *_shifted(shape.start_mm, arm), *_shifted(shape.end_mm, arm), shape.radius_mm]
        for shape in block_capsules(model.cell.config.block, grip_to_table)
    ]
    held = np.concatenate([capsules, _with_half_lengths(block, 1)])
    # The held block moves with the hand; it may meet everything up to the forearm.
    with_held = [(k, len(capsules) + j) for k in range(len(capsules)) if capsules[k, 0] <= 3 for j in range(len(block))]
    half = model.cell.config.block.side_mm / 2 * math.sqrt(2)
    edges = np.array([[tool[0] + side * half, tool[1] - grip_to_table] for side in (-1.0, 1.0)])
    limits = np.stack([arm.lower_rad[:4], arm.upper_rad[:4]], axis=1)
    all_pairs = np.concatenate([pairs, np.array(with_held, np.int64)])
    need = motion.self_clearance_mm + MARGIN_MM
    steps = np.maximum(np.ceil((limits[1:, 1] - limits[1:, 0]) / GRID_RAD), 2).astype(np.int64)
    # A base that stands out from the yaw axis is taken at all yaws here.
    swept = np.array([_swept(row) if row[0] == 0 else row for row in held])
    meeting = [can_meet(planar, swept, a, b, swept[a, 7] + swept[b, 7] + need, limits, steps) for a, b in all_pairs]
    all_pairs = all_pairs[np.array(meeting, bool)]
    fixed, hand = swept[held[:, 0] < 2], held[held[:, 0] >= 4]
    grouped = (held[all_pairs[:, 0], 0] < 2) & (held[all_pairs[:, 1], 0] >= 4)
    all_pairs = np.concatenate([all_pairs[grouped], all_pairs[~grouped]])  # the kernels skip the first ones together
    planar = np.concatenate([planar, _planar_ball(fixed), _planar_ball(hand)])
    levers = _levers_mm(planar, held, limits)
    bare_pairs = all_pairs[all_pairs.max(axis=1) < len(capsules)]
    at_grasp = _at_grasp_mm(capsules[capsules[:, 0] >= 4], held[len(capsules) :], arm)
    near = np.clip(at_grasp - GRASP_SLACK_MM, -COVER_MM, motion.block_clearance_mm)
    return CollisionModel(planar, capsules, bare_pairs, held, all_pairs, edges, limits, float(levers[0]), levers, near)


def _swept(row: Floats) -> Floats:
    """A capsule row of the base around all places it has, seen from the arm's plane: on the yaw axis."""
    wide = max(math.hypot(row[1], row[2]), math.hypot(row[4], row[5]))
    return np.array([row[0], 0.0, 0.0, row[3], 0.0, 0.0, row[6], row[7] + wide, abs(row[6] - row[3]) / 2])


def standing_arm(
    body: CollisionModel, arm: ClosedFormArm, motion: MotionConfig, q: Floats, x_mm: float, y_mm: float, facing_rad: float
) -> Floats:
    """Obstacle rows (M, 9) of an ``arm``, its shapes ``body``, that holds still at ``q`` (5,), its base in the moving arm's frame."""
    bare = body.capsules
    if q[4] == 0.0:
        shapes = world_shapes(q[None, :4].copy(), body.planar, bare, x_mm, y_mm, facing_rad)[0]
        rows = np.empty((len(bare), 9))
        rows[:, :6], rows[:, 6], rows[:, 7], rows[:, 8] = shapes[:, :6], shapes[:, 10], motion.arm_clearance_mm, shapes[:, 9]
        return rows
    frames = arm.link_transforms(q, motion.finger_travel_mm)
    T = flat_pose(x_mm, y_mm, facing_rad)
    listed = []
    for shape in capsule_pairs(arm.description)[0]:
        M = T @ frames[shape.link]
        ends = [apply(M, end) for end in (shape.start_mm, shape.end_mm)]
        listed.append([*ends[0], *ends[1], shape.radius_mm, motion.arm_clearance_mm])
    return _with_half_lengths(listed, 0)


def standing_block(body: CollisionModel, model: CellModel, place_mm: Floats) -> Floats:
    """Obstacle rows of the block standing at ``place_mm`` (2,) of a moving arm's base frame."""
    height = model.cell.pick_heights_mm[0]  # where its frame is; its shapes are over the table
    at = np.array([place_mm[0], place_mm[1], height])
    shapes = block_capsules(model.cell.config.block, height)
    rows = [
        [*(at + shape.start_mm), *(at + shape.end_mm), shape.radius_mm, clearance]
        for shape, clearance in zip(shapes, body.block_clearance_mm, strict=True)
    ]
    return _with_half_lengths(rows, 0)


def ball_around(obstacles: Floats) -> Floats:
    """A ball (x, y, z, radius) in mm around obstacle rows, and the greatest clearance they demand: (5,)."""
    if not len(obstacles):
        return np.zeros(5)
    points = obstacles[:, :6].reshape(-1, 3)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    away = np.linalg.norm(obstacles[:, :6].reshape(-1, 2, 3) - centre, axis=-1).max(axis=1) + obstacles[:, 6]
    return np.array([*centre, away.max(), obstacles[:, 7].max()])


def _at_grasp_mm(hand: Floats, block: Floats, arm: ClosedFormArm) -> Floats:
    """How near capsules (K, 9) of the hand come to each of the block's (B, 9) while it is grasped, its pin in any orientation: (B,)."""
    if not len(hand):
        return np.full(len(block), np.inf)
    grip, angle, turn = np.array(_shifted((0.0, 0.0, 0.0), arm)), np.arange(TURNS) * math.pi / TURNS, np.zeros((TURNS, 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 2, 2] = np.cos(angle), -np.sin(angle), 1.0
    turn[:, 1, 0], turn[:, 1, 1] = np.sin(angle), np.cos(angle)
    start, end = (np.einsum("nij,bj->nbi", turn, block[:, at : at + 3] - grip)[:, :, None] + grip for at in (1, 4))
    gap = segment_distance(hand[:, 1:4], hand[:, 4:7], start, end) - block[:, None, 7] - hand[:, 7]
    return np.asarray(gap.min(axis=(0, 2)))


def _shifted(point_mm: tuple[float, float, float], arm: ClosedFormArm) -> tuple[float, float, float]:
    """A point of the grip's frame in the wrist's."""
    return point_mm[0] + arm.tool_mm[0], point_mm[1] + arm.lateral_mm, point_mm[2] + arm.tool_mm[1]


def _planar_ball(capsules: Floats) -> Floats:
    """A ball (r, z, radius) around capsules of one frame, its centre in the arm's plane."""
    points = capsules[:, 1:7].reshape(-1, 3)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    centre[1] = 0.0
    away = np.linalg.norm(capsules[:, 1:7].reshape(-1, 2, 3) - centre, axis=-1).max(axis=1) + capsules[:, 7]
    return np.array([centre[0], centre[2], away.max()])


def out_of_reach(body: CollisionModel, obstacles: Floats) -> NDArray[np.bool_]:
    """Which obstacle rows (M,) the arm cannot come near to in any posture, whatever it holds: those are proved clear."""
    if not len(obstacles):
        return np.zeros(0, bool)
    points = obstacles[:, :6].reshape(-1, 2, 3)
    # The nearest a segment comes to the yaw axis is at least its nearer end's distance less its length.
    nearer = np.hypot(points[..., 0], points[..., 1]).min(axis=1) - np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    return np.asarray(nearer - obstacles[:, 6] - obstacles[:, 7] - MARGIN_MM > body.reach_mm)


def _levers_mm(planar: Floats, held: Floats, limits: Floats) -> Floats:
    """Bounds (4,) on how far from the axes of yaw, shoulder, elbow and wrist pitch any part of the arm beyond, or held by it, can be."""
    upper, forearm = math.hypot(planar[2], planar[3]), math.hypot(planar[4], planar[5])
    # The wrist is farthest from the shoulder where the elbow is least bent.
    angle = math.atan2(planar[5], planar[4]) - math.atan2(planar[3], planar[2])
    low, high = limits[2] + angle
    bend = 0.0 if low <= 0.0 <= high else min(abs(low), abs(high))
    wrist = math.sqrt(upper**2 + forearm**2 + 2 * upper * forearm * math.cos(min(bend, math.pi)))

    def beyond_pivot(level: int) -> float:
        rows = held[held[:, 0] == level]
        return float((np.linalg.norm(rows[:, 1:7].reshape(-1, 2, 3), axis=-1).max(axis=1) + rows[:, 7]).max()) if len(rows) else 0.0

    hand = beyond_pivot(4)
    elbow = max(beyond_pivot(3), forearm + hand)
    shoulder = max(beyond_pivot(2), upper + beyond_pivot(3), wrist + hand)
    standing = max(float(np.hypot(held[held[:, 0] < 2][:, [1, 4]], held[held[:, 0] < 2][:, [2, 5]]).max(initial=0.0)), 0.0)
    standing += float(held[held[:, 0] < 2, 7].max(initial=0.0))
    return np.array([max(abs(planar[0]) + shoulder, standing), shoulder, elbow, hand])


def _with_half_lengths(rows: list[list[float]], first: int) -> Floats:
    """Rows with the half length of their segment, whose points start at column ``first``, put at the end."""
    array = np.array(rows, dtype=float)
    halves = np.linalg.norm(array[:, first + 3 : first + 6] - array[:, first : first + 3], axis=1) / 2
    return np.concatenate([array, halves[:, None]], axis=1)
