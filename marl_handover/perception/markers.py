"""Corners of markers in a picture, the pin that cuts the block's marker notwithstanding."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple

import cv2
import numpy as np

from marl_handover.perception.calibration import Floats, Pixels
from marl_handover.perception.sheets import dictionary

PLAIN, OPENED = "plain", "opened"

_PASSES = ((PLAIN, 53), (OPENED, 53), (OPENED, 23))
"""Stages, each with the window of its threshold in px; a pass is made for what the ones before did not find.

A window larger than the marker is quickest, since clutter falls apart into fewer shapes; a small one copes with a shadow across it.
"""

_REFINE_WINDOW_PX, _REFINE_WINDOW_CELLS = 3, 0.7
_SMALLEST, _LARGEST = 0.55, 1.7  # of the perimeter expected of a marker
_PIN_MARGIN_PX = 1.5


class Corners(NamedTuple):
    """A marker's corners (4, 2) in px, from its upper left one on, clockwise as printed; and the stage that found it."""

    pixels: Floats
    stage: str


class MarkerFinder:
    """Finds markers of one dictionary whose edges have about ``edge_px``.

    A picture is searched as it is, and, for markers that were not found, with all bright things removed that are narrower than
    ``opening_px``: seen from the side, the pin cuts the marker's black border, and with it the square that every detector looks for.
    """

    def __init__(self, dictionary_name: str, edge_px: float, opening_px: int) -> None:
        self._words, self._edge_px = dictionary(dictionary_name), edge_px
        self._kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (opening_px, opening_px))
        self._detectors: dict[tuple[int, int], Any] = {}

    def find(self, grey: Pixels, wanted: Collection[int]) -> dict[int, Corners]:
        """The markers ``wanted`` that are in a grey picture (h, w)."""
        found: dict[int, Corners] = {}
        picture = grey
        for stage, window_px in _PASSES:
            missing = [number for number in wanted if number not in found]
            if not missing:
                break
            if stage == OPENED and picture is grey:
                picture = np.asarray(cv2.morphologyEx(grey, cv2.MORPH_OPEN, self._kernel), dtype=np.uint8)
            found |= self._search(picture, missing, stage, window_px)
        return found

    def _search(self, grey: Pixels, wanted: Collection[int], stage: str, window_px: int) -> dict[int, Corners]:
        corners, numbers, _ = self._detector(window_px, max(grey.shape)).detectMarkers(grey)
        if numbers is None:
            return {}
        seen = zip(np.ravel(numbers).tolist(), corners, strict=True)
        return {number: Corners(np.asarray(found, dtype=float).reshape(4, 2), stage) for number, found in seen if number in wanted}

    def _detector(self, window_px: int, longest_px: int) -> Any:
        """OpenCV states sizes in parts of the picture's longer edge, so each size of picture has a detector of its own."""
        key = (window_px, longest_px)
        if key not in self._detectors:
            settings = refined()
            settings.adaptiveThreshWinSizeMin = settings.adaptiveThreshWinSizeMax = window_px
            # Of all markers only the few wanted ones count, so all the bits that the code can mend may be mended.
            settings.errorCorrectionRate = 1.0
            around = 4 * self._edge_px / longest_px
            settings.minMarkerPerimeterRate, settings.maxMarkerPerimeterRate = _SMALLEST * around, _LARGEST * around
            self._detectors[key] = cv2.aruco.ArucoDetector(self._words, settings)
        return self._detectors[key]


def refined() -> Any:
    """OpenCV's detector parameters with the corner refinement that measured best: 0.02 mm where the default has 0.05 to 0.4."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.cornerRefinementWinSize = _REFINE_WINDOW_PX
    settings.relativeCornerRefinmentWinSize = _REFINE_WINDOW_CELLS
    settings.cornerRefinementMaxIterations, settings.cornerRefinementMinAccuracy = 50, 0.01
    return settings


def opening_px(pin_px: float, cell_px: float) -> int:
    """Kernel that removes a pin ``pin_px`` wide and leaves a marker whose cells have ``cell_px``: odd, at least 3."""
    wanted = math.ceil(pin_px + _PIN_MARGIN_PX)
    largest = math.floor(cell_px + 1)
    return max(3, min(wanted + (wanted + 1) % 2, largest - (largest + 1) % 2))
