"""The solid shapes of an arm's links: those of its file, capsules along its links, or none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.errors import UrdfError
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.meshes import mesh_boxes
from marl_handover.geometry.urdf import ArmDescription, Link, Mesh, Primitive

RADIUS_SHARE, LEAST_RADIUS_MM, MOST_RADIUS_MM = 0.12, 8.0, 40.0
"""Shapes along links are as thick as a small arm's: their radius is this share of the mean of upper arm and forearm, within bounds."""

FINGER_MM, FINGER_RADIUS_MM = 30.0, 4.0
"""How long fingers are before the grip, and how thick."""

MOST_SHAPES = 200


def with_shapes(arm: ClosedFormArm, shapes: str) -> ArmDescription:
    """The arm's description with the collision shapes that ``shapes`` asks for, as boxes, cylinders and spheres; notes say what was done.

    Raises:
        MissingFile, CorruptFile, MissingExtra: with ``shapes`` "file", of a mesh that is not there, or is none.
        UrdfError: for more shapes than an arm may have.
    """
    description = arm.description
    if shapes == "file":
        return _of_file(description)
    bare = tuple(replace(link, collisions=(), meshes=()) for link in description.links)
    if shapes == "none":
        return replace(description, links=bare, assumed=(*description.assumed, "shapes: none, so that nothing collides"))
    along, radius = _along_links(arm)
    links = tuple(replace(link, collisions=along.get(link.name, ())) for link in bare)
    note = f"shapes: capsules of radius {radius:.3g} mm along the links, a column under the shoulder"
    return replace(description, links=links, assumed=(*description.assumed, note))


def _of_file(description: ArmDescription) -> ArmDescription:
    links, notes = [], []
    has_shapes = any(link.collisions or link.meshes for link in description.links)  # else it is asked for them, where they are needed
    for link in description.links:
        if link.collisions and not link.meshes:
            links.append(link)
            continue
        solid: Sequence[Primitive | Mesh] = (*link.collisions, *link.meshes)
        if not solid and link.visuals and has_shapes:
            solid = [visual.shape for visual in link.visuals]
            notes.append(f"shapes: link {link.name!r} has no collision shape; what it looks like is taken")
        if solid:
            boxed, said = _boxed(link, solid)
            notes += said
            link = replace(link, collisions=boxed, meshes=())
        links.append(link)
    count = sum(len(link.collisions) for link in links)
    if count > MOST_SHAPES:
        raise UrdfError(description.path, f"it has {count} collision shapes; it may have {MOST_SHAPES}; set shapes=links")
    if not notes and tuple(links) == description.links:
        return description
    return replace(description, links=tuple(links), assumed=(*description.assumed, *notes))


def _boxed(link: Link, shapes: Sequence[Primitive | Mesh]) -> tuple[tuple[Primitive, ...], list[str]]:
    """Shapes of a link, its meshes as boxes, and what to say of them."""
    boxed: list[Primitive] = []
    notes = []
    for shape in shapes:
        if isinstance(shape, Primitive):
            boxed.append(shape)
            continue
        boxes, watertight = mesh_boxes(shape, link.name)
        boxed += boxes
        count = f"{len(boxes)} boxes" if len(boxes) > 1 else "a box"
        notes.append(f"shapes: mesh {shape.path.name} of link {link.name!r} as {count}" + ("" if watertight else "; it is not watertight"))
    return tuple(boxed), notes


def _along_links(arm: ClosedFormArm) -> tuple[dict[str, tuple[Primitive, ...]], float]:
    """Cylinders along the links, by the name of the link that they belong to, and their radius in mm."""
    description = arm.description
    upper, fore = math.hypot(*arm.upper_arm_mm), math.hypot(*arm.forearm_mm)
    radius = float(np.clip(RADIUS_SHARE * (upper + fore) / 2, LEAST_RADIUS_MM, MOST_RADIUS_MM))
    shoulder, elbow, wrist = (np.array([at[0], 0.0, at[1]]) for at in _pivots(arm))
    grip = arm.fk(np.zeros(5))[:3, 3]
    ahead = np.asarray(description.joint("wrist_roll").axis)
    finger_mm = min(FINGER_MM, 0.5 * float(np.linalg.norm(grip - wrist))) if description.gripper.joints else 0.0
    palm = np.asarray(grip - finger_mm * ahead, float)
    top = np.array([0.0, 0.0, shoulder[2] / 2])
    child = {role: description.joint(role).child for role in ("base_yaw", "shoulder", "elbow", "wrist_pitch")}
    hand = description.joint("wrist_roll").child
    spans: list[tuple[str, Floats, Floats, float]] = [
        (description.root, np.zeros(3), top, 1.5 * radius),
        (child["base_yaw"], top, shoulder, radius),
        (child["shoulder"], shoulder, elbow, radius),
        (child["elbow"], elbow, wrist, radius),
        (child["wrist_pitch"], wrist, palm, 0.75 * radius),
    ]
    if finger_mm:
        aside = np.array([0.0, min(description.gripper.travel_mm, 3 * radius) + FINGER_RADIUS_MM, 0.0])
        spans += [(hand, palm + side * aside, grip + side * aside, FINGER_RADIUS_MM) for side in (1.0, -1.0)]
    frames = arm.link_transforms(np.zeros(5))
    shapes: dict[str, tuple[Primitive, ...]] = {}
    for link, start, end, thick in spans:
        made = _cylinder(np.linalg.inv(frames[link]), start, end, thick)
        shapes[link] = (*shapes.get(link, ()), *made)
    return shapes, radius


def _pivots(arm: ClosedFormArm) -> tuple[Floats, Floats, Floats]:
    """Shoulder, elbow and wrist in the arm's plane at zero."""
    elbow = arm.shoulder_mm + arm.upper_arm_mm
    return arm.shoulder_mm, elbow, elbow + arm.forearm_mm


def _cylinder(T_link_base: NDArray[Any], start: Floats, end: Floats, radius_mm: float) -> tuple[Primitive, ...]:
    """A cylinder between two points of the base frame at zero, in its link's frame, drawn in so that its capsule ends at them."""
    start, end = (T_link_base[:3, :3] @ point + T_link_base[:3, 3] for point in (start, end))
    length = float(np.linalg.norm(end - start))
    if length < 1e-6:
        return ()
    ahead, middle = (end - start) / length, (start + end) / 2
    turn = (0.0, math.atan2(math.hypot(ahead[0], ahead[1]), ahead[2]), math.atan2(ahead[1], ahead[0]))
    size = (radius_mm, max(length - radius_mm, 0.5 * length))
    return (Primitive("cylinder", size, (float(middle[0]), float(middle[1]), float(middle[2])), turn),)
