from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from marl_handover.cell import Cell, build_cell, cell_config
from marl_handover.config import MotionConfig, RewardConfig, TaskConfig
from marl_handover.envs import SupervisorEnv, SupervisorGoalEnv
from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.files import package_path
from marl_handover.motion import path_length_table as tables
from marl_handover.motion.planner import MotionPlanner
from marl_handover.policies import adapted, load
from marl_handover.task.rules import Rules, straight_line_mm
from tests.canonical_arms import PARKED_DEG
from tests.symmetries import GROUP

MOTION = MotionConfig()


def transfers(cell: Cell, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arms (count,), and two places each reaches (count, 2), uniform over its manipulation space."""
    random = np.random.default_rng(seed)
    arm = random.integers(0, 2, count)
    radius = np.sqrt(random.uniform(cell.r_min_mm**2, cell.r_max_mm**2, (2, count)))
    facing = np.array([base.facing_rad for base in cell.bases])[arm]
    angle = facing + random.uniform(*cell.yaw_rad, (2, count))
    base = np.array([[base.x_mm, base.y_mm] for base in cell.bases])[arm]
    start, end = base + radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    return arm, start, end


@pytest.fixture(scope="module")
def table(paper):
    return tables.path_length_table(paper, MOTION)


def test_the_shipped_table_is_that_of_the_default_settings(paper):
    """Otherwise every user builds it anew; run scripts/build_motion_cost.py."""
    assert tables.read_table(package_path(tables.SHIPPED), tables.settings_key(paper, MOTION)).key


def test_it_is_near_the_planner(paper, table):
    planner = MotionPlanner(build_cell(cell_config("paper")), MOTION)
    arm, start, end = transfers(paper, 150, 3)
    lengths = np.array([planner.transfer(int(a), p, q, planner.home_rad).length_mm for a, p, q in zip(arm, start, end, strict=True)])
    error = abs(table(paper, arm, start, end) / lengths - 1)
    straight = abs(straight_line_mm(paper, arm, start, end) / lengths - 1)
    assert np.median(error) < 0.004
    assert np.percentile(error, 90) < 0.03
    assert np.median(straight) > 0.1  # what is to be known beyond the distance


def test_it_is_never_below_the_straight_line_and_zero_for_no_way(paper, table):
    arm, start, end = transfers(paper, 2000, 4)
    length = table(paper, arm, start, end)
    assert (length > straight_line_mm(paper, arm, start, end)).all()
    assert (table(paper, arm, start, start) == 0).all()
    for dtype in (np.float32, np.float64):
        assert table(paper, arm, start.astype(dtype), end.astype(dtype)).dtype == dtype


def test_there_is_as_long_as_back_and_both_arms_are_alike(paper, table):
    arm, start, end = transfers(paper, 500, 5)
    length = table(paper, arm, start, end)
    np.testing.assert_allclose(table(paper, arm, end, start), length, rtol=1e-12)
    pad = np.zeros((500, 1))
    for element in GROUP:
        images = [element.pose(np.concatenate([place, pad], -1))[:, :2] for place in (start, end)]
        np.testing.assert_allclose(table(paper, element.arm(arm), *images), length, rtol=1e-9)


def test_numpy_torch_batches_and_single_transfers_agree(paper, table):
    arm, start, end = transfers(paper, 60, 6)
    length = table(paper, arm, start, end)
    tensors = [torch.as_tensor(array) for array in (arm, start, end)]
    np.testing.assert_allclose(table(paper, *tensors).numpy(), length, rtol=1e-12)
    single = table(paper, tensors[0], tensors[1].float(), tensors[2].float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), length, rtol=2e-4)
    folded = table(paper, arm.reshape(3, 20), start.reshape(3, 20, 2), end.reshape(3, 20, 2))
    np.testing.assert_array_equal(folded.reshape(-1), length)
    assert table(paper, arm[7], start[7], end[7]) == pytest.approx(length[7], rel=1e-12)


def test_its_slope_is_that_of_small_steps(paper, table):
    """A learner may follow it downhill."""
    arm, start, end = (torch.as_tensor(array) for array in transfers(paper, 200, 7))
    end.requires_grad_()
    table(paper, arm, start, end).sum().backward()
    step = torch.tensor([1e-5, 0.0], dtype=torch.float64)
    there = end.detach()
    change = (table(paper, arm, start, there + step) - table(paper, arm, start, there - step)) / 2e-5
    torch.testing.assert_close(end.grad[:, 0], change, rtol=1e-4, atol=1e-4)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_interpolation_is_linear_between_nodes_and_constant_beyond(seed, dimensions):
    random = np.random.default_rng(seed)
    table = random.normal(size=random.integers(2, 6, dimensions))
    places = random.uniform(-1.0, 6.0, (dimensions, 40))
    inside = np.clip(places, 0, np.array(table.shape)[:, None] - 1)
    theirs = RegularGridInterpolator([np.arange(count) for count in table.shape], table)(inside.T)
    np.testing.assert_allclose(tables.interpolated(table, list(places)), theirs, atol=1e-12)


def test_a_stored_table_comes_back_and_another_cells_is_refused(table, tmp_path, paper):
    path = tmp_path / "costs.npz"
    table.save(path)
    again = tables.read_table(path, table.key)
    np.testing.assert_array_equal(again.excess_mm, table.excess_mm)
    np.testing.assert_array_equal(again.string_mm, table.string_mm)
    assert [file.name for file in tmp_path.iterdir()] == ["costs.npz"]
    higher = tables.settings_key(paper, replace(MOTION, lift_mm=60.0))
    with pytest.raises(tables.StaleTable, match=f"settings {table.key}, but {higher} was asked for"):
        tables.read_table(path, higher)


@pytest.mark.parametrize("spoil", [lambda whole: whole[: len(whole) // 2], lambda whole: b"", lambda whole: b"PK" + whole[:100]])
def test_a_damaged_table_is_refused(table, tmp_path, spoil):
    path = tmp_path / "costs.npz"
    with pytest.raises(MissingFile):
        tables.read_table(path, table.key)
    table.save(path)
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(CorruptFile, match=str(path)):
        tables.read_table(path, table.key)


def test_a_table_of_another_shape_or_not_finite_is_refused(table, tmp_path):
    path = tmp_path / "costs.npz"
    for wrong in ({"excess_mm": table.excess_mm[1:]}, {"string_mm": table.string_mm * math.nan}):
        replace(table, **wrong).save(path)
        with pytest.raises(CorruptFile, match="shapes"):
            tables.read_table(path, table.key)


def test_the_key_follows_what_the_paths_depend_on(paper):
    key = tables.settings_key(paper, MOTION)
    config = paper.config
    same = [(replace(paper, config=replace(config, name="else", chart_inset=0.9)), MOTION), (paper, replace(MOTION, velocity_scale=0.5))]
    assert {tables.settings_key(*settings) for settings in same} == {key}
    others = [
        (replace(paper, config=replace(config, pick_height_mm=50.0)), MOTION),
        (replace(paper, config=replace(config, block=replace(config.block, side_mm=41.0))), MOTION),
        (paper, replace(MOTION, lift_mm=41.0)),
        (paper, replace(MOTION, parked_deg=[10.0, *PARKED_DEG[1:]])),
    ]
    keys = [tables.settings_key(*settings) for settings in others]
    assert len({key, *keys}) == len(others) + 1


def test_a_new_cells_table_is_built_once_and_kept(paper, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name, count in (("RADII", 2), ("YAWS", 2), ("DISTANCES", 9)):
        monkeypatch.setattr(tables, name, count)
    low = replace(MOTION, lift_mm=20.0)
    built = tables.path_length_table(paper, low)
    file = tables.cache_file(built.key)
    assert file.parent.parent == tmp_path
    np.testing.assert_array_equal(tables.read_table(file, built.key).excess_mm, built.excess_mm)
    written = file.stat().st_mtime_ns
    assert tables.path_length_table(paper, low) is built
    monkeypatch.setattr(tables, "_TABLES", {})
    np.testing.assert_array_equal(tables.path_length_table(paper, low).excess_mm, built.excess_mm)
    assert file.stat().st_mtime_ns == written
    assert (built.excess_mm >= 0).all()
    assert (built.excess_mm == built.excess_mm.transpose(1, 0, 2)).all()


def test_a_node_without_a_path_is_as_dear_as_any(paper, monkeypatch):
    for name, count in (("RADII", 2), ("YAWS", 3), ("DISTANCES", 9)):
        monkeypatch.setattr(tables, name, count)
    found = iter([10.0, math.nan, 3.0, 4.0, 5.0, 30.0, 7.0])
    monkeypatch.setattr(tables, "_excess_mm", lambda *_: next(found))
    built = tables.build_table(paper, MOTION, progress=False)
    assert built.excess_mm.tolist() == [[[0, 10, 30], [3, 4, 5]], [[3, 4, 5], [0, 30, 7]]]
    assert next(found, None) is None


def test_the_string_is_the_planners_lower_bound(paper, table):
    planner = MotionPlanner(build_cell(cell_config("paper")), MOTION)
    for arm, start, end in zip(*transfers(paper, 40, 8), strict=True):
        bound = planner.carrying(int(arm), start, end, planner.home_rad)[0].lower_bound_mm
        string = tables.interpolated(table.string_mm, [np.linalg.norm(end - start) / table._distance_step])
        assert string == pytest.approx(bound, abs=0.05)


def test_rules_without_weight_keep_the_straight_line(paper, table):
    assert tables.motion_cost(paper, TaskConfig()) is straight_line_mm
    task = TaskConfig(reward=RewardConfig(motion_weight=2.0))
    assert tables.motion_cost(paper, task) is table
    rules = Rules(paper, task, tables.motion_cost(paper, task))
    arm, start, end = transfers(paper, 5, 9)
    np.testing.assert_allclose(rules.motion_penalty(arm, start, end), 2.0 * table(paper, arm, start, end) / 100)


def test_environments_training_and_policies_price_a_transfer_alike(paper, table):
    task = TaskConfig(layout="object", reward=RewardConfig(motion_weight=0.7))
    batch, single = SupervisorEnv(3, paper, task), SupervisorGoalEnv("B", paper, task)
    for rules in (batch.rules, single.rules, load("exact", paper, task).rules, adapted("exact", reward=task.reward).rules):
        assert rules.motion_cost is table
    state = batch.reset()
    state["action"] = torch.tensor([[-1.0, 1.0, 0.3, -0.2]] * 3)
    after = batch.step(state)["next"]
    way = table(paper, torch.ones(3, dtype=torch.int64), state["achieved_goal"][:, :2], after["placed"][:, :2])
    earned = torch.where(after["feasible"][:, 0], task.reward.step, task.reward.failure) - 0.7 * way / 100
    torch.testing.assert_close(after["reward"][:, 0], earned)
