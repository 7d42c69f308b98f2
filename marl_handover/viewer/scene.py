"""The cell as a browser shows it: table, arms, blocks. In mm, rad and world poses on this side, as everywhere in the package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.cell import Cell, CellModel
from marl_handover.config import BlockConfig
from marl_handover.geometry.capsules import joints_before
from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS, Joint, Primitive
from marl_handover.palette import ALERT, FAINT, GOAL, GREY, INK, arm_colour
from marl_handover.viewer.table import TableNodes
from marl_handover.viewer.words import UPWARDS, Colour, flat, metres, product, quaternion, rgb, turned

BEECH = (214, 170, 110)

# The arrow in shares of the block's side: tail and head, left and right.
_ARROW = np.array([[-0.36, 0.07], [0.08, 0.07], [0.08, 0.24], [0.4, 0.0], [0.08, -0.24], [0.08, -0.07], [-0.36, -0.07]])
_ARROW_FACES = np.array([[0, 6, 1], [1, 6, 5], [2, 4, 3]], np.uint32)
_ABOVE_MM = 0.5


class BlockNodes:
    """One block; its frame has the origin in the middle of the lower face.

    Args:
        server: of the page.
        name: of the frame.
        block: sizes.
        colour: of the body.
        opacity: below 1 for a ghost, which has edges and no pin.
        height_mm: of the body; None: the block's own.
        arrow: colour of the arrow.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        block: BlockConfig,
        colour: Colour,
        opacity: float | None = None,
        height_mm: float | None = None,
        arrow: Colour | None = None,
    ) -> None:
        side, high = block.side_mm, block.height_mm if height_mm is None else height_mm
        ghost = opacity is not None
        self._placed: tuple[bytes, ...] | None = None
        self.frame = server.scene.add_frame(name, show_axes=False, visible=False)
        self._body = server.scene.add_box(
            f"{name}/body",
            color=colour,
            dimensions=metres([side, side, high]),
            position=metres([0, 0, high / 2]),
            opacity=opacity,
            cast_shadow=not ghost,
            receive_shadow=not ghost,
        )
        points = np.concatenate([side * _ARROW, np.full((len(_ARROW), 1), high + _ABOVE_MM)], -1)
        server.scene.add_mesh_simple(
            f"{name}/arrow", metres(points), _ARROW_FACES, color=arrow or rgb(INK), side="double", cast_shadow=False, receive_shadow=False
        )
        self._edges = _add_edges(server, f"{name}/edges", side, high, colour) if ghost else None
        if not ghost:
            long = block.pin_top_mm - high
            pin, at = metres([block.pin_diameter_mm / 2, long]), metres([0, 0, high + long / 2])
            server.scene.add_cylinder(f"{name}/pin", radius=float(pin[0]), height=float(pin[1]), color=rgb(GREY), position=at)

    def show(self, where: ArrayLike | None, height_mm: float = 0.0) -> None:
        """Put it at a pose (3,) at a height above the table, or at ``T_world_block`` (4, 4) in mm; None hides it."""
        if where is not None:
            array = np.asarray(where, float)
            wxyz, position = (turned(array[:3, :3]), metres(array[:3, 3])) if array.shape == (4, 4) else flat(array, height_mm)
            placed = (wxyz.tobytes(), position.tobytes())
            if placed != self._placed:
                self._placed = placed
                self.frame.wxyz, self.frame.position = wxyz, position
        self.frame.visible = where is not None

    def paint(self, colour: Colour) -> None:
        """Give body and edges another colour."""
        if tuple(self._body.color) != colour:
            self._body.color = colour
            if self._edges is not None:
                self._edges.colors = np.array(colour, np.uint8)


