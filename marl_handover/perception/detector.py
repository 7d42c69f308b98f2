"""Where block and goal lie, from one picture: corners of markers, also where the pin cuts them, and the coloured top of the block.

Positions come from the known plane, never from the depth of a marker.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import wrap
from marl_handover.config import BlockConfig
from marl_handover.perception.calibration import CameraCalibration, Floats, Pixels
from marl_handover.perception.printables import dictionary, marker_cells
from marl_handover.perception.settings import DetectorConfig, TargetConfig

PLAIN, OPENED = "plain", "opened"

_PASSES = ((PLAIN, 53), (OPENED, 53), (OPENED, 23))
"""Stages, each with the window of its threshold in px; a pass is made for what the ones before did not find.

A window larger than the marker is quickest, since clutter falls apart into fewer shapes; a small one copes with a shadow across it.
"""

_REFINE_WINDOW_PX, _REFINE_WINDOW_CELLS = 3, 0.7
_SMALLEST, _LARGEST = 0.55, 1.7  # of the perimeter expected of a marker
_PIN_MARGIN_PX = 1.5

_LEAST_SATURATION, _LEAST_VALUE = 70, 40
_AREA_TOLERANCE = 0.35
_SAMPLES = 24  # along an edge, of which the ends stay out: corners are round in a blurred picture
_EDGE_SHARE = 0.8
_REACH_PX = 4.0
_STEP_PX = 0.5


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


_SHAPE_MM, _SCALE = 0.5, 0.03
"""Corners that miss a square by this root mean square, or a square that is too large or small by this part, halve the confidence.

Measured: noise makes 0.04 mm, one corner under the pin 0.5; a block lifted by 20 mm looks 3 % larger."""

_CORNER_MM = 0.25
"""From this root mean square on, one corner is suspected."""

_SEEN_SCALE = 0.99
"""Corner refinement puts a marker's corners 0.2 px inside."""


class PoseEstimate(NamedTuple):
    """Something that was seen.

    ``pose`` (3,): x_mm, y_mm, theta_rad in the world. ``confidence``: 0 to 1, from how well its corners fit its known shape on the known
    plane; a block that is tilted or in the air has little. ``stage``: how it was found. ``pixels`` (4, 2): its corners, to be drawn.
    """

    pose: Floats
    confidence: float
    stage: str
    pixels: Floats


class Sighting(NamedTuple):
    """What one picture shows of block and goal; None: not seen."""

    block: PoseEstimate | None
    goal: PoseEstimate | None


