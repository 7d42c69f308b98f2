"""The URDF that physics loads of an arm: its file as it stands where that is canonical and whole, else one written from the description."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS, ArmDescription, Inertial, Joint, Link, Mesh, Primitive, Vector, read_urdf

DENSITY_KG_MM3, LEAST_KG = 700e-9, 2e-3
"""Of links whose URDF says no mass: a servo in its bracket, its box counted full; and what a link without a shape weighs."""

_AROUND_MM = 10.0  # radius of a ball whose moments a link without a shape gets
GREY = (0.7, 0.72, 0.75, 1.0)


@lru_cache(maxsize=16)
def whole(description: ArmDescription) -> ArmDescription:
    """The description with a mass and moments for every link; what was made up is added to ``assumed``."""
    links, assumed = [], []
    for link in description.links:
        inertial, made_up = _inertial(link)
        links.append(replace(link, inertial=inertial))
        if made_up and inertial.mass_kg > LEAST_KG and link.name != description.root:
            assumed.append(f"{link.name} {1e3 * inertial.mass_kg:.0f} g")
    if not assumed:
        return replace(description, links=tuple(links))
    words = f"masses the URDF does not say: {', '.join(assumed)}"
    return replace(description, links=tuple(links), assumed=(*description.assumed, words))


@contextmanager
def arm_file(description: ArmDescription) -> Iterator[Path]:
    """A file to load the arm from; a written one is there until the block ends."""
    if is_canonical(description):
        yield description.path
        return
    with tempfile.TemporaryDirectory(prefix="marl-handover-arm-") as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(written(whole(description)), encoding="utf-8")
        yield path


@lru_cache(maxsize=16)
def is_canonical(description: ArmDescription) -> bool:
    """Whether the URDF itself says all that the description does, in the same frames, with a mass for every link and without meshes."""
    tree = read_urdf(description.path)
    if tree.links != description.links or tree.joints != description.joints:
        return False
    return not any(link.meshes or _made_up(link) or any(isinstance(visual.shape, Mesh) for visual in link.visuals) for link in tree.links)


def written(description: ArmDescription) -> str:
    """The URDF of a description in which every link has an inertial."""
    parts = [_link(link) for link in description.links]
    parts += [_joint(description, joint) for joint in description.joints]
    return "\n".join([f"<robot name={quoteattr(description.name)}>", *parts, "</robot>"])


def _made_up(link: Link) -> bool:
    inertial = link.inertial
    return inertial is None or inertial.mass_kg <= 0.0 or min(inertial.inertia_kg_m2[k] for k in (0, 3, 5)) <= 0.0


def _inertial(link: Link) -> tuple[Inertial, bool]:
    """Mass and moments of a link, and whether the mass had to be made up."""
    said = link.inertial
    if said is not None and not _made_up(link):
        return said, False
    boxes = [(_box_mm(shape), transform(shape.xyz_mm, shape.rpy_rad)) for shape in link.collisions]
    volumes = [math.prod(box) for box, _ in boxes]
    told = said is not None and said.mass_kg > 0.0
    mass = said.mass_kg if said is not None and told else max(DENSITY_KG_MM3 * sum(volumes), LEAST_KG)
    if not boxes:
        moment = 0.4 * mass * (1e-3 * _AROUND_MM) ** 2
        at, turned = (said.xyz_mm, said.rpy_rad) if said is not None else ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        return Inertial(mass, at, turned, (moment, 0.0, 0.0, moment, 0.0, moment)), not told
    centre = sum(volume * T[:3, 3] for volume, (_, T) in zip(volumes, boxes, strict=True)) / sum(volumes)
    tensor = np.zeros((3, 3))
    for volume, (box, T) in zip(volumes, boxes, strict=True):
        share, sides, gap = mass * volume / sum(volumes), np.square(box), T[:3, 3] - centre
        own = share / 12 * np.diag(sides.sum() - sides)
        tensor += T[:3, :3] @ own @ T[:3, :3].T + share * (float(gap @ gap) * np.eye(3) - np.outer(gap, gap))
    tensor *= 1e-6
    moments = tuple(float(tensor[row, column]) for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return Inertial(mass, _vector(centre), (0.0, 0.0, 0.0), moments), not told  # type: ignore[arg-type]


def _box_mm(shape: Primitive) -> tuple[float, float, float]:
    """The sides of a box around a shape, in its frame."""
    if shape.kind == "box":
        return shape.size_mm[0], shape.size_mm[1], shape.size_mm[2]
    across = 2 * shape.size_mm[0]
    return across, across, shape.size_mm[1] if shape.kind == "cylinder" else across


def _link(link: Link) -> str:
    assert link.inertial is not None
    moments = " ".join(
        f'{name}="{value!r}"' for name, value in zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), link.inertial.inertia_kg_m2, strict=True)
    )
    origin = _origin(link.inertial.xyz_mm, link.inertial.rpy_rad)
    parts = [f'<inertial>{origin}<mass value="{link.inertial.mass_kg!r}"/><inertia {moments}/></inertial>']
    seen = [visual for visual in link.visuals if not isinstance(visual.shape, Mesh) or visual.shape.path.is_file()]
    for visual in seen:
        parts.append(_shape("visual", visual.shape, visual.rgba or GREY))
    for shape in link.collisions:
        if not seen:
            parts.append(_shape("visual", shape, GREY))
        parts.append(_shape("collision", shape))
    return f"<link name={quoteattr(link.name)}>{''.join(parts)}</link>"


def _shape(tag: str, shape: Primitive | Mesh, rgba: tuple[float, float, float, float] | None = None) -> str:
    if isinstance(shape, Mesh):
        scale = " ".join(repr(float(value)) for value in shape.scale)
        geometry = f'<mesh filename={quoteattr(str(shape.path.absolute()))} scale="{scale}"/>'
    elif shape.kind == "box":
        geometry = f'<box size="{_metres(shape.size_mm)}"/>'
    elif shape.kind == "sphere":
        geometry = f'<sphere radius="{_metres(shape.size_mm)}"/>'
    else:
        geometry = f'<cylinder radius="{_metres(shape.size_mm[:1])}" length="{_metres(shape.size_mm[1:2])}"/>'
    colour = "" if rgba is None else f'<material name="{_colour_name(rgba)}"><color rgba="{" ".join(map(repr, rgba))}"/></material>'
    return f"<{tag}>{_origin(shape.xyz_mm, shape.rpy_rad)}<geometry>{geometry}</geometry>{colour}</{tag}>"


def _colour_name(rgba: tuple[float, float, float, float]) -> str:
    return "_".join(f"{value:.4f}" for value in rgba)


def mounted(description: ArmDescription, joint: Joint) -> Joint:
    """An arm's joint and its gripper's as they are; what else might move is fixed where it is."""
    missing = {role for role, source in zip(ARM_JOINTS, description.sources, strict=True) if source.joint is None}
    if joint.name in description.gripper.joints or (joint.name in ARM_JOINTS and joint.name not in missing):
        return replace(joint, kind="revolute") if joint.kind == "continuous" else joint
    xyz_mm = joint.xyz_mm
    if joint.kind == "prismatic" and joint.lower:
        xyz_mm = _vector((transform(joint.xyz_mm, joint.rpy_rad) @ np.append(joint.lower * np.asarray(joint.axis), 1.0))[:3])
    return replace(joint, kind="fixed", xyz_mm=xyz_mm)


def _joint(description: ArmDescription, joint: Joint) -> str:
    joint = mounted(description, joint)
    ends = f"<parent link={quoteattr(joint.parent)}/><child link={quoteattr(joint.child)}/>{_origin(joint.xyz_mm, joint.rpy_rad)}"
    if joint.kind == "fixed":
        return f'<joint name={quoteattr(joint.name)} type="fixed">{ends}</joint>'
    scale = 1e-3 if joint.kind == "prismatic" else 1.0
    limits = f'lower="{scale * joint.lower!r}" upper="{scale * joint.upper!r}"'
    limits += f' effort="{joint.effort!r}" velocity="{scale * joint.velocity!r}"'
    axis = " ".join(repr(float(value)) for value in joint.axis)
    return f'<joint name={quoteattr(joint.name)} type="{joint.kind}">{ends}<axis xyz="{axis}"/><limit {limits}/></joint>'


def _origin(xyz_mm: Vector, rpy_rad: Vector) -> str:
    return f'<origin xyz="{_metres(xyz_mm)}" rpy="{" ".join(repr(float(value)) for value in rpy_rad)}"/>'


def _metres(values_mm: tuple[float, ...]) -> str:
    return " ".join(repr(float(value) / 1000.0) for value in values_mm)


def _vector(values: np.ndarray) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
