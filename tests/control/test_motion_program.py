"""From wherever an arm stops there is a way to the pin, on with the block, and home."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover.control.interactive.motion_program import FreePaths, stopped
from marl_handover.motion.trajectory import NoPath, OutOfArmsReach

shares = st.floats(0.02, 0.98)
places = st.tuples(st.floats(151.0, 229.0), st.floats(-85.0, 85.0))


@pytest.fixture(scope="module")
def paths(planner):
    return FreePaths(planner)


def on_table(paths, arm, place):
    """World position (2,) of (radius_mm, yaw_deg) from an arm."""
    return paths.planner.model.cell.bases[arm].around(place[0], math.radians(place[1]))


def stop_of(paths, track, share):
    return stopped(track, share * track.duration_s, paths.limits[0][1]).end_rad


def check(paths, arm, track, start, pin_mm=None):
    """It begins and ends at rest where it should, keeps the limits, and its grip is never below the pin's height."""
    model = paths.planner.model
    assert np.allclose(track.joints_rad[0], start, atol=1e-9)
    assert not track.velocities_rad_s[[0, -1]].any()
    assert (abs(track.velocities_rad_s) <= paths.limits[0][0] * 1.001).all()
    grip = model.arm.fk(track.joints_rad)[:, :3, 3]
    assert grip[:, 2].min() >= model.cell.pick_height_mm - 0.05
    if pin_mm is None:
        assert paths.parked(arm, track.end_rad)
    else:
        assert np.allclose(grip[-1, :2], model.cell.bases[arm].to_local(pin_mm), atol=0.02)


@given(places, places, places, shares, st.integers(0, 1))
@settings(max_examples=15)
def test_an_empty_hand_that_stopped_finds_its_way(paths, old, new, other, share, arm):
    """To another pin, and home, past the block wherever it is, unless it is where the hand is."""
    pins = [on_table(paths, arm, place) for place in (old, new)]
    approach = paths.to_pin(arm, paths.homes_rad[0], pins[0])
    check(paths, arm, approach, paths.homes_rad[0], pins[0])
    here = stop_of(paths, approach, share)
    if paths.clear_of_block(arm, here[None], pins[1]):
        onward = paths.to_pin(arm, here, pins[1])
        check(paths, arm, onward, here, pins[1])
        assert paths.allows(arm, onward.joints_rad, pins[1])
    block = on_table(paths, 1 - arm, other)
    if paths.clear_of_block(arm, here[None], block):
        home = paths.home(arm, here, block)
        check(paths, arm, home, here)
        assert paths.allows(arm, home.joints_rad, block)


@given(places, places, places, shares, st.integers(0, 1))
@settings(max_examples=25)
def test_a_block_in_mid_air_can_go_elsewhere(paths, pick, old, new, share, arm):
    pick_mm, old_mm, new_mm = (on_table(paths, arm, place) for place in (pick, old, new))
    here = stop_of(paths, paths.carry(arm, pick_mm, old_mm), share)
    onward = paths.carry_on(arm, here, new_mm)
    check(paths, arm, onward, here, new_mm)
    assert paths.allows(arm, onward.joints_rad[1:-1], None)


def test_who_is_there_stays_there(paths):
    pick, place = on_table(paths, 0, (190.0, -20.0)), on_table(paths, 0, (190.0, 20.0))
    there = paths.carry(0, pick, place).end_rad
    for start, track in ((paths.homes_rad[0], paths.home(0, paths.homes_rad[0], pick)), (there, paths.carry_on(0, there, place))):
        assert np.array_equal(track.end_rad, start)
        assert track.duration_s < 0.01


def test_where_there_is_no_way_that_is_said_by_name(paths):
    pick, place = on_table(paths, 0, (190.0, -20.0)), on_table(paths, 0, (190.0, 20.0))
    with pytest.raises(OutOfArmsReach):
        paths.to_pin(0, paths.homes_rad[0], on_table(paths, 0, (260.0, 0.0)))
    grasp = paths.to_pin(0, paths.homes_rad[0], pick).end_rad
    with pytest.raises(OutOfArmsReach):
        paths.carry_on(0, grasp, on_table(paths, 1, (150.0, 0.0)) * 3)
    with pytest.raises(NoPath, match="start"):
        paths.to_pin(0, grasp + (0.0, 0.0, -0.2, 0.0, 0.0), place)


def test_a_hand_is_not_clear_of_a_block_that_it_stands_in(paths):
    pin = on_table(paths, 0, (190.0, 10.0))
    grasp = paths.to_pin(0, paths.homes_rad[0], pin).end_rad[None]
    assert paths.clear_of_block(0, grasp, pin)
    around = [pin + 20 * np.array([math.cos(angle), math.sin(angle)]) for angle in np.linspace(0, 6, 24)]
    assert not all(paths.clear_of_block(0, grasp, block) for block in around)
    assert paths.clear_of_block(0, grasp, on_table(paths, 0, (190.0, 60.0)))
