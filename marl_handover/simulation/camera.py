"""Cameras of the simulated cell: what each engine draws looks through one of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.cell.cell import Cell

Pixels = NDArray[np.uint8]


class Camera(NamedTuple):
    """A pinhole camera. ``focal_px`` is for a picture ``width_px`` wide; one of another shape shows all of that, and more on two sides."""

    eye_mm: tuple[float, float, float]
    target_mm: tuple[float, float, float]
    up: tuple[float, float, float]
    focal_px: float
    width_px: int = 1280
    height_px: int = 720


TOP = Camera((0.0, 0.0, 700.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 917.0)
"""The cell's own: straight down on the origin. World x is up in the picture, world y points left."""

VIEWS = ("overview", "top")

_OVERVIEW = Camera((-560.0, 0.0, 560.0), (-30.0, 0.0, 75.0), (0.0, 0.0, 1.0), 1330.0, height_px=832)
_OVERVIEW_REACH_MM, _TOP_REACH_MM = 230.0, 320.0


def view(name: str, cell: Cell) -> Camera:
    """The camera of that name, of :data:`VIEWS`: top, the cell's own; or overview.

    The overview is for people: from the side, all arms and all that they reach in view, a pair's left one on the left. Both stand farther
    off where arms reach farther, and over the middle of more than two arms.
    """
    if cell.num_arms > 2:
        return _over_many(name, cell)
    reach_mm = max(arm.r_max_mm for arm in cell.arms)
    if name == "top":
        return TOP if reach_mm <= _TOP_REACH_MM else TOP._replace(eye_mm=(0.0, 0.0, reach_mm / _TOP_REACH_MM * TOP.eye_mm[2]))
    farther = max(1.0, reach_mm / _OVERVIEW_REACH_MM)
    (eye_x, eye_y, eye_z), (x, y, z) = _OVERVIEW.eye_mm, _OVERVIEW.target_mm
    return _OVERVIEW._replace(eye_mm=(farther * eye_x, eye_y, farther * eye_z), target_mm=(farther * x, y, z))


_ROOM_MM = {"top": ((275.0, 488.0), 30.0), "overview": ((230.0, 270.0), 0.0)}
"""Half of what each camera sees of the table along x and along y, and what it leaves free beside that."""


def _over_many(name: str, cell: Cell) -> Camera:
    """A camera over the middle of what more than two arms stand on and reach, as far off as it takes."""
    low, high = _bounds_mm(cell)
    middle, (room, spare) = (low + high) / 2, _ROOM_MM[name]
    camera, farther = TOP if name == "top" else _OVERVIEW, max(1.0, float((((high - low) / 2 + spare) / room).max()))
    (eye_x, eye_y, eye_z), (x, y, z) = camera.eye_mm, camera.target_mm
    at_x, at_y = float(middle[0]), float(middle[1])
    return camera._replace(eye_mm=(at_x + farther * eye_x, at_y + eye_y, farther * eye_z), target_mm=(at_x + farther * x, at_y + y, z))


def _bounds_mm(cell: Cell) -> tuple[Floats, Floats]:
    """Least and greatest x and y, (2,) each, of where arms stand and of what they reach."""
    points = []
    for arm in cell.arms:
        angle = arm.base.facing_rad + np.linspace(*arm.yaw_rad, 91)
        points += [arm.base.position_mm[None], arm.base.position_mm + arm.r_max_mm * np.stack([np.cos(angle), np.sin(angle)], -1)]
    table = np.concatenate(points)
    return table.min(axis=0), table.max(axis=0)


NEAR_MM, _FAR_MM = 50.0, 3000.0
"""Nearer than this nothing is drawn."""

LIGHT = (0.4, -0.3, 1.0)
"""Towards the light."""


def far_mm(camera: Camera) -> float:
    """Farther than this nothing is drawn."""
    return max(_FAR_MM, 2 * float(np.linalg.norm(camera.eye_mm)))


def frustum_mm(camera: Camera, width: int, height: int) -> tuple[float, float]:
    """Half of the width and of the height of what a picture of ``width`` x ``height`` pixels shows, :data:`NEAR_MM` before the eye."""
    pixel = NEAR_MM / camera.focal_px * max(camera.width_px / width, camera.height_px / height)
    return pixel * width / 2, pixel * height / 2


def strip_triangles(count: int) -> NDArray[np.int64]:
    """The triangles (n, 3) of a strip between two edges of ``count`` points each, which are numbered one edge after the other."""
    first = np.arange(count - 1)
    return np.stack([first, first + 1, first + count, first + 1, first + count + 1, first + count], -1).reshape(-1, 3)
