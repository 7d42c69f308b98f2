"""Wiring that can be, and wiring that cannot; the shipped files."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
import yaml

from marl_handover.commands import emulate
from marl_handover.compose import compose, from_text, to_yaml
from marl_handover.errors import HandoverError, InvalidSetting, UnknownChoice
from marl_handover.hardware.calibration import nominal_calibration
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.errors import PortNotFound
from marl_handover.hardware.gate import JointCommand
from marl_handover.hardware.ports import choose_port, list_serial_ports
from marl_handover.hardware.settings import ARMS, GripperConfig, HardwareConfig
from marl_handover.hardware.wiring import Wiring, finger_mm, gripper_pulse_us
from marl_handover.resources import resource_path

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
        ("hardware.arms.left.channels=[0,1,2,3,32]", "hardware.arms.left.channels"),
        (
            "hardware.arms.left.pulse_limits_us=[[500,2600],[500,2500],[500,2500],[500,2500],[500,2500]]",
            "hardware.arms.left.pulse_limits_us",
        ),
        ("hardware.arms.left.gripper.open_us=3000", "hardware.arms.left.gripper.open_us"),
        ("hardware.boards.main.baud=57600", "hardware.boards.main.baud"),
        ("hardware.stream.period_s=nan", "hardware.stream.period_s"),
        ("hardware.gate.step_deg=0", "hardware.gate.step_deg"),
        ("hardware.gate.table_clearance_mm=-1", "hardware.gate.table_clearance_mm"),
        ("hardware.timeouts.reply_s=0", "hardware.timeouts.reply_s"),
        ("hardware.emulator.firmware=LSS", "hardware.emulator.firmware"),
        ("hardware.emulator.speed_deg_s=[1.0]", "hardware.emulator.speed_deg_s"),
    ],
)
def test_wiring_that_cannot_be_is_named(change, name):
    with pytest.raises(InvalidSetting) as caught:
        compose(Command, [change]).hardware.validate()
    assert caught.value.name == name


@pytest.mark.parametrize("change", ["hardware.first_move=jump", "hardware.on_disconnect=explode"])
def test_policies_are_chosen_from_a_list(change):
    with pytest.raises(UnknownChoice):
        compose(Command, [change]).hardware.validate()


def test_fingers_are_sent_into_the_pin_and_no_further():
    gripper = GripperConfig()
    assert gripper_pulse_us(gripper, 14.0, 2.5) == gripper.open_us
    assert gripper_pulse_us(gripper, 20.0, 2.5) == gripper.open_us
    closed = gripper_pulse_us(gripper, 0.0, 2.5)
    assert finger_mm(gripper, closed) == pytest.approx(2.5 / 2 - gripper.preload_mm, abs=0.02)
    assert gripper_pulse_us(GripperConfig(preload_mm=3.0), 0.0, 2.5) == gripper.closed_us


def test_wiring_translates_there_and_back(model):
    config = HardwareConfig()
    joints = np.array([joint.velocity for joint in model.arm.description.joints[:5]])
    calibrations = [nominal_calibration(config, arm, model.arm) for arm in ARMS]
    wiring = Wiring(config, calibrations, 2.5, joints)
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
