"""A batch of cells is each of its cells, row by row: reach, places, steps, observations; and what the ``graph`` layout does not see."""

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from marl_handover.cell.batch import CellBatch, LayoutPool, random_layout
from marl_handover.config import BlockConfig, LayoutConfig, TaskConfig
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.errors import InvalidSetting
from marl_handover.task.graph_observation import ARM_FIELDS, ODD_ARM_FIELDS, ODD_PAIR_FIELDS, PAIR_FIELDS
from marl_handover.task.observations import observation_size, observe
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules
from tests.layouts import moved

MIXED = LayoutConfig(arms=[3, 6], r_min_mm=[120.0, 160.0], r_max_mm=[215.0, 260.0], yaw_deg=[90.0, 132.0], obstacles=[0, 3])
CLOSE = LayoutConfig(arms=[3, 4], spacing_mm=[80.0, 200.0], apart_mm=70.0)


@pytest.fixture(scope="module", params=[MIXED, CLOSE], ids=["mixed", "close"])
def pool(request):
    return LayoutPool.random(request.param, 12, np.random.default_rng(3))


@pytest.fixture
def problems(pool):
    draw = np.random.default_rng(0)
    layout = draw.integers(len(pool), size=120)
    start, goal = (poses.numpy() for poses in sample_problems(CellBatch(pool, layout), 120, torch.Generator().manual_seed(1)))
    action = draw.uniform(-1.0, 1.0, (120, 2 * pool.number.shape[1] + 3))
    return layout, start, goal, action


def padded(action, few, many):
    """The action of a cell of ``few`` arms, of one in a batch with room for ``many``."""
    scores = action[1 : 1 + few], action[1 + many : 1 + many + few]
    return np.concatenate([action[:1], *scores, action[-2:]])


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_a_step_of_a_batch_is_a_step_of_each_cell(pool, problems, architecture):
    layout, start, goal, action = problems
    many = pool.number.shape[1]
    config = TaskConfig(architecture=architecture, layout="graph")
    for row, count in enumerate(pool.n_arms[layout]):  # arms that are not there are never asked
        action[row, 1 + count : 1 + many] = action[row, 1 + many + count : 1 + 2 * many] = -2.0
    rules = Rules(CellBatch(pool, layout), config)
    result = rules.step(start, goal, np.full(120, -1), action)
    seen = observe(rules, "graph", start, goal, np.full(120, -1))
    for row in range(120):
        one = Rules(pool.cell(layout[row]), config)
        few = one.cell.num_arms
        alone = one.step(start[row], goal[row], np.int64(-1), padded(action[row], few, many))
        np.testing.assert_allclose(alone.pose, result.pose[row], atol=1e-9)
        assert (alone.feasible, alone.outcome, alone.external_arm) == (
            result.feasible[row],
            result.outcome[row],
            result.external_arm[row],
        )
        blocks = observe(one, "graph", start[row], goal[row], np.int64(-1))
        arms = seen[row, : many * len(ARM_FIELDS)].reshape(many, -1)
        np.testing.assert_allclose(arms[:few].reshape(-1), blocks[: few * len(ARM_FIELDS)], atol=1e-8)
        assert not arms[few:].any()


def test_problems_of_a_batch_lie_where_its_arms_reach_in_the_open(pool, problems):
    layout, start, goal, _ = problems
    for row in range(120):
        cell = pool.cell(layout[row])
        assert cell.reaches(start[row]).any()
        assert cell.reaches(goal[row]).any()


def test_every_random_layout_is_connected_and_keeps_its_limits():
    draw = np.random.default_rng(5)
    for _ in range(40):
        arms, discs = random_layout(MIXED, draw, BlockConfig())
        assert 3 <= len(arms) <= 6
        assert len(discs) <= 3
        apart = np.hypot(*(arms[:, None, :2] - arms[None, :, :2]).transpose(2, 0, 1)) + 1e9 * np.eye(len(arms))
        assert apart.min() >= 300.0
        assert LayoutPool([(arms, discs)]).cell(0).graph.is_connected


