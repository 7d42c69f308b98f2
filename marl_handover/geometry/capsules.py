"""How far an arm's links stay from the ground and from each other.

Ground clearance is exact for the URDF's shapes. Self clearance uses capsules that cover the shapes, so it errs on the safe side: one
capsule a shape while that stays close to it, else a few parallel ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Array, namespace
from marl_handover.config import BlockConfig, MotionConfig
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.closed_form import Floats
from marl_handover.geometry.se3 import apply, transform
from marl_handover.geometry.urdf import ARM_JOINTS, ArmDescription, Primitive

ONE_CAPSULE_MM = {"box": 15.0, "cylinder": 21.0, "sphere": 0.0}
"""How far the one capsule around a shape may stand out of its surface; beyond that the shape is covered by several."""

COVER_MM, MOST_CAPSULES = 10.0, 12
"""How far several may stand out, and how many they may be; a box that needs more gets the least excess that so many leave."""


SPOKES = 3
"""The block's footprint, whatever its orientation, is covered by this many capsules through its centre."""

TABLE = "the table"

TOUCHING_SAMPLES = (50, 4000)
"""How many random postures are looked at, the second time for the pairs that are left."""


@dataclass(frozen=True)
class Capsule:
    """All points within ``radius_mm`` of the segment ``start_mm``-``end_mm``, in the frame of ``link``."""

    link: str
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    radius_mm: float


def ground_clearance_mm(arm: ArmModel, q: ArrayLike) -> Floats:
    """Height (...) in mm of the lowest point of the links after the turret, fingers open, for joint vectors ``q`` (..., 5).

    Negative below the table. The base and the turret stand on the table and do not count.
    """
    frames = arm.link_transforms(q)
    bodies = joints_before(arm.description)
    first = ARM_JOINTS.index("shoulder") + 1
    heights = [
        _lowest_mm(frames[link.name], shape) for link in arm.description.links if bodies[link.name] >= first for shape in link.collisions
    ]
    if not heights:
        return np.full(np.shape(q)[:-1], np.inf)
    return np.asarray(np.min(np.stack(heights), axis=0))


def self_clearance_mm(arm: ArmModel, q: ArrayLike) -> Floats:
    """Smallest distance (...) in mm between the capsules of bodies that are not neighbours, for joint vectors ``q`` (..., 5).

    Negative where capsules overlap. Links between which no arm joint lies are one body: fixed links, and the fingers (open) with the hand.
    """
    capsules, first, second = capsule_pairs(arm.description)
    if not len(first):
        return np.full(np.shape(q)[:-1], np.inf)
    frames = arm.link_transforms(q)
    starts = np.stack([apply(frames[capsule.link], capsule.start_mm) for capsule in capsules])
    ends = np.stack([apply(frames[capsule.link], capsule.end_mm) for capsule in capsules])
    radii = np.array([capsule.radius_mm for capsule in capsules])
    best = np.full(np.shape(q)[:-1], np.inf)
    for i, j in zip(first, second, strict=True):  # a loop over some thirty pairs keeps the arrays small enough for the cache
        gap = segment_distance(starts[i], ends[i], starts[j], ends[j]) - (radii[i] + radii[j])
        best = np.minimum(best, gap)
    return best


