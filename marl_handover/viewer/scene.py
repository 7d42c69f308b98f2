"""The cell as a browser shows it. In mm, rad and world poses on this side, as everywhere in the package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from marl_handover.cell import CellModel
from marl_handover.palette import ALERT, GOAL, arm_colour
from marl_handover.viewer.arms import ArmNodes
from marl_handover.viewer.blocks import BEECH, BlockNodes
from marl_handover.viewer.table import add_table
from marl_handover.viewer.units import metres, rgb

Floats = NDArray[np.float64]

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
