"""The lens, from pictures of a ChArUco board held at many places and slants."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from marl_handover.perception.calibration import CalibrationFailed, Floats, Intrinsics, Pixels
from marl_handover.perception.settings import BoardConfig
from marl_handover.perception.sheets import board_corners_mm, charuco_board
from marl_handover.wording import counted

LEAST_VIEWS, LEAST_CORNERS = 8, 8
LARGEST_ERROR_PX = 1.0
LEAST_SLANT_DEG = 10.0

_OUTLIER = 2.5


class BoardView(NamedTuple):
    """A board in a picture: corners (n, 2) in px, and where those are on the board (n, 3) in mm, in its sheet's frame."""

    pixels: Floats
    board_mm: Floats


class BoardFinder:
    """Finds the inner corners of one ChArUco board."""

    def __init__(self, config: BoardConfig) -> None:
        self._corners_mm = board_corners_mm(config)
        self._detector: Any = cv2.aruco.CharucoDetector(charuco_board(config))

    def find(self, image: Pixels) -> BoardView | None:
        """The board in a BGR or grey picture; None if fewer than :data:`LEAST_CORNERS` of its corners are seen."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        corners, numbers, _, _ = self._detector.detectBoard(grey)
        if numbers is None or len(np.ravel(numbers)) < LEAST_CORNERS:
            return None
        return BoardView(np.asarray(corners, dtype=float).reshape(-1, 2), self._corners_mm[np.ravel(numbers)])


def calibrate_lens(images: Iterable[Pixels], config: BoardConfig) -> Intrinsics:
    """Intrinsics from pictures, BGR or grey, all of one size.

    Pictures without the board are left out, and so is, once, any whose error is far above the others'. The board should fill the
    picture's corners in some, and be slanted by 20 to 40 degrees in most: seen flat, it cannot tell focal length from distance.

    Raises:
        CalibrationFailed: too few usable pictures, none slanted, pictures of several sizes, or points that fit no camera to 1 px.
    """
    finder, views, size = BoardFinder(config), [], None
    for image in images:
        if size is not None and image.shape[:2] != size:
            raise CalibrationFailed(f"the pictures have several sizes: {size[1]}x{size[0]} and {image.shape[1]}x{image.shape[0]} px")
        size = image.shape[:2]
        found = finder.find(image)
        if found is not None:
            views.append(found)
    if size is None or len(views) < LEAST_VIEWS:
        raise CalibrationFailed(
            f"the board is found in {counted(len(views), 'picture')}, {LEAST_VIEWS} are needed; "
            f"is it the board of {config.columns} x {config.rows} squares with {config.dictionary} markers, in focus and evenly lit?"
        )
    lens, errors, slants = _fit(views, (size[1], size[0]))
    kept = [view for view, error in zip(views, errors, strict=True) if error <= _OUTLIER * float(np.median(errors))]
    if LEAST_VIEWS <= len(kept) < len(views):
        lens, errors, slants = _fit(kept, (size[1], size[0]))
    if max(slants) < LEAST_SLANT_DEG:
        raise CalibrationFailed(
            f"the board lies flat in all pictures (slant up to {max(slants):.0f} deg); slant it by 20 to 40 deg in most"
        )
    if not lens.error_px < LARGEST_ERROR_PX:
        raise CalibrationFailed(
            f"no lens fits the pictures: {lens.error_px:.2f} px off, {LARGEST_ERROR_PX:g} is allowed; "
            "check with a ruler that the print has its true size and lies on something flat"
        )
    return lens


def _fit(views: Sequence[BoardView], size_px: tuple[int, int]) -> tuple[Intrinsics, Floats, list[float]]:
    """Intrinsics, the error of each view in px, and each view's slant in degrees."""
    board = [view.board_mm.astype(np.float32) for view in views]
    seen = [view.pixels.astype(np.float32) for view in views]
    error, matrix, distortion, turns, _, _, _, errors = cv2.calibrateCameraExtended(
        board, seen, size_px, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    )
    slants = [float(np.degrees(np.arccos(min(1.0, abs(cv2.Rodrigues(turn)[0][2, 2]))))) for turn in turns]
    lens = Intrinsics(size_px, np.array(matrix, dtype=float), np.ravel(distortion).astype(float)[:5], float(error), len(views))
    return lens, np.ravel(errors), slants
