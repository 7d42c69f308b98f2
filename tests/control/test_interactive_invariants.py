"""Whatever is dragged when: nothing breaks a limit or jumps, nothing touches, and in the end it is solved."""

from __future__ import annotations

import math

import numpy as np
import pytest
from interactive_fuzz import (
    DT_S,
    EXACT_MM,
    HELD,
    fuzz,
    joints_of,
    least_gaps_mm,
    make,
    rates_limits,
    settle,
)

from marl_handover.control.interactive.motion_program import FreePaths
from marl_handover.geometry.capsules import ground_clearance_mm, self_clearance_mm
from marl_handover.motion.trajectory import NoPath
from tests.canonical_arms import PARKED_DEG

STORMS = [
    pytest.param(("exact", 50), id="exact"),
    pytest.param(("pretrained_a", 20), id="pretrained_a"),
    pytest.param(("pretrained_b", 20), id="pretrained_b"),
    pytest.param(("exact", 1500), id="exact, long", marks=pytest.mark.slow),
    pytest.param(("pretrained_b", 1000), id="pretrained_b, long", marks=pytest.mark.slow),
]


@pytest.fixture(scope="module", params=STORMS)
def fuzzed(request, model):
    """A cell in which much was dragged, and what was seen."""
    name, changes = request.param
    cell = make(model, name)
    return cell, fuzz(cell, changes, seed=7)


def test_joints_keep_their_limits_and_never_jump(fuzzed):
    cell, seen = fuzzed
    joints, arm = joints_of(seen), cell.model.arm
    velocity, acceleration = rates_limits(cell)
    assert (joints >= arm.lower_rad - 1e-9).all()
    assert (joints <= arm.upper_rad + 1e-9).all()
    rates = np.diff(joints, axis=0) / DT_S
    assert (abs(rates) <= velocity * 1.001).all()
    assert (abs(np.diff(rates, axis=0)) / DT_S <= acceleration * 1.02).all()


def test_one_arm_moves_at_a_time_and_the_other_is_parked(fuzzed):
    _, seen = fuzzed
    parked = np.radians(PARKED_DEG)
    for snapshot in seen.snapshots:
        away = [arm for arm, joints in enumerate(snapshot.joints_rad) if abs(joints - parked).max() > 1e-6]
        assert len(away) <= 1
        assert not away or snapshot.arm == away[0]


def test_nothing_touches_anything(fuzzed):
    """By other functions than the planner's; they take the fingers for fully open where an arm might touch itself."""
    cell, seen = fuzzed
    between, to_block = least_gaps_mm(cell, seen)
    assert between.min() >= cell.motion.arm_clearance_mm - 0.1
    assert to_block.min() >= cell.motion.block_clearance_mm - 0.1
    joints = joints_of(seen)
    assert ground_clearance_mm(cell.model.arm, joints).min() >= cell.motion.ground_clearance_mm - 0.1
    assert self_clearance_mm(cell.model.arm, joints).min() > 0.0
    assert min(snapshot.T_world_block[2, 3] for snapshot in seen.snapshots) > -0.1


def test_the_block_moves_only_in_a_hand_or_when_dragged(fuzzed):
    _, seen = fuzzed
    for before, after, dragged in zip(seen.snapshots, seen.snapshots[1:], seen.dragged[1:], strict=False):
        shift = np.linalg.norm(after.T_world_block[:3, 3] - before.T_world_block[:3, 3])
        if dragged:
            continue
        if after.phase in HELD or before.phase in HELD:
            assert shift < 1000 * DT_S  # no hand is faster than 1 m/s
        else:
            assert shift < EXACT_MM
    assert any(snapshot.T_world_block[2, 3] > 20 for snapshot in seen.snapshots)


def test_the_block_keeps_its_place_in_the_hand(fuzzed):
    cell, seen = fuzzed
    grips = []
    for before, after, dragged in zip(seen.snapshots, seen.snapshots[1:], seen.dragged[1:], strict=False):
        if dragged or before.phase not in HELD or after.phase not in HELD:
            continue
        pair = []
        for it in (before, after):
            base = cell.model.cell.bases[it.arm]
            T = np.linalg.inv(cell.model.arm.fk(it.joints_rad[it.arm]))
            cos, sin = base.facing
            T_base_world = np.linalg.inv([[cos, -sin, 0, base.x_mm], [sin, cos, 0, base.y_mm], [0, 0, 1, 0], [0, 0, 0, 1]])
            pair.append(T @ T_base_world @ it.T_world_block)
        grips.append(abs(pair[0] - pair[1]).max())
    assert len(grips) > 100
    assert max(grips) < 1e-6


def test_what_is_left_alone_is_solved(fuzzed):
    cell, _ = fuzzed
    cell.new_problem(3)
    last = settle(cell)[-1]
    assert last.state == "done"
    assert cell._controller.adapter.there(last.block, last.goal)
    assert last.optimal <= last.transfers <= last.optimal + (0 if cell._controller.adapter.policy.name == "exact" else 2)


def test_the_score_counts_what_was_seen_to_end(fuzzed):
    cell, seen = fuzzed
    counts = np.array([(it.episodes, it.solved) for it in seen.snapshots])
    steps = np.diff(counts, axis=0)
    assert (steps >= 0).all()
    assert (counts[:, 1] <= counts[:, 0]).all()
    assert counts[-1, 0] >= 1
    assert math.isnan(seen.snapshots[0].ratio)
    if cell._controller.adapter.policy.name == "exact":
        assert counts[-1, 0] == counts[-1, 1]
        assert seen.snapshots[-1].ratio >= 1.0


class Clumsy(FreePaths):
    """Arms that often find no way."""

    def __init__(self, planner, seed, share):
        super().__init__(planner)
        self.random, self.share = np.random.default_rng(seed), share

    def timed(self, arm, found):
        if self.random.random() < self.share:
            raise NoPath("path", "nothing", 1.0, 0)
        return super().timed(arm, found)


def test_where_no_way_is_found_the_block_is_left_standing_and_the_next_change_is_taken_up(model, planner):
    cell = make(model)
    paths = cell._controller.programs.paths = Clumsy(planner, 2, 0.3)
    seen = fuzz(cell, 40, seed=11)
    velocity, acceleration = rates_limits(cell)
    rates = np.diff(joints_of(seen), axis=0) / DT_S
    assert (abs(rates) <= velocity * 1.001).all()
    assert (abs(np.diff(rates, axis=0)) / DT_S <= acceleration * 1.02).all()
    stuck = [it for it in seen.snapshots if it.state == "stuck"]
    assert stuck
    assert all(abs(it.T_world_block[2, 3]) < 1e-9 and "no collision-free path" in it.message for it in stuck)
    paths.share = 0.0
    for seed in range(3):
        cell.new_problem(seed)
        assert settle(cell)[-1].state == "done"