class Detector:
    """Finds block and goal in pictures of one camera.

    Args:
        calibration: lens and place of the camera.
        block: the block, whose upper face carries the marker (``marker_mm`` wide, x to its right, y up, origin at the pin).
        target: which markers, or which colour.
        config: how to look.
    """

    def __init__(
        self, calibration: CameraCalibration, block: BlockConfig, target: TargetConfig | None = None, config: DetectorConfig | None = None
    ) -> None:
        self.calibration, self.block = calibration, block
        self.target, self.config = target or TargetConfig(), config or DetectorConfig()
        self.target.validate()
        self.config.validate()
        scale = calibration.px_per_mm(block.height_mm)
        cells = len(marker_cells(self.target.dictionary, self.target.block_id))
        kernel = self.config.opening_px or opening_px(block.pin_diameter_mm * scale, block.marker_mm * scale / cells)
        self._finders = {
            self.target.block_id: MarkerFinder(self.target.dictionary, block.marker_mm * scale, kernel),
            self.target.goal_id: MarkerFinder(self.target.dictionary, self.target.goal_mm * scale, kernel),
        }
        self._same_size = math.isclose(block.marker_mm, self.target.goal_mm, rel_tol=0.3)
        self._square = ColouredSquare(calibration, block, self.target) if self.target.object == "square" else None

    def detect(
        self, image: Pixels, block_near: ArrayLike | None = None, goal_near: ArrayLike | None = None, everywhere: bool = True
    ) -> Sighting:
        """Block and goal in a BGR or grey picture.

        Args:
            image: (height, width[, 3]) uint8 of the calibrated size.
            block_near: (3,) where the block was last: there it is looked for first, which takes a tenth of the time.
            goal_near: the same of the goal.
            everywhere: search the whole picture for what is not there; False: only for what has no such place.

        Raises:
            CalibrationMismatch: the picture has another size.
        """
        self.calibration.require_size(image)
        wanted = {self.target.goal_id: goal_near}
        if self._square is None:
            wanted[self.target.block_id] = block_near
        found: dict[int, Corners] = {}
        for number, near in wanted.items():
            if near is not None:
                found |= self._look_around(image, number, near)
        rest = [number for number, near in wanted.items() if number not in found and (everywhere or near is None)]
        if rest:
            grey = _grey(image)
            if self._same_size:
                found |= self._finders[rest[0]].find(grey, rest)
            else:
                for number in rest:
                    found |= self._finders[number].find(grey, [number])
        return Sighting(self._block(image, found, block_near, everywhere), self._estimate(found, self.target.goal_id))

    def window(self, pose: ArrayLike, z_mm: float) -> tuple[slice, slice]:
        """Rows and columns of a picture within ``detector.window_mm`` of ``pose`` (3,) at height ``z_mm``."""
        x_mm, y_mm = (float(value) for value in np.asarray(pose)[:2])
        column, row = self.calibration.project([[x_mm, y_mm, z_mm]])[0]
        reach = (self.config.window_mm + self.block.side_mm / 2) * self.calibration.px_per_mm(z_mm)
        width, height = self.calibration.intrinsics.size_px
        return (
            slice(int(np.clip(row - reach, 0, height)), int(np.clip(row + reach, 0, height))),
            slice(int(np.clip(column - reach, 0, width)), int(np.clip(column + reach, 0, width))),
        )

    def _look_around(self, image: Pixels, number: int, near: ArrayLike) -> dict[int, Corners]:
        rows, columns = self.window(near, self._plane_mm(number))
        part = image[rows, columns]
        if min(part.shape[:2]) < 3 * self.config.window_mm * self.calibration.px_per_mm() / 4:
            return {}
        found = self._finders[number].find(_grey(part), [number])
        return {key: it._replace(pixels=it.pixels + (columns.start, rows.start)) for key, it in found.items()}

    def _plane_mm(self, number: int) -> float:
        return self.block.height_mm if number == self.target.block_id else self.target.goal_height_mm

    def _block(self, image: Pixels, found: dict[int, Corners], near: ArrayLike | None, everywhere: bool) -> PoseEstimate | None:
        if self._square is None:
            return self._estimate(found, self.target.block_id)
        seen = self._square.find(image, None if near is None else self.window(near, self.block.height_mm))
        if seen is None and near is not None and everywhere:
            seen = self._square.find(image, None)
        if seen is None:
            return None
        pose, confidence = fit_square(self.calibration.on_plane(seen, self.block.height_mm), self.block.side_mm)
        wanted = 0.0 if near is None else float(np.asarray(near)[2])
        pose[2] = wrap(pose[2] + math.pi / 2 * round((wanted - pose[2]) / (math.pi / 2)))
        return PoseEstimate(pose, confidence, "square", seen) if confidence >= self.config.least_confidence else None

    def _estimate(self, found: dict[int, Corners], number: int) -> PoseEstimate | None:
        """The pose of a marker's carrier."""
        if number not in found:
            return None
        pixels, stage = found[number]
        is_block = number == self.target.block_id
        corners = self.calibration.on_plane(pixels, self._plane_mm(number))
        marker_mm = self.block.marker_mm if is_block else self.target.goal_mm
        pose, confidence = fit_square(corners, marker_mm * _SEEN_SCALE)
        if is_block:
            pose = _without_offset(pose, self.target.block_offset)
        return PoseEstimate(pose, confidence, stage, pixels) if confidence >= self.config.least_confidence else None


def fit_square(corners_mm: Floats, side_mm: float) -> tuple[Floats, float]:
    """The pose (3,) of a square with edges of about ``side_mm``, and the confidence in it.

    ``corners_mm`` (4, 2): its corners on the table, the upper left one first, clockwise as seen from above.
    """
    half = side_mm / 2
    model = np.array([-half + 1j * half, half + 1j * half, half - 1j * half, -half - 1j * half])
    points = corners_mm[:, 0] + 1j * corners_mm[:, 1]
    centre, turn, residual = _similar(model, points)
    if residual > _CORNER_MM:
        # The pin may cover one corner, which is then found somewhere along it.
        others = [_similar(np.delete(model, index), np.delete(points, index)) for index in range(4)]
        best = min(others, key=lambda it: it[2])
        if best[2] < residual / 3:
            centre, turn, residual = best
    confidence = 1 / (1 + (residual / _SHAPE_MM) ** 2 + ((abs(turn) - 1) / _SCALE) ** 2)
    return np.array([centre.real, centre.imag, math.atan2(turn.imag, turn.real)]), float(confidence)


def _similar(model: NDArray[np.complex128], points: NDArray[np.complex128]) -> tuple[complex, complex, float]:
    """The map z -> centre + turn z that takes ``model`` nearest to ``points``, both (n,), and its root mean square residual."""
    model_middle, middle = model.mean(), points.mean()
    turn = np.vdot(model - model_middle, points - middle) / np.vdot(model - model_middle, model - model_middle)
    centre = middle - turn * model_middle
    return complex(centre), complex(turn), math.sqrt(float(np.mean(abs(points - centre - turn * model) ** 2)))


def _without_offset(pose: Floats, offset: list[float]) -> Floats:
    """The block's pose from its marker's, which lies at ``offset`` (x_mm, y_mm, yaw_deg) on it."""
    yaw = float(wrap(pose[2] - math.radians(offset[2])))
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([pose[0] - cos * offset[0] + sin * offset[1], pose[1] - sin * offset[0] - cos * offset[1], yaw])


def _grey(image: Pixels) -> Pixels:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