def _add_edges(server: viser.ViserServer, name: str, side_mm: float, high_mm: float, colour: Colour) -> viser.LineSegmentsHandle:
    half = side_mm / 2
    corners = np.array([[half, half], [-half, half], [-half, -half], [half, -half]])
    low, high = (np.concatenate([corners, np.full((4, 1), z)], -1) for z in (0.0, high_mm))
    around = [np.stack([ring, np.roll(ring, -1, 0)], 1) for ring in (low, high)]
    segments = np.concatenate([*around, np.stack([low, high], 1)])
    return server.scene.add_line_segments(name, metres(segments), colors=colour, thickness=1.5, thickness_units="screen")


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
        self.description, base = model.arms[index].description, model.cell.bases[index]
        self.names = {self.description.root: f"/arm_{index}"}
        yaw = quaternion(UPWARDS, base.facing_rad)
        self._root = server.scene.add_frame(
            self.names[self.description.root], show_axes=False, wxyz=yaw, position=metres([base.x_mm, base.y_mm, 0.0])
        )
        self._base = base
        self._shapes: list[tuple[Any, bool]] = []
        self._colour: tuple[str, bool] = (arm_colour(index), True)
        self.standing: list[str] = []
        """Names of the shapes that stand on the table, or turn on what does."""
        self._frames: dict[str, viser.FrameHandle] = {}
        self._rest: dict[str, Floats] = {}
        for joint in self.description.joints:
            self._add_joint(server, joint)
        before = joints_before(self.description)
        for link in self.description.links:
            dark = link.name in DARK_LINKS
            for number, shape in enumerate(link.collisions):
                name = f"{self.names[link.name]}/shape_{number}"
                self._shapes.append((_add_shape(server, name, shape, rgb(INK if dark else arm_colour(index))), dark))
                self.standing += [name] if before[link.name] <= 1 else []

    def move(self, base: SE2) -> None:
        """Stand it somewhere else."""
        if base != self._base:
            self._base = base
            self._root.wxyz, self._root.position = quaternion(UPWARDS, base.facing_rad), metres([base.x_mm, base.y_mm, 0.0])

    def paint(self, colour: str, in_order: bool = True) -> None:
        """Its links in ``colour``, or in grey if it is out of order."""
        if self._colour != (colour, in_order):
            self._colour = colour, in_order
            for shape, dark in self._shapes:
                shape.color = rgb((INK if dark else colour) if in_order else FAINT)

    def remove(self) -> None:
        """Take it out of the scene."""
        self._root.remove()

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


def _add_shape(server: viser.ViserServer, name: str, shape: Primitive, colour: tuple[int, int, int]) -> Any:
    wxyz, position = turned(transform((0.0, 0.0, 0.0), shape.rpy_rad)[:3, :3]), metres(shape.xyz_mm)
    size = metres(shape.size_mm)
    if shape.kind == "box":
        return server.scene.add_box(name, color=colour, dimensions=size, wxyz=wxyz, position=position)
    if shape.kind == "cylinder":
        return server.scene.add_cylinder(name, radius=float(size[0]), height=float(size[1]), color=colour, wxyz=wxyz, position=position)
    return server.scene.add_icosphere(name, radius=float(size[0]), color=colour, wxyz=wxyz, position=position)


EYE_MM, TARGET_MM, VIEW_DEG = (-640.0, -75.0, 520.0), (0.0, -75.0, 10.0), 42.0
"""The first look: the left arm on the left, and room for the panel on the right."""

PAIR_EXTENT_MM = 410.0
"""How far a pair reaches from the origin; from more arms the eye is farther away, as they reach farther."""

LAMP_M = (-0.5, 0.3, 0.9)

_SAME_MM, _SAME_RAD = 2.0, math.radians(10.0)
"""A placement this near to the goal is shown as the goal."""

_NEAR_MM = 18.0
"""Labels nearer than this would hide each other."""

_PLATE_MM = 3.0
_PATH_MM = 4.0


