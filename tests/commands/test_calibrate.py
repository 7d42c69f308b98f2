"""``marl-handover calibrate`` on the twin: what it finds is near the truth, without ever having been told."""

from __future__ import annotations

import io
import json
import shutil

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.cli import main
from marl_handover.control.calibration import TerminalOperator, confirmed
from marl_handover.control.settings import CardConfig, twin_workcell
from marl_handover.errors import WorkFailed
from marl_handover.hardware.calibration import load_backlash, load_calibration, nominal_calibration, require_one_set
from marl_handover.hardware.emulator.device import EmulatedCell
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.settings import ARMS
from marl_handover.perception.calibration import CameraCalibration, hung_camera
from tests.canonical_arms import PARKED_DEG


@pytest.fixture(scope="module")
def model():
    return build_cell(cell_config("paper"))


def test_the_camera_maps_the_table_to_a_millimetre(twin_calibration):
    config = twin_workcell()
    truth = hung_camera(config.mount, (config.camera.width_px, config.camera.height_px))
    found = CameraCalibration.load(twin_calibration / "camera.json")
    points = np.array([[x, y, 15.0] for x in (-150, 0, 150) for y in (-250, 0, 250)], float)
    assert np.abs(found.on_plane(truth.project(points), 15.0) - points[:, :2]).max() < 1.5


def test_servos_come_out_far_nearer_than_nominal_ones(twin_calibration, model):
    config = twin_workcell().hardware
    truths = EmulatedCell(config, model.arm, np.radians(PARKED_DEG)).truths
    q = np.stack([model.arm.ik(np.array([radius, side, 45.0]))[0] for radius in (165, 190, 215) for side in (-60.0, 60.0)])
    for name in ARMS:
        found = load_calibration(twin_calibration / f"{name}.json", name, model.arm)
        errors = []
        for calibration in (found, nominal_calibration(config, name, model.arm)):
            pulses = calibration.to_us(q)
            real = np.stack([(pulses[:, n] - t.zero_us) / t.slope_us for n, t in enumerate(truths[name][:5])], axis=1)
            errors.append(np.linalg.norm((model.arm.fk(real) - model.arm.fk(q))[:, :2, 3], axis=1).max())
        assert errors[0] < 4.0 < errors[1], "mm at the grip"
        bands = np.array([truth.dead_band_us for truth in truths[name][:5]])
        assert np.ptp(bands) > 1.0, "no two servos are alike"
        off = np.abs(2 * load_backlash(twin_calibration)[name] - bands)
        assert off[:3].max() < 3.0, "base, shoulder, elbow: the ones that move the hand"
        assert off.max() < 6.0


def test_servos_need_the_camera_first(tmp_path, capsys):
    assert main(["calibrate", "hardware=twin", f"calibration={tmp_path}", "what=servos"]) == 2
    assert "what=camera" in capsys.readouterr().err


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and "stop" not in path.name}


@pytest.fixture
def again(twin_calibration, tmp_path):
    """``again(*settings)``: the exit status of calibrating the servos once more, in a copy of what was found, ``again.folder``."""
    folder = tmp_path / "cell"
    shutil.copytree(twin_calibration, folder)

    def run(*settings):
        usual = ["hardware=twin", "what=servos", "postures=12", f"calibration={folder}", f"hardware.stop_file={tmp_path / 'stop'}"]
        return main(["calibrate", *usual, *settings])

    run.folder = folder
    return run


def test_a_run_that_breaks_off_between_the_arms_changes_nothing(again, tmp_path, monkeypatch):
    """The stop is latched as soon as the left arm is done."""

    class Ear(io.StringIO):
        def write(self, text):
            if text.startswith("left arm"):
                StopLatch(tmp_path / "stop").latch("test")
            return super().write(text)

    before = contents(again.folder)
    monkeypatch.setattr("sys.stdout", ear := Ear())
    assert again() == 1
    assert "left arm: seen in" in ear.getvalue()
    assert "right arm: seen in" not in ear.getvalue()
    assert contents(again.folder) == before
    require_one_set(again.folder)


def test_servos_that_explain_little_are_not_saved(again, capsys):
    """Somebody has knocked against the camera since it was calibrated."""
    before = contents(again.folder)
    assert again("mount.tilt_deg=[0.8,0.4]") == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    assert "nothing was saved; does the camera hang as it was calibrated" in told.err
    assert contents(again.folder) == before
    assert again("mount.tilt_deg=[0.8,0.4]", "worst_mm=9") == 0
    assert "left arm: WARNING" in capsys.readouterr().out
    assert contents(again.folder) != before


def test_sound_servos_are_saved_without_a_warning_and_say_how_sure_they_are(again, capsys):
    assert again() == 0
    told = capsys.readouterr().out
    assert "WARNING" not in told
    assert told.count("sure to within degrees: base_yaw 0.") == 2
    require_one_set(again.folder)


@pytest.mark.parametrize("wrong", ["worst_mm=0", "what=arms", "postures=3", "views=2", "camera.width_px=12"])
def test_bad_input_is_one_line(tmp_path, capsys, wrong):
    assert main(["calibrate", "hardware=lynxmotion", f"calibration={tmp_path}", wrong]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert wrong.split("=")[0].split(".")[-1] in error


def test_sheets_are_written_for_everything_that_has_to_be_printed(tmp_path, capsys):
    assert main(["calibrate", "what=sheets", f"calibration={tmp_path}"]) == 0
    named = set(capsys.readouterr().out.split())
    assert named == {str(path) for path in (tmp_path / "sheets").iterdir()}
    assert {"board.pdf", "block.pdf", "goal.pdf", "hands.pdf"} <= {path.name for path in (tmp_path / "sheets").iterdir()}


def test_files_are_json_and_say_whose_they_are(twin_calibration):
    for name in ARMS:
        content = json.loads((twin_calibration / f"{name}.json").read_text())
        assert content["arm"] == name
        assert content["measured_unix_s"] > 0


def test_without_a_terminal_nobody_is_there(monkeypatch):
    monkeypatch.setattr("sys.stdin", open("/dev/null"))  # noqa: SIM115 - closed with the process
    assert not confirmed("Is the way free?")
    with pytest.raises(WorkFailed, match="terminal"):
        TerminalOperator(CardConfig(), build_cell(cell_config("paper"))).glue_cards()
