"""What stands in the cell, as shapes, and a software renderer that draws them true to the pixel for the twin's camera and for tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.cell.build import CellModel
from marl_handover.config import BlockConfig
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.se3 import flat_pose, transform
from marl_handover.geometry.urdf import Primitive
from marl_handover.perception.calibration import CameraCalibration, Floats, Pixels
from marl_handover.perception.printables import Sheet, block_top, marker_sheet
from marl_handover.perception.settings import LookConfig, TargetConfig

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


_WHITE = (248.0, 248.0, 248.0)
_WOOD, _PIN = (107.0, 153.0, 194.0), (148.0, 199.0, 224.0)
_LINKS: dict[str, Colour] = {"base_link": (33, 31, 31), "wrist": (33, 31, 31), "hand": (33, 31, 31)}
_FINGER, _SILVER = (33.0, 184.0, 237.0), (199.0, 194.0, 191.0)
_LIGHT = np.array([0.4, -0.3, 1.0]) / math.sqrt(0.4**2 + 0.3**2 + 1)
_PIN_PIECES = 5
_ROUND = 12


def sheet_shape(sheet: Sheet, T_world_sheet: Floats, window: str = "sheet") -> Shape:
    """A printed sheet; ``T_world_sheet`` (4, 4) as in :class:`Sheet`, in mm."""
    x, y = sheet.width_mm / 2, sheet.height_mm / 2
    return Shape(_moved(T_world_sheet, [[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]]), _WHITE, sheet.pixels, window)


def block_shapes(block: BlockConfig, T_world_block: Floats, eye_mm: Floats, top: Sheet | Colour, sides: Colour = _WOOD) -> list[Shape]:
    """The block with its pin, seen from ``eye_mm`` (3,).

    ``T_world_block`` (4, 4) in mm: origin in the middle of the lower face, z along the pin; it may be carried, or lie on its side.
    ``top``: the sheet on its upper face, or a colour.
    """
    half, high = block.side_mm / 2, block.height_mm
    corners = np.array([[-half, half], [half, half], [half, -half], [-half, -half]])
    upper, lower = (np.column_stack([corners, np.full(4, z)]) for z in (high, 0.0))
    faces = [lower, *(np.array([lower[i], lower[i - 1], upper[i - 1], upper[i]]) for i in range(4))]
    shapes, centre = [], _moved(T_world_block, [[0, 0, high / 2]])[0]
    for face in faces:
        points = _moved(T_world_block, face)
        outwards = points.mean(axis=0) - centre
        normal = outwards / np.linalg.norm(outwards)
        if normal @ (eye_mm - points[0]) > 0:
            shapes.append(Shape(points, _shaded(sides, normal), window="block"))
    if T_world_block[:3, 2] @ (eye_mm - _moved(T_world_block, upper[:1])[0]) > 0:
        points = _moved(T_world_block, upper)
        shapes.append(Shape(points, _WHITE, top.pixels, "block") if isinstance(top, Sheet) else Shape(points, top, window="block"))
    heights = np.linspace(high, block.pin_top_mm, _PIN_PIECES + 1)
    ring = _ring(block.pin_diameter_mm / 2)
    for low, up in pairwise(heights):
        piece = np.concatenate([np.column_stack([ring, np.full(_ROUND, z)]) for z in (low, up)])
        shapes.append(Shape(_moved(T_world_block, piece), _PIN, window="block"))
    return shapes


def arm_shapes(arm: ArmModel, base: SE2, joints_rad: ArrayLike, gripper_mm: float | None = None) -> list[Shape]:
    """An arm, as its URDF's collision shapes, at joints (5,); ``gripper_mm``: how far each finger is from closed, None: open."""
    T_world_base = base.matrix()
    frames = arm.link_transforms(np.asarray(joints_rad, dtype=float), gripper_mm)
    shapes = []
    for link in arm.description.links:
        colour = _FINGER if "finger" in link.name else _LINKS.get(link.name, _SILVER)
        for primitive in link.collisions:
            T = T_world_base @ frames[link.name] @ transform(primitive.xyz_mm, primitive.rpy_rad)
            shapes.append(Shape(_moved(T, outline(primitive)), colour))
    return shapes


