"""A cell with everything that has a plug, real or the twin: driver, camera, what is known of both, clock, log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.control.events import EventLog
from marl_handover.control.pose_monitor import PoseMonitor
from marl_handover.control.settings import WorkcellConfig
from marl_handover.control.twin import Twin
from marl_handover.errors import MissingFile
from marl_handover.hardware.calibration import (
    BACKLASH_FILE,
    SET_FILE,
    arm_file,
    calibrations,
    half_bands_rad,
    load_backlash,
    require_one_set,
    servo_files,
)
from marl_handover.hardware.clock import Clock, RealClock
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.gripper import with_grippers
from marl_handover.hardware.settings import ARMS, HardwareConfig
from marl_handover.perception.calibration import CameraCalibration
from marl_handover.perception.camera import Camera, open_camera
from marl_handover.perception.detector import Detector
from marl_handover.perception.tracker import Tracker

CAMERA_FILE = "camera.json"


@dataclass
class Devices:
    """What a cell is reached through. ``twin`` is None for a real one."""

    hardware: HardwareConfig
    camera: Camera
    clock: Clock
    confirm: Callable[[str], bool] | None
    twin: Twin | None = None

    def close(self) -> None:
        """Let camera and twin go."""
        self.camera.close()
        if self.twin is not None:
            self.twin.close()


@dataclass
class Workcell:
    """A cell that is ready to be connected."""

    config: WorkcellConfig
    driver: ArmDriver
    camera: Camera
    pose_monitor: PoseMonitor
    half_band_rad: NDArray[np.float64]
    clock: Clock
    log: EventLog
    twin: Twin | None

    def close(self) -> None:
        """Let go of arms, as the settings say, of camera and log."""
        try:
            self.driver.disconnect()
        finally:
            self.camera.close()
            self.log.close()
            if self.twin is not None:
                self.twin.close()


def open_devices(config: WorkcellConfig, model: CellModel, motion: MotionConfig, confirm: Callable[[str], bool] | None = None) -> Devices:
    """The twin, if ``config`` is one; else the camera that is there, and ``confirm`` is asked before first moves.

    Raises:
        InvalidSetting, UnknownChoice: a setting is out of its limits, or an arm of the cell is not wired.
        NoCamera: the camera is not there.
    """
    config.validate(model.cell.names)
    if config.emulated:
        twin = Twin(model, motion, config)
        return Devices(twin.hardware, twin.camera, twin.clock, twin.confirm, twin)
    clock = RealClock()
    return Devices(config.hardware.for_arms(model.cell.names), open_camera(config.camera, clock=clock.now_s), clock, confirm)


def open_workcell(
    config: WorkcellConfig,
    model: CellModel,
    motion: MotionConfig,
    *,
    confirm: Callable[[str], bool] | None = None,
    dry_run: bool = False,
    log_path: str = "",
    grippers: bool = True,
    latch: StopLatch | None = None,
) -> Workcell:
    """A calibrated cell; without ``grippers`` the hands are as the settings say, without ``latch`` it has the stop that they name.

    Raises:
        MissingFile, CorruptFile, CalibrationProblem, CalibrationMismatch: ``calibrate`` has to be run first, or again.
        NoCamera: the camera is not there.
        InvalidSetting, UnknownChoice: a setting is out of its limits, or an arm of the cell is not wired.
    """
    wired = config.hardware.for_arms(model.cell.names)
    folder = config.folder()
    seen_by = camera_calibration(folder)
    require_one_set(folder, [*(arm_file(arm) for arm, wiring in wired.arms.items() if not wiring.calibration), BACKLASH_FILE])
    half_us = load_backlash(folder, tuple(wired.arms))
    devices = open_devices(config, model, motion, confirm)
    try:
        hardware = calibrated(devices.hardware, folder)
        if grippers:
            hardware = with_grippers(hardware, folder)
        half_band_rad = half_bands_rad(half_us, calibrations(hardware, model.arm))
        stop = latch or StopLatch(hardware.stop_path())
        driver = ArmDriver(hardware, model, motion, clock=devices.clock, latch=stop, confirm=devices.confirm, dry_run=dry_run)
        log = EventLog(devices.clock.now_s, log_path)
        tracker = Tracker(Detector(seen_by, model.cell.config.block, config.target, config.detector), config.tracker)
        pose_monitor = PoseMonitor(devices.camera, tracker, devices.clock, config.watch, log, driver.wait)
    except BaseException:
        devices.close()
        raise
    return Workcell(config, driver, devices.camera, pose_monitor, half_band_rad, devices.clock, log, devices.twin)


def is_calibrated(folder: Path, arms: Sequence[str] = ARMS) -> bool:
    """Whether every file that ``calibrate`` writes of ``arms`` is in ``folder``."""
    return all((folder / name).is_file() for name in (CAMERA_FILE, SET_FILE, *servo_files(arms)))


def camera_calibration(folder: Path) -> CameraCalibration:
    """The camera's, from the folder of calibrations. Raises :class:`MissingFile` or :class:`CorruptFile`."""
    path = folder / CAMERA_FILE
    if not path.is_file():
        raise MissingFile("camera calibration", path, "run: marl-handover calibrate what=camera hardware=NAME, with the name you run")
    return CameraCalibration.load(path)


def calibrated(hardware: HardwareConfig, folder: Path) -> HardwareConfig:
    """The electronics with the arms' calibration files in ``folder``; a file that the settings name stays."""
    arms = {
        name: wiring if wiring.calibration else replace(wiring, calibration=str(folder / arm_file(name)))
        for name, wiring in hardware.arms.items()
    }
    return replace(hardware, arms=arms)
