"""Camera pictures for people: smaller, with what was seen drawn in, as JPEG files."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from PIL import Image

from marl_handover.errors import CorruptFile
from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.calibration import CameraCalibration, Floats, Pixels

QUALITY = 80
LARGEST_PX = 20_000_000
_THIN_PX, _THICK_PX, _LETTERS = 2, 5, 0.8
_GAP_PX = 8
_DARK = (20, 20, 20)
_FRACTION_BITS = 4


class Mark(NamedTuple):
    """A square on the table, or on something of height ``z_mm``: pose (3,), edge, colour "#RRGGBB", and what is written beside it."""

    pose: Floats
    side_mm: float
    z_mm: float
    colour: str
    text: str


def annotated(image: Pixels, calibration: CameraCalibration, marks: Sequence[Mark], width_px: int = 640) -> Pixels:
    """A BGR picture (height, width, 3), made ``width_px`` wide if it is wider, with the outline and the +x direction of every mark."""
    scale = min(1.0, width_px / image.shape[1])
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    small: Any = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale < 1 else image.copy()
    for mark in marks:
        _draw(small, mark, (calibration.project(_lines_mm(mark)) + 0.5) * scale - 0.5)
    return np.asarray(small)


def jpeg(image: Pixels) -> bytes:
    """A BGR picture as a JPEG file's content."""
    done, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done, "a picture of bytes can always be written"
    return bytes(content)


def decoded(content: bytes, path: Path, formats: tuple[str, ...] = ("JPEG", "PNG")) -> Pixels:
    """The picture that a file at ``path`` holds, BGR (height, width, 3). How large it is is looked at first.

    Raises:
        CorruptFile: it is no such picture, or larger than :data:`LARGEST_PX`.
    """
    try:
        with Image.open(io.BytesIO(content), formats=formats) as head:
            width, height = head.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise CorruptFile("picture", path, f"it is no {' or '.join(formats)} file") from error
    if width * height > LARGEST_PX:
        raise CorruptFile("picture", path, f"it has {width} x {height} pixels, more than {LARGEST_PX}")
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise CorruptFile("picture", path, f"it is no {' or '.join(formats)} file")
    return np.asarray(image, dtype=np.uint8)


def _lines_mm(mark: Mark) -> Floats:
    """World points (6, 3): the four corners, the middle, and the tip of the arrow."""
    half = mark.side_mm / 2
    inside = np.array([[-half, -half], [half, -half], [half, half], [-half, half], [0, 0], [half, 0]], float)
    x_mm, y_mm, yaw_rad = (float(value) for value in mark.pose)
    T = flat_pose(x_mm, y_mm, yaw_rad, mark.z_mm)
    return np.asarray(inside @ T[:2, :2].T @ np.eye(2, 3) + T[:3, 3])


def _draw(image: Any, mark: Mark, pixels: Floats) -> None:
    """Every line twice: dark and thick, then thin in its colour, to be seen on anything."""
    colour = tuple(int(mark.colour[at : at + 2], 16) for at in (5, 3, 1))
    outside = 8 * max(image.shape)
    fixed = np.round(np.clip(pixels, -outside, outside) * 2**_FRACTION_BITS).astype(np.int32)
    corner = _beside(image, mark.text, pixels[:4])
    for ink, width in ((_DARK, _THICK_PX), (colour, _THIN_PX)):
        cv2.polylines(image, [fixed[:4]], True, ink, width, cv2.LINE_AA, _FRACTION_BITS)
        cv2.polylines(image, [fixed[4:]], False, ink, width, cv2.LINE_AA, _FRACTION_BITS)
        cv2.putText(image, mark.text, corner, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, ink, width, cv2.LINE_AA)


def _beside(image: Any, text: str, corners: Floats) -> tuple[int, int]:
    """Where to begin a text: right of the square, or left of it where there is no room."""
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, _THIN_PX)
    left, right = corners[:, 0].min() - _GAP_PX - wide, corners[:, 0].max() + _GAP_PX
    column = right if right + wide <= image.shape[1] else left
    row = np.clip(corners[:, 1].mean() + high / 2, high + _GAP_PX, image.shape[0] - _GAP_PX)
    return int(np.clip(column, -1e4, 1e4)), int(row)
