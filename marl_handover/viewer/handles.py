"""What is dragged with a hand: handles on the table, and where a dragged thing may lie."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import viser
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.cell import Cell
from marl_handover.viewer.words import flat, yaw_of

SIZE_M = 0.06
_LEAST_SLOPE = 1e-3
"""A line of sight flatter than this has no point on the table that anybody could mean."""


class Dragged(NamedTuple):
    """Where a handle was dragged: ``pose`` (3,) in mm and rad, anywhere in the plane; ``released``: that is where it was let go."""

    pose: Floats
    released: bool


class PlaneHandle:
    """Two arrows, a plate and an arc about the vertical; bodies that are named can be dragged too, without turning.

    What was dragged waits to be fetched, the newest only: whoever moves things asks when he has time, and never gets old wishes.

    Args:
        server: of the page.
        name: in the scene.
        height_mm: of the handle above the table.
        bodies: names of scene nodes to be dragged.
        dragged: is set whenever there is something to fetch.
    """

    def __init__(
        self, server: viser.ViserServer, name: str, height_mm: float, bodies: Sequence[str] = (), dragged: threading.Event | None = None
    ) -> None:
        self._height_mm, self._lock, self._dragged = height_mm, threading.Lock(), dragged or threading.Event()
        self._newest: Dragged | None = None
        self._held: Floats | None = None
        self._grabbed_m = np.zeros(2)
        self._control = server.scene.add_transform_controls(
            name, scale=SIZE_M, active_axes=(True, True, False), line_width=3.0, depth_test=False, visible=False
        )
        self._control.on_update(self._on_control)
        for body in bodies:
            node: Any = server.scene.get_handle_by_name(body)
            node.on_drag("left")(self._on_body)

    @property
    def held(self) -> Floats | None:
        """The pose (3,) at which somebody holds it now; None: nobody does."""
        with self._lock:
            return self._held

    def fetch(self) -> Dragged | None:
        """The newest that nobody has fetched yet."""
        with self._lock:
            newest, self._newest = self._newest, None
            return newest

    def show(self, pose: ArrayLike | None, arrows: bool = True) -> None:
        """Put the handle at a pose (3,), unless somebody holds it; None hides it. Without ``arrows`` only its bodies can be dragged."""
        if self.held is not None:
            return
        if pose is not None:
            self._control.wxyz, self._control.position = flat(pose, self._height_mm)
        self._control.visible = pose is not None and arrows

    def remove(self) -> None:
        """Take it out of the scene."""
        self._control.remove()

    async def _on_control(self, event: viser.TransformControlsEvent) -> None:
        position, wxyz = event.target.position, event.target.wxyz
        self._note(np.array([1e3 * position[0], 1e3 * position[1], yaw_of(wxyz)]), event.phase)

    async def _on_body(self, event: viser.SceneNodeDragEvent[Any]) -> None:
        grip_m, here = np.asarray(event.start_position), self._control.position
        if event.phase == "start":
            self._grabbed_m = grip_m[:2] - here[:2]
        point = on_level(np.asarray(event.client.camera.position), np.asarray(event.end_position), float(grip_m[2]))
        where_m = here[:2] if point is None else point[:2] - self._grabbed_m
        pose = np.array([*(1e3 * where_m), yaw_of(self._control.wxyz)])
        self._control.position = flat(pose, self._height_mm)[1]
        self._note(pose, event.phase)

    def _note(self, pose: Floats, phase: str) -> None:
        with self._lock:
            sound = bool(np.isfinite(pose).all())
            if phase == "end":
                self._held = None
            elif sound:
                self._held = pose
            if phase != "start" and sound:
                self._newest = Dragged(pose, phase == "end")
                self._dragged.set()


def on_level(eye_m: Floats, seen_m: Floats, height_m: float) -> Floats | None:
    """Where the line of sight from ``eye_m`` (3,) through ``seen_m`` (3,) meets a level height; None: nowhere in front of the eye."""
    along = seen_m - eye_m
    if abs(along[2]) < _LEAST_SLOPE * float(np.linalg.norm(along)):
        return None
    share = (height_m - eye_m[2]) / along[2]
    return np.asarray(eye_m + share * along) if share > 0 else None


def within_reach(cell: Cell, pose: Floats) -> Floats:
    """``pose`` (3,) in mm and rad with its position moved to the nearest one (to rounding; to a mm among discs) that some arm reaches."""
    if cell.reaches(pose[:2]).any():
        return pose.copy()
    candidates = np.concatenate([_of_sector(cell, arm, pose[:2]) for arm in range(cell.num_arms)] + _around_discs(cell, pose[:2]))
    reached = candidates[cell.reaches(candidates).any(-1)]
    if not len(reached):  # discs lie on all that is near
        spread = np.concatenate(
            [arm.at(*np.meshgrid(np.linspace(arm.r_min_mm, arm.r_max_mm, 60), np.linspace(*arm.yaw_rad, 240))) for arm in cell.arms]
        )
        reached = spread[cell.reaches(spread).any(-1)].reshape(-1, 2)
    if not len(reached):
        return pose.copy()
    nearest = reached[int(np.argmin(np.hypot(*(reached - pose[:2]).T)))]
    return np.array([*nearest, pose[2]])


def _around_discs(cell: Cell, point_mm: Floats) -> list[Floats]:
    """Points (n, 2) on the edge of each keep-out disc, the nearest to ``point_mm`` among them."""
    around = []
    for disc in cell.keep_out:
        nearest = math.atan2(point_mm[1] - disc.y_mm, point_mm[0] - disc.x_mm)
        angle = nearest + np.linspace(0.0, 2 * math.pi, 720, endpoint=False)
        around.append(np.array(disc[:2]) + (disc.radius_mm + 1e-6) * np.stack([np.cos(angle), np.sin(angle)], -1))
    return around


def _of_sector(cell: Cell, arm: int, point_mm: Floats) -> Floats:
    """Points (n, 2) of one arm's annulus sector, the nearest to ``point_mm`` among them: on its arcs, its straight edges, its corners."""
    each = cell.arms[arm]
    low, high = each.yaw_rad
    square, yaw = (float(value[arm]) for value in cell.polar(point_mm))
    radius = math.sqrt(square)
    at = [(float(np.clip(radius, each.r_min_mm, each.r_max_mm)), float(np.clip(yaw, low, high)))]
    at += [(float(np.clip(radius * math.cos(yaw - edge), each.r_min_mm, each.r_max_mm)), edge) for edge in (low, high)]
    return np.array([each.at(r, a) for r, a in at])
