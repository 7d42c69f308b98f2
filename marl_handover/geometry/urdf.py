"""Read one arm from a URDF made of primitive shapes.

URDFs are in metres; everything here is in millimetres and radians. Files that declare a document type or entities are refused, so a URDF
from a stranger can neither read other files nor blow up memory.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from marl_handover.errors import UrdfError
from marl_handover.files import MEGABYTE, read_bounded

ARM_JOINTS = ("base_yaw", "shoulder", "elbow", "wrist_pitch", "wrist_roll")
"""Names of an arm's joints, from the base on; the order of every joint vector."""

Vector = tuple[float, float, float]

_MM = 1000.0
_NUMBERS = {"xyz", "rpy", "size", "radius", "length", "lower", "upper", "effort", "velocity", "value"}
_NUMBERS |= {"ixx", "ixy", "ixz", "iyy", "iyz", "izz"}
_MOVABLE = ("revolute", "continuous", "prismatic")

MOST_ELEMENTS, LARGEST = 1000, 1e6
"""What a file may have: so many links and joints, and no number beyond, whatever its unit."""


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
    """A rigid link: its collision shapes, those that are meshes apart, what it looks like and what it weighs."""

    name: str
    collisions: tuple[Primitive, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    visuals: tuple[Visual, ...] = ()
    inertial: Inertial | None = None


@dataclass(frozen=True)
class Joint:
    """A joint; its frame is the child link's frame at zero.

    ``lower`` and ``upper`` are in rad (revolute) or mm (prismatic), ``velocity`` in rad/s or mm/s, ``effort`` in N m or N. Fixed: all 0.
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


@dataclass(frozen=True)
class Gripper:
    """How a hand opens.

    Attributes:
        kind: ``fingers``, which slide; ``jaw``, one that is hinged opposite a fixed one; ``none``: things stick to the grip.
        joints: its joints in the URDF.
        closed: where each of them is when the hand is closed, mm or rad.
        opening: 1 where a joint's value grows as the hand opens, else -1.
        lever_mm: of a jaw, from its hinge to its pad.
        travel_mm: how far each pad can be from where it is when the hand is closed.
    """

    kind: str = "none"
    joints: tuple[str, ...] = ()
    closed: tuple[float, ...] = ()
    opening: tuple[int, ...] = ()
    lever_mm: float = 0.0
    travel_mm: float = 0.0

    def joint_values(self, gripper_mm: float | None) -> dict[str, float]:
        """Joint -> value, mm or rad, with each pad ``gripper_mm`` from where it is when the hand is closed; None: fully open.

        The one pad of a jaw moves twice as far, along the chord of its way.
        """
        pad_mm = self.travel_mm if gripper_mm is None else min(gripper_mm, self.travel_mm)
        moved = pad_mm if self.kind == "fingers" else 2 * math.asin(min(max(pad_mm / self.lever_mm, -1.0), 1.0)) if self.joints else 0.0
        return {name: at + sign * moved for name, at, sign in zip(self.joints, self.closed, self.opening, strict=True)}

    def gripper_mm(self, values: Sequence[float]) -> float:
        """How far each pad is from where it is when the hand is closed, on average, for values of the :attr:`joints`."""
        moved = [sign * (value - at) for value, at, sign in zip(values, self.closed, self.opening, strict=True)]
        if self.kind == "fingers":
            return sum(moved) / len(moved)
        return self.lever_mm * math.sin(moved[0] / 2) if moved else 0.0


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


def read_urdf(path: Path | str, grasp_link: str = "grip") -> ArmDescription:
    """Read the URDF at ``path``: an arm with the joints :data:`ARM_JOINTS` and the link ``grasp_link``.

    Raises :class:`MissingFile` if there is no such file, and :class:`UrdfError`, which names the fault, for anything else wrong with it.
    """
    path = Path(path)
    robot = _parse(path)
    _refuse_non_finite(path, robot)
    if len(robot) > MOST_ELEMENTS:
        _fail(path, f"it has {len(robot)} links and joints; it may have {MOST_ELEMENTS}")
    links = tuple(Link(_attribute(path, e, "name", "a link"), _collisions(path, e)) for e in robot.findall("link"))
    names = [link.name for link in links]
    joints = tuple(_joint(path, element) for element in robot.findall("joint"))
    _refuse_duplicates(path, "link", names)
    _refuse_duplicates(path, "joint", [joint.name for joint in joints])
    if grasp_link not in names:
        raise UrdfError(path, f"link {grasp_link!r}, the grasp frame, is missing; it has: {', '.join(names)}; set grasp_link")
    _check_order(path, joints)
    root, joints = _sort_tree(path, names, joints)
    arm = ArmDescription(path, robot.get("name", path.stem), root, grasp_link, links, joints, _fingers(joints))
    moving = tuple(joint.name for joint in arm.chain() if joint.kind != "fixed")
    if moving != ARM_JOINTS:
        _fail(path, f"the joints from {root!r} to {grasp_link!r} are {', '.join(moving) or 'none'}; they must be {', '.join(ARM_JOINTS)}")
    return arm


def _fingers(joints: tuple[Joint, ...]) -> Gripper:
    sliding = [joint for joint in joints if joint.kind == "prismatic"]
    if not sliding:
        return Gripper()
    travel = min(joint.upper - joint.lower for joint in sliding)
    names, closed = tuple(joint.name for joint in sliding), tuple(joint.lower for joint in sliding)
    return Gripper("fingers", names, closed, (1,) * len(names), 0.0, travel)


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
    try:
        robot = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise UrdfError(path, f"malformed XML: {error}") from None
    if robot.tag != "robot":
        _fail(path, f"its outermost element is <{robot.tag}>; it must be <robot>")
    return robot


def _refuse_non_finite(path: Path, robot: ET.Element) -> None:
    for element in robot.iter():
        for name in _NUMBERS.intersection(element.attrib):
            _numbers(path, element, name)


def _refuse_duplicates(path: Path, what: str, names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            _fail(path, f"{what} {name!r} is there {names.count(name)} times; names must be unique")


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
        raise UrdfError(path, f"<{element.tag} {name}={text!r}> is not a number") from None
    if not values or not all(math.isfinite(value) for value in values):
        _fail(path, f"<{element.tag} {name}={text!r}>: every number must be finite")
    if any(abs(value) > LARGEST for value in values):
        _fail(path, f"<{element.tag} {name}={text!r}>: no number may be beyond {LARGEST:g}")
    return values


def _scalar(path: Path, element: ET.Element | None, name: str, where: str) -> float:
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


def _collisions(path: Path, link: ET.Element) -> tuple[Primitive, ...]:
    where = f"link {link.get('name')!r}"
    shapes = []
    for collision in link.findall("collision"):
        geometry = collision.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        size: tuple[float, ...]
        if shape is not None and shape.tag == "box":
            _attribute(path, shape, "size", where)
            size = _vector(path, shape, "size", (0.0, 0.0, 0.0), _MM)
        elif shape is not None and shape.tag == "cylinder":
            size = tuple(_MM * _scalar(path, shape, name, where) for name in ("radius", "length"))
        elif shape is not None and shape.tag == "sphere":
            size = (_MM * _scalar(path, shape, "radius", where),)
        else:
            found = "no collision shape" if shape is None else f"the collision shape <{shape.tag}>"
            _fail(path, f"{where} has {found}; only box, cylinder and sphere are supported")
        if min(size) <= 0:
            _fail(path, f"{where} has a <{shape.tag}> with a size that is not above 0")
        shapes.append(Primitive(shape.tag, size, *_origin(path, collision)))
    return tuple(shapes)


def _joint(path: Path, element: ET.Element) -> Joint:
    name = _attribute(path, element, "name", "a joint")
    where = f"joint {name!r}"
    kind = _attribute(path, element, "type", where)
    parent = _attribute(path, element.find("parent"), "link", f"{where}: its parent")
    child = _attribute(path, element.find("child"), "link", f"{where}: its child")
    if kind not in (*_MOVABLE, "fixed"):
        _fail(path, f"{where} has type {kind!r}; only fixed, {', '.join(_MOVABLE)} are supported")
    xyz_mm, rpy_rad = _origin(path, element)
    axis = _vector(path, element.find("axis"), "xyz", (1.0, 0.0, 0.0))
    if kind == "fixed":
        return Joint(name, kind, parent, child, xyz_mm, rpy_rad, axis)
    length = math.hypot(*axis)
    if length < 1e-9:
        _fail(path, f"{where} has an axis of length 0")
    limit = element.find("limit")
    if limit is None:
        _fail(path, f"{where} lacks its <limit>; every moving joint needs lower, upper, effort and velocity")
    scale = _MM if kind == "prismatic" else 1.0
    lower, upper, velocity = (scale * _scalar(path, limit, key, f"the <limit> of {where}") for key in ("lower", "upper", "velocity"))
    if lower > upper:
        _fail(path, f"{where} has a lower limit above its upper limit")
    if velocity <= 0:
        _fail(path, f"{where} has velocity {velocity:g} in its <limit>; it must be above 0")
    effort = _scalar(path, limit, "effort", f"the <limit> of {where}")
    unit = (axis[0] / length, axis[1] / length, axis[2] / length)
    return Joint(name, kind, parent, child, xyz_mm, rpy_rad, unit, lower, upper, effort, velocity)


def _check_order(path: Path, joints: tuple[Joint, ...]) -> None:
    moving = [joint.name for joint in joints if joint.kind != "fixed"]
    missing = [name for name in ARM_JOINTS if name not in moving]
    if missing:
        _fail(path, f"joint {', '.join(map(repr, missing))} is missing or fixed; the moving joints are: {', '.join(moving) or 'none'}")
    if tuple(moving[: len(ARM_JOINTS)]) != ARM_JOINTS:
        _fail(path, f"the moving joints come in the order {', '.join(moving)}; they must begin with {', '.join(ARM_JOINTS)}")


def _sort_tree(path: Path, links: list[str], joints: tuple[Joint, ...]) -> tuple[str, tuple[Joint, ...]]:
    """The root link, and the joints with every parent before its children."""
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                _fail(path, f"joint {joint.name!r} names link {link!r}, which is missing")
    _refuse_duplicates(path, "child link", [joint.child for joint in joints])
    roots = sorted(set(links) - {joint.child for joint in joints})
    if len(roots) != 1:
        _fail(path, f"it has {len(roots)} links without a parent ({', '.join(roots)}); it must have 1")
    placed, waiting, ordered = {roots[0]}, list(joints), []
    while waiting:
        ready = [joint for joint in waiting if joint.parent in placed]
        if not ready:
            _fail(path, f"joint {waiting[0].name!r} is part of a loop")
        ordered += ready
        placed.update(joint.child for joint in ready)
        waiting = [joint for joint in waiting if joint not in ready]
    return roots[0], tuple(ordered)
