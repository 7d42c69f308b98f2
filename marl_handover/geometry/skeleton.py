"""The bodies of a robot and the joints that move them: links without a moving joint between them are one body."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.geometry.se3 import rotation, transform
from marl_handover.geometry.urdf import Joint, Primitive, UrdfTree


class Skeleton:
    """A URDF's tree as bodies.

    Attributes:
        tree: the URDF.
        joints: name -> joint.
        body: link -> the first link of its body.
        members: first link of a body -> all its links.
        moving: first link of a body -> the moving joints that it carries, mimicking ones too.
    """

    def __init__(self, tree: UrdfTree) -> None:
        self.tree = tree
        self.joints = {joint.name: joint for joint in tree.joints}
        self.links = {link.name: link for link in tree.links}
        self.body = {tree.root: tree.root}
        self.above: dict[str, Joint] = {}
        for joint in tree.joints:
            self.body[joint.child] = self.body[joint.parent] if joint.kind == "fixed" else joint.child
            if joint.kind != "fixed":
                self.above[joint.child] = joint
        self.members: dict[str, list[str]] = {}
        self.moving: dict[str, list[Joint]] = {first: [] for first in self.body.values()}
        for link, first in self.body.items():
            self.members.setdefault(first, []).append(link)
        for joint in self.above.values():
            self.moving[self.body[joint.parent]].append(joint)
        self._origins = {joint.name: transform(joint.xyz_mm, joint.rpy_rad) for joint in tree.joints}

    def path(self, body: str) -> list[Joint]:
        """The moving joints from the root's body to ``body``."""
        found: list[Joint] = []
        while body in self.above:
            found.append(self.above[body])
            body = self.body[self.above[body].parent]
        return found[::-1]

    def below(self, body: str) -> list[Joint]:
        """All moving joints that are carried by ``body`` or by what it carries."""
        found = []
        for joint in self.moving[body]:
            found += [joint, *self.below(joint.child)]
        return found

    def value(self, joint: Joint, values: Mapping[str, float]) -> float:
        """A joint's value, rad or mm: as given, as the joint that it mimics has it, or 0."""
        if joint.name in values or joint.mimic is None:
            return values.get(joint.name, 0.0)
        return joint.mimic.multiplier * self.value(self.joints[joint.mimic.joint], values) + joint.mimic.offset

    def way_to(self, body: str) -> frozenset[str]:
        """The links on the way from the root to a body, its own, and those that its joints move."""
        links = {*self.members[body], *(joint.child for joint in self.moving[body])}
        carrying = {joint.child: joint.parent for joint in self.tree.joints}
        for link in tuple(links):
            while link in carrying and carrying[link] not in links:
                link = carrying[link]
                links.add(link)
        return frozenset(links)

    def frames(self, values: Mapping[str, float], only: Collection[str] | None = None) -> dict[str, Floats]:
        """Link -> T_root_link (4, 4) in mm with moving joints at ``values``, rad or mm; of the links in ``only``, if it is given."""
        frames: dict[str, Floats] = {self.tree.root: np.eye(4)}
        for joint in self.tree.joints:
            if only is not None and joint.child not in only:
                continue
            T = frames[joint.parent] @ self._origins[joint.name]
            if joint.kind == "prismatic":
                T = T @ transform([self.value(joint, values) * part for part in joint.axis], (0.0, 0.0, 0.0))
            elif joint.kind != "fixed":
                turned = np.eye(4)
                turned[:3, :3] = rotation(np.asarray(self.value(joint, values)), joint.axis)
                T = T @ turned
            frames[joint.child] = T
        return frames

    def axis(self, joint: Joint, frames: Mapping[str, Floats]) -> Floats:
        """A joint's axis (3,) in the root's frame."""
        return np.asarray(frames[joint.child][:3, :3] @ np.asarray(joint.axis))

    def centre(self, link: str) -> Floats:
        """Where a link's bulk is, (3,) mm in its frame: its centre of mass, the middle of its shapes, or, of meshes alone, its origin."""
        about = self.links[link]
        if about.inertial is not None and about.inertial.mass_kg > 0 and any(about.inertial.xyz_mm):
            return np.asarray(about.inertial.xyz_mm)
        seen = [visual.shape for visual in about.visuals if isinstance(visual.shape, Primitive)]
        shapes = [shape.xyz_mm for shape in about.collisions or seen]
        return np.mean(shapes, axis=0) if shapes else np.zeros(3)

    def far_end_mm(self, link: str) -> float:
        """How far a link reaches from its origin, guessed from its mass and inertia; 0 where there is none.

        A density that falls evenly towards the far end, as (1 - x / L)^p, has one L for a centre of mass and a moment about it.
        """
        about = self.links[link].inertial
        if about is None or about.mass_kg <= 0:
            return 0.0
        xx, xy, xz, yy, yz, zz = about.inertia_kg_m2
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        spread_mm = 1000.0 * math.sqrt(max(float(moments.sum() / 2 - moments.min()) / about.mass_kg, 0.0))
        away_mm = math.hypot(*about.xyz_mm)
        if spread_mm <= 0.0 or away_mm <= spread_mm:
            return away_mm + math.sqrt(3.0) * spread_mm
        squared = min(max((away_mm / spread_mm) ** 2, 1.8), 3.0)  # from evenly spread to piled up at the near end
        return away_mm * ((3.0 - squared) / (squared - 1.0) + 2.0)
