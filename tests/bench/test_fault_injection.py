"""Mishaps happen when they are told to, where nobody is in the way, and are over when an episode is."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))

from fault_injection import SIGNS, FaultInjector

from marl_handover.cell import build_cell, cell_config
from marl_handover.compose import from_yaml
from marl_handover.config import MotionConfig
from marl_handover.control.events import Event
from marl_handover.control.session import GivenGoal
from marl_handover.control.settings import WorkcellConfig, twin_workcell
from marl_handover.control.twin import Twin
from marl_handover.errors import UnknownChoice
from marl_handover.files import resource_path
from marl_handover.hardware.settings import ARMS, HardwareConfig
from tests.canonical_arms import PARKED_DEG

PHASES = [["approach", 0.0, 1.0], ["grasp", 1.0, 1.4], ["transfer", 1.4, 3.0], ["park", 3.0, 4.0]]


@pytest.fixture(scope="module")
def model():
    return build_cell(cell_config("paper"))


@pytest.fixture
def twin(model):
    twin = Twin(model, MotionConfig(), twin_workcell())
    twin.set_object_pose([60.0, 0.0, 0.0])
    twin.clock.sleep_s(0.5)
    yield twin
    twin.close()


@pytest.fixture
def goal():
    return GivenGoal([0.0, 0.0, 0.0])


@pytest.fixture
def mishaps(twin, model):
    return FaultInjector(twin, SimpleNamespace(cell=model.cell), seed=1)


def motion(mishaps):
    mishaps.note({"event": "motion", "phases": PHASES})


def test_every_kind_has_its_signs(mishaps, goal):
    assert set(mishaps.kinds) == set(SIGNS)
    for arrange in (mishaps.arrange, mishaps.arrange_in):
        with pytest.raises(UnknownChoice, match="earthquake"):
            arrange("earthquake", *([0.0] if arrange == mishaps.arrange else [0, 0.5]), goal)


@pytest.mark.parametrize(("kind", "share", "at_s"), [("goal_change", 0.5, 2.0), ("missed_grasp", 0.5, 0.5), ("camera_freeze", 0.0, 3.0)])
def test_it_happens_in_the_motion_that_was_named(mishaps, twin, goal, kind, share, at_s):
    mishap = mishaps.arrange_in(kind, 1, share, goal)
    motion(mishaps)
    twin.clock.sleep_s(3.5)
    assert not mishap.happened, "the first one is not it"
    begun_s = twin.clock.now_s()
    motion(mishaps)
    twin.clock.sleep_s(3.5)
    assert mishap.at_s - begun_s == pytest.approx(at_s, abs=0.1)
    assert not mishap.felt
    mishaps.note({"event": str(SIGNS[kind][0])})
    assert mishap.felt


def test_a_sign_that_came_before_is_not_its(mishaps, twin, goal):
    mishap = mishaps.arrange("goal_change", 1.0, goal)
    mishaps.note({"event": str(Event.GOAL_CHANGED)})
    twin.clock.sleep_s(2.0)
    assert mishap.happened
    assert not mishap.felt


def test_what_is_late_never_happens_and_what_lasts_is_waited_for(mishaps, twin, goal):
    late, unplanned = mishaps.arrange("nudge", 2.0, goal), mishaps.arrange_in("brown_out", 3, 0.5, goal)
    frozen = mishaps.arrange("camera_freeze", 0.1, goal)
    twin.clock.sleep_s(0.2)
    before, pose = twin.clock.now_s(), twin.true_pose()
    mishaps.finish()
    assert twin.clock.now_s() - before == pytest.approx(0.9, abs=0.1)
    assert twin.clock.now_s() >= twin.frozen_until_s
    for _ in range(5):
        motion(mishaps)
    twin.clock.sleep_s(3.0)
    assert frozen.happened
    assert not late.happened
    assert not unplanned.happened
    np.testing.assert_allclose(twin.true_pose(), pose, atol=0.01)


def test_no_block_is_pushed_from_under_a_hand_or_into_one(mishaps, twin, goal, model):
    base = model.cell.bases[1]
    q = model.arm.ik(np.array([math.dist((60.0, 0.0), (base.x_mm, base.y_mm)), 0.0, 55.0]))[0]
    q[0] = math.atan2(-base.y_mm, 60.0 - base.x_mm) - base.facing_rad
    twin.set_object_pose([60.0 + 45.0, 0.0, 0.0])
    twin.electronics.put(1, q, twin.clock.now_s())
    twin.clock.sleep_s(0.5)
    mishap = mishaps.arrange("nudge", 0.0, goal)
    twin.clock.sleep_s(0.5)
    assert not mishap.happened, "a hand beside it"
    twin.electronics.put(1, np.radians(PARKED_DEG), twin.clock.now_s())
    twin.clock.sleep_s(0.5)
    assert mishap.happened
    assert math.dist(twin.true_pose()[:2], (105.0, 0.0)) < 20.5


def test_a_jam_holds_both_grippers(mishaps, twin, goal):
    mishap = mishaps.arrange("missed_grasp", 0.0, goal)
    twin.clock.sleep_s(0.1)
    assert mishap.happened
    assert all(twin.electronics.servos(arm)[-1].jammed for arm in range(len(ARMS)))
    mishaps.finish()
    assert not any(twin.electronics.servos(arm)[-1].jammed for arm in range(len(ARMS)))


def test_of_two_boards_one_fails_and_every_hand_is_jammed(goal):
    """A cable comes out, or a supply sags, at one board, now at this one and now at that; hands jam by their own board's channel."""
    built = build_cell(cell_config("triangle"))
    twin = Twin(built, MotionConfig(), WorkcellConfig(from_yaml(HardwareConfig, resource_path("configs/hardware/triangle_twin.yaml"))))
    mishaps, hit = FaultInjector(twin, SimpleNamespace(cell=built.cell), seed=1), []
    for _ in range(8):
        mishaps.arrange("serial_loss", 0.1, goal)
        twin.clock.sleep_s(0.2)
        now_s = twin.clock.now_s()
        for device in twin.electronics.devices.values():
            device.advance(now_s)
        out = [name for name, device in twin.electronics.devices.items() if not device.plugged]
        assert len(out) == 1
        hit += out
        mishaps.finish()
    assert set(hit) == {"main", "second"}
    mishaps.arrange("missed_grasp", 0.1, goal)
    twin.clock.sleep_s(0.2)
    twin.electronics.gripper_mm(twin.clock.now_s())
    jammed = {
        (name, number) for name, device in twin.electronics.devices.items() for number, servo in device.servos.items() if servo.jammed
    }
    assert jammed == {("main", 4), ("main", 20), ("second", 4)}
    twin.close()