def grasp_margins_mm(arm: ArmModel, q: ArrayLike, motion: MotionConfig, block: Sequence[Capsule] = ()) -> dict[tuple[str, str], Floats]:
    """What arms at joint vectors ``q`` (..., 5) leave of the clearances that ``motion`` demands, with the ``block`` in their hand.

    Args:
        arm: its kinematics and shapes.
        q: joint vectors in rad.
        motion: clearances in mm, and how far the fingers are open.
        block: in the frame of the grip, as :func:`block_capsules` gives it.

    Returns:
        for each two bodies that must not touch, by the names of their links, of "block", "pin" and of :data:`TABLE`, the smallest margin
        (...) in mm; negative where motion planning refuses the posture.
    """
    capsules, first, second = capsule_pairs(arm.description)
    frames, level, T_base_grip = arm.link_transforms(q, motion.finger_travel_mm), joints_before(arm.description), arm.fk(q)
    placed = [(apply(frames[shape.link], shape.start_mm), apply(frames[shape.link], shape.end_mm), shape.radius_mm) for shape in capsules]
    margins: dict[tuple[str, str], Floats] = {}

    def note(pair: tuple[str, str], margin: Floats) -> None:
        margins[pair] = np.minimum(margins[pair], margin) if pair in margins else margin

    def between(one: tuple[Floats, Floats, float], other: tuple[Floats, Floats, float], demanded_mm: float) -> Floats:
        return np.asarray(segment_distance(one[0], one[1], other[0], other[1]) - (one[2] + other[2]) - demanded_mm)

    for i, j in zip(first, second, strict=True):
        note((capsules[i].link, capsules[j].link), between(placed[i], placed[j], motion.self_clearance_mm))
    for shape, (start, end, radius) in zip(capsules, placed, strict=True):
        if level[shape.link] >= ARM_JOINTS.index("shoulder") + 1:
            note((shape.link, TABLE), np.minimum(start[..., 2], end[..., 2]) - radius - motion.ground_clearance_mm)
        for held in block:
            grasped = (apply(T_base_grip, held.start_mm), apply(T_base_grip, held.end_mm), held.radius_mm)
            # Nothing moves between the block and wrist and hand; capsules stand out of both, so these may overlap a little.
            demanded = motion.self_clearance_mm if level[shape.link] < ARM_JOINTS.index("wrist_pitch") + 1 else -COVER_MM
            note((shape.link, held.link), between((start, end, radius), grasped, demanded))
    return margins


def touching_links(arm: ArmModel, motion: MotionConfig) -> tuple[tuple[str, str], ...]:
    """Pairs of links, not of neighbouring bodies, that are nearer than what ``motion`` demands in every posture within the joint limits.

    Looked for in random postures, the same ones every time.
    """
    generator = np.random.default_rng(0)
    left: tuple[tuple[str, str], ...] | None = None
    for count in TOUCHING_SAMPLES:  # a few postures settle nearly every pair
        q = generator.uniform(arm.lower_rad, arm.upper_rad, (count, len(arm.lower_rad)))
        margins = {pair: margin for pair, margin in grasp_margins_mm(arm, q, motion).items() if pair[1] != TABLE}
        left = tuple(pair for pair, margin in margins.items() if margin.max() < 0 and (left is None or pair in left))
        if not left:
            break
    return left or ()


def segment_distance(start_1: Array, end_1: Array, start_2: Array, end_2: Array) -> Array:
    """Distance (...) between the segments start-end (..., 3), numpy or torch; exact also for parallel segments and for points."""
    xp = namespace(start_1)
    d1, d2, gap = end_1 - start_1, end_2 - start_2, start_1 - start_2
    a, e, b = _dot(d1, d1), _dot(d2, d2), _dot(d1, d2)
    c, f = _dot(d1, gap), _dot(d2, gap)
    # Nearest points of the two lines, clamped to the first segment, then to the second, then the first once more for that point.
    determinant = a * e - b * b
    skew = determinant > 1e-12 * a * e
    s = xp.where(skew, xp.clip((b * f - c * e) / xp.where(skew, determinant, 1.0), 0.0, 1.0), 0.0)
    t = xp.where(e > 0, xp.clip((b * s + f) / xp.where(e > 0, e, 1.0), 0.0, 1.0), 0.0)
    s = xp.where(a > 0, xp.clip((b * t - c) / xp.where(a > 0, a, 1.0), 0.0, 1.0), 0.0)
    between = gap + s[..., None] * d1 - t[..., None] * d2
    return xp.sqrt(_dot(between, between))


