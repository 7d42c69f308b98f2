"""``marl-handover calibrate``: the camera's lens and place, every servo's pulses, how hands hold; of a real cell or its twin."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from marl_handover.cell import build_cell
from marl_handover.config import CELL_ALIASES, CellConfig, MotionConfig, bounded, check_bounds, chosen, seed_field
from marl_handover.control.settings import WorkcellConfig
from marl_handover.geometry.urdf import ARM_JOINTS

if TYPE_CHECKING:
    from marl_handover.cell import CellModel
    from marl_handover.control.calibration import Operator
    from marl_handover.control.servo_calibration import Measured
    from marl_handover.control.workcell import Devices
    from marl_handover.hardware.calibration import ArmCalibration

DOUBTFUL_MM = 1.5
"""Sightings of sound servos are less far off, with errors twice the usual ones as well."""

_SUSPECTS = (
    "does the camera hang as it was calibrated, is each hand's own marker where hand_markers.place_mm says, is a horn loose, are the links "
    "the cell's?"
)
_CUT_MM = 10.0
WHAT = ("all", "camera", "servos", "grippers", "sheets")


@dataclass
class CalibrateCommand(WorkcellConfig):
    """Settings of ``calibrate``; files go to ``calibration=DIR``."""

    what: str = chosen("all", WHAT)  # camera, servos (needs camera), grippers (needs both), all, or sheets: what has to be printed
    paper: str = chosen("a4", ("a4", "a3", "letter"))  # of the sheets: a4, a3 or letter
    postures: int = bounded(60, 12, 500)  # of each arm
    worst_mm: float = bounded(3.0, 0.01, 100.0)  # servos that explain the sightings no better are not saved
    views: int = bounded(20, 8, 200)  # of the board, held before the camera
    seed: int = seed_field()  # of the postures
    cell: CellConfig = field(default_factory=CellConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    progress: bool = True  # of what takes long, on stderr


SCHEMA: type = CalibrateCommand
ALIASES = CELL_ALIASES
GROUPS: dict[str, dict[str, type]] = {}


def run(config: CalibrateCommand) -> int:
    """Go through the procedures and save what they give."""
    from marl_handover.control.calibration import TerminalOperator, confirmed
    from marl_handover.control.workcell import open_devices

    check_bounds(config)
    model = build_cell(config.cell)
    if config.what == "sheets":
        config.board.validate()
        config.target.validate()
        config.hand_markers.validate(config.target, model.cell.num_arms)
        return _sheets(config, model)
    if config.what in ("all", "camera", "servos"):
        devices = open_devices(config, model, config.motion, confirmed)
        try:
            operator: Operator = devices.twin or TerminalOperator(config.hand_markers, model, tuple(devices.hardware.arms))
            if config.what in ("all", "camera"):
                _camera(config, devices, operator)
            if config.what in ("all", "servos"):
                _servos(config, devices, operator, model)
        finally:
            devices.close()
    if config.what in ("all", "grippers"):
        _grippers(config, model)
    return 0


def _sheets(config: CalibrateCommand, model: CellModel) -> int:
    from marl_handover.perception.printables import PX_PER_MM, marker_sheet, page, save_sheet, write_sheets

    folder, cards, target = config.folder() / "sheets", config.hand_markers, config.target
    ids = cards.numbers(model.cell.num_arms)
    files = write_sheets(folder, model.cell.config.block, target, config.board, config.paper)
    sheets = [marker_sheet(target.dictionary, number, cards.marker_mm, cards.marker_mm + _CUT_MM, PX_PER_MM) for number in ids]
    (name, first), *others = zip(config.hardware.for_arms(model.cell.names).arms, ids, strict=True)
    rest = "".join(f", {number} for the {arm}" for arm, number in others)
    words = f"markers {first} for the {name} hand{rest}: flat on top, upper edge to the left"
    files.append(folder / "hands.pdf")
    save_sheet(page(sheets, config.paper, "hands", words), files[-1])
    for path in files:
        print(path)
    return 0


def _camera(config: CalibrateCommand, devices: Devices, operator: Operator) -> None:
    from marl_handover.control.calibration import calibrate_camera
    from marl_handover.control.workcell import CAMERA_FILE

    found = calibrate_camera(devices.camera, devices.clock, config.board, operator, devices.camera.name, config.views)
    path = config.folder() / CAMERA_FILE
    found.save(path)
    x, y, z = found.eye_mm()
    print(
        f"camera: {found.intrinsics.views} views, lens {found.intrinsics.error_px:.2f} px off, place {found.pose_error_px:.2f} px off, "
        f"eye at ({x:z.1f}, {y:z.1f}, {z:z.1f}) mm -> {path}"
    )


def _servos(config: CalibrateCommand, devices: Devices, operator: Operator, model: CellModel) -> None:
    from marl_handover.control.servo_calibration import ServoCalibration
    from marl_handover.control.workcell import camera_calibration
    from marl_handover.files import make_folder
    from marl_handover.hardware.calibration import lerobot_motors, save_servos
    from marl_handover.hardware.driver import ArmDriver
    from marl_handover.hardware.estop import StopLatch
    from marl_handover.hardware.lerobot_file import write_motors

    seen_by = camera_calibration(config.folder())
    operator.glue_cards()
    latch = StopLatch(devices.hardware.stop_path())
    driver = ArmDriver(devices.hardware, model, config.motion, clock=devices.clock, latch=latch, confirm=devices.confirm)
    found: dict[str, Measured] = {}
    with driver:
        driver.arm()
        procedure = ServoCalibration(driver, devices.camera, seen_by, config.target, config.hand_markers, config.seed, config.postures)
        for arm, name in enumerate(driver.config.arms):
            found[name] = measured = procedure.arm(arm)
            print(
                f"{name} arm: seen in {measured.sightings} postures, {measured.residual_mm:.2f} mm off, {_bands(measured)}, "
                f"{_sure(measured)}, {_change(driver.calibrations[arm], measured.calibration)}"
            )
            _require_good(name, measured, config.worst_mm)
            if (spread := procedure.repeatability(arm)) is not None:
                what = f"{spread.position_mm:.2f} mm and {spread.yaw_deg:.2f} degrees"
                print(f"{name} arm: comes back to a posture within {what} (root mean square of {spread.visits} visits)")
    save_servos(
        config.folder(),
        {name: measured.calibration for name, measured in found.items()},
        {name: measured.half_band_us for name, measured in found.items()},
        {name: measured.half_band_sd_us for name, measured in found.items()},
    )
    print(f"-> {config.folder()}")
    for name, measured in found.items():
        if not measured.calibration.homing_offsets:  # servos of a board, which LeRobot does not drive
            continue
        ids, closed = driver.config.channels(name), driver.config.arms[name].gripper.closed_us
        path = config.folder() / "lerobot" / f"{name}.json"
        make_folder(path.parent)
        write_motors(path, lerobot_motors(measured.calibration, model.arm, ids, closed))
        print(f"the {name} arm for LeRobot's own programs -> {path}")
    operator.take_cards_off()


def _grippers(config: CalibrateCommand, model: CellModel) -> None:
    from marl_handover.control.calibration import Grip, GripperCalibration, TerminalOperator, confirmed, places
    from marl_handover.control.hardware_backend import HardwareBackend
    from marl_handover.hardware.gripper import save_grippers
    from marl_handover.motion.planner import MotionPlanner

    planner = MotionPlanner(model, config.motion)
    planner.warm_up()
    backend = HardwareBackend(model, config.motion, config=config, confirm=confirmed, grippers=False)
    names = tuple(backend.workcell.driver.config.arms)
    found: dict[str, Grip] = {}
    try:
        operator: Operator = backend.workcell.twin or TerminalOperator(config.hand_markers, model, names)
        first = places(model.cell)[0]
        operator.stand_block(first)
        backend.reset(np.array(first), config.seed)
        procedure = GripperCalibration(backend, planner, operator, lambda arm, further_mm, held: _told(names[arm], further_mm, held))
        for arm, name in enumerate(names):
            found[name] = grip = procedure.arm(arm)
            print(
                f"{name} gripper: {grip.off_mm:+.1f} mm further than set, after {grip.tries} tries: "
                f"open_us={grip.gripper.open_us} closed_us={grip.gripper.closed_us}"
            )
    finally:
        backend.close()
    asked = {name: config.hardware.arms[name].gripper for name in names}
    print(f"-> {save_grippers(config.folder(), asked, {name: grip.gripper for name, grip in found.items()})}")


def _told(arm: str, further_mm: float, held: bool) -> None:
    """One try of a gripper."""
    print(f"{arm} gripper, {further_mm:+.1f} mm: {'holds' if held else 'does not hold'}", file=sys.stderr)


def _require_good(name: str, measured: Measured, worst_mm: float) -> None:
    """Refuse a calibration that explains little; say so of one that explains less than it should."""
    from marl_handover.hardware.calibration import CalibrationProblem

    off = f"{measured.residual_mm:.2f} mm off"
    if not measured.residual_mm <= worst_mm:
        raise CalibrationProblem(f"the {name} arm", f"{off}, more than worst_mm={worst_mm:g}, so nothing was saved; {_SUSPECTS}")
    if measured.residual_mm > DOUBTFUL_MM:
        print(f"{name} arm: WARNING, {off} where {DOUBTFUL_MM:g} mm are usual at most; {_SUSPECTS}")


def _sure(measured: Measured) -> str:
    """Each joint's standard deviation."""
    joints = zip(ARM_JOINTS, measured.joint_sd_deg, strict=True)
    return "sure to within degrees: " + " ".join(f"{joint} {sd_deg:.2f}" for joint, sd_deg in joints)


def _bands(measured: Measured) -> str:
    """The dead bands, each with the half-width of the interval it is in with 95 %."""
    if not measured.half_band_us.any():
        return "encoders take out dead bands"
    bands = zip(ARM_JOINTS, 2 * measured.half_band_us, 4 * measured.half_band_sd_us, strict=True)
    return "dead bands in us: " + " ".join(f"{joint} {width:.1f} +- {sure:.1f}" for joint, width, sure in bands)


def _change(before: ArmCalibration, after: ArmCalibration) -> str:
    """How far each joint was from where it was taken to be, at 1500 us."""
    moved = (
        f"{joint} {math.degrees(float(new.to_rad(1500.0) - old.to_rad(1500.0))):+.1f}"
        for joint, old, new in zip(ARM_JOINTS, before.maps, after.maps, strict=True)
    )
    return "degrees off before: " + " ".join(moved)
