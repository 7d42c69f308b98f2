"""Wiring that can be, and wiring that cannot; the shipped files."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace

import numpy as np
import pytest
import yaml

from marl_handover.bounds import bounds_of
from marl_handover.commands import emulate
from marl_handover.compose import compose, from_text, to_yaml
from marl_handover.config import BlockConfig
from marl_handover.errors import HandoverError, InvalidSetting, UnknownChoice
from marl_handover.files import resource_path
from marl_handover.geometry.urdf import Gripper
from marl_handover.hardware.board_group import Wiring
from marl_handover.hardware.calibration import nominal_calibration
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.errors import PortNotFound
from marl_handover.hardware.gripper import GripperMap
from marl_handover.hardware.safety_filter import JointCommand
from marl_handover.hardware.settings import ARMS, HardwareConfig
from marl_handover.hardware.transport import choose_port, list_serial_ports

FILES = sorted(resource_path("configs/hardware").glob("*.yaml"))


@dataclass
class Command:
    hardware: HardwareConfig = field(default_factory=HardwareConfig)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_shipped_files_load_and_validate(file):
    config = compose(Command, [f"hardware={file.stem}"]).hardware
    config.validate()
    assert config.name == file.stem
    tree = yaml.safe_load(file.read_text())
    assert config.first_move == tree.get("first_move", HardwareConfig().first_move)
    assert from_text(Command, to_yaml(Command(config)), file).hardware == config


def test_a_second_board_is_two_settings():
    changes = ["hardware.boards.second.port=/dev/ttyX", "hardware.arms.right.board=second", "hardware.arms.right.channels=[0,1,2,3,5]"]
    config = compose(Command, [*changes, "hardware.arms.right.gripper.channel=4"]).hardware
    config.validate()
    assert config.used_boards() == ("main", "second")
    assert HardwareConfig().used_boards() == ("main",)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ("hardware.arms.right.board=other", "hardware.arms.right.board"),
        ("hardware.arms.right.channels=[0,1,2,3,5]", "channels of board main"),
        ("hardware.arms.left.channels=[0,1,2,3]", "hardware.arms.left.channels"),
        ("hardware.arms.left.channels=[0,1,2,3,32]", "hardware.arms.left.channels[4]"),
        (
            "hardware.arms.left.pulse_limits_us=[[500,2600],[500,2500],[500,2500],[500,2500],[500,2500]]",
            "hardware.arms.left.pulse_limits_us[0][1]",
        ),
        ("hardware.arms.left.gripper.open_us=3000", "hardware.arms.left.gripper.open_us"),
        ("hardware.boards.main.baud=57600", "hardware.boards.main.baud"),
        ("hardware.stream.period_s=nan", "hardware.stream.period_s"),
        ("hardware.gate.step_deg=0", "hardware.gate.step_deg"),
        ("hardware.gate.table_clearance_mm=-1", "hardware.gate.table_clearance_mm"),
        ("hardware.timeouts.reply_s=0", "hardware.timeouts.reply_s"),
        ("hardware.emulator.firmware=LSS", "hardware.emulator.firmware"),
        ("hardware.gate.finger_mm_s=1e300", "hardware.gate.finger_mm_s"),
        ("hardware.gate.stale_s=1e9", "hardware.gate.stale_s"),
        ("hardware.stream.settle_s=1e12", "hardware.stream.settle_s"),
        ("hardware.stream.late_s=inf", "hardware.stream.late_s"),
        ("hardware.timeouts.reply_s=1e6", "hardware.timeouts.reply_s"),
        ("hardware.timeouts.retries=1000000", "hardware.timeouts.retries"),
        ("hardware.nominal.elbow.us_per_deg=nan", "hardware.nominal.elbow.us_per_deg"),
        ("hardware.log_entries=1000000000000", "hardware.log_entries"),
        ("hardware.emulator.speed_deg_s=[1.0]", "hardware.emulator.speed_deg_s"),
    ],
)
def test_wiring_that_cannot_be_is_named(change, name):
    with pytest.raises(InvalidSetting) as caught:
        compose(Command, [change]).hardware.validate()
    assert caught.value.name == name


def numbers(settings, prefix=""):
    """Every field of a settings class that is a number, or a list of them, with its key."""
    for item in fields(settings):
        value = getattr(settings, item.name)
        if is_dataclass(value):
            yield from numbers(value, f"{prefix}{item.name}.")
        elif isinstance(value, dict):
            for key, each in value.items():
                yield from numbers(each, f"{prefix}{item.name}.{key}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{prefix}{item.name}", item


@pytest.mark.parametrize(("key", "item"), list(numbers(HardwareConfig())), ids=lambda given: given if isinstance(given, str) else "")
def test_every_number_has_an_upper_bound(key, item):
    if key.endswith(".baud"):
        return  # one of a list
    assert bounds_of(item).numeric
    with pytest.raises(InvalidSetting) as caught:
        compose(Command, [f"hardware.{key}=100000000000"]).hardware.validate()
    assert caught.value.name == f"hardware.{key}"


@pytest.mark.parametrize("change", ["hardware.first_move=jump", "hardware.on_disconnect=explode"])
def test_policies_are_chosen_from_a_list(change):
    with pytest.raises(UnknownChoice):
        compose(Command, [change]).hardware.validate()


def test_fingers_are_sent_into_the_pin_and_no_further():
    config = HardwareConfig()
    gripper, pulses = config.arms["left"].gripper, GripperMap(config, "left", Gripper())
    assert pulses.closing_pulse(14.0, 2.5) == gripper.open_us
    assert pulses.closing_pulse(20.0, 2.5) == gripper.open_us
    assert pulses.mm(pulses.closing_pulse(0.0, 2.5)) == pytest.approx(2.5 / 2 - gripper.preload_mm, abs=0.02)
    gripper.preload_mm = 3.0
    assert pulses.closing_pulse(0.0, 2.5) == gripper.closed_us


@pytest.mark.parametrize(("preload_mm", "pin_mm"), [(1.25, 2.5), (3.0, 2.5), (0.6, 1.2), (0.25, 0.5)])
def test_fingers_never_close_to_their_end(preload_mm, pin_mm):
    """They would press on nothing but each other, with all that the servo has: its gears strip."""
    config = HardwareConfig()
    config.arms["right"].gripper.preload_mm = preload_mm
    with pytest.raises(InvalidSetting, match=r"hardware.arms.(left|right).gripper.preload_mm .*pin_diameter_mm"):
        config.require_grip(pin_mm)
    HardwareConfig().require_grip(2.5)


def test_a_cell_whose_pin_is_too_thin_for_the_preload_is_not_connected(rig, model, one_board):
    thin = replace(model.cell.config, block=BlockConfig(pin_diameter_mm=1.0))
    with pytest.raises(InvalidSetting, match="preload_mm"):
        ArmDriver(one_board, model._replace(cell=replace(model.cell, config=thin)))


def test_a_gate_that_is_off_is_said_at_every_start_and_before_the_first_move(rig, one_board, caplog):
    one_board.gate.enabled = False
    for _ in range(2):
        caplog.clear()
        asked = []
        made = rig(one_board, confirm=lambda text, asked=asked: asked.append(text) or True)
        with made.driver as driver:
            driver.arm()
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        assert "THE SAFETY FILTER IS OFF (hardware.gate.enabled=false)" in caplog.text
        assert "THE SAFETY FILTER IS OFF" in asked[0]


def test_a_gate_that_is_on_is_not_spoken_of(armed, caplog):
    armed()
    assert caplog.records == []


def test_wiring_translates_there_and_back(model):
    config = HardwareConfig()
    joints = np.array([joint.velocity for joint in model.arm.description.joints[:5]])
    calibrations = [nominal_calibration(config, arm, model.arm) for arm in ARMS]
    wiring = Wiring(config, calibrations, model.arm.description.gripper, 2.5, joints)
    q = [0.3, 2.0, -2.1, 0.4, -0.2]
    found = wiring.pulses([JointCommand(1, q, 9.0)])
    assert set(found["main"]) == {16, 17, 18, 19, 20, 21}
    joints_rad, fingers = wiring.state(found, 1)
    assert joints_rad == pytest.approx(q, abs=0.001)
    assert fingers == pytest.approx(9.0, abs=0.02)
    assert wiring.boards([1, 0, 1]) == ("main",)
    with pytest.raises(HandoverError):
        wiring.pulses([JointCommand(0, [float("nan")] * 5, 9.0)])


def test_ports_are_listed_and_a_named_one_is_taken_as_it_is():
    assert choose_port("/dev/ttyUSB7") == "/dev/ttyUSB7"
    likely = [port for port in list_serial_ports() if port.likely]
    if len(likely) != 1:
        with pytest.raises(PortNotFound, match="hardware.boards"):
            choose_port("")


@pytest.mark.parametrize(
    "change", ["faults=earthquake@1", "faults=unplug@x", "board=third", "firmware=LSS", "seed=-1", "hardware.boards.main.baud=1"]
)
def test_emulate_refuses_what_cannot_be(change, tmp_path):
    with pytest.raises(HandoverError):
        emulate.run(compose(emulate.SCHEMA, [change, f"link={tmp_path / 'x'}"], aliases=emulate.ALIASES))
    assert not (tmp_path / "x").is_symlink()


def test_virtual_time_calls_what_is_due_in_order():
    clock, called = VirtualClock(), []
    for t_s in (0.3, 0.1, 0.2, 0.9):
        clock.at(t_s, lambda t_s=t_s: called.append((t_s, clock.now_s())))
    clock.sleep_s(-1.0)
    clock.sleep_s(0.5)
    assert called == [(0.1, 0.1), (0.2, 0.2), (0.3, 0.3)]
    assert clock.now_s() == 0.5
