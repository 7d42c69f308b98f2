"""The corners of a block without a marker: a square top of one colour, on sides of another."""

from __future__ import annotations

import math

import cv2
import numpy as np

from marl_handover.config import BlockConfig
from marl_handover.perception.calibration import CameraCalibration, Floats, Pixels
from marl_handover.perception.settings import TargetConfig

_LEAST_SATURATION, _LEAST_VALUE = 70, 40
_AREA_TOLERANCE = 0.35
_SAMPLES = 24  # along an edge, of which the ends stay out: corners are round in a blurred picture
_EDGE_SHARE = 0.8
_REACH_PX = 4.0
_STEP_PX = 0.5


class ColouredSquare:
    """Finds the block's top by its hue, then each of its edges to a fraction of a pixel."""

    def __init__(self, calibration: CameraCalibration, block: BlockConfig, target: TargetConfig) -> None:
        self._calibration, self._side_mm, self._z_mm = calibration, block.side_mm, block.height_mm
        self._hue, self._width = target.colour_hue_deg, target.colour_width_deg
        self._area_px = (block.side_mm * calibration.px_per_mm(block.height_mm)) ** 2
        pin = math.ceil(block.pin_diameter_mm * calibration.px_per_mm(block.pin_top_mm)) + 2
        self._kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (pin, pin))

    def find(self, image: Pixels, window: tuple[slice, slice] | None) -> Floats | None:
        """Corners (4, 2) in px, clockwise in the picture, of the square in a BGR picture or in a window of it; None if there is none."""
        rows, columns = window or (slice(0, image.shape[0]), slice(0, image.shape[1]))
        part = image[rows, columns]
        mask = self._mask(part)
        corners = self._rough(mask)
        if corners is None:
            return None
        lack = _colourlessness(part, mask)
        lines = [self._edge(lack, corners[i - 1], corners[i]) for i in range(4)]
        found = [_crossing(lines[i], lines[(i + 1) % 4]) for i in range(4)]
        return np.array(found) + (columns.start, rows.start)

    def _mask(self, image: Pixels) -> Pixels:
        """Where the colour is, gaps left by the pin closed."""
        # In smoothed colours, since noise turns hues where there is little light.
        hsv = cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1.0), cv2.COLOR_BGR2HSV)
        away = np.abs((hsv[..., 0].astype(np.int16) * 2 - round(self._hue) + 180) % 360 - 180)
        mask = (away <= self._width) & (hsv[..., 1] >= _LEAST_SATURATION) & (hsv[..., 2] >= _LEAST_VALUE)
        return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, self._kernel), dtype=np.uint8)

    def _rough(self, mask: Pixels) -> Floats | None:
        """Corners (4, 2) of the region that is most like the square in area, to a pixel."""
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        areas = [abs(cv2.contourArea(contour) / self._area_px - 1) for contour in contours]
        if not areas or min(areas) > _AREA_TOLERANCE:
            return None
        box = cv2.boxPoints(cv2.minAreaRect(contours[int(np.argmin(areas))])).astype(float)
        centre = box.mean(axis=0)
        # Clockwise as seen, y down, whatever order OpenCV has today.
        return np.asarray(box[np.argsort(np.arctan2(box[:, 1] - centre[1], box[:, 0] - centre[0]))])

    def _edge(self, lack: Floats, start: Floats, end: Floats) -> tuple[Floats, Floats]:
        """A point and a direction (2,) of the edge between two corners, from where the colour changes most along lines across it."""
        along = np.linspace(0.5 - _EDGE_SHARE / 2, 0.5 + _EDGE_SHARE / 2, _SAMPLES)[:, None]
        middle = start + along * (end - start)
        outwards = np.array([end[1] - start[1], start[0] - end[0]]) / math.hypot(*(end - start))
        steps = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
        places = (middle[:, None] + steps[None, :, None] * outwards).astype(np.float32)
        profile = cv2.remap(lack, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        slope = np.diff(profile, axis=1)
        best = np.clip(slope.argmax(axis=1), 1, slope.shape[1] - 2)
        left, peak, right = (slope[np.arange(_SAMPLES), best + shift] for shift in (-1, 0, 1))
        bend = left - 2 * peak + right
        shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, 1), 0.0)
        offset = steps[best] + _STEP_PX / 2 + _STEP_PX * np.clip(shift, -1, 1)
        points = (middle + offset[:, None] * outwards).astype(np.float32)
        vx, vy, x, y = np.ravel(cv2.fitLine(points, cv2.DIST_HUBER, 0, 0.01, 0.01)).tolist()
        return np.array([x, y]), np.array([vx, vy])


def _colourlessness(image: Pixels, mask: Pixels) -> Floats:
    """How much each pixel lacks of the colour that is inside ``mask``: (h, w) float32.

    Brightness does not count: seen over a narrow side face in shadow, the step from top to side would drown in that from side to table.
    """
    tint = np.array(cv2.mean(image, mask)[:3], np.float32)
    tint -= tint.mean()
    # A tint adds up to zero, so grey, whatever its brightness, has none of it.
    return np.asarray(-(image.astype(np.float32) @ (tint / max(1.0, float(np.linalg.norm(tint))))))


def _crossing(first: tuple[Floats, Floats], second: tuple[Floats, Floats]) -> Floats:
    """Where two lines (point, direction) meet: (2,)."""
    (p, u), (q, v) = first, second
    return np.asarray(p + u * np.linalg.solve(np.column_stack([u, -v]), q - p)[0])
