"""The twin of three arms on two boards, end to end: what is calibrated, seen, evaluated and run."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from marl_handover.arrays import wrap
from marl_handover.cell import build_cell, cell_config
from marl_handover.cli import main
from marl_handover.compose import from_yaml
from marl_handover.config import MotionConfig
from marl_handover.control.calibration import TerminalOperator, partners, places
from marl_handover.control.settings import CardConfig, WorkcellConfig, twin_workcell
from marl_handover.control.twin import Twin, camera_over
from marl_handover.control.workcell import CAMERA_FILE
from marl_handover.errors import InvalidSetting, WorkFailed
from marl_handover.files import resource_path
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import make_calibration, save_servos
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.perception.calibration import hung_camera
from marl_handover.perception.detector import Detector

NAMES = ("north", "west", "east")
CELL = ["cell=triangle", "hardware=triangle_twin"]


@pytest.fixture(scope="module")
def triangle():
    return build_cell(cell_config("triangle"))


@pytest.fixture(scope="module")
def config() -> WorkcellConfig:
    return WorkcellConfig(from_yaml(HardwareConfig, resource_path("configs/hardware/triangle_twin.yaml")))


@pytest.fixture(scope="module")
def twin(triangle, config):
    twin = Twin(triangle, MotionConfig(), config)
    yield twin
    twin.close()


@pytest.fixture(scope="module")
def known(twin, triangle, tmp_path_factory):
    """A folder of calibrations by somebody who knows the truth: of the camera, and of every servo of the three arms."""
    folder = tmp_path_factory.mktemp("triangle")
    twin.painter.renderer.calibration.save(folder / CAMERA_FILE)
    found, bands = {}, {}
    for name, truths in twin.electronics.truths.items():
        points = {
            joint: [(truth.zero_us + truth.slope_us * angle, angle) for angle in (-1.0, 1.0)]
            for joint, truth in zip(ARM_JOINTS, truths[:5], strict=True)
        }
        found[name] = make_calibration(name, triangle.arm, points)
        bands[name] = [truth.dead_band_us / 2 for truth in truths[:5]]
    save_servos(folder, found, bands, bands)
    return folder


def test_the_camera_sees_all_that_three_arms_reach(triangle, twin):
    calibration, block = twin.painter.renderer.calibration, triangle.cell.config.block
    reached = np.argwhere(np.any(triangle.grid.masks, axis=0))
    points = np.column_stack([triangle.grid.x_mm[reached[:, 0]], triangle.grid.y_mm[reached[:, 1]], np.full(len(reached), block.height_mm)])
    pixels, size = calibration.project(points), np.array(calibration.intrinsics.size_px)
    assert (pixels > 0).all()
    assert (pixels < size).all()
    detector = Detector(calibration, block)
    for x, y in points[:: len(points) // 6, :2]:
        twin.set_object_pose([x, y, 0.7])
        twin.clock.sleep_s(0.3)
        seen, true = detector.detect(twin.camera.read().image).block.pose, twin.true_pose()
        assert math.dist(seen[:2], true[:2]) < 1.0
        assert abs(float(wrap(seen[2] - true[2]))) < math.radians(1.5)


def test_over_a_pair_and_where_it_is_told_the_camera_hangs_as_ever(model, triangle, config):
    assert camera_over(model, config) == (config.mount, (1280, 720))
    told = WorkcellConfig(config.hardware)
    told.mount.eye_mm = [0.0, 0.0, 900.0]
    assert camera_over(triangle, told) == (told.mount, (1280, 720))
    assert camera_over(triangle, config)[1] == (1280, 720)


@pytest.mark.parametrize("name", ["line4", "ring6"])
def test_large_cells_are_seen_whole_by_a_camera_of_more_pixels(name):
    """They lie along the picture; the lens is the same."""
    cell, config = build_cell(cell_config(name)), twin_workcell()
    mount, size_px = camera_over(cell, config)
    assert mount.turn_deg == pytest.approx(90.4), "world x is longer than world y"
    assert size_px == (1920, 1080)
    assert mount.focal_px / 1920 == pytest.approx(config.mount.focal_px / 1280)
    rows = np.argwhere(np.any(cell.grid.masks, axis=0))
    places = np.column_stack([cell.grid.x_mm[rows[:, 0]], cell.grid.y_mm[rows[:, 1]], np.full(len(rows), 15.0)])
    pixels = hung_camera(mount, size_px).project(places)
    assert (pixels > 0).all()
    assert (pixels < size_px).all()


def test_a_cell_too_large_for_the_picture_names_one_that_would_do(triangle, config):
    small = WorkcellConfig(config.hardware)
    small.camera.width_px, small.camera.height_px = 640, 360
    with pytest.raises(InvalidSetting, match=r"camera.height_px = 360: must be at least (\d+)") as refused:
        camera_over(triangle, small)
    small.camera.height_px = int(refused.value.limit.split()[2].rstrip(","))
    small.camera.width_px = math.ceil(small.camera.height_px * 16 / 9)
    assert camera_over(triangle, small)[0].eye_mm[2] > 702.0


def test_three_arms_pass_a_block_on_through_bytes_and_pixels(known, tmp_path):
    result, trace = tmp_path / "result.json", tmp_path / "trace.jsonl"
    more = [f"calibration={known}", "episodes=3", "seed=1", "progress=false", f"json={result}", f"trace={trace}"]
    assert main(["evaluate", "policy=exact", "backend=twin", *CELL, *more]) == 0
    report = json.loads(result.read_text())
    assert report["success_in_the_end"] == 1.0
    assert 0 < report["position_error_mm"]["p99"] < 5
    rows = [json.loads(line) for line in trace.read_text().splitlines()]
    assert {row["arm"] for row in rows} <= set(NAMES)
    assert len({row["arm"] for row in rows}) >= 2


def test_real_wiring_is_emulated_by_evaluate(known, tmp_path):
    """``hardware=triangle`` names real ports; the twin takes its boards and channels, and none of its ports."""
    more = [f"calibration={known}", "episodes=1", "seed=1", "progress=false"]
    assert main(["evaluate", "policy=exact", "backend=twin", "cell=triangle", "hardware=triangle", *more]) == 0


def test_run_shows_and_logs_three_arms(known, tmp_path, capsys):
    log, live = tmp_path / "log.jsonl", tmp_path / "live"
    more = [f"calibration={known}", f"log={log}", f"publish={live}", f"hardware.stop_file={tmp_path / 'stop'}"]
    assert main(["run", "policy=pretrained_any", *CELL, "start=[-250,100,0]", "goal=[250,100,90]", *more]) == 0
    assert "1 of 1 at the goal" in capsys.readouterr().out
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    assert rows[0]["hardware"] == "triangle_twin"
    assert {len(row["joints_rad"]) for row in rows if row["event"] == "state"} == {3}
    assert {row["arm"] for row in rows if row["event"] == "transfer"} <= set(NAMES)
    state = json.loads((live / "state.json").read_text())
    assert [(arm["name"], arm["letter"]) for arm in state["arms"]] == [(name, name) for name in NAMES]


def test_an_arm_out_of_order_stands_parked_on_its_board(known, tmp_path):
    """The two that are left go on; the third is held where it stands."""
    log = tmp_path / "log.jsonl"
    more = [f"calibration={known}", f"log={log}", "arms.enabled=[north,west]", f"hardware.stop_file={tmp_path / 'stop'}"]
    assert main(["run", "policy=exact", *CELL, "start=[-200,40,0]", "goal=[-150,60,170]", *more]) == 0
    states = [row["joints_rad"] for row in map(json.loads, log.read_text().splitlines()) if row["event"] == "state"]
    assert np.ptp(np.array(states)[:, 2], axis=0).max() == 0.0
    assert np.ptp(np.array(states)[:, :2], axis=0).max() > 0.1


def test_a_calibration_without_one_of_the_arms_is_refused(known, tmp_path, capsys):
    for path in known.iterdir():
        if path.name != "east.json":
            (tmp_path / path.name).write_bytes(path.read_bytes())
    assert main(["evaluate", "policy=exact", "backend=twin", *CELL, f"calibration={tmp_path}", "episodes=1"]) == 2
    assert "east.json" in capsys.readouterr().err


def test_each_hand_tries_to_carry_between_places_that_it_and_a_partner_reach(triangle, model):
    for arm in range(3):
        first, second = np.array(places(triangle.cell, arm))
        assert math.dist(first[:2], second[:2]) > 80.0
        for place in (first, second):
            assert triangle.cell.reaches(place[:2])[list(partners(triangle.cell, arm))].all()
        assert arm in partners(triangle.cell, arm)
    assert places(model.cell, 0) == places(model.cell, 1)
    assert partners(model.cell, 1) == (0, 1)


def test_markers_are_numbered_on_and_people_are_told_of_all(config, tmp_path, capsys):
    assert CardConfig().numbers(2) == [2, 3]
    assert CardConfig().numbers(3) == [2, 3, 4]
    assert CardConfig([7, 9, 8]).numbers(3) == [7, 9, 8]
    with pytest.raises(WorkFailed, match="marker 2 flat on the north hand, 3 on the west one, 4 on the east one"):
        TerminalOperator(CardConfig(), build_cell(cell_config("triangle")), NAMES).glue_cards()
    assert main(["calibrate", "what=sheets", *CELL, f"calibration={tmp_path}"]) == 0
    assert (tmp_path / "sheets" / "hands.pdf").is_file()
    assert main(["calibrate", "what=sheets", *CELL, f"calibration={tmp_path}", "hand_markers.ids=[2,3]"]) == 2
    assert "hand_markers.ids" in capsys.readouterr().err


@pytest.mark.slow
def test_calibrate_finds_the_servos_of_all_three(tmp_path, triangle, twin):
    from marl_handover.hardware.calibration import load_backlash, load_calibration

    more = [f"calibration={tmp_path}", "postures=24", f"hardware.stop_file={tmp_path / 'stop'}"]
    assert main(["calibrate", *CELL, *more]) == 0
    q = np.stack([triangle.arm.ik(np.array([radius, side, 45.0]))[0] for radius in (165, 215, 265) for side in (-60.0, 60.0)])
    for name in NAMES:
        found, truths = load_calibration(tmp_path / f"{name}.json", name, triangle.arm), twin.electronics.truths[name]
        pulses = found.to_us(q)
        real = np.stack([(pulses[:, n] - truth.zero_us) / truth.slope_us for n, truth in enumerate(truths[:5])], axis=1)
        assert np.linalg.norm((triangle.arm.fk(real) - triangle.arm.fk(q))[:, :2, 3], axis=1).max() < 5.0, "mm at the grip"
    assert set(load_backlash(tmp_path, NAMES)) == set(NAMES)
    assert main(["evaluate", "policy=exact", "backend=twin", *CELL, f"calibration={tmp_path}", "episodes=1", "progress=false"]) == 0