def enclosing_capsule(link: str, shape: Primitive) -> Capsule:
    """The capsule of least volume, among those along the shape's longest axis, that encloses ``shape``."""
    T = transform(shape.xyz_mm, shape.rpy_rad)
    if shape.kind == "sphere":
        half_length, rim, axis = 0.0, 0.0, 2
        radius = shape.size_mm[0]
    else:
        if shape.kind == "box":
            halves = [edge / 2 for edge in shape.size_mm]
            axis = int(np.argmax(halves))
            half_length = halves.pop(axis)
            rim = math.hypot(*halves)
        else:
            rim, half_length, axis = shape.size_mm[0], shape.size_mm[1] / 2, 2
        # Drawing the segment in by s needs a radius of hypot(rim, s) to keep the rim of the end face inside.
        drawn_in = np.linspace(0.0, half_length, 101)
        radii = np.hypot(rim, drawn_in)
        best = int(np.argmin(radii**2 * (2 * (half_length - drawn_in) + 4 / 3 * radii)))
        radius, half_length = float(radii[best]), half_length - float(drawn_in[best])
    ends = [tuple(float(v) for v in T[:3, 3] + sign * half_length * T[:3, axis]) for sign in (-1.0, 1.0)]
    return Capsule(link, ends[0], ends[1], radius)  # type: ignore[arg-type]


def covering_capsules(link: str, shape: Primitive) -> tuple[Capsule, ...]:
    """Capsules that together cover ``shape``: :func:`enclosing_capsule` up to :data:`ONE_CAPSULE_MM`, else parallel ones of one radius."""
    one = enclosing_capsule(link, shape)
    if _excess_mm(one, shape) <= ONE_CAPSULE_MM[shape.kind]:
        return (one,)
    T = transform(shape.xyz_mm, shape.rpy_rad)
    capsules = []
    for centre, halves in _strips(shape):
        axis, across, radius, half_length = _lattice(halves)
        for offset in across:
            ends = [apply(T, centre + offset + sign * half_length * np.eye(3)[axis]) for sign in (-1.0, 1.0)]
            start, end = (tuple(float(value) for value in point) for point in ends)
            capsules.append(Capsule(link, start, end, radius))  # type: ignore[arg-type]
    return tuple(capsules)


def _excess_mm(capsule: Capsule, shape: Primitive) -> float:
    """How far the capsule around a shape stands out of it, across or along."""
    if shape.kind == "sphere":
        return capsule.radius_mm - shape.size_mm[0]
    half_length = math.dist(capsule.start_mm, capsule.end_mm) / 2
    if shape.kind == "cylinder":
        return capsule.radius_mm + max(half_length - shape.size_mm[1] / 2, -shape.size_mm[0])
    thin, _, long = sorted(edge / 2 for edge in shape.size_mm)
    return capsule.radius_mm + max(half_length - long, -thin)


def _strips(shape: Primitive) -> list[tuple[Floats, Floats]]:
    """Centres (3,) and half edges (3,) of the boxes that cover a shape: itself, or strips of a cylinder's round face."""
    if shape.kind == "box":
        return [(np.zeros(3), np.asarray(shape.size_mm) / 2)]
    radius, length = shape.size_mm
    count = min(math.ceil(radius / max(COVER_MM, length / 4)), MOST_CAPSULES)
    half = radius / count
    places = half * (2 * np.arange(count) + 1 - count)
    nearest = np.maximum(np.abs(places) - half, 0.0)
    chords = np.sqrt(radius**2 - nearest**2)
    return [(np.array([0.0, y, 0.0]), np.array([chord, half, length / 2])) for y, chord in zip(places, chords, strict=True)]


