"""The compiled geometry against the cell's own kinematics, brute force and finite differences."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.geometry.capsules import block_capsules, segment_distance
from marl_handover.geometry.kernels import (
    at_wrist,
    broad_phase,
    closest_points,
    elbow_up,
    forward_kinematics,
    into_arm_plane,
    jacobian_transpose,
    place_capsules,
)
from marl_handover.motion.collision_model import CollisionModel, out_of_reach


def postures(model, count, seed):
    """Random joints (count, 4) within the limits."""
    arm = model.arm
    return np.random.default_rng(seed).uniform(arm.lower_rad[:4], arm.upper_rad[:4], (count, 4))


def placed(body: CollisionModel, q):
    """Frames and placed capsules of one posture."""
    frames, ends = np.empty((1, 5, 4)), np.empty((len(body.held), 10))
    forward_kinematics(body.planar, q[None], 0, frames, 0)
    place_capsules(body.held, q[0], frames, 0, ends)
    return frames, ends


def in_base(points, yaw):
    """Planar points (..., 3) in the base frame."""
    c, s = np.cos(yaw), np.sin(yaw)
    r, t, z = np.moveaxis(points, -1, 0)
    return np.stack([c * r - s * t, s * r + c * t, z], -1)


def test_the_grip_is_where_forward_kinematics_puts_it(model, planner):
    for q in postures(model, 50, 0):
        frames, _ = placed(planner.collision_model, q)
        r, z = at_wrist(frames, 0, *planner.collision_model.planar[6:8])
        expected = model.arm.fk(np.append(q, 0.0))[:3, 3]
        np.testing.assert_allclose(in_base(np.array([r, 0.0, z]), q[0]), expected, atol=1e-9)


def test_capsules_enclose_every_shape_of_the_arm(model, planner):
    generator = np.random.default_rng(2)
    for q in postures(model, 10, 1):
        _, ends = placed(planner.collision_model, q)
        starts, stops = in_base(ends[:, :3], q[0]), in_base(ends[:, 3:6], q[0])
        frames = model.arm.link_transforms(np.append(q, 0.0), planner.motion.finger_travel_mm)
        for link in model.arm.description.links:
            for shape in link.collisions:
                if shape.kind != "box":
                    continue
                local = generator.uniform(-0.5, 0.5, (30, 3)) * shape.size_mm + shape.xyz_mm
                world = local @ frames[link.name][:3, :3].T + frames[link.name][:3, 3]
                gap = segment_distance(starts[:, None], stops[:, None], world[None], world[None]) - planner.collision_model.held[:, None, 7]
                assert (gap.min(axis=0) <= 1e-6).all(), link.name


@given(st.floats(0, 2 * np.pi), st.integers(0, 10_000))
def test_the_blocks_capsules_hold_for_every_orientation(angle, seed):
    from marl_handover.config import BlockConfig

    block = BlockConfig()
    capsules = block_capsules(block, 45.0)
    p = np.random.default_rng(seed).uniform(-0.5, 0.5, (20, 3)) * [block.side_mm, block.side_mm, block.height_mm]
    p[:, 2] += block.height_mm / 2 - 45.0
    c, s = np.cos(angle), np.sin(angle)
    p[:, :2] = p[:, :2] @ np.array([[c, s], [-s, c]])
    starts, stops = (np.array([getattr(k, name) for k in capsules])[:, None] for name in ("start_mm", "end_mm"))
    radii = np.array([k.radius_mm for k in capsules])[:, None]
    assert ((segment_distance(starts, stops, p[None], p[None]) - radii).min(axis=0) <= 1e-9).all()


@given(st.integers(0, 100_000))
def test_distances_agree_with_the_batched_ones(seed):
    generator = np.random.default_rng(seed)
    rows = np.zeros((2, 10))
    rows[:, :6] = generator.integers(-4, 5, (2, 6)) * generator.choice([1.0, 0.37, 20.0])  # parallel, crossing and pointlike ones too
    rows[:, 6:9] = (rows[:, :3] + rows[:, 3:6]) / 2
    rows[:, 9] = np.linalg.norm(rows[:, 3:6] - rows[:, :3], axis=1) / 2
    out = np.empty(6)
    distance = closest_points(rows, 0, rows, 1, out)
    expected = segment_distance(rows[0, :3], rows[0, 3:6], rows[1, :3], rows[1, 3:6])
    assert distance == pytest.approx(float(expected), abs=1e-9)
    assert np.linalg.norm(out[3:]) == pytest.approx(1.0)
    for limit in (0.5 * distance, 0.999 * distance - 1e-9):
        assert not (broad_phase(rows, 0, rows, 1, distance + 1e-9) and limit < distance), "what is near must not be skipped"


def test_the_push_of_a_point_is_its_jacobian(model, planner):
    body, h = planner.collision_model, 1e-6
    for q in postures(model, 20, 3):
        frames, ends = placed(body, q)
        generator = np.random.default_rng(4)
        for k in range(3, len(body.held)):
            n = generator.normal(size=3)
            world = in_base(ends[k, :3], q[0])
            n_planar = in_base(n, -q[0])
            grad = np.zeros((1, 4))
            jacobian_transpose(frames, 0, int(body.held[k, 0]), *ends[k, :3], *n_planar, 1.0, grad)
            for joint in range(4):
                moved = q.copy()
                moved[joint] += h
                _, after = placed(body, moved)
                slope = n @ (in_base(after[k, :3], moved[0]) - world) / h
                assert grad[0, joint] == pytest.approx(slope, abs=2e-3)


def test_turning_an_obstacle_keeps_its_distance_to_the_arm(model, planner):
    generator = np.random.default_rng(5)
    obstacle = np.array([[*generator.normal(size=6) * 100, 5.0, 5.0, 0.0]])
    for yaw in (0.0, 1.0, -2.5):
        out = np.empty((1, 10))
        into_arm_plane(obstacle, 0, np.cos(yaw), np.sin(yaw), out, 0)
        np.testing.assert_allclose(in_base(out[0, :3], yaw), obstacle[0, :3], atol=1e-9)
        np.testing.assert_allclose(in_base(out[0, 3:6], yaw), obstacle[0, 3:6], atol=1e-9)


def test_the_compiled_inverse_kinematics_are_the_cells(model, planner):
    r, z = (grid.ravel() for grid in np.meshgrid(np.linspace(100, 300, 21), np.linspace(40, 160, 13)))
    pitch = np.linspace(-1.0, 1.0, len(r))
    out = np.empty((len(r), 3))
    elbow_up(planner.collision_model.planar, r, z, pitch, out)
    expected = model.arm.ik(np.stack([r, 0 * r, z], -1), pitch)[:, 0, 1:4]
    difference = np.angle(np.exp(1j * (out - expected)))
    assert (np.isnan(out) == np.isnan(expected)).all()
    assert np.nanmax(np.abs(difference)) < 1e-9


def test_pairs_left_out_never_come_near(model, planner):
    body = planner.collision_model
    kept = {tuple(sorted(pair)) for pair in body.held_pairs.tolist()}
    levels = body.held[:, 0]
    block = len(body.capsules)
    everyone = {
        (i, j) for i in range(len(levels)) for j in range(i + 1, len(levels))
        if (levels[j] - levels[i] > 1) or (levels[i] == 3 and j >= block)
    }  # fmt: skip
    left_out = [pair for pair in everyone if pair not in kept]
    assert left_out
    for q in postures(model, 300, 6):
        _, ends = placed(body, q)
        for i, j in left_out:
            gap = segment_distance(ends[i, :3], ends[i, 3:6], ends[j, :3], ends[j, 3:6]) - body.held[i, 7] - body.held[j, 7]
            assert gap > planner.motion.self_clearance_mm


def test_the_arm_never_reaches_past_its_reach(model, planner):
    body = planner.collision_model
    for q in postures(model, 500, 7):
        _, ends = placed(body, q)
        for e in (0, 3):
            assert (np.hypot(ends[:, e], ends[:, e + 1]) + body.held[:, 7] <= body.reach_mm + 1e-9).all()
    far = np.array([[body.reach_mm + 30, 0, 0, body.reach_mm + 30, 0, 100, 10, 5, 50.0], [200, 0, 0, 200, 0, 100, 10, 5, 50.0]])
    assert out_of_reach(body, np.array([*far[:1] + [120, 0, 0, 120, 0, 0, 0, 0, 0], far[1]])).tolist() == [True, False]


PLANNED = """
from marl_handover.cell import build_cell, cell_config
from marl_handover.motion.planner import MotionPlanner

planner = MotionPlanner(build_cell(cell_config("paper")))
for pick, place in (([-60.0, 20.0], [50.0, 25.0]), ([0.0, 30.0], [-155.0, 60.0]), ([90.0, -10.0], [-20.0, -15.0])):
    for arm in (0, 1):
        try:
            motion = planner.pick_place(arm, pick, place, planner.home_rad, planner.home_rad)
        except Exception as refusal:
            print(type(refusal).__name__)
        else:
            print([phase.joints_rad.tobytes().hex() for phase in motion.phases])
"""


@pytest.mark.slow
def test_a_process_that_compiles_moves_as_one_that_finds_all_compiled(tmp_path):
    """To the last bit. A compiler that may reorder sums does so one way where it sees a called function and another where it does not."""
    told = [
        subprocess.run(
            [sys.executable, "-c", PLANNED],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    ]
    assert told[0].count("[") >= 3
    assert told[0] == told[1]