class CellScene:
    """Arms, table, block, goal and plan of one cell, on one server.

    Every method sends what has changed, in one piece, and nothing if nothing has. They may be called from any thread, one at a time.

    Args:
        server: of the page.
        model: the cell.
    """

    def __init__(self, server: viser.ViserServer, model: CellModel) -> None:
        self.server, self.model = server, model
        self._block_config = model.cell.config.block
        self._sent: dict[str, Any] = {}
        self.generation = 0
        """How often the nodes of all arms were made anew."""
        with server.atomic():
            _look(server, _distance(model.cell))
            server.on_client_connect(partial(_step_back, _distance(model.cell)))
            self._table = TableNodes(server)
            self._table.show(model.cell)
            self._arms = [ArmNodes(server, model, arm) for arm in range(model.cell.num_arms)]
            self._goal = BlockNodes(server, "/goal", self._block_config, rgb(GOAL), opacity=0.3)
            self._goal_label = server.scene.add_label("/goal/label", "goal", position=metres([0, 0, 38.0]), anchor="bottom-center")
            self._block = BlockNodes(server, "/block", self._block_config, BEECH)
            self._ghosts: list[BlockNodes] = []
            self._labels: list[viser.LabelHandle] = []
            self._goal_pose: Floats | None = None
            self._plan = np.zeros((0, 3))
            self._paths = [_add_path(server, arm) for arm in range(model.cell.num_arms)]

    @property
    def bases(self) -> list[list[str]]:
        """Names of the nodes that an arm can be dragged by, of each."""
        return [arm.standing for arm in self._arms]

    @property
    def discs(self) -> list[str]:
        """Names of the nodes that discs can be dragged by."""
        return self._table.discs

    def show_cell(self, model: CellModel, in_order: Sequence[str] | None = None, dials: bool = False) -> None:
        """Another layout of the cell. Arms that are out of order, those not among ``in_order``, are grey."""
        changed = [(arm.name, arm.robot) for arm in model.cell.arms] != [(arm.name, arm.robot) for arm in self.model.cell.arms]
        self.model = model
        with self.server.atomic():
            if changed:
                self._replace_arms()
            on = model.cell.names if in_order is None else in_order
            for index, (node, arm) in enumerate(zip(self._arms, model.cell.arms, strict=True)):
                node.move(arm.base)
                node.paint(arm_colour(index), arm.name in on)
            standing = model.cell if in_order is None else model.cell.with_arms(on)
            self._table.show(model.cell, standing, dials)

    def show_bases(self, bases: Sequence[SE2]) -> None:
        """Where the cell's arms are held that cannot stand so: what each reaches there, in red."""
        arms = [replace(arm, base=base) for arm, base in zip(self.model.cell.arms, bases, strict=True)]
        with self.server.atomic():
            for node, base in zip(self._arms, bases, strict=True):
                node.move(base)
            self._table.show_arms(arms, self.model.cell.labels, allowed=False)

    def _replace_arms(self) -> None:
        """Arms have come or gone."""
        self.generation += 1
        for node in self._arms:
            node.remove()
        for path in self._paths:
            path.remove()
        self._sent = {key: value for key, value in self._sent.items() if not key.startswith(("joints", "grip", "plan"))}
        self._arms = [ArmNodes(self.server, self.model, arm) for arm in range(self.model.cell.num_arms)]
        self._paths = [_add_path(self.server, arm) for arm in range(self.model.cell.num_arms)]

    def show_joints(self, joints_rad: ArrayLike, grip_open: Sequence[bool] | None = None) -> None:
        """Pose all arms.

        Args:
            joints_rad: (n, 5).
            grip_open: of each hand; None leaves the fingers as they are.
        """
        joints = np.asarray(joints_rad, float)
        with self.server.atomic():
            for index, (arm, row) in enumerate(zip(self._arms, joints, strict=True)):
                if self._changed(f"joints_{index}", row.tobytes()):
                    arm.show(row)
                if grip_open is not None and self._changed(f"grip_{index}", bool(grip_open[index])):
                    arm.open(1.0 if grip_open[index] else 0.0)

    def show_block(self, where: ArrayLike | None, height_mm: float = 0.0) -> None:
        """Put the block at a pose (3,) with its lower face at a height, or at ``T_world_block`` (4, 4) in mm; None: it is not seen."""
        with self.server.atomic():
            self._block.show(where, height_mm)

    def show_goal(self, pose: ArrayLike | None, reachable: bool = True) -> None:
        """Put the ghost at the goal (3,); red if no arm reaches it."""
        self._goal_pose = None if pose is None else np.array(pose, float)
        with self.server.atomic():
            self._goal.show(pose)
            self._goal.paint(rgb(GOAL if reachable else ALERT))
            self._number_ghosts()

    def show_plan(self, poses: Sequence[ArrayLike] | Floats, arms: Sequence[int], start: ArrayLike | None = None) -> None:
        """Draw what is planned: numbered ghosts where the block is to be put, in the colours of the arms that put it there.

        Args:
            poses: (k, 3).
            arms: k indices.
            start: (3,) where the block is taken from first, to draw the way from there.
        """
        self._plan = np.array(poses, float).reshape(-1, 3)
        where = self._plan if start is None else np.concatenate([np.asarray(start, float)[None], self._plan])
        if not self._changed("plan", (where.tobytes(), len(self._plan), tuple(arms))):
            return
        with self.server.atomic():
            for number in range(len(self._ghosts), len(self._plan)):
                self._add_ghost(number)
            for ghost, pose, arm in zip(self._ghosts, self._plan, arms, strict=False):
                ghost.paint(rgb(arm_colour(arm)))
                ghost.show(pose)
            self._number_ghosts()
            self._draw_path(where, arms[1 if start is None else 0 :])

    def _add_ghost(self, number: int) -> None:
        name = f"/plan_{number}"
        self._ghosts.append(BlockNodes(self.server, name, self._block_config, rgb(GOAL), opacity=0.4, height_mm=_PLATE_MM))
        self._labels.append(self.server.scene.add_label(f"{name}/label", "", position=metres([0, 0, 12.0]), anchor="bottom-center"))

    def _number_ghosts(self) -> None:
        """Say which placement is where, once for every place; what comes to lie at the goal is told there, and has no ghost of its own."""
        names = place_names(self._plan, self._goal_pose)
        for number, (ghost, label) in enumerate(zip(self._ghosts, self._labels, strict=True)):
            name = names[number] if number < len(self._plan) else None
            ghost.frame.visible = name is not None
            label.visible = bool(name)
            if name and label.text != name:
                label.text = name
        if self._goal_label.text != names[-1]:
            self._goal_label.text = str(names[-1])

    def _draw_path(self, where: Floats, arms: Sequence[int]) -> None:
        """The way of the block, seen from above, each piece in the colour of the arm that makes it."""
        points = metres(np.column_stack([where[:, :2], np.full(len(where), _PATH_MM)])).astype(np.float32)
        pieces = np.stack([points[:-1], points[1:]], 1)
        for index, path in enumerate(self._paths):
            own = pieces[np.asarray(arms[: len(pieces)], int) == index]
            path.visible = len(own) > 0
            if len(own) > 0:
                path.points = own

    def _changed(self, key: str, value: Any) -> bool:
        same = key in self._sent and self._sent[key] == value
        self._sent[key] = value
        return not same


