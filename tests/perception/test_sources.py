import sys

import cv2
import numpy as np
import pytest

from marl_handover.errors import CorruptFile, InvalidSetting, MissingFile, UnknownChoice
from marl_handover.perception.camera import EndOfFrames, NoCamera, cameras_found, open_camera
from marl_handover.perception.settings import CameraConfig


def picture(value):
    return np.full((48, 64, 3), value, np.uint8)


def test_a_folder_gives_its_pictures_in_order_then_ends(tmp_path):
    for name, value in (("b.png", 20), ("a.png", 10), ("c.PNG", 30)):
        cv2.imwrite(str(tmp_path / name), picture(value))
    (tmp_path / "notes.txt").write_text("none")
    with open_camera(CameraConfig("folder", str(tmp_path), frames_per_s=10), clock=lambda: 5.0) as camera:
        frames = [camera.read() for _ in range(3)]
        assert [int(frame.image[0, 0, 0]) for frame in frames] == [10, 20, 30]
        assert [frame.t_s for frame in frames] == pytest.approx([5.0, 5.1, 5.2])
        assert [frame.number for frame in frames] == [1, 2, 3]
        with pytest.raises(EndOfFrames, match="after 3 pictures"):
            camera.read()


def test_a_video_gives_its_pictures_at_its_own_pace(tmp_path):
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for value in (40, 120, 200):
        writer.write(picture(value))
    writer.release()
    with open_camera(CameraConfig("video", str(path)), clock=lambda: 0.0) as camera:
        frames = [camera.read() for _ in range(3)]
        assert [float(frame.image.mean()) for frame in frames] == pytest.approx([40, 120, 200], abs=3)
        assert [frame.t_s for frame in frames] == pytest.approx([0.0, 0.04, 0.08])
        with pytest.raises(EndOfFrames):
            camera.read()


def test_files_that_are_not_there_or_no_pictures_are_named(tmp_path):
    with pytest.raises(MissingFile, match="film.avi"):
        open_camera(CameraConfig("video", str(tmp_path / "film.avi")))
    (tmp_path / "film.avi").write_bytes(b"no film")
    with pytest.raises(CorruptFile, match="film.avi"):
        open_camera(CameraConfig("video", str(tmp_path / "film.avi")))
    with pytest.raises(MissingFile, match="folder"):
        open_camera(CameraConfig("folder", str(tmp_path / "none")))
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingFile, match="png"):
        open_camera(CameraConfig("folder", str(tmp_path / "empty")))
    (tmp_path / "empty" / "a.png").write_bytes(b"no picture")
    with open_camera(CameraConfig("folder", str(tmp_path / "empty"))) as camera, pytest.raises(CorruptFile, match="a.png"):
        camera.read()


def test_a_camera_that_is_not_there_is_one_clear_line():
    with pytest.raises(NoCamera, match="/dev/v4l/by-id/usb-nobody is not there; found: ") as caught:
        open_camera(CameraConfig("uvc", "/dev/v4l/by-id/usb-nobody"))
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2
    assert all(path.startswith("/dev/") for path in cameras_found())


def test_a_file_is_no_uvc_camera(tmp_path):
    (tmp_path / "file").write_bytes(b"no camera")
    with pytest.raises(NoCamera, match="cannot be opened"):
        open_camera(CameraConfig("uvc", str(tmp_path / "file")))


def test_the_realsense_library_is_asked_for_by_its_install_line(monkeypatch, tmp_path):
    for text in ("raise ImportError('libusb-1.0.so.0: cannot open shared object file')", "raise OSError('no driver')"):
        (tmp_path / "pyrealsense2.py").write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path))
        with pytest.raises(NoCamera, match=r"pip install .*pyrealsense2.*libusb"):
            open_camera(CameraConfig("realsense"))


def test_a_realsense_that_is_not_plugged_in_is_one_clear_line(monkeypatch, tmp_path):
    """A stand-in for the library, as it behaves without a device: this machine has neither."""
    (tmp_path / "pyrealsense2.py").write_text(
        "class config:\n"
        "    def enable_device(self, serial): pass\n"
        "    def enable_stream(self, *arguments): pass\n"
        "class pipeline:\n"
        "    def start(self, settings): raise RuntimeError('No device connected')\n"
        "class stream: color = 1\n"
        "class format: bgr8 = 2\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    with pytest.raises(NoCamera, match="RealSense 0815 cannot be started: No device connected"):
        open_camera(CameraConfig("realsense", "0815"))
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)


def test_settings_that_cannot_be_are_refused():
    for config, says in (
        (CameraConfig("uvc"), "camera.path"),
        (CameraConfig("uvc", "/dev/video0", fourcc="YUV"), "fourcc"),
        (CameraConfig("rendered"), "camera.source"),
        (CameraConfig("folder", ".", frames_per_s=0), "frames_per_s"),
    ):
        with pytest.raises(InvalidSetting, match=says):
            open_camera(config)
    with pytest.raises(UnknownChoice, match="realsense"):
        open_camera(CameraConfig("webcam"))
    rendered = open_camera(CameraConfig("rendered"), lambda: picture(3))
    assert rendered.read().image[0, 0, 0] == 3
