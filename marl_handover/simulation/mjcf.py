"""A scene as MuJoCo's model file: with all that touches, for physics; or with all that is seen, for pictures.

Names are ``0/turret`` for what belongs to arm 0. The joints are the same in both, and in the same order, so a state of one is one of the
other.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.capsules import joints_before
from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS, Inertial, Joint, Link, Mesh, Primitive
from marl_handover.simulation.arm import finger_links, fingers_coupled, turning_roles, wrist_links
from marl_handover.simulation.arm_file import GREY, mounted, whole
from marl_handover.simulation.block import TABLE_MM, TABLE_RGB, block_look, mass_properties
from marl_handover.simulation.camera import LIGHT, strip_triangles
from marl_handover.simulation.engine import BLOCK, TABLE, Scene

BLOCK_BODY, WORLD_BODY = "block", "world"

_MM = 1e-3
_PADS, _SHELL, _TABLE, _WOOD = (1.0, 2e-3), (0.4, 1e-4), (0.3, 1e-4), (1e-3, 1e-4)
"""Sliding friction, and torsional in m; of two surfaces that touch the larger counts: the wood leaves it to the other one."""

_ARMATURE_KG_M2, _FINGER_ARMATURE_KG = 2e-3, 0.02
"""What a servo's own rotor adds to its joint, behind its gears."""

_DRAWN = (".stl", ".obj")
"""Meshes that MuJoCo reads; of links with others their shapes are drawn."""

_OPTION = {"cone": "elliptic", "impratio": "10", "noslip_iterations": "3", "gravity": "0 0 -9.81"}
_CONTACT = {"solref": "0.002 1", "solimp": "0.95 0.99 0.0005", "density": "0", "contype": "0", "conaffinity": "0"}
_TIE = {"solref": "0.002 1", "solimp": "0.999 0.9999 0.0001"}
"""As stiff as steps of 1 ms allow. MuJoCo leaves the turning of the bodies out of a contact's acceleration, so that what is held slips in a
curve, at a speed that grows with this time."""


class Strip(NamedTuple):
    """A flat strip between two edges (n, 2)."""

    one_mm: Floats
    other_mm: Floats
    height_mm: float
    rgb: Sequence[float]


class Look(NamedTuple):
    """What is seen beside arms, block and table: strips, and colours of arms' bases."""

    strips: Sequence[Strip] = ()
    bases: Mapping[int, Sequence[float]] = {}


def named(arm: int, name: str) -> str:
    """What a link or a joint of an arm is called in the model."""
    return f"{arm}/{name}"


def bond_name(arm: int) -> str:
    """What the rigid joint between an arm's hand and the block is called."""
    return named(arm, "bond")


def mjcf(scene: Scene, look: Look | None = None) -> str:
    """The text of the model: of what is seen if ``look`` is given, else of what touches."""
    return ET.tostring(_Writer(scene, look).root, encoding="unicode")


