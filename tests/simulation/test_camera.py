"""The top camera is the pinhole it says it is."""

import numpy as np
import pytest

from marl_handover.errors import InvalidSetting


def red_centre(image):
    pixels = image.astype(int)
    rows, columns = np.nonzero((pixels[..., 0] > 120) & (pixels[..., 1] < 80) & (pixels[..., 2] < 80))
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (40.0, -60.0, 0.0), (-70.0, 30.0, 2.0)])
def test_the_red_bar_is_where_a_pinhole_camera_sees_it(cell, pose):
    cell.reset(pose)
    x = pose[0] + 9 * np.cos(pose[2])
    y = pose[1] + 9 * np.sin(pose[2])
    depth = 700 - cell.model.cell.config.block.height_mm
    wanted = (640 - 917 * y / depth, 360 - 917 * x / depth)
    # The pin hides part of the bar, and the renderer rounds to pixels.
    np.testing.assert_allclose(red_centre(cell.camera_image()), wanted, atol=3)


def test_pictures_have_the_size_asked_for_and_repeat(cell):
    cell.reset((10.0, 20.0, 0.5))
    first, second = cell.camera_image(160, 90), cell.camera_image(160, 90)
    assert first.shape == (90, 160, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, second)
    with pytest.raises(InvalidSetting, match="width"):
        cell.camera_image(0, 90)
