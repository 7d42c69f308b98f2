"""``marl-handover emulate``: a servo controller on a pseudo-terminal, for trying out whatever talks to one."""

from __future__ import annotations

import signal
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from marl_handover.config import path_field, require_choice, require_seed
from marl_handover.errors import InvalidSetting, WorkFailed
from marl_handover.hardware.settings import HardwareConfig

if TYPE_CHECKING:
    from marl_handover.hardware.emulator.device import EmulatedDevice


@dataclass
class EmulateConfig:
    """Keys of ``emulate``."""

    link: str = path_field("runs/ssc32")  # symlink to the port; give it as hardware.boards.main.port to a run
    faults: str = ""  # kind@start_s[:duration_s][=amount],...: unplug brownout silent drop corrupt late stuck ignore random frozen jam
    board: str = "main"  # which of the boards in hardware.boards
    lines: bool = False  # print every line that comes in
    hardware: HardwareConfig = field(default_factory=HardwareConfig)


SCHEMA: type = EmulateConfig
ALIASES = {"firmware": "hardware.emulator.firmware", "seed": "hardware.emulator.seed"}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: EmulateConfig) -> int:
    """Serve until Ctrl-C or SIGTERM, which is how it is meant to end: 0 then."""
    try:
        from marl_handover.hardware.emulator.pty import PtyEmulator
    except ImportError as error:
        raise WorkFailed(f"emulate needs pseudo-terminals, which this system does not have ({error})") from error

    emulator = PtyEmulator(_device(config), config.link)
    stopped: list[int] = []
    before = {number: signal.signal(number, lambda number, _: stopped.append(number)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        print(f"{emulator.device.board.firmware.text} at {config.link}, {emulator.device.baud} baud; Ctrl-C ends it", flush=True)
        while not stopped:
            emulator.turn()
            while config.lines and emulator.device.lines:
                t_s, line = emulator.device.lines.popleft()
                print(f"{t_s:10.4f} s  {line.decode('ascii', 'backslashreplace').rstrip()}", flush=True)
    finally:
        emulator.close()
        for number, handler in before.items():
            signal.signal(number, handler)
    return 0


def _device(config: EmulateConfig) -> EmulatedDevice:
    """The board that is asked for, with its servos where a lab puts the arms before switching on."""
    from marl_handover.cell.build import build_cell, cell_config
    from marl_handover.config import MotionConfig
    from marl_handover.hardware.emulator.device import EmulatedCell, parse_faults
    from marl_handover.motion.home import parked_poses

    require_seed(config.hardware.emulator.seed)
    require_choice("board", config.board, tuple(config.hardware.boards))
    faults = parse_faults(config.faults)
    model = build_cell(cell_config("paper"))
    cell = EmulatedCell(config.hardware, model.arm, parked_poses(model, MotionConfig())[0])
    if config.board not in cell.devices:
        raise InvalidSetting("board", config.board, f"one that an arm is wired to: {', '.join(cell.devices)}")
    cell.devices[config.board].add_faults(faults)
    return cell.devices[config.board]