class _Writer:
    """Fills the tree."""

    def __init__(self, scene: Scene, look: Look | None) -> None:
        self.scene, self.look = scene, look
        self.root = ET.Element("mujoco")
        self._add(self.root, "compiler", angle="radian", eulerseq="XYZ", balanceinertia="true", boundmass="1e-6", boundinertia="1e-9")
        self._add(self.root, "option", **_OPTION)
        default = self._add(self.root, "default")
        self._add(default, "geom", **_CONTACT)
        self._add(default, "equality", **_TIE)
        self._add(default, "mesh", inertia="shell")
        self.asset, self.world, self.contact, self.equality = (
            self._add(self.root, tag) for tag in ("asset", "worldbody", "contact", "equality")
        )
        self._meshes: dict[tuple[str, str], str] = {}
        self._table()
        for index, (arm, base) in enumerate(zip(scene.arms, scene.bases, strict=True)):
            self._arm(index, arm, base)
            self._ties(index, arm)
        self._block()
        if look is not None:
            self._surroundings(look)

    @staticmethod
    def _add(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
        return ET.SubElement(parent, tag, attributes)

    def _table(self) -> None:
        side, thick = self.scene.table_mm, TABLE_MM
        if self.look is None:
            self._add(self.world, "geom", type="plane", size=f"{_metres((side, side))} 0.1", **_surface(TABLE, _TABLE))
        else:
            at, size = _metres((0, 0, -thick)), _metres((side, side, thick))
            self._add(self.world, "geom", type="box", pos=at, size=size, rgba=_rgba(TABLE_RGB))

    def _arm(self, index: int, arm: ArmModel, base: SE2) -> None:
        """The tree of an arm's links."""
        description = whole(arm.description)
        links = {link.name: link for link in description.links}
        carried: dict[str, list[Joint]] = {name: [] for name in links}
        for joint in description.joints:
            carried[joint.parent].append(mounted(description, joint))
        ranges = {ARM_JOINTS[role]: (float(arm.lower_rad[role]), float(arm.upper_rad[role])) for role in turning_roles(description)}
        pads, levels = finger_links(description), joints_before(description)

        def add(parent: ET.Element, name: str, frame: dict[str, str], joint: Joint | None) -> None:
            """A link, and all that it carries."""
            body = self._add(parent, "body", name=named(index, name), **frame)
            self._inertial(body, links[name].inertial)
            if joint is not None and joint.kind != "fixed":
                self._joint(body, index, joint, ranges.get(joint.name))
            if self.look is None:
                for shape in links[name].collisions:
                    self._add(body, "geom", **_solid(shape), **_surface(index, _PADS if name in pads else _SHELL))
            else:
                self._seen(body, links[name], self.look.bases.get(index) if levels[name] <= 1 else None)
            for below in carried[name]:
                add(body, below.child, _frame(below.xyz_mm, below.rpy_rad), below)

        add(self.world, description.root, _frame((base.x_mm, base.y_mm, 0.0), (0.0, 0.0, base.facing_rad)), None)

    def _inertial(self, body: ET.Element, inertial: Inertial | None) -> None:
        assert inertial is not None
        xx, xy, xz, yy, yz, zz = inertial.inertia_kg_m2
        R = transform((0.0, 0.0, 0.0), inertial.rpy_rad)[:3, :3]
        turned = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
        moments = turned[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        self._add(body, "inertial", pos=_metres(inertial.xyz_mm), mass=_numbers([inertial.mass_kg]), fullinertia=_numbers(moments))

    def _joint(self, body: ET.Element, index: int, joint: Joint, limits: tuple[float, float] | None) -> None:
        slides = joint.kind == "prismatic"
        scale = _MM if slides else 1.0
        kind = "slide" if slides else "hinge"
        armature = _numbers([_FINGER_ARMATURE_KG if slides else _ARMATURE_KG_M2])
        span = _numbers(limits or (scale * joint.lower, scale * joint.upper))
        self._add(body, "joint", name=named(index, joint.name), type=kind, axis=_numbers(joint.axis), range=span, armature=armature)

    def _seen(self, body: ET.Element, link: Link, rgb: Sequence[float] | None) -> None:
        """What a link looks like; its shapes if its file does not say, or says it in a mesh that is not there."""
        visuals = [v for v in link.visuals if not isinstance(v.shape, Mesh) or (v.shape.path.is_file() and _is_drawn(v.shape))]
        for shape, rgba in [(v.shape, v.rgba) for v in visuals] or [(shape, None) for shape in link.collisions]:
            colour = _rgba(rgb) if rgb is not None else _numbers(rgba or GREY)
            solid = self._mesh(shape) if isinstance(shape, Mesh) else _solid(shape)
            self._add(body, "geom", rgba=colour, **solid)

    def _mesh(self, mesh: Mesh) -> dict[str, str]:
        key = (str(mesh.path.absolute()), _numbers(mesh.scale))
        if key not in self._meshes:
            self._meshes[key] = f"mesh{len(self._meshes)}"
            self._add(self.asset, "mesh", name=self._meshes[key], file=key[0], scale=key[1])
        return {"type": "mesh", "mesh": self._meshes[key], **_frame(mesh.xyz_mm, mesh.rpy_rad)}

    def _ties(self, index: int, arm: ArmModel) -> None:
        """What holds what together, and which touches nothing comes of."""
        description = arm.description
        standing = [link for link, level in joints_before(description).items() if level <= 1]
        passing = wrist_links(description) if self.scene.passes[index] else ()
        for link, other in [(link, WORLD_BODY) for link in standing] + [(link, BLOCK_BODY) for link in passing]:
            self._add(self.contact, "exclude", body1=named(index, link), body2=other)
        if coupling := fingers_coupled(description.gripper):
            first, second = (named(index, name) for name in description.gripper.joints)
            curve = _numbers([coupling[1] * _MM, -coupling[0], 0.0, 0.0, 0.0])
            self._add(self.equality, "joint", joint1=first, joint2=second, polycoef=curve)
        hand = named(index, description.joint(ARM_JOINTS[-1]).child)
        here = "0 0 0 1 0 0 0"
        self._add(self.equality, "weld", name=bond_name(index), body1=hand, body2=BLOCK_BODY, relpose=here, active="false")

    def _block(self) -> None:
        """The block, its pin a capsule."""
        config = self.scene.block
        mass, centre_mm, moments = mass_properties(config)
        body = self._add(self.world, "body", name=BLOCK_BODY)
        self._add(body, "freejoint")
        moment = _numbers(1e-6 * np.array(moments))
        self._add(body, "inertial", pos=_metres((0, 0, centre_mm)), mass=_numbers([mass]), diaginertia=moment)
        if self.look is None:
            half, up, pin = config.side_mm / 2, config.height_mm / 2, config.pin_diameter_mm / 2
            ends, wood = _metres((0, 0, 2 * up + pin, 0, 0, config.pin_top_mm - pin)), _surface(BLOCK, _WOOD)
            self._add(body, "geom", type="box", pos=_metres((0, 0, up)), size=_metres((half, half, up)), **wood)
            self._add(body, "geom", type="capsule", fromto=ends, size=_metres([pin]), **wood)
            return
        for part in block_look(config):
            size = part.half_mm if part.kind == "box" else (part.half_mm[0], part.half_mm[2])
            self._add(body, "geom", type=part.kind, pos=_metres(part.at_mm), size=_metres(size), rgba=_rgba(part.rgb))

    def _surroundings(self, look: Look) -> None:
        """Light, and what is drawn on the table."""
        visual = self._add(self.root, "visual")
        self._add(visual, "headlight", ambient="0.45 0.45 0.45", diffuse="0.25 0.25 0.25", specular="0 0 0")
        self._add(visual, "quality", shadowsize="4096", offsamples="8")
        away = np.multiply(-1.0, LIGHT)
        light = {"directional": "true", "pos": _numbers(LIGHT), "dir": _numbers(away), "diffuse": "0.4 0.4 0.4", "specular": "0.1 0.1 0.1"}
        self._add(self.world, "light", castshadow="true", **light)
        for number, strip in enumerate(look.strips):
            name, count = f"strip{number}", len(strip.one_mm)
            flat = np.concatenate([strip.one_mm, strip.other_mm])
            vertices = np.column_stack([flat, np.zeros(len(flat))])
            corners = strip_triangles(count)
            faces = " ".join(map(str, np.concatenate([corners, corners[:, ::-1]]).ravel().tolist()))
            self._add(self.asset, "mesh", name=name, vertex=_metres(vertices.ravel()), face=faces)
            self._add(self.world, "geom", type="mesh", mesh=name, pos=_metres((0, 0, strip.height_mm)), rgba=_rgba(strip.rgb))


def _is_drawn(mesh: Mesh) -> bool:
    return mesh.path.suffix.lower() in _DRAWN


def _solid(shape: Primitive) -> dict[str, str]:
    """A primitive's kind, size and frame."""
    size = np.array(shape.size_mm, float)
    if shape.kind == "box":
        size = size / 2
    elif shape.kind == "cylinder":
        size = size * (1.0, 0.5)
    return {"type": shape.kind, "size": _metres(size), **_frame(shape.xyz_mm, shape.rpy_rad)}


def _surface(owner: int, friction: tuple[float, float]) -> dict[str, str]:
    """Friction, and what touches what: all that belong to different owners."""
    bit, every = 1 << (owner + 2), (1 << 31) - 1
    condim = "4" if friction is _PADS else "3"
    return {"friction": f"{friction[0]} {friction[1]} 1e-5", "condim": condim, "contype": str(bit), "conaffinity": str(every & ~bit)}


def _frame(xyz_mm: Sequence[float], rpy_rad: Sequence[float]) -> dict[str, str]:
    return {"pos": _metres(xyz_mm), "euler": _numbers(rpy_rad)}


def _rgba(rgb: Sequence[float]) -> str:
    return f"{_numbers(rgb)} 1"


def _metres(values_mm: Iterable[float]) -> str:
    return _numbers(float(value) * _MM for value in values_mm)


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
