"""A software renderer for the twin's camera and for tests: flat and convex things over a table, drawn true to the pixel.

Edges are drawn four times as fine as the picture where it matters, so that a marker's edges fall where a lens would put them. PyBullet's
own renderer needs 0.4 s for a picture of 1280x720 without any smoothing of edges; this one needs some 20 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from marl_handover.perception.calibration import CameraCalibration, Floats, Pixels
from marl_handover.perception.settings import LookConfig

FINE = 4
"""Pixels of a fine window to one of the picture, each way."""

_SUBPIXEL_BITS = 4
_NOISE_MARGIN_PX = 61
_TABLE = (226, 229, 230)
_EDGE_PX = 3

Colour = tuple[float, float, float]


class Shape(NamedTuple):
    """Something to draw: the convex outline of world points (n, 3) in mm, in a BGR colour, or a texture.

    A ``texture``, grey or BGR, lies on four points: its upper left corner, upper right, lower right, lower left. ``window`` names the fine
    window the shape belongs to; shapes without one are drawn at the picture's own resolution.
    """

    points_mm: Floats
    colour: Colour
    texture: Pixels | None = None
    window: str = ""

    def height_mm(self) -> float:
        """Which of two shapes is nearer to a camera above."""
        return float(self.points_mm[:, 2].mean())


class Renderer:
    """Draws pictures as the camera of ``calibration`` would see them; equal seeds and calls give equal pictures.

    Args:
        calibration: the camera, as it truly is; its place included.
        look: blur, noise and light.
        seed: of the noise.
        background: BGR picture of the empty table; None: plain.
    """

    def __init__(
        self, calibration: CameraCalibration, look: LookConfig | None = None, seed: int = 0, background: Pixels | None = None
    ) -> None:
        self.calibration, self.look = calibration, look or LookConfig()
        self.look.validate()
        width, height = calibration.intrinsics.size_px
        self._random = np.random.default_rng(seed)
        self._background = np.full((height, width, 3), _TABLE, np.uint8) if background is None else background
        T, K = calibration.pose(), calibration.intrinsics.matrix
        self._P = K @ T[:3]
        self._lens = self._lens_map()
        self._gain = self._light_field()
        self._grains = self._noise_bank()

    def picture(self, shapes: Sequence[Shape]) -> Pixels:
        """BGR (height, width, 3): ``shapes`` on the table, the lower ones hidden by the higher ones."""
        ordered = sorted(shapes, key=Shape.height_mm)
        outlines = [self._pixels(shape.points_mm) for shape in ordered]
        frame = self._background.copy()
        for shape, outline in zip(ordered, outlines, strict=True):
            if not shape.window:
                _draw(frame, shape, outline, 1)
        for name in dict.fromkeys(shape.window for shape in ordered if shape.window):
            self._fine_window(frame, name, ordered, outlines)
        return self._seen(frame)

    def _pixels(self, points_mm: Floats) -> Floats:
        """Pixels (n, 2) of world points (n, 3) as a lens without distortion has them."""
        seen = np.column_stack([points_mm, np.ones(len(points_mm))]) @ self._P.T
        return np.asarray(seen[:, :2] / seen[:, 2:])

    def _fine_window(self, frame: Pixels, name: str, shapes: Sequence[Shape], outlines: Sequence[Floats]) -> None:
        """Draw the part of the picture around the shapes of one window, everything in it, finely."""
        own = np.concatenate([outline for shape, outline in zip(shapes, outlines, strict=True) if shape.window == name])
        limit = np.array([frame.shape[1], frame.shape[0]])
        low = np.clip(np.floor(own.min(axis=0)).astype(int) - _EDGE_PX, 0, limit)
        high = np.clip(np.ceil(own.max(axis=0)).astype(int) + _EDGE_PX + 1, 0, limit)
        if (high <= low).any():
            return
        part = self._background[low[1] : high[1], low[0] : high[0]]
        canvas = np.repeat(np.repeat(part, FINE, axis=0), FINE, axis=1)
        for shape, outline in zip(shapes, outlines, strict=True):
            if (outline.max(axis=0) > low - 1).all() and (outline.min(axis=0) < high + 1).all():
                _draw(canvas, shape, (outline + 0.5 - low) * FINE - 0.5, FINE)
        frame[low[1] : high[1], low[0] : high[0]] = cv2.resize(canvas, tuple((high - low).tolist()), interpolation=cv2.INTER_AREA)

    def _seen(self, frame: Any) -> Pixels:
        """What lens and sensor make of a sharp picture."""
        if self._lens is not None:
            frame = cv2.remap(frame, *self._lens, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if self.look.blur_px > 0:
            frame = cv2.GaussianBlur(frame, (0, 0), self.look.blur_px)
        frame = cv2.multiply(frame, self._gain, scale=1 / 128)
        if self._grains is not None:
            row, column = self._random.integers(0, _NOISE_MARGIN_PX, 2)
            height, width = frame.shape[:2]
            brighter, darker = (bank[row : row + height, column : column + width] for bank in self._grains)
            frame = cv2.subtract(cv2.add(frame, brighter), darker)
        return np.asarray(frame, dtype=np.uint8)

    def _light_field(self) -> Pixels:
        """Gain of each pixel, times 128: it falls from one corner of the picture to the opposite one."""
        width, height = self.calibration.intrinsics.size_px
        along = (np.arange(width)[None, :] / width + np.arange(height)[:, None] / height) / 2
        gain = self.look.light * (1 - self.look.gradient * along)
        return np.repeat(np.clip(np.rint(128 * gain), 0, 255).astype(np.uint8)[..., None], 3, axis=2)

    def _noise_bank(self) -> tuple[Pixels, Pixels] | None:
        """What noise adds and takes away; each picture cuts its own piece from it, since drawing it anew would take most of the time."""
        if self.look.noise == 0:
            return None
        width, height = self.calibration.intrinsics.size_px
        grain = self._random.normal(0, self.look.noise, (height + _NOISE_MARGIN_PX, width + _NOISE_MARGIN_PX, 1))
        grain = np.repeat(np.rint(grain), 3, axis=2)
        return np.clip(grain, 0, 255).astype(np.uint8), np.clip(-grain, 0, 255).astype(np.uint8)

    def _lens_map(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """For each pixel behind a lens that distorts, where a pinhole would have it."""
        lens = self.calibration.intrinsics
        if not lens.distortion.any():
            return None
        width, height = lens.size_px
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2).astype(float)
        straight = cv2.undistortPoints(grid, lens.matrix, lens.distortion, P=lens.matrix).reshape(height, width, 2)
        return np.ascontiguousarray(straight[..., 0], np.float32), np.ascontiguousarray(straight[..., 1], np.float32)


def _draw(canvas: Pixels, shape: Shape, outline: Floats, scale: int) -> None:
    """Draw one shape whose points are at pixels ``outline`` (n, 2) of the canvas."""
    corners = np.rint(outline * (1 << _SUBPIXEL_BITS)).astype(np.int32)
    hull = corners if shape.texture is not None else cv2.convexHull(corners.reshape(-1, 1, 2))
    smooth = cv2.LINE_AA if scale == 1 else cv2.LINE_8
    cv2.fillConvexPoly(canvas, hull, shape.colour, smooth, _SUBPIXEL_BITS)
    if shape.texture is None:
        return
    texture = shape.texture if shape.texture.ndim == 3 else cv2.cvtColor(shape.texture, cv2.COLOR_GRAY2BGR)
    height, width = texture.shape[:2]
    edges = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]], np.float32)
    H = cv2.getPerspectiveTransform(edges, outline.astype(np.float32))
    size = (canvas.shape[1], canvas.shape[0])
    cv2.warpPerspective(texture, H, size, dst=canvas, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT)
