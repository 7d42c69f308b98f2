"""Cameras of the simulated cell, drawn by PyBullet's software renderer: they need no display."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.config import require_at_least
from marl_handover.simulation.engine import Engine, length, pybullet

Pixels = NDArray[np.uint8]


class Camera(NamedTuple):
    """A pinhole camera. ``focal_px`` is for a picture ``width_px`` wide; other sizes see the same width of table."""

    eye_mm: tuple[float, float, float]
    target_mm: tuple[float, float, float]
    up: tuple[float, float, float]
    focal_px: float
    width_px: int = 1280
    height_px: int = 720


TOP = Camera((0.0, 0.0, 700.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 917.0)
"""The cell's own: straight down on the origin. World x is up in the picture, world y points left."""

OVERVIEW = Camera((-760.0, 0.0, 520.0), (0.0, 0.0, 90.0), (0.0, 0.0, 1.0), 1450.0)
"""For people: from the side, both arms in view, the left one on the left."""

_NEAR_MM, _FAR_MM = 50.0, 3000.0
_LIGHT = (0.4, -0.3, 1.0)


def picture(engine: Engine, camera: Camera, width: int, height: int) -> Pixels:
    """What ``camera`` sees now: RGB (height, width, 3). Raises :class:`InvalidSetting` for a size below 1."""
    require_at_least("width", width, 1)
    require_at_least("height", height, 1)
    eye, target = ([length(value) for value in point] for point in (camera.eye_mm, camera.target_mm))
    half_width = length(_NEAR_MM) * camera.width_px / (2 * camera.focal_px)
    half_height = half_width * height / width
    _, _, pixels, _, _ = pybullet.getCameraImage(
        width,
        height,
        viewMatrix=pybullet.computeViewMatrix(eye, target, camera.up),
        projectionMatrix=pybullet.computeProjectionMatrix(
            -half_width, half_width, -half_height, half_height, length(_NEAR_MM), length(_FAR_MM)
        ),
        lightDirection=_LIGHT,
        shadow=0,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=engine.client,
    )
    return np.ascontiguousarray(np.reshape(np.asarray(pixels, dtype=np.uint8), (height, width, 4))[..., :3])
