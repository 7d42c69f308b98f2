import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile
from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.calibration import CalibrationMismatch, CameraCalibration, Intrinsics, hung_camera, looking_down
from marl_handover.perception.settings import MountConfig

numbers = st.floats(-1, 1)


def camera(tilt=(0.0, 0.0), turn=0.0, distortion=(0.0, 0.0, 0.0, 0.0, 0.0), eye=(0.0, 0.0, 700.0)):
    lens = Intrinsics((1280, 720), np.array([[917.0, 0, 642], [0, 915, 357], [0, 0, 1]]), np.array(distortion))
    return CameraCalibration(lens, looking_down(eye, tilt, turn))


def test_a_pinhole_looks_down_with_world_x_up_and_y_to_the_left():
    straight = hung_camera(MountConfig([0, 0, 700], [0, 0]), (1280, 720))
    straight = straight.placed(looking_down((0, 0, 700)))
    wanted = [[639.5, 359.5], [639.5, 359.5 - 917 * 100 / 700], [639.5 - 917 * 50 / 600, 359.5]]
    np.testing.assert_allclose(straight.project([[0, 0, 15], [100, 0, 0], [0, 50, 100]]), wanted, atol=1e-9)
    assert straight.px_per_mm(15.0) == pytest.approx(917 / 685)


@given(x=numbers, y=numbers, z=numbers, tilt_x=numbers, tilt_y=numbers, turn=numbers, bend=numbers)
def test_points_of_a_plane_come_back_from_their_pixels(x, y, z, tilt_x, tilt_y, turn, bend):
    it = camera((3 * tilt_x, 3 * tilt_y), 180 * turn, (0.05 * bend, 0.01, 0.001, -0.001, 0.0), (5, -7, 690))
    point, height = (220 * x, 220 * y), 60 * z
    np.testing.assert_allclose(it.on_plane(it.project([[*point, height]]), height), [point], atol=1e-3)


def test_the_eye_is_where_it_was_hung_and_a_turn_leaves_it_there():
    np.testing.assert_allclose(camera((2, -1), 30, eye=(3, -4, 702)).eye_mm(), (3, -4, 702), atol=1e-9)
    before, after = camera(), camera(turn=90)
    centre = np.array([642, 357])
    offset = before.project([[30, 40, 0]])[0] - centre
    # A camera that turns clockwise sees the world turn the other way.
    turned = after.project([[30, 40, 0]])[0] - centre
    np.testing.assert_allclose(turned, [-offset[1] * 917 / 915, offset[0] * 915 / 917], atol=1e-9)


def test_flat_poses_turn_counterclockwise_from_above():
    T = flat_pose(10, 20, math.pi / 2, 3)
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [10, 21, 3, 1], atol=1e-12)


def test_a_file_comes_back_as_it_was_and_keeps_the_one_before(tmp_path):
    path = tmp_path / "deep" / "camera.json"
    first, second = camera((1, 2), 3), camera(distortion=(0.1, 0, 0, 0, 0))
    first.save(path)
    second.save(path)
    for stored, wanted in ((path, second), (tmp_path / "deep" / "camera.json.bak", first)):
        read = CameraCalibration.load(stored)
        assert read.intrinsics.size_px == (1280, 720)
        np.testing.assert_array_equal(read.intrinsics.matrix, wanted.intrinsics.matrix)
        np.testing.assert_array_equal(read.intrinsics.distortion, wanted.intrinsics.distortion)
        np.testing.assert_array_equal(read.pose(), wanted.pose())
    assert sorted(file.name for file in path.parent.iterdir()) == ["camera.json", "camera.json.bak"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": 2}, "version 2"),
        ({"format": "a poem"}, "no calibration"),
        ({"matrix_px": [[1, 0], [0, 1]]}, "matrix_px"),
        ({"matrix_px": [[-917, 0, 0], [0, 917, 0], [0, 0, 1]]}, "focal"),
        ({"distortion": [0, 0, 0, 0, float("nan")]}, "NaN"),
        ({"T_camera_world": np.diag([2.0, 1, 1, 1]).tolist()}, "rigid"),
        ({"T_camera_world": np.diag([-1.0, 1, 1, 1]).tolist()}, "rigid"),
        ({"size_px": None}, ".bak"),
    ],
)
def test_a_spoiled_file_is_refused_by_name(tmp_path, change, says):
    path = tmp_path / "camera.json"
    camera().save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(CorruptFile, match=says):
        CameraCalibration.load(path)


def test_missing_truncated_and_unfinished_files_say_what_to_do(tmp_path):
    path = tmp_path / "camera.json"
    with pytest.raises(MissingFile, match="calibrate camera"):
        CameraCalibration.load(path)
    CameraCalibration(camera().intrinsics).save(path)
    with pytest.raises(CalibrationMismatch, match="calibrate camera"):
        CameraCalibration.load(path).project([[0, 0, 0]])
    path.write_text(path.read_text()[:100])
    with pytest.raises(CorruptFile, match="camera.json"):
        CameraCalibration.load(path)


def test_pictures_of_another_size_are_refused():
    camera().require_size(np.zeros((720, 1280, 3), np.uint8))
    with pytest.raises(CalibrationMismatch, match="640x360.*1280x720"):
        camera().require_size(np.zeros((360, 640), np.uint8))


def test_a_mount_that_cannot_be_is_refused():
    with pytest.raises(InvalidSetting, match="eye_mm"):
        hung_camera(MountConfig(eye_mm=[0, 0, float("nan")]), (1280, 720))
