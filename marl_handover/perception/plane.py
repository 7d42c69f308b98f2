"""Where the camera hangs over the table: from a board that lies on it at a known place, or from markers at known places."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from marl_handover.geometry.se3 import apply, flat_pose
from marl_handover.perception.calibration import BoardFinder, CalibrationFailed, CameraCalibration, Floats, Intrinsics, Pixels
from marl_handover.perception.detector import MarkerFinder
from marl_handover.perception.settings import BoardConfig

LARGEST_ERROR_PX = 1.0
LARGEST_LAID_PX = 2.5
"""Of several boards on the table, places and all: 2 mm and a bit."""

LEAST_MARKERS = 3

_LAID_MM, _LAID_RAD, _SEEN_PX = 0.5, math.radians(0.2), 0.1
"""How exactly people lay a board onto its marks, and how exactly its corners are seen."""

_SCALES = (0.06, 0.03, 0.12)
"""Edges of table markers that are looked for, as parts of the picture's width."""


class BoardOnTable(NamedTuple):
    """A picture of the board flat on the table, and the world pose of its middle (x along its rows, to the right, y up the sheet)."""

    image: Pixels
    x_mm: float
    y_mm: float
    yaw_rad: float
    thickness_mm: float = 0.0


def locate_by_board(lens: Intrinsics, boards: Sequence[BoardOnTable], config: BoardConfig, camera: str = "") -> CameraCalibration:
    """The camera's pose from one or more pictures of the board; more places see more of the table.

    Nobody lays a board exactly, but it lies flat: how far each lies from its place is found along with the pose.

    Raises:
        CalibrationFailed: the board is not found, or not where it is said to be: more than 1 px off, 2.5 px if it is laid more than once.
        CalibrationMismatch: a picture has another size than ``lens``.
    """
    finder, world, pixels = BoardFinder(config), [], []
    for board in boards:
        CameraCalibration(lens).require_size(board.image)
        view = finder.find(board.image)
        if view is None:
            continue
        T = flat_pose(board.x_mm, board.y_mm, board.yaw_rad, board.thickness_mm)
        world.append(view.board_mm @ T[:3, :3].T + T[:3, 3])
        pixels.append(view.pixels)
    if not world:
        raise CalibrationFailed("the board on the table is not found; is it flat, whole in the picture and evenly lit, no arm over it?")
    T_camera_world = _solve(lens, np.concatenate(world), np.concatenate(pixels))
    if len(world) > 1:
        T_camera_world = _with_slack(lens, world, pixels, T_camera_world)
    limit_px = LARGEST_ERROR_PX if len(world) == 1 else LARGEST_LAID_PX
    return _checked(CameraCalibration(lens, T_camera_world, camera=camera), np.concatenate(world), np.concatenate(pixels), limit_px)


def locate_by_markers(
    lens: Intrinsics,
    image: Pixels,
    places_mm: Mapping[int, tuple[float, float]],
    marker_mm: float,
    dictionary: str,
    camera: str = "",
) -> CameraCalibration:
    """The camera's pose from three or more printed markers whose centres lie at known places; how they are turned does not matter.

    Args:
        lens: the intrinsics.
        image: BGR or grey picture.
        places_mm: marker number -> world (x, y) of its centre.
        marker_mm: edge of each marker, black to black.
        dictionary: as in TargetConfig.
        camera: a name to store.

    Raises:
        CalibrationFailed: fewer than three are seen, they lie on one line, or they are not where they are said to be.
        CalibrationMismatch: the picture has another size than ``lens``.
    """
    CameraCalibration(lens).require_size(image)
    seen = _seen_markers(image, places_mm, dictionary)
    if len(seen) < LEAST_MARKERS:
        raise CalibrationFailed(f"{len(seen)} of the markers {sorted(places_mm)} are seen, {LEAST_MARKERS} are needed")
    numbers = sorted(seen)
    centres = np.array([places_mm[number] for number in numbers], dtype=float)
    pixels = np.stack([seen[number] for number in numbers])
    spread = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
    if spread[1] < 0.1 * spread[0]:
        raise CalibrationFailed("the markers lie on one line; lay them out as a triangle that is as large as the picture")
    yaws = _first_yaws(centres, pixels)
    corners = _marker_corners(centres, yaws, marker_mm)
    start = _solve(lens, corners.reshape(-1, 3), pixels.reshape(-1, 2))
    turn, shift = cv2.Rodrigues(start[:3, :3])[0].ravel(), start[:3, 3]

    def misses(values: Floats) -> Floats:
        points = _marker_corners(centres, values[6:], marker_mm).reshape(-1, 3)
        projected, _ = cv2.projectPoints(points, values[:3], values[3:6], lens.matrix, lens.distortion)
        return np.asarray((projected.reshape(-1, 2) - pixels.reshape(-1, 2)).ravel())

    # The 0.2 px by which corner refinement shrinks a marker leave its centre alone, and so the pose.
    best = least_squares(
        misses, np.concatenate([turn, shift, yaws]), x_scale=np.concatenate([np.full(3, 1e-2), np.full(3, 5.0), np.full(len(yaws), 1e-2)])
    )
    final = _marker_corners(centres, best.x[6:], marker_mm).reshape(-1, 3)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(best.x[:3])[0], best.x[3:6]
    return _checked(CameraCalibration(lens, T, camera=camera), final, pixels.reshape(-1, 2))


