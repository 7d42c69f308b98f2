import numpy as np
import pytest

from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.calibration import CalibrationFailed, CameraCalibration, Intrinsics, calibrate_lens
from marl_handover.perception.printables import charuco_sheet
from marl_handover.perception.scene import Renderer, held_boards, sheet_shape


def test_the_lens_is_found_from_rendered_boards(lens, truth):
    assert lens.size_px == truth.intrinsics.size_px
    assert lens.views == 10
    assert 0 < lens.error_px < 0.2
    np.testing.assert_allclose(lens.matrix, truth.intrinsics.matrix, atol=2.0)
    np.testing.assert_allclose(lens.distortion, 0, atol=0.01)


def test_a_lens_that_bends_lines_is_found_too(truth, board):
    bent = Intrinsics((1280, 720), np.array([[905.0, 0, 648], [0, 903, 352], [0, 0, 1]]), np.array([0.08, 0, 0, 0, 0]))
    renderer = Renderer(CameraCalibration(bent, truth.pose()))
    sheet = charuco_sheet(board, margin_mm=10)
    found = calibrate_lens((renderer.picture([sheet_shape(sheet, T)]) for T in held_boards(truth, 9, seed=2)), board)
    straight = CameraCalibration(bent, truth.pose())
    rebuilt = CameraCalibration(found, truth.pose())
    points = np.random.default_rng(0).uniform(-200, 200, (50, 3)) * (1, 1, 0)
    assert found.distortion[0] == pytest.approx(0.08, abs=0.015)
    # A shift of the middle is a tilt to a lens; what is left after the best one has to be small.
    gap = rebuilt.project(points) - straight.project(points)
    assert np.abs(gap - gap.mean(axis=0)).max() < 1.0


def test_too_few_flat_or_mixed_pictures_are_refused_with_the_remedy(painter, board, held_views):
    with pytest.raises(CalibrationFailed, match="found in 3 pictures, 8 are needed.*9 x 6"):
        calibrate_lens([*held_views[:3], painter.picture(None)], board)
    with pytest.raises(CalibrationFailed, match="several sizes"):
        calibrate_lens([held_views[0], held_views[1][::2, ::2]], board)
    sheet = charuco_sheet(board, margin_mm=10)
    places = [(-60 + 20 * i, 30 - 9 * i, 0.3 * i) for i in range(8)]
    flat = [painter.picture(None, sheets=[(sheet, flat_pose(*place))]) for place in places]
    with pytest.raises(CalibrationFailed, match="slant"):
        calibrate_lens(flat, board)
