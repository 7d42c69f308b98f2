"""A cell, the truth about a camera over it, and what calibrating that camera from rendered boards comes out at."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.calibration import CameraCalibration, calibrate_lens, hung_camera
from marl_handover.perception.plane import BoardOnTable, locate_by_board
from marl_handover.perception.printables import charuco_sheet
from marl_handover.perception.scene import CellPainter, held_boards
from marl_handover.perception.settings import BoardConfig, LookConfig, MountConfig
from tests.canonical_arms import PARKED_DEG

SIZE_PX = (1280, 720)
PLACES = ((-80.0, 0.0, math.pi / 2), (80.0, 10.0, -math.pi / 2))
cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def truth():
    return hung_camera(MountConfig(), SIZE_PX)


@pytest.fixture(scope="session")
def painter(model, truth):
    return CellPainter(model, truth, look=LookConfig())


@pytest.fixture(scope="session")
def parked(model):
    return np.tile(np.radians(PARKED_DEG), (model.cell.num_arms, 1))


@pytest.fixture(scope="session")
def board():
    return BoardConfig()


@pytest.fixture(scope="session")
def held_views(painter, truth, board):
    """Ten pictures of the board, held before the camera."""
    sheet = charuco_sheet(board, margin_mm=10)
    return [painter.picture(None, sheets=[(sheet, T)]) for T in held_boards(truth, 10)]


@pytest.fixture(scope="session")
def lens(held_views, board):
    return calibrate_lens(held_views, board)


@pytest.fixture(scope="session")
def boards_on_table(painter, board):
    """Pictures of the board at two places on the table."""
    sheet = charuco_sheet(board, margin_mm=10)
    return [BoardOnTable(painter.picture(None, sheets=[(sheet, flat_pose(*place))]), *place) for place in PLACES]


@pytest.fixture(scope="session")
def calibration(lens, boards_on_table, board, tmp_path_factory):
    """What the rendered camera's calibration file gives; the truth is known to nobody."""
    path = tmp_path_factory.mktemp("camera") / "camera.json"
    locate_by_board(lens, boards_on_table, board).save(path)
    return CameraCalibration.load(path)


@pytest.fixture(scope="session")
def reachable(model):
    """``reachable(count, seed)``: poses (count, 3), uniform over all that the arms reach."""

    def make(count, seed):
        random = np.random.default_rng(seed)
        points = random.uniform(-300, 300, (40 * count, 2))
        points = points[model.cell.reaches(points).any(-1)][:count]
        return np.column_stack([points, random.uniform(-math.pi, math.pi, len(points))])

    return make


@pytest.fixture(scope="session")
def turned_deg():
    """Smallest angle between two yaws in rad, in degrees."""

    def between(first, second, period=2 * math.pi):
        return math.degrees(abs((first - second + period / 2) % period - period / 2))

    return between