def place_names(plan: Floats, goal: Floats | None) -> list[str | None]:
    """Labels of the placements (k, 3) and, at last, of the goal (3,).

    Placements at one place share the label of the first, the others' are empty; None: it lies on the goal.
    """
    numbers: dict[int, list[str]] = {}
    names: list[str | None] = []
    at_goal: list[str] = []
    for number, pose in enumerate(plan):
        turned = 0.0 if goal is None else abs(math.remainder(float(pose[2] - goal[2]), 2 * math.pi))
        if goal is not None and math.dist(pose[:2], goal[:2]) < _SAME_MM and turned < _SAME_RAD:
            at_goal.append(str(number + 1))
            names.append(None)
            continue
        first = next((other for other in numbers if math.dist(plan[other, :2], pose[:2]) < _NEAR_MM), number)
        numbers.setdefault(first, []).append(str(number + 1))
        names.append("")
    for first, those in numbers.items():
        names[first] = ", ".join(those)
    return [*names, f"goal ({', '.join(at_goal)})" if at_goal else "goal"]


async def _step_back(far: float, client: viser.ClientHandle) -> None:
    """On a screen that is higher than wide, a phone's, the panel is below: the eye is farther away, the cell higher in the picture."""
    camera = client.camera
    if camera.aspect < 1.0:
        away = far * min(1.0 / camera.aspect, MOST_AWAY)
        target = away * metres([_LOWER * EYE_MM[0], 0.0, 0.0])
        with client.atomic():
            camera.position = target + away * metres([EYE_MM[0], 0.0, EYE_MM[2]])
            camera.look_at = target  # after the position, which takes it along


MOST_AWAY = 2.2
_LOWER = 0.3
"""Of the distance of the eye: how much nearer to it than the middle of the table a phone looks."""


def _distance(cell: Cell) -> float:
    """How far away the eye is, in distances from a pair."""
    return 1.0 if cell.num_arms == 2 else max(1.0, max(cell.extent_mm) / PAIR_EXTENT_MM)


def _look(server: viser.ViserServer, away: float) -> None:
    camera, scene = server.initial_camera, server.scene
    camera.position, camera.look_at, camera.fov = away * metres(EYE_MM), away * metres(TARGET_MM), math.radians(VIEW_DEG)
    # viser's own lights bleach colours, which mean something here.
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/lights/all", intensity=2.0)
    scene.add_light_directional("/lights/lamp", intensity=1.6, position=LAMP_M)


def _add_path(server: viser.ViserServer, arm: int) -> viser.LineSegmentsHandle:
    return server.scene.add_line_segments(
        f"/path_{arm}", np.zeros((1, 2, 3)), colors=rgb(arm_colour(arm)), thickness=3.0, thickness_units="screen", visible=False
    )
