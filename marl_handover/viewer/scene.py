"""The cell as a browser shows it: table, arms, blocks. In mm, rad and world poses on this side, as everywhere in the package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import Floats
from marl_handover.cell import Cell, CellModel
from marl_handover.config import BlockConfig
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS, Joint, Primitive
from marl_handover.palette import ALERT, GOAL, GREY, INK, SHARED, arm_colour
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


WOOD = (240, 238, 233)
MARGIN_MM = 45.0
"""Table beyond the last place that an arm reaches."""

# Heights in mm: what is drawn on the table lies in layers, so that no two fight for the same pixels.
_SHADE_MM, _CHART_MM, _OUTLINE_MM = 0.4, 0.8, 1.2
_CHART_LINES = 5
_POINTS = 61
_NAMES = {"L": "left arm", "R": "right arm"}


def add_table(server: viser.ViserServer, cell: Cell) -> None:
    """Put everything that stays where it is into the scene."""
    outlines = [sector_outline(cell, arm) for arm in range(cell.num_arms)]
    corners = np.concatenate([*outlines, [[base.x_mm, base.y_mm] for base in cell.bases]])
    half = np.abs(corners).max(0) + MARGIN_MM
    server.scene.add_box("/table", color=WOOD, dimensions=metres([2 * half[0], 2 * half[1], 15.0]), position=metres([0, 0, -7.5]))
    for arm, outline in enumerate(outlines):
        _add_line(server, f"/reach_{arm}", outline, arm_colour(arm), _OUTLINE_MM, 1.6)
        base, name = cell.bases[arm], _NAMES.get(cell.labels[arm], f"arm {cell.labels[arm]}")
        beyond = 1 + 35.0 / math.hypot(base.x_mm, base.y_mm)
        server.scene.add_label(f"/name_{arm}", name, position=metres([base.x_mm * beyond, base.y_mm * beyond, 0.0]), anchor="center-center")
    vertices, faces = shared_mesh(cell)
    server.scene.add_mesh_simple(
        "/shared", metres(vertices), faces, color=rgb(SHARED), opacity=0.45, side="double", cast_shadow=False, receive_shadow=False
    )
    for number, line in enumerate(chart_lines(cell)):
        _add_line(server, f"/chart_{number}", line, SHARED, _CHART_MM, 0.7)


def sector_outline(cell: Cell, arm: int) -> Floats:
    """The closed outline (n, 2) in mm of the annulus sector where an arm can pick and place."""
    each = cell.arms[arm]
    yaw = np.linspace(*each.yaw_rad, _POINTS)
    return np.concatenate([each.at(each.r_max_mm, yaw), each.at(each.r_min_mm, yaw[::-1]), each.at(each.r_max_mm, yaw[:1])])


def shared_mesh(cell: Cell) -> tuple[Floats, NDArray[np.uint32]]:
    """Vertices (n, 3) in mm and triangles (m, 3) of the space both arms reach: a strip between its two long sides."""
    alpha = np.linspace(-1.0, 1.0, _POINTS)
    sides = np.stack([cell.shared.to_table(alpha, np.full(_POINTS, beta)) for beta in (-1.0, 1.0)], 1).reshape(-1, 2)
    vertices = np.concatenate([sides, np.full((len(sides), 1), _SHADE_MM)], -1)
    first = 2 * np.arange(_POINTS - 1)[:, None]
    faces = np.concatenate([first + [0, 2, 1], first + [1, 2, 3]])
    return vertices, faces.astype(np.uint32)


def chart_lines(cell: Cell) -> list[Floats]:
    """Lines (n, 2) in mm of constant alpha and of constant beta."""
    values, along = np.linspace(-1.0, 1.0, _CHART_LINES), np.linspace(-1.0, 1.0, _POINTS)
    across = np.array([-1.0, 1.0])
    lines = [cell.shared.to_table(along, np.full(_POINTS, beta)) for beta in values]
    return lines + [cell.shared.to_table(np.full(2, alpha), across) for alpha in values[1:-1]]


def _add_line(server: viser.ViserServer, name: str, points_mm: Floats, colour: str, height_mm: float, width_px: float) -> None:
    points = metres(np.concatenate([points_mm, np.full((len(points_mm), 1), height_mm)], -1))
    segments = np.stack([points[:-1], points[1:]], 1)
    server.scene.add_line_segments(name, segments, colors=rgb(colour), thickness=width_px, thickness_units="screen")


EYE_MM, TARGET_MM, VIEW_DEG = (-640.0, -75.0, 520.0), (0.0, -75.0, 10.0), 42.0
"""The first look: the left arm on the left, and room for the panel on the right."""

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
        with server.atomic():
            _look(server)
            add_table(server, model.cell)
            self._arms = [ArmNodes(server, model, arm) for arm in range(model.cell.num_arms)]
            self._goal = BlockNodes(server, "/goal", self._block_config, rgb(GOAL), opacity=0.3)
            self._goal_label = server.scene.add_label("/goal/label", "goal", position=metres([0, 0, 38.0]), anchor="bottom-center")
            self._block = BlockNodes(server, "/block", self._block_config, BEECH)
            self._ghosts: list[BlockNodes] = []
            self._labels: list[viser.LabelHandle] = []
            self._goal_pose: Floats | None = None
            self._plan = np.zeros((0, 3))
            self._paths = [_add_path(server, arm) for arm in range(model.cell.num_arms)]

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


def _look(server: viser.ViserServer) -> None:
    camera, scene = server.initial_camera, server.scene
    camera.position, camera.look_at, camera.fov = metres(EYE_MM), metres(TARGET_MM), math.radians(VIEW_DEG)
    # viser's own lights bleach colours, which mean something here.
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/lights/all", intensity=2.0)
    scene.add_light_directional("/lights/lamp", intensity=1.6, position=LAMP_M)


def _add_path(server: viser.ViserServer, arm: int) -> viser.LineSegmentsHandle:
    return server.scene.add_line_segments(
        f"/path_{arm}", np.zeros((1, 2, 3)), colors=rgb(arm_colour(arm)), thickness=3.0, thickness_units="screen", visible=False
    )
