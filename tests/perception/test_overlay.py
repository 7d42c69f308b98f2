"""Pictures for people: small, marked where things are, readable again."""

from __future__ import annotations

import resource

import numpy as np
import pytest
from PIL import Image

from marl_handover.errors import CorruptFile
from marl_handover.perception.calibration import hung_camera
from marl_handover.perception.overlay import Mark, annotated, decoded, jpeg
from marl_handover.perception.settings import MountConfig

RED = "#FF0000"


@pytest.fixture(scope="module")
def calibration():
    return hung_camera(MountConfig(), (1280, 720))


@pytest.fixture
def grey():
    return np.full((720, 1280, 3), 128, np.uint8)


def test_a_mark_is_where_the_camera_sees_the_square(calibration, grey):
    pose, half = np.array([40.0, -60.0, 0.4]), 20.0
    picture = annotated(grey, calibration, [Mark(pose, 2 * half, 15.0, RED, "")])
    assert picture.shape == (360, 640, 3)
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]]) @ turn.T + pose[:2]
    columns, rows = calibration.project(np.column_stack([corners, np.full(4, 15.0)])).T / 2
    reds = np.argwhere((picture[..., 2] > 200) & (picture[..., 0] < 60))
    np.testing.assert_allclose(reds.min(0), [rows.min(), columns.min()], atol=2)
    np.testing.assert_allclose(reds.max(0), [rows.max(), columns.max()], atol=2)
    middle, tip = (calibration.project([[*point, 15.0]])[0][::-1] / 2 for point in (pose[:2], pose[:2] + turn @ [half, 0]))
    for point in (middle, (middle + tip) / 2, tip):
        assert np.abs(reds - point).max(1).min() < 2, "the arrow goes along +x"


@pytest.mark.parametrize("pose", [[0, 0, 0], [480, 0, 1], [-480, 0, 1], [0, 270, 0], [0, -270, 2], [5000, 5000, 0], [1e9, 0, 0]])
def test_texts_stay_in_the_picture(calibration, grey, pose):
    text = annotated(grey, calibration, [Mark(np.array(pose, float), 40.0, 0.0, RED, "block 0.99")])
    without = annotated(grey, calibration, [Mark(np.array(pose, float), 40.0, 0.0, RED, "")])
    assert text.shape == without.shape
    if abs(pose[0]) < 490:
        letters = np.argwhere((text != without).any(-1))
        assert np.ptp(letters[:, 1]) > 100, "the whole of it is in the picture"


def test_the_picture_given_is_left_alone_and_small_ones_are_not_blown_up(calibration, grey):
    before = grey.copy()
    annotated(grey, calibration, [Mark(np.zeros(3), 40.0, 0.0, RED, "x")], width_px=4000)
    np.testing.assert_array_equal(grey, before)


def test_files_hold_what_was_put_in(tmp_path):
    image = np.zeros((90, 160, 3), np.uint8)
    image[:, 80:] = 30, 120, 220
    path = tmp_path / "picture.jpg"
    path.write_bytes(jpeg(image))
    back = decoded(path.read_bytes(), path)
    assert back.dtype == np.uint8
    np.testing.assert_allclose(back[45, 120], [30, 120, 220], atol=12)
    for content in (b"", b"nonsense"):
        with pytest.raises(CorruptFile, match="JPEG"):
            decoded(content, path)


def test_a_small_file_that_would_be_a_large_picture_is_not_decoded(tmp_path):
    Image.new("1", (30_000, 30_000)).save(tmp_path / "bomb.png")
    content = (tmp_path / "bomb.png").read_bytes()
    assert len(content) < 200_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CorruptFile, match="30000 x 30000 pixels|JPEG or PNG"):
        decoded(content, tmp_path / "bomb.png")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB
