"""Settings of a cell: what cannot be is refused, and so is what this cell would not use."""

from __future__ import annotations

import cv2
import pytest

from marl_handover.cli import main
from marl_handover.control.settings import CardConfig, WorkcellConfig, twin_workcell
from marl_handover.errors import InvalidSetting
from marl_handover.perception.printables import dictionary
from marl_handover.perception.settings import MARKERS, CameraConfig, TargetConfig


def real_lab():
    return WorkcellConfig(camera=CameraConfig(path="/dev/video0"))


def test_the_shipped_cells_are_sound():
    twin_workcell().validate()
    real_lab().validate()
    drawn = twin_workcell()
    drawn.camera = CameraConfig("rendered", width_px=640, height_px=480, max_age_s=0.5)
    drawn.validate()


def test_dictionaries_have_as_many_markers_as_is_said():
    assert {name: len(dictionary(name).bytesList) for name in MARKERS} == MARKERS
    assert cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11).markerSize == 6


@pytest.mark.parametrize(
    "changes",
    [
        {"ids": [2]},
        {"ids": [2, 3, 4]},
        {"ids": [2, 2]},
        {"ids": [0, 3]},
        {"ids": [2, 1]},
        {"ids": [2, 587]},
        {"ids": [-1, 2]},
        {"marker_mm": -3.0},
        {"marker_mm": 0.0},
        {"place_mm": [1.0, 2.0]},
        {"place_mm": [1.0, 2.0, float("nan")]},
    ],
)
def test_cards_that_cannot_be_are_refused(changes):
    for config in (twin_workcell(), real_lab()):
        config.hand_markers = CardConfig(**changes)
        with pytest.raises(InvalidSetting, match=f"hand_markers.{next(iter(changes))}"):
            config.validate()


def test_a_marker_that_the_dictionary_does_not_have_is_refused():
    TargetConfig(dictionary="16h5", block_id=29).validate()
    with pytest.raises(InvalidSetting, match="block_id"):
        TargetConfig(dictionary="16h5", block_id=30).validate()
    with pytest.raises(InvalidSetting, match="goal_id"):
        TargetConfig(goal_id=587).validate()


@pytest.mark.parametrize(
    "setting",
    [f"camera.{it}" for it in ("width_px=0", "max_age_s=0", "source=folder", "path=/dev/video0", "timeout_s=5", "fourcc=MJPG")],
)
def test_the_twin_refuses_a_camera_it_does_not_have(setting, tmp_path, capsys):
    assert main(["calibrate", "hardware=twin", f"calibration={tmp_path}", setting]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert setting.split("=")[0] in error


@pytest.mark.parametrize("setting", ["mount.focal_px=900", "look.noise=1", "twin.seed=3", "twin.card_sd_mm=0"])
def test_a_real_cell_refuses_what_only_the_twin_has(setting, tmp_path, capsys):
    assert main(["calibrate", "hardware=lynxmotion", "camera.path=/dev/video0", f"calibration={tmp_path}", setting]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert setting.split("=")[0] in error
    assert "twin" in error


def test_sheets_are_not_printed_of_cards_that_cannot_be(tmp_path, capsys):
    assert main(["calibrate", "what=sheets", f"calibration={tmp_path}", "hand_markers.ids=[2]"]) == 2
    assert "hand_markers.ids" in capsys.readouterr().err
