"""A cell, and timed cycles by hand: straight up and down over both ends, at walking speed, so that no planner is needed."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.config import MotionConfig
from marl_handover.motion.trajectory import Phase
from marl_handover.simulation.world import SimulatedCell
from tests.canonical_arms import PARKED_DEG

ABOVE_MM = 40.0
SAMPLES = 60


@pytest.fixture(scope="session")
def motion():
    return MotionConfig()


@pytest.fixture
def cell(model, motion, engine):
    with SimulatedCell(model, motion, engine=engine) as cell:
        yield cell


@pytest.fixture(scope="session")
def joints_at(model):
    """``joints_at(arm, place, height)``: joints (n, 5) with the hand level, ``place`` (n, 2) in the world."""

    def make(arm, place_mm, height_mm):
        base = model.cell.bases[arm]
        gap = np.atleast_2d(place_mm) - (base.x_mm, base.y_mm)
        cosine, sine = base.facing
        x, y = gap[:, 0] * cosine + gap[:, 1] * sine, gap[:, 1] * cosine - gap[:, 0] * sine
        return model.arm.ik(np.stack([x, y, np.broadcast_to(height_mm, x.shape)], axis=1))[:, 0]

    return make


@pytest.fixture(scope="session")
def cycle(model, motion, joints_at):
    """``cycle(arm, pick, place)``: phases of a whole cycle; ``turn_s`` is the time of its transfer."""
    ease = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, SAMPLES))

    def make(arm, pick_mm, place_mm, turn_s=1.0):
        pick_mm, place_mm = np.asarray(pick_mm, float), np.asarray(place_mm, float)
        low = model.cell.pick_height_mm
        parked, opened = np.radians(PARKED_DEG), motion.finger_travel_mm
        over = [joints_at(arm, place, low + ABOVE_MM)[0] for place in (pick_mm, place_mm)]
        down, up = (
            [joints_at(arm, np.tile(place, (SAMPLES, 1)), low + ABOVE_MM * height) for place in (pick_mm, place_mm)]
            for height in (1 - ease, ease)
        )
        go = [start + np.outer(ease, end - start) for start, end in ((parked, over[0]), over, (over[1], parked))]
        pieces = [
            ("approach", np.concatenate([go[0], down[0][1:]]), 1.4, (opened, opened)),
            ("grasp", np.tile(down[0][-1], (SAMPLES, 1)), motion.grasp_s, (opened, 0.0)),
            ("lift", up[0], 0.6, (0.0, 0.0)),
            ("transfer", go[1], turn_s, (0.0, 0.0)),
            ("lower", down[1], 0.6, (0.0, 0.0)),
            ("release", np.tile(down[1][-1], (SAMPLES, 1)), motion.release_s, (0.0, opened)),
            ("retreat", np.concatenate([up[1], go[2][1:]]), 1.4, (opened, opened)),
        ]
        phases, begin_s = [], 0.0
        for name, joints, seconds, fingers in pieces:
            t_s = begin_s + np.linspace(0, seconds, len(joints))
            phases.append(Phase(name, t_s, joints, np.linspace(*fingers, len(joints))))
            begin_s += seconds
        return tuple(phases)

    return make


@pytest.fixture(scope="session")
def expected(model):
    """Where the closed form says the block is after ``arm`` took it from ``pose`` to ``place``."""

    def make(arm, pose, place_mm):
        yaws = [model.cell.gripper_yaw(model.cell.polar(np.asarray(point, float)[:2])[1])[arm] for point in (pose, place_mm)]
        return np.array([*place_mm, pose[2] + yaws[1] - yaws[0]])

    return make
