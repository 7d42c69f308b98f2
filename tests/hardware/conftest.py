"""Emulated cells in virtual time: boards behind the URL scheme, a driver that reaches them through pyserial."""

from __future__ import annotations

import signal
from types import SimpleNamespace

import numpy as np
import pytest

from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.emulator.device import EmulatedCell, parse_faults
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.settings import ArmWiring, BoardConfig, GripperConfig, HardwareConfig
from marl_handover.motion.planner import MotionPlanner
from tests.canonical_arms import PARKED_DEG

PARKED = np.radians(PARKED_DEG)


@pytest.fixture(autouse=True)
def _no_handler_of_others():
    """Ray, once used in this process, leaves a handler of SIGTERM behind, and a session leaves those alone."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def motion(model):
    """A planned transfer of the left arm from the middle of the table, and back again."""
    planner = MotionPlanner(model)
    return planner.pick_place(0, [0.0, 0.0], [30.0, -10.0], PARKED, PARKED)


def _one_board() -> HardwareConfig:
    return HardwareConfig(name="twin", boards={"main": BoardConfig("ssc32emu://main")})


def _two_boards() -> HardwareConfig:
    return HardwareConfig(
        name="twin",
        boards={"west": BoardConfig("ssc32emu://west"), "east": BoardConfig("ssc32emu://east")},
        arms={
            "left": ArmWiring(board="west"),
            "right": ArmWiring(board="east", channels=[8, 9, 10, 11, 13], gripper=GripperConfig(channel=12)),
        },
    )


@pytest.fixture
def one_board() -> HardwareConfig:
    return _one_board()


@pytest.fixture
def two_boards() -> HardwareConfig:
    return _two_boards()


@pytest.fixture(params=["one board", "two boards"])
def wired(request) -> HardwareConfig:
    return _one_board() if request.param == "one board" else _two_boards()


@pytest.fixture
def rig(model, tmp_path):
    """``rig(config, faults, confirm=..., **driver)``: clock, latch, emulated cell, its first device, driver; the boards run since 1 s."""
    made = []

    def make(config=None, faults="", confirm=lambda text: True, dry_run=False):
        config = config or _one_board()
        clock, latch = VirtualClock(), StopLatch(tmp_path / "stop")
        cell = EmulatedCell(config, model.arm, PARKED)
        cell.mount(clock)
        device = next(iter(cell.devices.values()))
        clock.until(1.0)
        device.advance(1.0)
        device.add_faults(parse_faults(faults))
        driver = ArmDriver(config, model, clock=clock, latch=latch, confirm=confirm, dry_run=dry_run)
        made.append(SimpleNamespace(clock=clock, latch=latch, cell=cell, device=device, driver=driver, config=config))
        return made[-1]

    yield make
    for rig in made:
        rig.driver.close()


@pytest.fixture
def armed(rig):
    """The same, connected, configured and armed."""

    def make(*arguments, **keywords):
        made = rig(*arguments, **keywords)
        made.driver.connect()
        made.driver.configure()
        made.driver.arm()
        return made

    return make
