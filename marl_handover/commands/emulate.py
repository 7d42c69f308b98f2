"""``marl-handover emulate``: servo controllers on pseudo-terminals, for trying out whatever talks to one."""

from __future__ import annotations

import signal
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from marl_handover.config import path_field, require_choice, require_seed
from marl_handover.errors import InvalidSetting, WorkFailed
from marl_handover.hardware.settings import HardwareConfig

if TYPE_CHECKING:
    from collections.abc import Mapping

    from marl_handover.hardware.emulator.device import SerialDevice
    from marl_handover.hardware.emulator.pty import PtyEmulator


@dataclass
class EmulateConfig:
    """Keys of ``emulate``."""

    link: str = path_field("runs/ssc32")  # symlink to the port; give it as the board's port to a run
    faults: str = ""  # kind@start_s[:duration_s][=amount],...: unplug brownout silent drop corrupt late stuck ignore random frozen jam
    board: str = ""  # which of the boards in hardware.boards; empty: all, those after the first at link_BOARD
    lines: bool = False  # print every line that comes in
    hardware: HardwareConfig = field(default_factory=HardwareConfig)


SCHEMA: type = EmulateConfig
ALIASES = {"firmware": "hardware.emulator.firmware", "seed": "hardware.emulator.seed"}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: EmulateConfig) -> int:
    """Serve until Ctrl-C or SIGTERM, which is how it is meant to end: 0 then."""
    try:
        from marl_handover.hardware.emulator.pty import turn
    except ImportError as error:
        raise WorkFailed(f"emulate needs pseudo-terminals, which this system does not have ({error})") from error

    emulators = _served(config)
    stopped: list[int] = []
    before = {number: signal.signal(number, lambda number, _: stopped.append(number)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for emulator in emulators:
            print(f"{emulator.device.title} at {emulator.link}, {emulator.device.baud} baud; Ctrl-C ends it", flush=True)
        while not stopped:
            turn(emulators)
            for emulator in emulators:
                while config.lines and emulator.device.lines:
                    t_s, line = emulator.device.lines.popleft()
                    print(f"{t_s:10.4f} s  {line.decode('ascii', 'backslashreplace').rstrip()}", flush=True)
    finally:
        for emulator in emulators:
            emulator.close()
        for number, handler in before.items():
            signal.signal(number, handler)
    return 0


def _served(config: EmulateConfig) -> list[PtyEmulator]:
    """The boards that are asked for, on their ports; if one cannot be served, none is."""
    from marl_handover.hardware.emulator.pty import PtyEmulator

    emulators: list[PtyEmulator] = []
    try:
        for number, (name, device) in enumerate(_devices(config).items()):
            emulators.append(PtyEmulator(device, f"{config.link}_{name}" if number else config.link))
    except BaseException:
        for emulator in emulators:
            emulator.close()
        raise
    return emulators


def _devices(config: EmulateConfig) -> Mapping[str, SerialDevice]:
    """The boards that are asked for, or all."""
    require_seed(config.hardware.emulator.seed)
    if config.board:
        require_choice("board", config.board, tuple(config.hardware.boards))
    config.hardware.validate()
    devices = _buses(config) if config.hardware.protocol == "feetech" else _boards(config)
    if config.board and config.board not in devices:
        raise InvalidSetting("board", config.board, f"one that an arm is wired to: {', '.join(devices)}")
    return {name: device for name, device in devices.items() if config.board in ("", name)}


def _boards(config: EmulateConfig) -> Mapping[str, SerialDevice]:
    """Boards with their servos where a lab puts the arms before switching on."""
    from marl_handover.cell.build import build_cell, cell_config
    from marl_handover.config import MotionConfig
    from marl_handover.hardware.emulator.device import EmulatedCell, parse_faults
    from marl_handover.motion.home import parked_poses

    faults = parse_faults(config.faults)
    model = build_cell(cell_config("paper"))  # joint limits and parked pose are the robot's, wherever it stands
    cell = EmulatedCell(config.hardware.for_arms(), model.arm, parked_poses(model, MotionConfig())[0])
    for name, device in cell.devices.items():
        if config.board in ("", name):
            device.add_faults(faults)
    return cell.devices


def _buses(config: EmulateConfig) -> Mapping[str, SerialDevice]:
    """Buses of servos, limp, where a lab puts the arms before switching on."""
    from marl_handover.cell.build import build_cell, cell_config
    from marl_handover.config import MotionConfig
    from marl_handover.hardware.emulator.servo_bus import EmulatedServoCell, parse_servo_faults
    from marl_handover.motion.home import parked_poses

    faults = parse_servo_faults(config.faults)
    model = build_cell(cell_config("so101"))
    cell = EmulatedServoCell(config.hardware.for_arms(), model.arm, parked_poses(model, MotionConfig())[0])
    for name, bus in cell.devices.items():
        if config.board in ("", name):
            bus.add_faults(faults)
    return cell.devices