class CellPainter:
    """The camera of a twin: the picture of a cell from the truth about it.

    Args:
        model: the cell.
        calibration: the camera as it truly hangs; never show it to what has to calibrate.
        target: which markers are on block and goal.
        look: blur, noise and light.
        seed: of the noise.
        background: BGR picture of the empty table; None: plain.
    """

    def __init__(
        self,
        model: CellModel,
        calibration: CameraCalibration,
        target: TargetConfig | None = None,
        look: LookConfig | None = None,
        seed: int = 0,
        background: Pixels | None = None,
    ) -> None:
        target = target or TargetConfig()
        target.validate()
        self.model, self.target = model, target
        self.renderer = Renderer(calibration, look, seed, background)
        self._eye = calibration.eye_mm()
        self._block = model.cell.config.block
        self._top = block_top(self._block, target)
        self._goal = marker_sheet(target.dictionary, target.goal_id, target.goal_mm, target.goal_mm * 4 / 3)

    def picture(
        self,
        T_world_block: Floats | None,
        joints_rad: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        gripper_mm: Sequence[float | None] | None = None,
        sheets: Sequence[tuple[Sheet, Floats]] = (),
    ) -> Pixels:
        """BGR (height, width, 3).

        Args:
            T_world_block: (4, 4) in mm, see :func:`block_shapes`; None: there is no block.
            joints_rad: (num_arms, 5); None: no arms.
            goal: (3,) where the printed goal lies, x_mm, y_mm, theta_rad; None: there is none.
            gripper_mm: per arm, how far each finger is from closed; None: open.
            sheets: further printed sheets, each with its T_world_sheet.
        """
        shapes = [sheet_shape(sheet, T, f"sheet {index}") for index, (sheet, T) in enumerate(sheets)]
        if goal is not None:
            x_mm, y_mm, theta_rad = (float(value) for value in np.asarray(goal))
            shapes.append(sheet_shape(self._goal, flat_pose(x_mm, y_mm, theta_rad, self.target.goal_height_mm), "goal"))
        if T_world_block is not None:
            shapes += block_shapes(self._block, np.asarray(T_world_block), self._eye, self._top)
        if joints_rad is not None:
            grippers = gripper_mm or [None] * self.model.cell.num_arms
            model = self.model
            for arm, base, joints, opened in zip(model.arms, model.cell.bases, np.asarray(joints_rad), grippers, strict=True):
                shapes += arm_shapes(arm, base, joints, opened)
        return self.renderer.picture(shapes)


def held_boards(calibration: CameraCalibration, count: int, seed: int = 0) -> list[Floats]:
    """T_world_sheet (4, 4) each of a board that somebody holds before the camera: near and far, slanted, all over the picture."""
    random, T_camera_world = np.random.default_rng(seed), calibration.pose()
    width, height = calibration.intrinsics.size_px
    wide, high = np.array([width, height]) / 2 / calibration.intrinsics.matrix[0, 0]
    poses = []
    for _ in range(count):
        depth = random.uniform(0.45, 0.75) * T_camera_world[2, 3]
        place = random.uniform(-0.5, 0.5, 2) * (wide, high) * depth
        slant = transform((0.0, 0.0, 0.0), (math.pi + random.uniform(-0.6, 0.6), random.uniform(-0.6, 0.6), random.uniform(-0.4, 0.4)))
        T_camera_sheet = transform((*place, depth), (0.0, 0.0, 0.0)) @ slant
        poses.append(np.linalg.inv(T_camera_world) @ T_camera_sheet)
    return poses


def _moved(T: Floats, points: ArrayLike) -> Floats:
    points = np.asarray(points, dtype=float)
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _shaded(colour: Colour, normal: Floats) -> Colour:
    """A face's colour in the light, of which a face that looks away still gets some."""
    gain = 0.45 + 0.55 * max(0.0, float(normal @ _LIGHT))
    return colour[0] * gain, colour[1] * gain, colour[2] * gain


def _ring(radius_mm: float) -> Floats:
    angle = np.arange(_ROUND) * (2 * math.pi / _ROUND)
    return radius_mm * np.column_stack([np.cos(angle), np.sin(angle)])


def outline(shape: Primitive) -> Floats:
    """Points (n, 3) whose convex hull is the shape, in its own frame; round ones from twelve sides."""
    if shape.kind == "box":
        signs = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, -1).T
        return np.asarray(signs * np.asarray(shape.size_mm) / 2)
    if shape.kind == "cylinder":
        radius, length = shape.size_mm
        ring = _ring(radius)
        return np.concatenate([np.column_stack([ring, np.full(_ROUND, side * length / 2)]) for side in (-1, 1)])
    radius = shape.size_mm[0]
    rings = [np.column_stack([_ring(radius * math.cos(a)), np.full(_ROUND, radius * math.sin(a))]) for a in np.linspace(-1.2, 1.2, 7)]
    return np.concatenate(rings)