def _with_slack(lens: Intrinsics, world: Sequence[Floats], pixels: Sequence[Floats], T: Floats) -> Floats:
    """T_camera_world (4, 4), near ``T``, if every board (n, 3) may lie a little beside and askew of where it is said to."""
    seen = np.concatenate(pixels)
    slack = np.tile([_LAID_MM, _LAID_MM, _LAID_RAD], len(world))

    def misses(values: Floats) -> Floats:
        points = np.concatenate([_shifted(board, *off) for board, off in zip(world, values[6:].reshape(-1, 3), strict=True)])
        projected, _ = cv2.projectPoints(points, values[:3], values[3:6], lens.matrix, lens.distortion)
        return np.concatenate([((projected.reshape(-1, 2) - seen) / _SEEN_PX).ravel(), values[6:] / slack])

    start = np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3], np.zeros(len(slack))])
    best = least_squares(misses, start, x_scale=np.concatenate([np.full(3, 1e-2), np.full(3, 5.0), slack]))
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = cv2.Rodrigues(best.x[:3])[0], best.x[3:6]
    return found


def _shifted(points: Floats, x_mm: float, y_mm: float, yaw_rad: float) -> Floats:
    """Points (n, 3) of the table, turned about their middle and shifted."""
    middle = points.mean(axis=0)
    return apply(flat_pose(x_mm, y_mm, yaw_rad), points - middle) + middle


def _solve(lens: Intrinsics, world_mm: Floats, pixels: Floats) -> Floats:
    """T_camera_world (4, 4) from points of the table (n, 3) and where they are seen (n, 2)."""
    # A plane fits two poses; of those the camera is the one above the table.
    found, turns, shifts, errors = cv2.solvePnPGeneric(world_mm, pixels, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE)
    above = []
    for turn, shift, error in zip(turns[:found], shifts[:found], np.ravel(errors)[:found], strict=True):
        R = cv2.Rodrigues(turn)[0]
        if (-R.T @ np.ravel(shift))[2] > 0:
            above.append((float(error), turn, shift))
    if not above:
        raise CalibrationFailed("the board is seen from below: its x and y, or the numbers of the markers, are mixed up")
    _, turn, shift = min(above, key=lambda it: it[0])
    turn, shift = cv2.solvePnPRefineLM(world_mm, pixels, lens.matrix, lens.distortion, turn, shift)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return T


def _checked(calibration: CameraCalibration, world_mm: Floats, pixels: Floats, limit_px: float = LARGEST_ERROR_PX) -> CameraCalibration:
    """``calibration`` with its error. Raises :class:`CalibrationFailed` if that is too large."""
    misses = calibration.project(world_mm) - pixels
    error = math.sqrt(float((misses**2).sum(axis=1).mean()))
    if error > limit_px:
        raise CalibrationFailed(
            f"the points on the table are {error:.2f} px off, {limit_px:g} is allowed; check their places, that the print has its "
            "true size, and that the intrinsics are this camera's"
        )
    return calibration.placed(calibration.pose(), error)


def _seen_markers(image: Pixels, places_mm: Mapping[int, tuple[float, float]], dictionary: str) -> dict[int, Floats]:
    """Corners (4, 2) in px of the markers that are in the picture."""
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    seen: dict[int, Floats] = {}
    for scale in _SCALES:
        missing = [number for number in places_mm if number not in seen]
        if missing:
            found = MarkerFinder(dictionary, scale * grey.shape[1], 3).find(grey, missing)
            seen |= {number: corners.pixels for number, corners in found.items()}
    return seen


def _first_yaws(centres: Floats, pixels: Floats) -> Floats:
    """Yaws (n,) of markers at ``centres`` (n, 2), from an affine map of the picture (n, 4, 2) onto the table."""
    middles = pixels.mean(axis=1)
    to_table = np.linalg.lstsq(np.column_stack([middles, np.ones(len(middles))]), centres, rcond=None)[0][:2]
    edges = (pixels[:, 1] - pixels[:, 0] + pixels[:, 2] - pixels[:, 3]) @ to_table
    return np.asarray(np.arctan2(edges[:, 1], edges[:, 0]))


def _marker_corners(centres: Floats, yaws: Floats, marker_mm: float) -> Floats:
    """World corners (n, 4, 3), upper left first, clockwise, of markers that lie on the table."""
    half = marker_mm / 2
    square = np.array([[-half, half], [half, half], [half, -half], [-half, -half]])
    cos, sin = np.cos(yaws), np.sin(yaws)
    R = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
    flat = centres[:, None] + np.einsum("nij,kj->nki", R, square)
    return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)
