"""The tree of links and joints of a URDF, and the records of one arm.

URDFs are in metres; everything here is in millimetres and radians. Files that declare a document type or entities are refused, so a URDF
from a stranger can neither read other files nor blow up memory. What is beside links and joints (transmissions, plugins of simulators) is
not looked at.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

from marl_handover.errors import UrdfError, listed, shown
from marl_handover.files import MEGABYTE, read_bounded

ARM_JOINTS = ("base_yaw", "shoulder", "elbow", "wrist_pitch", "wrist_roll")
"""Names of an arm's joints, from the base on; the order of every joint vector."""

Vector = tuple[float, float, float]

_MM = 1000.0
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_NUMBERS = {"xyz", "rpy", "size", "radius", "length", "lower", "upper", "effort", "velocity", "value", "rgba", "scale", *_MOMENTS}
_MOVABLE = ("revolute", "continuous", "prismatic")
_OTHER_FORMATS = {
    "sdf": "this is an SDF; write the arm as a URDF, or take the URDF it was made from",
    "mujoco": "this is an MJCF; take the URDF it was made from",
    "COLLADA": "this is a mesh, not a robot",
}

_MOST_FOLDERS = 6
MOST_ELEMENTS, LARGEST, LARGEST_LIMIT = 1000, 1e6, 1e20
"""What a file may have: so many links and joints, and no number beyond, whatever its unit; limits may be as good as none."""


@dataclass(frozen=True)
class Primitive:
    """A collision shape in its link's frame.

    ``size_mm`` holds a box's three edge lengths, a cylinder's (radius, length along its z axis) or a sphere's (radius,).
    """

    kind: str
    size_mm: tuple[float, ...]
    xyz_mm: Vector
    rpy_rad: Vector


@dataclass(frozen=True)
class Mesh:
    """A shape in a file of its own, in its link's frame; the file need not be there. ``scale``: of its units to metres."""

    path: Path
    scale: Vector
    xyz_mm: Vector
    rpy_rad: Vector


