import cv2
import numpy as np
import pytest

from marl_handover.config import BlockConfig
from marl_handover.errors import InvalidSetting, UnknownChoice
from marl_handover.perception.calibration import BoardFinder
from marl_handover.perception.printables import (
    OldOpenCV,
    block_top,
    board_corners_mm,
    charuco_sheet,
    dictionary,
    marker_cells,
    marker_sheet,
)
from marl_handover.perception.settings import BoardConfig, TargetConfig


def test_the_sheet_of_a_marker_is_that_marker_in_true_size():
    sheet = marker_sheet("36h11", 7, 30, 40, px_per_mm=8)
    assert (sheet.width_mm, sheet.height_mm) == (40, 40)
    dark_rows, dark_columns = (np.flatnonzero((sheet.pixels == 0).any(axis=axis)) for axis in (1, 0))
    for dark in (dark_rows, dark_columns):
        assert (dark[0] / 8, (dark[-1] + 1) / 8) == (5, 35)
    middles = np.rint((5 + 30 / 8 * (np.arange(8) + 0.5)) * 8).astype(int)
    assert np.array_equal(sheet.pixels[np.ix_(middles, middles)], marker_cells("36h11", 7))
    _, numbers, _ = cv2.aruco.ArucoDetector(dictionary("36h11")).detectMarkers(sheet.pixels)
    assert np.ravel(numbers).tolist() == [7]


def test_the_block_top_covers_the_block():
    block = BlockConfig(side_mm=50, marker_mm=32)
    top = block_top(block, TargetConfig(block_id=3))
    assert (top.width_mm, top.height_mm) == (50, 50)
    assert (top.pixels == 0).any(axis=0).sum() == 32 * 8


@pytest.mark.parametrize("config", [BoardConfig(), BoardConfig(7, 5, 20, 14, "5x5_100")])
def test_corners_found_on_the_sheet_are_where_the_board_has_them(config):
    sheet = charuco_sheet(config, px_per_mm=6, margin_mm=12)
    view = BoardFinder(config).find(sheet.pixels)
    assert len(view.pixels) == (config.columns - 1) * (config.rows - 1)
    scale = sheet.pixels.shape[1] / sheet.width_mm
    found_mm = (view.pixels + 0.5) / scale
    wanted_mm = np.column_stack([view.board_mm[:, 0] + sheet.width_mm / 2, sheet.height_mm / 2 - view.board_mm[:, 1]])
    np.testing.assert_allclose(found_mm, wanted_mm, atol=0.03)
    assert np.array_equal(np.unique(board_corners_mm(config), axis=0), np.unique(view.board_mm, axis=0))


def test_markers_and_boards_that_cannot_be_are_refused():
    with pytest.raises(InvalidSetting, match="586"):
        marker_cells("36h11", 587)
    with pytest.raises(UnknownChoice, match="36h11"):
        charuco_sheet(BoardConfig(dictionary="7h3"))
    with pytest.raises(InvalidSetting, match="marker_mm"):
        charuco_sheet(BoardConfig(marker_mm=31))


@pytest.mark.parametrize("version", ["4.12.0", "4.13.0", "4.9.0-dev"])
def test_an_opencv_that_finds_corners_elsewhere_is_refused(monkeypatch, version):
    dictionary.cache_clear()
    monkeypatch.setattr(cv2, "__version__", version)
    with pytest.raises(OldOpenCV, match=r"half a pixel off; run: pip install 'opencv-python-headless>=5'"):
        BoardFinder(BoardConfig())
