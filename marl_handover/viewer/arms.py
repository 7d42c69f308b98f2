"""The arms in the scene: a chain of frames for each, with the shapes of its URDF. To move a joint is one message."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from marl_handover.cell import CellModel
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS, Joint, Primitive
from marl_handover.palette import INK, arm_colour
from marl_handover.viewer.units import UPWARDS, metres, product, quaternion, rgb, turned

Floats = NDArray[np.float64]

DARK_LINKS = ("base_link", "hand", "wrist")
"""Links drawn in ink, so that the joints of an arm are seen."""


class ArmNodes:
    """One arm.

    Args:
        server: of the page.
        model: the cell.
        index: of the arm.
    """

    def __init__(self, server: viser.ViserServer, model: CellModel, index: int) -> None:
        self.description, base = model.arm.description, model.cell.bases[index]
        self.names = {self.description.root: f"/arm_{index}"}
        yaw = quaternion(UPWARDS, base.facing_rad)
        server.scene.add_frame(self.names[self.description.root], show_axes=False, wxyz=yaw, position=metres([base.x_mm, base.y_mm, 0.0]))
        self._frames: dict[str, viser.FrameHandle] = {}
        self._rest: dict[str, Floats] = {}
        for joint in self.description.joints:
            self._add_joint(server, joint)
        for link in self.description.links:
            colour = INK if link.name in DARK_LINKS else arm_colour(index)
            for number, shape in enumerate(link.collisions):
                _add_shape(server, f"{self.names[link.name]}/shape_{number}", shape, rgb(colour))

    def show(self, joints_rad: Sequence[float] | Floats) -> None:
        """Turn the joints (5,)."""
        for name, angle in zip(ARM_JOINTS, joints_rad, strict=True):
            joint = self.description.joint(name)
            self._frames[name].wxyz = product(self._rest[name], quaternion(joint.axis, float(angle)))

    def open(self, opened: float) -> None:
        """Move the fingers: 0 closed, 1 as wide as they go."""
        for joint in self.description.joints:
            if joint.kind == "prismatic":
                travel_mm = joint.lower + opened * (joint.upper - joint.lower)
                origin = transform(joint.xyz_mm, joint.rpy_rad)
                self._frames[joint.name].position = metres(origin[:3, 3] + origin[:3, :3] @ np.asarray(joint.axis) * travel_mm)

    def _add_joint(self, server: viser.ViserServer, joint: Joint) -> None:
        name = self.names[joint.child] = f"{self.names[joint.parent]}/{joint.child}"
        rest = turned(transform(joint.xyz_mm, joint.rpy_rad)[:3, :3])
        if joint.kind in ("revolute", "continuous") and joint.name not in ARM_JOINTS:  # a hinged finger stays at its lower stop
            rest = product(rest, quaternion(joint.axis, joint.lower))
        self._rest[joint.name] = rest
        self._frames[joint.name] = server.scene.add_frame(name, show_axes=False, wxyz=rest, position=metres(joint.xyz_mm))


def _add_shape(server: viser.ViserServer, name: str, shape: Primitive, colour: tuple[int, int, int]) -> None:
    wxyz, position = turned(transform((0.0, 0.0, 0.0), shape.rpy_rad)[:3, :3]), metres(shape.xyz_mm)
    size = metres(shape.size_mm)
    if shape.kind == "box":
        server.scene.add_box(name, color=colour, dimensions=size, wxyz=wxyz, position=position)
    elif shape.kind == "cylinder":
        server.scene.add_cylinder(name, radius=float(size[0]), height=float(size[1]), color=colour, wxyz=wxyz, position=position)
    else:
        server.scene.add_icosphere(name, radius=float(size[0]), color=colour, wxyz=wxyz, position=position)
