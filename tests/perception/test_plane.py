import math

import numpy as np
import pytest

from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.calibration import CalibrationFailed, CalibrationMismatch
from marl_handover.perception.plane import BoardOnTable, locate_by_board, locate_by_markers
from marl_handover.perception.printables import charuco_sheet, marker_sheet

CORNERS = {10: (-210.0, -150.0), 11: (-200.0, 160.0), 12: (220.0, 10.0), 13: (190.0, 170.0)}


@pytest.fixture(scope="module")
def strewn(painter):
    """Four markers on the table, turned anyhow."""
    sheets = [(marker_sheet("36h11", number, 50, 64), flat_pose(*place, 1.3 * number)) for number, place in CORNERS.items()]
    return painter.picture(None, sheets=sheets)


def worst_mm(calibration, truth, reachable):
    """How far off, at worst, the block's top is taken to be anywhere in reach."""
    poses = reachable(300, 5)
    pixels = truth.project(np.column_stack([poses[:, :2], np.full(len(poses), 15.0)]))
    return np.hypot(*(calibration.on_plane(pixels, 15.0) - poses[:, :2]).T).max()


def test_a_board_on_the_table_gives_the_map_of_the_whole_reach(calibration, truth, reachable):
    assert 0 < calibration.pose_error_px < 0.3
    assert worst_mm(calibration, truth, reachable) < 0.3
    np.testing.assert_allclose(calibration.eye_mm(), truth.eye_mm(), atol=3.0)


@pytest.mark.parametrize("numbers", [(10, 11, 12), (10, 11, 12, 13)])
def test_so_do_markers_turned_anyhow(lens, strewn, truth, reachable, numbers):
    found = locate_by_markers(lens, strewn, {number: CORNERS[number] for number in numbers}, 50, "36h11", "top")
    assert found.camera == "top"
    assert worst_mm(found, truth, reachable) < 0.3


def test_a_board_that_lies_elsewhere_than_said_is_noticed_if_there_are_two(lens, boards_on_table, board):
    moved = boards_on_table[0]._replace(x_mm=boards_on_table[0].x_mm + 8)
    with pytest.raises(CalibrationFailed, match="px off"):
        locate_by_board(lens, [moved, boards_on_table[1]], board)


def test_what_cannot_be_located_says_why(lens, strewn, painter, board, boards_on_table):
    with pytest.raises(CalibrationFailed, match="2 of the markers"):
        locate_by_markers(lens, strewn, {10: CORNERS[10], 11: CORNERS[11], 14: (0, 0)}, 50, "36h11")
    with pytest.raises(CalibrationFailed, match="one line"):
        locate_by_markers(lens, strewn, {10: (0, 0), 11: (100, 0), 12: (200, 1)}, 50, "36h11")
    with pytest.raises(CalibrationFailed, match="px off|from below"):
        locate_by_markers(lens, strewn, CORNERS | {10: CORNERS[11], 11: CORNERS[10]}, 50, "36h11")
    with pytest.raises(CalibrationFailed, match="not found"):
        locate_by_board(lens, [boards_on_table[0]._replace(image=painter.picture(None))], board)
    with pytest.raises(CalibrationMismatch, match="1280x720"):
        locate_by_board(lens, [boards_on_table[0]._replace(image=boards_on_table[0].image[::2, ::2])], board)


def test_boards_laid_as_people_lay_them_do_not_tilt_the_camera(lens, painter, truth, board):
    """Half a millimetre beside three marks: that much the map is off, at any height, and no more."""
    sheet, random = charuco_sheet(board, margin_mm=10), np.random.default_rng(1)
    laid = []
    for place in ((0.0, 0.0, 0.0), (-90.0, 20.0, math.pi / 2), (90.0, -20.0, -math.pi / 2)):
        off = np.array(place) + random.normal(size=3) * (0.5, 0.5, math.radians(0.2))
        laid.append(BoardOnTable(painter.picture(None, sheets=[(sheet, flat_pose(*off))]), *place))
    found = locate_by_board(lens, laid, board)
    np.testing.assert_allclose(found.eye_mm(), truth.eye_mm(), atol=2.5)
    points = np.array([[x, y, 180.0] for x in (-150, 150) for y in (-250, 250)], float)
    assert np.hypot(*(found.on_plane(truth.project(points), 180.0) - points[:, :2]).T).max() < 2.0
