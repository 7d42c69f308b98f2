"""Hands are calibrated by carrying the block, on the twin; and the file of what that found."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.config import MotionConfig
from marl_handover.control.calibration import RANGE_MM, GripperCalibration, places
from marl_handover.control.hardware_backend import HardwareBackend
from marl_handover.control.settings import WatchConfig, twin_workcell
from marl_handover.errors import CorruptFile, InvalidSetting
from marl_handover.geometry.urdf import Gripper
from marl_handover.hardware.calibration import CalibrationProblem
from marl_handover.hardware.gripper import GRIPPERS_FILE, GripperMap, save_grippers, with_grippers
from marl_handover.hardware.settings import ARMS, ArmWiring, GripperConfig, HardwareConfig

PIN_MM = 2.5


def pulses_of(gripper):
    """What a board's servo is told, and back."""
    return GripperMap(HardwareConfig(arms={"left": ArmWiring(gripper=gripper)}), "left", Gripper())


def pulse(gripper, opening_mm, pin_mm=PIN_MM):
    """What a board's servo is told for fingers so far from closed."""
    return pulses_of(gripper).closing_pulse(opening_mm, pin_mm)


def shifted(gripper, further_mm):
    return pulses_of(gripper).shifted(further_mm)


@pytest.fixture
def hands(twin_calibration, tmp_path, model, planner):
    """``hands(off_us)``: the procedure on a twin whose gripper servos have their zeros that far from what the settings say."""
    opened = []

    def make(off_us):
        config = twin_workcell()
        config.calibration, config.watch, config.hardware.stop_file = (
            str(twin_calibration),
            WatchConfig(timeout_s=4.0),
            str(tmp_path / "s"),
        )
        backend = HardwareBackend(model, MotionConfig(), config=config, grippers=False)
        opened.append(backend)
        twin = backend.workcell.twin
        for servo in (twin.electronics.servos(arm)[-1] for arm in range(len(ARMS))):
            at_mm = servo.position
            servo.truth = replace(servo.truth, zero_us=GripperConfig().closed_us + off_us)
            servo.put(at_mm)
        first = places(model.cell)[0]
        twin.stand_block(first)
        backend.reset(np.array(first), 0)
        return GripperCalibration(backend, planner, twin)

    yield make
    for backend in opened:
        backend.close()


def test_the_hand_is_found_that_holds_and_does_not_press_harder_than_it_must(hands):
    """60 us are a whole millimetre for each finger: as they were set, they would not touch the pin."""
    procedure = hands(60.0)
    twin, told = procedure.backend.workcell.twin, []
    procedure.progress = lambda arm, further_mm, held: told.append((further_mm, held))
    grip = procedure.arm(1)
    truth = twin.electronics.servos(1)[-1].truth
    closed_mm = (pulse(grip.gripper, 0.0) - truth.zero_us) / truth.slope_us
    assert 0.3 < PIN_MM / 2 - closed_mm < 1.3, "mm into the pin, for each finger"
    assert [held for _, held in told] == [False] * (grip.tries - 1) + [True]
    assert np.all(np.diff([further for further, _ in told]) > 0), "never closed further than it needed"
    assert procedure.backend.workcell.driver.config.arms["right"].gripper == grip.gripper, "goes on with it"
    assert procedure.backend.workcell.config.hardware.arms["right"].gripper == GripperConfig(channel=20), "settings are the user's"


def test_both_arms_reach_the_places_in_every_cell(cell):
    first, second = places(cell)
    assert cell.reaches(np.array([first[:2], second[:2]])).all()
    assert math.dist(first[:2], second[:2]) / 2 > 2 * MotionConfig().lift_scale_mm, "lifted wholly from wherever a block was dragged to"


def test_settings_that_are_far_off_are_told_and_not_worked_around(hands):
    with pytest.raises(CalibrationProblem, match="left gripper: it holds the pin 1.6 mm too early .*open_us=1000, closed_us=1900"):
        hands(-160.0).arm(0)


@pytest.mark.slow
def test_a_hand_that_never_holds_is_told(hands):
    with pytest.raises(CalibrationProblem, match=f"does not hold the pin, {RANGE_MM:g} mm further"):
        hands(200.0).arm(0)


@pytest.mark.parametrize(("open_us", "closed_us"), [(1000, 1900), (1900, 1000)])
@given(further_mm=st.floats(-1.6, 1.6), at_mm=st.floats(3.0, 12.0))
def test_a_shift_moves_every_pulse_alike_and_back(open_us, closed_us, further_mm, at_mm):
    gripper = GripperConfig(open_us=open_us, closed_us=closed_us)
    moved = shifted(gripper, further_mm)
    assert moved.closed_us - moved.open_us == closed_us - open_us
    assert shifted(moved, -further_mm) == gripper
    # The old pulse for "further closed" is the new one for the same opening.
    assert abs(pulse(moved, at_mm) - pulse(gripper, at_mm - further_mm)) <= 1


def test_no_shift_goes_beyond_what_a_servo_takes():
    with pytest.raises(InvalidSetting, match="gripper.closed_us"):
        shifted(GripperConfig(open_us=1500, closed_us=2490), 1.0)


def grippers(hardware):
    return {arm: hardware.arms[arm].gripper for arm in ARMS}


@pytest.fixture
def saved(tmp_path):
    hardware = twin_workcell().hardware
    asked = grippers(hardware)
    found = {arm: shifted(gripper, further) for (arm, gripper), further in zip(asked.items(), (0.5, -0.7), strict=True)}
    save_grippers(tmp_path, asked, found)
    return hardware, found, tmp_path


def test_what_was_found_comes_back_and_leaves_the_settings_alone(saved):
    hardware, found, folder = saved
    before = grippers(twin_workcell().hardware)
    assert grippers(with_grippers(hardware, folder)) == found
    assert grippers(hardware) == before
    assert with_grippers(hardware, folder / "elsewhere") is hardware, "nobody has calibrated them"


def test_settings_changed_since_are_told(saved):
    hardware, _, folder = saved
    hardware.arms["right"].gripper.open_mm = 13.0
    with pytest.raises(CalibrationProblem, match="right gripper.*what=grippers"):
        with_grippers(hardware, folder)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda content: content.update(version=2),
        lambda content: content.pop("arms"),
        lambda content: content["arms"]["left"]["found"].update(open_us="wide"),
        lambda content: content["arms"]["left"]["found"].update(open_us=20),
        lambda content: content["arms"].pop("right"),
    ],
)
def test_a_broken_file_is_refused(saved, spoil):
    hardware, _, folder = saved
    content = json.loads((folder / GRIPPERS_FILE).read_text())
    spoil(content)
    (folder / GRIPPERS_FILE).write_text(json.dumps(content))
    with pytest.raises(CorruptFile, match="gripper calibration"):
        with_grippers(hardware, folder)