def _lattice(halves: Floats) -> tuple[int, Floats, float, float]:
    """The fewest parallel capsules that cover a box closely.

    Args:
        halves: the box's half edges (3,) in mm.

    Returns:
        their axis, their centres (n, 3), their radius, half the length of their segments.
    """
    best: tuple[tuple[float, ...], tuple[int, Floats, float, float]] | None = None
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for first in range(1, MOST_CAPSULES + 1):
            for second in range(1, MOST_CAPSULES // first + 1):
                cell = (halves[others[0]] / first, halves[others[1]] / second)
                rim, thin = math.hypot(*cell), min(cell)
                # Drawn in just so far that the round end stands out by no more than is allowed; the radius grows by it.
                drawn_in = min(max((rim**2 - COVER_MM**2) / (2 * COVER_MM), 0.0), thin, halves[axis])
                radius = math.hypot(rim, drawn_in)
                excess = radius - min(thin, drawn_in)
                rank = (max(excess - COVER_MM, 0.0), first * second, radius)
                if best is None or rank < best[0]:
                    centres = np.zeros((first * second, 3))
                    for column, count, half in zip(others, (first, second), cell, strict=True):
                        places = half * (2 * np.arange(count) + 1 - count)
                        centres[:, column] = np.repeat(places, second) if column == others[0] else np.tile(places, first)
                    best = rank, (axis, centres, radius, halves[axis] - drawn_in)
    assert best is not None
    return best[1]


def block_capsules(block: BlockConfig, grip_to_table_mm: float) -> list[Capsule]:
    """Capsules around the block and its pin in a frame at the grip, z up; they hold for every orientation of the block about the pin."""
    half_side, half_height = block.side_mm / 2, block.height_mm / 2
    corner = half_side * math.sqrt(2)
    turn = math.pi / (2 * SPOKES)
    radius = math.hypot(corner * math.sin(turn), half_height)
    reach = corner * math.cos(turn)
    centre = half_height - grip_to_table_mm
    shapes = []
    for spoke in range(SPOKES):
        x, y = reach * math.cos(spoke * math.pi / SPOKES), reach * math.sin(spoke * math.pi / SPOKES)
        shapes.append(Capsule("block", (-x, -y, centre), (x, y, centre), radius))
    pin = block.pin_diameter_mm / 2
    bottom, top = block.height_mm - grip_to_table_mm, block.pin_top_mm - grip_to_table_mm - pin
    return [*shapes, Capsule("pin", (0.0, 0.0, bottom), (0.0, 0.0, top), pin)]


def _dot(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _lowest_mm(T_base_link: Floats, shape: Primitive) -> Floats:
    """Height (...) of the lowest point of one shape."""
    T = T_base_link @ transform(shape.xyz_mm, shape.rpy_rad)
    up, height = T[..., 2, :3], T[..., 2, 3]  # the base's z axis in the shape's frame
    if shape.kind == "sphere":
        return np.asarray(height - shape.size_mm[0])
    if shape.kind == "box":
        return np.asarray(height - np.abs(up) @ (np.asarray(shape.size_mm) / 2))
    radius, length = shape.size_mm
    return np.asarray(height - np.abs(up[..., 2]) * length / 2 - radius * np.hypot(up[..., 0], up[..., 1]))


@lru_cache(maxsize=8)
def joints_before(description: ArmDescription) -> dict[str, int]:
    """Link name -> number of arm joints between it and the base."""
    bodies = {description.root: 0}
    for joint in description.joints:
        bodies[joint.child] = ARM_JOINTS.index(joint.name) + 1 if joint.name in ARM_JOINTS else bodies[joint.parent]
    return bodies


@lru_cache(maxsize=64)
def base_radius_mm(description: ArmDescription) -> float:
    """Radius in mm of a disc around the base frame's origin that the root link's shapes stay over."""
    root = next(link for link in description.links if link.name == description.root)
    shapes = [capsule for shape in root.collisions for capsule in covering_capsules(root.name, shape)]
    return max((math.hypot(*end[:2]) + shape.radius_mm for shape in shapes for end in (shape.start_mm, shape.end_mm)), default=0.0)


@lru_cache(maxsize=8)
def capsule_pairs(description: ArmDescription) -> tuple[tuple[Capsule, ...], tuple[int, ...], tuple[int, ...]]:
    """All capsules, and the indices of the pairs that belong to bodies which are not neighbours, those ignored left out."""
    bodies = joints_before(description)
    capsules = tuple(capsule for link in description.links for shape in link.collisions for capsule in covering_capsules(link.name, shape))
    order = [bodies[capsule.link] for capsule in capsules]
    pairs = [(i, j) for i in range(len(order)) for j in range(i + 1, len(order)) if abs(order[i] - order[j]) > 1]
    pairs = [(i, j) for i, j in pairs if (capsules[i].link, capsules[j].link) not in description.ignored]
    return capsules, tuple(i for i, _ in pairs), tuple(j for _, j in pairs)
