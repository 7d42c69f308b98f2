"""How far an arm's links stay from the ground and from each other.

Ground clearance is exact for the URDF's shapes. Self clearance uses capsules that enclose the shapes, so it errs on the safe side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Array, namespace
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.closed_form import Floats
from marl_handover.geometry.se3 import apply, transform
from marl_handover.geometry.urdf import ARM_JOINTS, ArmDescription, Primitive


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


def base_radius_mm(description: ArmDescription) -> float:
    """Radius in mm of a disc around the base frame's origin that the root link's shapes stay over."""
    root = next(link for link in description.links if link.name == description.root)
    shapes = [enclosing_capsule(root.name, shape) for shape in root.collisions]
    return max((math.hypot(*end[:2]) + shape.radius_mm for shape in shapes for end in (shape.start_mm, shape.end_mm)), default=0.0)


@lru_cache(maxsize=8)
def capsule_pairs(description: ArmDescription) -> tuple[tuple[Capsule, ...], tuple[int, ...], tuple[int, ...]]:
    """All capsules, and the indices of the pairs that belong to bodies which are not neighbours."""
    bodies = joints_before(description)
    capsules = tuple(enclosing_capsule(link.name, shape) for link in description.links for shape in link.collisions)
    order = [bodies[capsule.link] for capsule in capsules]
    pairs = [(i, j) for i in range(len(order)) for j in range(i + 1, len(order)) if abs(order[i] - order[j]) > 1]
    return capsules, tuple(i for i, _ in pairs), tuple(j for _, j in pairs)