def test_layouts_that_cannot_be_are_named():
    apart = LayoutConfig(spacing_mm=[600.0, 700.0])
    with pytest.raises(InvalidSetting, match=r"layouts = .*spacing_mm \[600.0, 700.0\].*such that arms can pass to each other"):
        random_layout(apart, np.random.default_rng(0), BlockConfig())
    with pytest.raises(InvalidSetting, match=r"layouts\.arms = \[5, 2\]: must be the least first"):
        LayoutConfig(arms=[5, 2]).validate()


@pytest.mark.parametrize("layout", ["graph", "raw"])
def test_the_environment_draws_a_layout_for_each_episode(pool, layout):
    env = SupervisorEnv(32, task=TaskConfig(layout=layout), layouts=pool, seed=0)
    check_env_specs(env)
    env.set_seed(0)
    first = env.rollout(40, break_when_any_done=False)
    assert len(first["layout"].unique()) == len(pool)
    done = first["next", "done"][:, :-1, 0]
    same = first["layout"][:, 1:, 0] == first["layout"][:, :-1, 0]
    assert same[~done].all()
    assert not same[done].all()
    env.set_seed(0)
    env.reset()
    again = SupervisorEnv(32, task=TaskConfig(layout=layout), layouts=pool, seed=0).rollout(1)
    assert torch.equal(first["observation"][:, 0], again["observation"][:, 0])


def blocks(arms, discs, poses, order=None):
    """The observation of problems in one layout, as blocks of arms and of pairs."""
    order = np.arange(len(arms)) if order is None else order
    cell = CellBatch(LayoutPool([(arms[order], discs)]), np.zeros(len(poses[0]), np.int64))
    seen = observe(Rules(cell, TaskConfig()), "graph", *poses, np.full(len(poses[0]), -1))
    count = len(arms)
    of_arms, of_pairs = np.split(seen, [count * len(ARM_FIELDS)], -1)
    return of_arms.reshape(-1, count, len(ARM_FIELDS)), of_pairs.reshape(-1, count, count, len(PAIR_FIELDS))


def assert_same(found, expected, names):
    """Blocks are equal, angles up to full turns."""
    angles = np.array(["angle" in name or "middle" in name for name in names])
    away = found - expected
    np.testing.assert_allclose(np.where(angles, np.sin(np.pi * away / 2), away), 0.0, atol=1e-6)


@pytest.mark.parametrize("flip", [False, True])
def test_the_graph_layout_does_not_see_where_the_table_is_and_turns_odd_fields_over_in_a_mirror(flip):
    draw = np.random.default_rng(7)
    for _ in range(6):
        arms, discs = random_layout(MIXED, draw, BlockConfig())
        batch = CellBatch(LayoutPool([(arms, discs)]), np.zeros(50, np.int64))
        poses = [pose.numpy() for pose in sample_problems(batch, 50, torch.Generator().manual_seed(2))]
        of_arms, of_pairs = blocks(arms, discs, poses)
        angle, shift = draw.uniform(-3, 3), draw.uniform(-400, 400, 2)
        there = blocks(*moved(arms, discs, poses, angle, shift, flip))
        signs = [
            np.where(np.isin(names, odd) & flip, -1, 1) for names, odd in ((ARM_FIELDS, ODD_ARM_FIELDS), (PAIR_FIELDS, ODD_PAIR_FIELDS))
        ]
        assert_same(there[0], of_arms * signs[0], ARM_FIELDS)
        assert_same(there[1], of_pairs * signs[1], PAIR_FIELDS)


def test_a_permutation_of_the_arms_permutes_the_blocks():
    draw = np.random.default_rng(8)
    arms, discs = random_layout(MIXED, draw, BlockConfig())
    batch = CellBatch(LayoutPool([(arms, discs)]), np.zeros(50, np.int64))
    poses = [pose.numpy() for pose in sample_problems(batch, 50, torch.Generator().manual_seed(2))]
    order = draw.permutation(len(arms))
    of_arms, of_pairs = blocks(arms, discs, poses)
    there = blocks(arms, discs, poses, order)
    np.testing.assert_allclose(there[0], of_arms[:, order], atol=1e-9)
    np.testing.assert_allclose(there[1], of_pairs[:, order][:, :, order], atol=1e-9)


def test_sizes_are_as_the_layout_says():
    assert observation_size("graph", 5) == 5 * len(ARM_FIELDS) + 25 * len(PAIR_FIELDS)
