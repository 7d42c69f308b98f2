"""The printed things as OpenCV's objects and as textures: the ChArUco board, markers, the block's top."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from marl_handover.config import BlockConfig
from marl_handover.errors import HandoverError, InvalidSetting
from marl_handover.perception.calibration import Floats, Pixels
from marl_handover.perception.settings import BoardConfig, TargetConfig
from marl_handover.requirements import install_line

_NAMES = {"16h5": "DICT_APRILTAG_16h5", "25h9": "DICT_APRILTAG_25h9", "36h11": "DICT_APRILTAG_36h11"}
WHITE, BLACK = 255, 0
TRUE_CORNERS = (4, 14)
"""The first OpenCV that counts the middle of a pixel alike when it finds a board's corners and when it projects them."""


class Sheet(NamedTuple):
    """A flat grey picture of a known size: pixels (height, width), and the edges in mm. Its frame: origin in the middle, y up, z out."""

    pixels: Pixels
    width_mm: float
    height_mm: float


class OldOpenCV(HandoverError):
    """An OpenCV that puts the printed corners of a board half a pixel off: cameras calibrated with it would be off in silence."""

    def __init__(self, version: str) -> None:
        super().__init__(f"OpenCV {version} finds corners half a pixel off; run: {install_line(only=['opencv-python-headless'])}")


@lru_cache(maxsize=8)
def dictionary(name: str) -> Any:
    """OpenCV's marker dictionary of one of ``settings.DICTIONARIES``.

    Raises:
        OldOpenCV: another package may have brought its own OpenCV, which then takes the place of the one that is asked for.
    """
    if tuple(map(int, cv2.__version__.split(".")[:2])) < TRUE_CORNERS:
        raise OldOpenCV(cv2.__version__)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _NAMES.get(name, "DICT_" + name.upper())))


def marker_cells(name: str, number: int) -> Pixels:
    """A marker, one pixel a cell, its black border included: (n, n) of 0 and 255. Raises :class:`InvalidSetting` for a number too high."""
    words = dictionary(name)
    if not 0 <= number < len(words.bytesList):
        raise InvalidSetting("marker", number, f"0 to {len(words.bytesList) - 1} in dictionary {name}")
    cells = int(words.markerSize) + 2
    return np.asarray(cv2.aruco.generateImageMarker(words, number, cells), dtype=np.uint8)


def marker_sheet(name: str, number: int, marker_mm: float, sheet_mm: float, px_per_mm: float = 8.0) -> Sheet:
    """A marker in the middle of a white square with edges of ``sheet_mm``."""
    cells = marker_cells(name, number)
    count, edge = len(cells), round(sheet_mm * px_per_mm)
    scale, middle = count / marker_mm / px_per_mm, (edge - 1) / 2
    # From a pixel of the sheet to the cell it shows; sampling the nearest cell keeps edges where they are to half a pixel.
    inverse = np.array([[scale, 0, (count - 1) / 2 - scale * middle], [0, scale, (count - 1) / 2 - scale * middle]])
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    pixels = cv2.warpAffine(cells, inverse, (edge, edge), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=WHITE)
    return Sheet(np.asarray(pixels, dtype=np.uint8), edge / px_per_mm, edge / px_per_mm)


def block_top(block: BlockConfig, target: TargetConfig, px_per_mm: float = 8.0) -> Sheet:
    """The block's upper face with its marker."""
    return marker_sheet(target.dictionary, target.block_id, block.marker_mm, block.side_mm, px_per_mm)


def charuco_board(config: BoardConfig) -> Any:
    """OpenCV's board; its corners' coordinates are in mm from its upper left corner, y down."""
    config.validate()
    return cv2.aruco.CharucoBoard((config.columns, config.rows), config.square_mm, config.marker_mm, dictionary(config.dictionary))


def board_corners_mm(config: BoardConfig) -> Floats:
    """The inner corners (n, 3) of the board in its sheet's frame: origin in its middle, x to the right, y up, z out."""
    corners = np.array(charuco_board(config).getChessboardCorners(), dtype=float)
    middle = np.array([config.columns, config.rows]) * config.square_mm / 2
    return np.column_stack([corners[:, 0] - middle[0], middle[1] - corners[:, 1], np.zeros(len(corners))])


def charuco_sheet(config: BoardConfig, px_per_mm: float = 6.0, margin_mm: float = 0.0) -> Sheet:
    """The board, with a white margin around it."""
    square = round(config.square_mm * px_per_mm)
    margin = round(margin_mm * px_per_mm)
    size = (config.columns * square + 2 * margin, config.rows * square + 2 * margin)
    pixels = np.asarray(charuco_board(config).generateImage(size, marginSize=margin, borderBits=1), dtype=np.uint8)
    scale = config.square_mm / square
    return Sheet(pixels, size[0] * scale, size[1] * scale)