@dataclass(frozen=True)
class Visual:
    """What a link looks like. ``rgba``: 0 to 1 each; None where the file does not say."""

    shape: Primitive | Mesh
    rgba: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Inertial:
    """Mass [kg], centre of mass, and the moments ixx, ixy, ixz, iyy, iyz, izz [kg m^2] about it in the frame that ``rpy_rad`` turns."""

    mass_kg: float
    xyz_mm: Vector
    rpy_rad: Vector
    inertia_kg_m2: tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Link:
    """A rigid link: its collision shapes, those that are meshes apart, what it looks like and what it weighs.

    ``file_xyz_mm`` and ``file_rpy_rad``: where the frame is, in this one, that the URDF gives the link.
    """

    name: str
    collisions: tuple[Primitive, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    visuals: tuple[Visual, ...] = ()
    inertial: Inertial | None = None
    file_xyz_mm: Vector = (0.0, 0.0, 0.0)
    file_rpy_rad: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another: its value is ``multiplier`` times that one's, and ``offset`` (rad or mm)."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Joint:
    """A joint; its frame is the child link's frame at zero.

    ``lower`` and ``upper`` are in rad (revolute) or mm (prismatic), ``velocity`` in rad/s or mm/s, ``effort`` in N m or N. Fixed: all 0.
    A continuous one turns from -pi to pi.
    """

    name: str
    kind: str
    parent: str
    child: str
    xyz_mm: Vector
    rpy_rad: Vector
    axis: Vector
    lower: float = 0.0
    upper: float = 0.0
    effort: float = 0.0
    velocity: float = 0.0
    mimic: Mimic | None = None


@dataclass(frozen=True)
class UrdfTree:
    """What a URDF says: its links, and its joints sorted, each after the one that carries its parent link.

    ``assumed``: what was left out, in words.
    """

    path: Path
    name: str
    root: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    assumed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Gripper:
    """How a hand opens.

    Attributes:
        kind: ``fingers``, which slide; ``jaw``, which is hinged; ``none``: things stick to the grip.
        joints: those that move with it.
        closed: where each of them is when the hand is closed, mm or rad.
        opening: what each changes by as a pad slides by 1 mm, or the hinge turns by 1 rad, to open.
        pads: how many pads move: 2, or 1 opposite a fixed one, which then goes twice as far.
        lever_mm: of a jaw, from its hinge to its pad.
        travel_mm: how far each pad can be from where it is when the hand is closed; of a single one half of its way.
    """

    kind: str = "none"
    joints: tuple[str, ...] = ()
    closed: tuple[float, ...] = ()
    opening: tuple[float, ...] = ()
    pads: int = 2
    lever_mm: float = 0.0
    travel_mm: float = 0.0

    def joint_values(self, gripper_mm: float | None) -> dict[str, float]:
        """Joint -> value, mm or rad, with each pad ``gripper_mm`` from where it is when the hand is closed; None: fully open."""
        if not self.joints:
            return {}
        pad_mm = (self.travel_mm if gripper_mm is None else min(gripper_mm, self.travel_mm)) * (2 if self.pads == 1 else 1)
        moved = pad_mm if self.kind == "fingers" else 2 * math.asin(min(max(pad_mm / (2 * self.lever_mm), -1.0), 1.0))
        return {name: at + rate * moved for name, at, rate in zip(self.joints, self.closed, self.opening, strict=True)}

    def gripper_mm(self, values: Sequence[float]) -> float:
        """How far each pad is from where it is when the hand is closed, on average, for values of the :attr:`joints`."""
        moved = [(value - at) / rate for value, at, rate in zip(values, self.closed, self.opening, strict=True)]
        if not moved:
            return 0.0
        mean = sum(moved) / len(moved)
        return (mean if self.kind == "fingers" else 2 * self.lever_mm * math.sin(mean / 2)) / (2 if self.pads == 1 else 1)


@dataclass(frozen=True)
class JointSource:
    """The joint of the URDF that plays a role: its value is ``sign * q + offset_rad``. ``joint`` None: the arm has none, and q is 0."""

    joint: str | None
    sign: int = 1
    offset_rad: float = 0.0


@dataclass(frozen=True)
class ArmDescription:
    """One arm. ``joints`` are sorted: each comes after the one that carries its parent link.

    Attributes:
        sources: of each of :data:`ARM_JOINTS`, the URDF's joint.
        locked: the URDF's joints that are held, each with its angle in rad.
        tip: the URDF's link by which the grip was found; empty where it was guessed otherwise.
        assumed: what the file does not say, and was taken to be so; in words.
        ignored: pairs of links that touch in every posture, such as shells of one housing; nobody asks how far they are apart.
    """

    path: Path
    name: str
    root: str
    grasp_link: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    gripper: Gripper = Gripper()
    sources: tuple[JointSource, ...] = tuple(JointSource(name) for name in ARM_JOINTS)
    locked: tuple[tuple[str, float], ...] = ()
    tip: str = ""
    assumed: tuple[str, ...] = ()
    ignored: tuple[tuple[str, str], ...] = ()

    def joint(self, name: str) -> Joint:
        """The joint of this name. Raises :class:`UrdfError` if there is none."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise UrdfError(self.path, f"joint {name!r} is missing; it has: {', '.join(joint.name for joint in self.joints)}")

    def chain(self) -> tuple[Joint, ...]:
        """The joints, fixed ones too, on the way from the root to the grasp link."""
        carrying = {joint.child: joint for joint in self.joints}
        link, chain = self.grasp_link, []
        while link != self.root:
            chain.append(carrying[link])
            link = carrying[link].parent
        return tuple(reversed(chain))


def read_urdf(path: Path | str) -> UrdfTree:
    """Read the URDF at ``path``.

    Raises :class:`MissingFile` if there is no such file, and :class:`UrdfError`, which names the fault, for anything wrong with it.
    """
    path = Path(path)
    robot = _parse(path)
    if len(robot) > MOST_ELEMENTS:
        _fail(path, f"it has {len(robot)} links and joints; it may have {MOST_ELEMENTS}")
    found = {tag: robot.findall(tag) for tag in ("link", "joint")}
    _refuse_non_finite(path, found["link"] + found["joint"])
    colours = {e.get("name", ""): rgba for e in robot.findall("material") if (rgba := _rgba(path, e)) is not None}
    links = tuple(_link(path, element, colours) for element in found["link"])
    joints = tuple(_joint(path, element) for element in found["joint"])
    _refuse_duplicates(path, "link", [link.name for link in links])
    _refuse_duplicates(path, "joint", [joint.name for joint in joints])
    _refuse_strange_mimics(path, joints)
    root, joints = _sort_tree(path, [link.name for link in links], joints)
    there = {root, *(joint.child for joint in joints)}
    links, assumed = _without_points([link for link in links if link.name in there])
    return UrdfTree(path, robot.get("name") or path.stem, root, links, joints, assumed)


def _without_points(links: Sequence[Link]) -> tuple[tuple[Link, ...], tuple[str, ...]]:
    """The links without collision shapes of size 0, which stand for none; and whose these were, in words."""
    solid = [replace(link, collisions=tuple(shape for shape in link.collisions if any(shape.size_mm))) for link in links]
    lost = [link.name for link, left in zip(links, solid, strict=True) if len(left.collisions) < len(link.collisions)]
    return tuple(solid), (f"shapes of size 0 are none: those of {listed(lost, 80)}",) if lost else ()


def _fail(path: Path, problem: str) -> NoReturn:
    raise UrdfError(path, problem)


def _parse(path: Path) -> ET.Element:
    # Decoding first keeps another encoding from hiding a declaration from the check below.
    try:
        text = read_bounded(path, 16 * MEGABYTE, "URDF").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UrdfError(path, "is not UTF-8 text") from None
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        _fail(path, "declares a DOCTYPE or an entity, which is refused; remove the declaration")
    if marker := re.search(r"^(<{7}|>{7})( |$)", text, re.MULTILINE):
        line = text.count("\n", 0, marker.start()) + 1
        _fail(path, f"line {line} is a marker of an unfinished merge ({marker[1]}); finish the merge")
    xacro = f"it is a xacro file; run xacro first: xacro {path.name} > {path.name.partition('.')[0]}.urdf"
    try:
        robot = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        problem = xacro if re.search(r"<xacro:", text) else f"malformed XML: {error}"
        raise UrdfError(path, problem) from None
    if robot.tag != "robot":
        _fail(path, f"its outermost element is <{robot.tag[:40]}>; it must be <robot>" + _hint(_OTHER_FORMATS.get(robot.tag, "")))
    parts = [part for tag in ("link", "joint") for part in robot.findall(tag)]
    commands = any("xacro" in each.tag and not each.tag.endswith(("property", "arg")) for each in robot.iter())
    if commands or any("${" in value for part in parts for each in part.iter() for value in each.attrib.values()):
        _fail(path, xacro)
    return robot


def _hint(text: str) -> str:
    return f": {text}" if text else ""


def _refuse_non_finite(path: Path, parts: list[ET.Element]) -> None:
    for part in parts:
        for element in part.iter():
            for name in _NUMBERS.intersection(element.attrib):
                _numbers(path, element, name)


def _refuse_duplicates(path: Path, what: str, names: list[str]) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            _fail(path, f"{what} {name!r} is there {count} times; names must be unique")


def _refuse_strange_mimics(path: Path, joints: tuple[Joint, ...]) -> None:
    followed = {joint.name: joint.mimic.joint if joint.mimic else None for joint in joints}
    for joint in joints:
        leader, seen = followed[joint.name], {joint.name}
        while leader is not None:
            if leader not in followed:
                _fail(path, f"joint {joint.name!r} mimics joint {leader!r}, which is missing")
            if leader in seen:
                _fail(path, f"joint {joint.name!r} mimics itself, by way of {leader!r}")
            seen.add(leader)
            leader = followed[leader]


def _attribute(path: Path, element: ET.Element | None, name: str, where: str) -> str:
    value = None if element is None else element.get(name)
    if value is None:
        _fail(path, f"{where} lacks its {name!r}")
    return value


def _numbers(path: Path, element: ET.Element, name: str) -> tuple[float, ...]:
    text = element.get(name, "")
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        raise UrdfError(path, f"<{element.tag} {name}={shown(text, 60)}> is not a number") from None
    if not values or not all(math.isfinite(value) for value in values):
        _fail(path, f"<{element.tag} {name}={shown(text, 60)}>: every number must be finite")
    largest = LARGEST_LIMIT if element.tag == "limit" else LARGEST
    if any(abs(value) > largest for value in values):
        _fail(path, f"<{element.tag} {name}={shown(text, 60)}>: no number may be beyond {largest:g}")
    return values


def _scalar(path: Path, element: ET.Element | None, name: str, where: str, default: float | None = None) -> float:
    if default is not None and (element is None or element.get(name) is None):
        return default
    _attribute(path, element, name, where)
    assert element is not None
    values = _numbers(path, element, name)
    if len(values) != 1:
        _fail(path, f"{where}: {name} has {len(values)} numbers; it must have 1")
    return values[0]


def _vector(path: Path, element: ET.Element | None, name: str, default: Vector, scale: float = 1.0) -> Vector:
    if element is None or element.get(name) is None:
        return default
    values = _numbers(path, element, name)
    if len(values) != 3:
        _fail(path, f"<{element.tag} {name}> has {len(values)} numbers; it must have 3")
    return (values[0] * scale, values[1] * scale, values[2] * scale)


def _origin(path: Path, element: ET.Element) -> tuple[Vector, Vector]:
    origin = element.find("origin")
    zero = (0.0, 0.0, 0.0)
    return _vector(path, origin, "xyz", zero, _MM), _vector(path, origin, "rpy", zero)


def _rgba(path: Path, material: ET.Element | None) -> tuple[float, float, float, float] | None:
    colour = None if material is None else material.find("color")
    if colour is None or colour.get("rgba") is None:
        return None
    values = _numbers(path, colour, "rgba")
    return (values[0], values[1], values[2], values[3]) if len(values) == 4 else None


def _link(path: Path, element: ET.Element, colours: dict[str, tuple[float, float, float, float]]) -> Link:
    name = _attribute(path, element, "name", "a link")
    where = f"link {name!r}"
    solid = [_shape(path, where, each) for each in element.findall("collision")]
    visuals = []
    for each in element.findall("visual"):
        material = each.find("material")
        named = None if material is None else colours.get(material.get("name", ""))
        visuals.append(Visual(_shape(path, where, each), _rgba(path, material) or named))
    primitives = tuple(shape for shape in solid if isinstance(shape, Primitive))
    meshes = tuple(shape for shape in solid if isinstance(shape, Mesh))
    return Link(name, primitives, meshes, tuple(visuals), _inertial(path, where, element.find("inertial")))


def _shape(path: Path, where: str, element: ET.Element) -> Primitive | Mesh:
    """The shape of a ``<collision>`` or a ``<visual>``."""
    geometry = element.find("geometry")
    shape = None if geometry is None else next(iter(geometry), None)
    size: tuple[float, ...]
    if shape is not None and shape.tag == "mesh":
        file = mesh_path(path, _attribute(path, shape, "filename", f"a mesh of {where}"))
        return Mesh(file, _vector(path, shape, "scale", (1.0, 1.0, 1.0)), *_origin(path, element))
    if shape is not None and shape.tag == "box":
        _attribute(path, shape, "size", where)
        size = _vector(path, shape, "size", (0.0, 0.0, 0.0), _MM)
    elif shape is not None and shape.tag in ("cylinder", "capsule"):
        size = tuple(_MM * _scalar(path, shape, name, where) for name in ("radius", "length"))
    elif shape is not None and shape.tag == "sphere":
        size = (_MM * _scalar(path, shape, "radius", where),)
    else:
        found = f"no {element.tag} shape" if shape is None else f"the {element.tag} shape <{shape.tag}>"
        _fail(path, f"{where} has {found}; only box, cylinder, sphere and mesh are supported")
    if min(size) <= 0 and any(size) and element.tag == "collision":
        _fail(path, f"{where} has a <{shape.tag}> with a size that is not above 0")
    return Primitive("cylinder" if shape.tag == "capsule" else shape.tag, size, *_origin(path, element))


def mesh_path(urdf: Path, filename: str) -> Path:
    """The file that a URDF names: beside it, or, of ``package://NAME/...``, in the folder that holds the URDF and is called NAME.

    A package that is none of these folders is looked for beside each of them. The file need not be there.
    """
    scheme, colon, rest = filename.partition("://")
    if not colon:
        return urdf.parent / filename
    if scheme == "file":
        return Path(rest)
    package, _, inside = rest.partition("/")
    folders = list(urdf.absolute().parents)[:_MOST_FOLDERS]
    places = [folder / inside for folder in folders if folder.name == package] + [folder / package / inside for folder in folders]
    return next((place for place in [*places, urdf.parent / inside] if place.is_file()), urdf.parent / inside)


def mesh_files(urdf: Path) -> dict[str, Path]:
    """Names of all meshes as a URDF writes them, and the files that they mean. Raises as :func:`read_urdf` does."""
    names = {mesh.get("filename", "") for mesh in _parse(urdf).iter("mesh")}
    return {name: mesh_path(urdf, name) for name in sorted(names - {""})}


def _inertial(path: Path, where: str, element: ET.Element | None) -> Inertial | None:
    if element is None:
        return None
    mass = _scalar(path, element.find("mass"), "value", f"the mass of {where}", 0.0)
    if mass < 0:
        _fail(path, f"{where} has a mass of {mass:g} kg; it cannot be below 0")
    inertia = element.find("inertia")
    moments = [_scalar(path, inertia, name, f"the inertia of {where}", 0.0) for name in _MOMENTS]
    return Inertial(mass, *_origin(path, element), (moments[0], moments[1], moments[2], moments[3], moments[4], moments[5]))


def _joint(path: Path, element: ET.Element) -> Joint:
    name = _attribute(path, element, "name", "a joint")
    where = f"joint {name!r}"
    kind = _attribute(path, element, "type", where)
    parent = _attribute(path, element.find("parent"), "link", f"{where}: its parent")
    child = _attribute(path, element.find("child"), "link", f"{where}: its child")
    if kind not in (*_MOVABLE, "fixed"):
        _fail(path, f"{where} has type {shown(kind, 40)}; only fixed, {', '.join(_MOVABLE)} are supported")
    xyz_mm, rpy_rad = _origin(path, element)
    axis = _vector(path, element.find("axis"), "xyz", (1.0, 0.0, 0.0))
    if kind == "fixed":
        return Joint(name, kind, parent, child, xyz_mm, rpy_rad, axis)
    length = math.hypot(*axis)
    if length < 1e-9:
        _fail(path, f"{where} has an axis of length 0")
    unit = (axis[0] / length, axis[1] / length, axis[2] / length)
    return Joint(name, kind, parent, child, xyz_mm, rpy_rad, unit, *_limits(path, element, where, kind), _mimic(path, element, where, kind))


def _limits(path: Path, element: ET.Element, where: str, kind: str) -> tuple[float, float, float, float]:
    """Lower, upper, effort and velocity. A continuous joint needs no limits; where it has none, effort and velocity are infinite."""
    limit = element.find("limit")
    if limit is None and kind == "continuous":
        return -math.pi, math.pi, math.inf, math.inf
    if limit is None:
        _fail(path, f"{where} lacks its <limit>; every moving joint needs lower, upper, effort and velocity")
    scale, about = _MM if kind == "prismatic" else 1.0, f"the <limit> of {where}"
    lower, upper = (
        (-math.pi, math.pi) if kind == "continuous" else (scale * _scalar(path, limit, key, about, 0.0) for key in ("lower", "upper"))
    )
    effort, velocity = _scalar(path, limit, "effort", about), scale * _scalar(path, limit, "velocity", about)
    if lower > upper and element.find("mimic") is None:  # what mimics another has its limits from that one
        _fail(path, f"{where} has a lower limit above its upper limit")
    for what, value in (("effort", effort), ("velocity", velocity)):
        if value < 0:
            _fail(path, f"{where} has {what} {value:g} in its <limit>; it must be above 0")
    return lower, upper, effort, velocity


def _mimic(path: Path, element: ET.Element, where: str, kind: str) -> Mimic | None:
    mimic = element.find("mimic")
    if mimic is None:
        return None
    leader = _attribute(path, mimic, "joint", f"the <mimic> of {where}")
    multiplier, offset = (
        _scalar(path, mimic, key, f"the <mimic> of {where}", value) for key, value in (("multiplier", 1.0), ("offset", 0.0))
    )
    return Mimic(leader, multiplier, offset * (_MM if kind == "prismatic" else 1.0))


def _sort_tree(path: Path, links: list[str], joints: tuple[Joint, ...]) -> tuple[str, tuple[Joint, ...]]:
    """The root link, and the joints with every parent before its children. Links that nothing joins to any other are left out."""
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                _fail(path, f"joint {joint.name!r} names link {link!r}, which is missing")
    if not links:
        _fail(path, "it has no links")
    for child, count in Counter(joint.child for joint in joints).items():
        if count > 1:
            _fail(
                path,
                f"child link {child!r} is there {count} times: it closes a loop; cut the loop, so that every link has one joint above it",
            )
    parents = {joint.parent for joint in joints}
    roots = sorted(set(links) - {joint.child for joint in joints})
    roots = [root for root in roots if root in parents] or roots
    if not roots:
        _fail(path, f"joint {joints[0].name!r} is part of a loop")
    if len(roots) != 1:
        _fail(path, f"it has {len(roots)} links without a parent ({listed(roots, 80)}); it must have 1")
    placed, waiting, ordered = {roots[0]}, list(joints), []
    while waiting:
        ready = [joint for joint in waiting if joint.parent in placed]
        if not ready:
            _fail(path, f"joint {waiting[0].name!r} is part of a loop")
        ordered += ready
        placed.update(joint.child for joint in ready)
        waiting = [joint for joint in waiting if joint not in ready]
    return roots[0], tuple(ordered)
