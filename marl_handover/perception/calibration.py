"""What a calibrated camera knows: its lens, and where it hangs over the table. Kept in a JSON file."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import Floats
from marl_handover.errors import CorruptFile, HandoverError, MissingFile, WorkFailed, counted
from marl_handover.files import copy_whole, make_folder, write_whole
from marl_handover.parsing import read_json
from marl_handover.perception.printables import board_corners_mm, charuco_board
from marl_handover.perception.settings import USUAL_EYE_MM, BoardConfig, MountConfig

Pixels = NDArray[np.uint8]

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


FORMAT, VERSION = "marl_handover camera calibration", 1


class CalibrationFailed(WorkFailed):
    """Pictures do not give a calibration; the message says what to do about it."""


class CalibrationMismatch(HandoverError):
    """A calibration is not one for these pictures, or not complete."""


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """The lens and the sensor.

    Attributes:
        size_px: width and height of the pictures it is for.
        matrix: (3, 3), in px.
        distortion: (5,) k1 k2 p1 p2 k3.
        error_px: root mean square distance of the calibration's points from where they should be; 0 if it was not measured.
        views: how many pictures it was made from.
    """

    size_px: tuple[int, int]
    matrix: Floats
    distortion: Floats
    error_px: float = 0.0
    views: int = 0

    @classmethod
    def pinhole(cls, focal_px: float, size_px: tuple[int, int]) -> Intrinsics:
        """A camera without distortion that looks through the middle of its picture."""
        matrix = np.array([[focal_px, 0, (size_px[0] - 1) / 2], [0, focal_px, (size_px[1] - 1) / 2], [0, 0, 1.0]])
        return cls(size_px, matrix, np.zeros(5))


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Intrinsics, and the pose ``T_camera_world`` (4, 4) in mm, or None while that is unknown; ``pose_error_px`` as in Intrinsics."""

    intrinsics: Intrinsics
    T_camera_world: Floats | None = None
    pose_error_px: float = 0.0
    camera: str = ""

    def pose(self) -> Floats:
        """``T_camera_world`` (4, 4). Raises :class:`CalibrationMismatch` if it is not known."""
        if self.T_camera_world is None:
            raise CalibrationMismatch("the camera's place over the table is not calibrated; run: marl-handover calibrate camera")
        return self.T_camera_world

    def placed(self, T_camera_world: Floats, error_px: float = 0.0) -> CameraCalibration:
        """The same camera hanging elsewhere."""
        return replace(self, T_camera_world=np.array(T_camera_world, dtype=float), pose_error_px=error_px)

    def eye_mm(self) -> Floats:
        """Where the camera is in the world: (3,) mm."""
        T = self.pose()
        return np.asarray(-T[:3, :3].T @ T[:3, 3])

    def project(self, points_mm: ArrayLike) -> Floats:
        """Pixels (n, 2) of world points (n, 3) in mm, distortion included."""
        T = self.pose()
        points = np.asarray(points_mm, dtype=float).reshape(-1, 1, 3)
        pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], self.intrinsics.matrix, self.intrinsics.distortion)
        return np.asarray(pixels, dtype=float).reshape(-1, 2)

    def on_plane(self, pixels: ArrayLike, z_mm: float) -> Floats:
        """World points (n, 2) in mm at height ``z_mm`` that are seen in pixels (n, 2)."""
        T = self.pose()
        pixels = np.asarray(pixels, dtype=float).reshape(-1, 1, 2)
        seen = cv2.undistortPoints(pixels, self.intrinsics.matrix, self.intrinsics.distortion).reshape(-1, 2)
        rays = np.column_stack([seen, np.ones(len(seen))]) @ T[:3, :3]
        eye = self.eye_mm()
        return np.asarray(eye[:2] + rays[:, :2] * ((z_mm - eye[2]) / rays[:, 2:]))

    def px_per_mm(self, z_mm: float = 0.0) -> float:
        """How many pixels a mm has straight below the camera, at height ``z_mm``."""
        return float(self.intrinsics.matrix[0, 0] / (self.eye_mm()[2] - z_mm))

    def require_size(self, image: Pixels) -> None:
        """Raise :class:`CalibrationMismatch` unless ``image`` has the size that was calibrated."""
        height, width = image.shape[:2]
        if (width, height) != tuple(self.intrinsics.size_px):
            wanted = "x".join(str(edge) for edge in self.intrinsics.size_px)
            raise CalibrationMismatch(
                f"a picture is {width}x{height} px, the camera was calibrated at {wanted}; set camera.width_px and height_px, or calibrate"
            )

    def save(self, path: Path | str) -> None:
        """Write the JSON file as a whole; the one that was there stays beside it, its name ending in ``.bak``."""
        path = Path(path)
        make_folder(path.parent)
        text = json.dumps(self._content(), indent=1) + "\n"
        if path.exists():
            copy_whole(path, path.with_name(path.name + ".bak"))
        write_whole(path, text)

    def _content(self) -> dict[str, Any]:
        lens = self.intrinsics
        return {
            "format": FORMAT,
            "version": VERSION,
            "made": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "camera": self.camera,
            "size_px": list(lens.size_px),
            "matrix_px": lens.matrix.tolist(),
            "distortion": lens.distortion.tolist(),
            "error_px": lens.error_px,
            "views": lens.views,
            "T_camera_world": None if self.T_camera_world is None else self.T_camera_world.tolist(),
            "pose_error_px": self.pose_error_px,
        }

    @classmethod
    def load(cls, path: Path | str) -> CameraCalibration:
        """Read what :meth:`save` wrote.

        Raises:
            MissingFile: there is none; its message says how to make one.
            CorruptFile: it is not such a file, of another version, or its numbers make no camera.
        """
        path = Path(path)
        if not path.is_file():
            raise MissingFile("camera calibration", path, "run: marl-handover calibrate camera")
        try:
            content = read_json(path, "camera calibration")
            if content.get("format") != FORMAT:
                raise CorruptFile("camera calibration", path, "it is no calibration of a camera")
            if content.get("version") != VERSION:
                raise CorruptFile("camera calibration", path, f"it has version {content.get('version')}, this package reads {VERSION}")
            return cls._from(content)
        except (ValueError, KeyError, TypeError) as error:
            raise CorruptFile("camera calibration", path, f"{error}; restore the .bak beside it, or calibrate again") from error

    @classmethod
    def _from(cls, content: dict[str, Any]) -> CameraCalibration:
        width, height = (int(edge) for edge in content["size_px"])
        matrix = _array(content, "matrix_px", (3, 3))
        if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise ValueError("matrix_px has no positive focal lengths")
        lens = Intrinsics((width, height), matrix, _array(content, "distortion", (5,)), float(content["error_px"]), int(content["views"]))
        if content["T_camera_world"] is None:
            return cls(lens, camera=str(content["camera"]))
        T = _array(content, "T_camera_world", (4, 4))
        R = T[:3, :3]
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise ValueError("T_camera_world is no rigid transform")
        return cls(lens, T, float(content["pose_error_px"]), str(content["camera"]))


def _array(content: dict[str, Any], name: str, shape: tuple[int, ...]) -> Floats:
    values = np.array(content[name], dtype=float)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{name} is no array of {shape} finite numbers")
    return values


def looking_down(eye_mm: ArrayLike, tilt_deg: Sequence[float] = (0.0, 0.0), turn_deg: float = 0.0) -> Floats:
    """T_camera_world (4, 4) of a camera over the table; the angles as in :class:`MountConfig`."""
    straight = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    tilt, turn = (cv2.Rodrigues(np.radians(vector))[0] for vector in ([*tilt_deg, 0.0], [0.0, 0.0, turn_deg]))
    R_camera_world = tilt @ turn @ straight
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_camera_world, -R_camera_world @ np.asarray(eye_mm, dtype=float)
    return T


def hung_camera(mount: MountConfig, size_px: tuple[int, int]) -> CameraCalibration:
    """The truth about a rendered camera: what calibrating it should come out at."""
    mount.validate()
    lens = Intrinsics.pinhole(mount.focal_px, size_px)
    return CameraCalibration(lens, looking_down(USUAL_EYE_MM if mount.eye_mm is None else mount.eye_mm, mount.tilt_deg, mount.turn_deg))
