"""``marl-handover calibrate``: the camera's lens and place, and what every servo's pulse means; of a real cell or of its twin."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from marl_handover.cell import build_cell
from marl_handover.cell.urdf import ARM_JOINTS
from marl_handover.commands.person import Person, confirmed
from marl_handover.config import CellConfig, MotionConfig, require_between, require_choice
from marl_handover.hardware.settings import ARMS
from marl_handover.runtime.settings import LabConfig

if TYPE_CHECKING:
    from marl_handover.cell import CellModel
    from marl_handover.hardware.calibration import ArmCalibration
    from marl_handover.runtime.camera_calibration import Assistant
    from marl_handover.runtime.lab import Plugs

_CUT_MM = 10.0
WHAT = ("all", "camera", "servos", "sheets")


@dataclass
class CalibrateCommand(LabConfig):
    """Settings of ``calibrate``; files go to ``calibration=DIR``."""

    what: str = "all"  # camera, servos (which needs the camera's), all (both), or sheets: writes what has to be printed
    paper: str = "a4"  # of the sheets: a4, a3 or letter
    postures: int = 60  # of each arm
    views: int = 20  # of the board, held before the camera
    seed: int = 0  # of the postures
    cell: CellConfig = field(default_factory=CellConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)


SCHEMA: type = CalibrateCommand
ALIASES: dict[str, str] = {}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: CalibrateCommand) -> int:
    """Go through the procedures and save what they give."""
    from marl_handover.runtime.lab import plug_in

    require_choice("what", config.what, WHAT)
    require_between("postures", config.postures, 12, 500)
    require_between("views", config.views, 8, 200)
    model = build_cell(config.cell)
    if config.what == "sheets":
        return _sheets(config, model)
    plugs = plug_in(config, model, config.motion, confirmed)
    try:
        assistant: Assistant = plugs.twin or Person(config.cards)
        if config.what in ("all", "camera"):
            _camera(config, plugs, assistant)
        if config.what in ("all", "servos"):
            _servos(config, plugs, assistant, model)
    finally:
        plugs.close()
    return 0


def _sheets(config: CalibrateCommand, model: CellModel) -> int:
    from marl_handover.perception.boards import marker_sheet
    from marl_handover.perception.sheets import DPI, PX_PER_MM, page, write_sheets

    folder, cards, target = config.folder() / "sheets", config.cards, config.target
    files = write_sheets(folder, model.cell.config.block, target, config.board, config.paper)
    sheets = [marker_sheet(target.dictionary, number, cards.marker_mm, cards.marker_mm + _CUT_MM, PX_PER_MM) for number in cards.ids]
    words = f"markers {cards.ids[0]} for the left hand, {cards.ids[1]} for the right: flat on top, upper edge to the left"
    files.append(folder / "hands.pdf")
    page(sheets, config.paper, "hands", words).save(files[-1], resolution=DPI)
    for path in files:
        print(path)
    return 0


def _camera(config: CalibrateCommand, plugs: Plugs, assistant: Assistant) -> None:
    from marl_handover.runtime.camera_calibration import calibrate_camera
    from marl_handover.runtime.lab import CAMERA_FILE

    found = calibrate_camera(plugs.camera, plugs.clock, config.board, assistant, plugs.camera.name, config.views)
    path = config.folder() / CAMERA_FILE
    found.save(path)
    x, y, z = found.eye_mm()
    print(
        f"camera: {found.intrinsics.views} views, lens {found.intrinsics.error_px:.2f} px off, place {found.pose_error_px:.2f} px off, "
        f"eye at ({x:.1f}, {y:.1f}, {z:.1f}) mm -> {path}"
    )


def _servos(config: CalibrateCommand, plugs: Plugs, assistant: Assistant, model: CellModel) -> None:
    from marl_handover.hardware.driver import ArmDriver
    from marl_handover.hardware.latch import StopLatch
    from marl_handover.runtime.lab import camera_calibration
    from marl_handover.runtime.play import save_play
    from marl_handover.runtime.servo_calibration import ServoCalibration

    seen_by = camera_calibration(config.folder())
    assistant.glue_cards()
    latch = StopLatch(plugs.hardware.stop_path())
    driver = ArmDriver(plugs.hardware, model, config.motion, clock=plugs.clock, latch=latch, confirm=plugs.confirm)
    half_us: dict[str, float] = {}
    with driver:
        driver.arm()
        procedure = ServoCalibration(driver, plugs.camera, seen_by, config.target, config.cards, config.seed, config.postures)
        for arm, name in enumerate(ARMS):
            measured = procedure.arm(arm)
            path = config.folder() / f"{name}.json"
            measured.calibration.save(path)
            half_us[name] = measured.half_band_us
            print(
                f"{name} arm: seen in {measured.sightings} postures, {measured.residual_mm:.2f} mm off, dead band "
                f"{2 * measured.half_band_us:.1f} us, {_change(driver.calibrations[arm], measured.calibration)} -> {path}"
            )
    save_play(Path(config.folder()), half_us)
    assistant.take_cards_off()


def _change(before: ArmCalibration, after: ArmCalibration) -> str:
    """How far each joint was from where it was taken to be, at 1500 us."""
    moved = (
        f"{joint} {math.degrees(float(new.to_rad(1500.0) - old.to_rad(1500.0))):+.1f}"
        for joint, old, new in zip(ARM_JOINTS, before.maps, after.maps, strict=True)
    )
    return "degrees off before: " + " ".join(moved)
