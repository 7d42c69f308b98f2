"""The batched TorchRL environment is a thin skin over the rule book."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from marl_handover.config import LAYOUTS, NoiseConfig, TaskConfig
from marl_handover.envs import SupervisorEnv
from marl_handover.errors import InvalidSetting
from marl_handover.task.observations import observation_size, observe
from marl_handover.task.rules import Outcome

architectures = pytest.mark.parametrize("architecture", ["A", "B"])
FIELDS = ("observation", "achieved_goal", "desired_goal", "previous_arm", "epsilon", "transfers", "placed", "feasible", "outcome")


def make(architecture="B", num_envs=16, seed=0, **task):
    return SupervisorEnv(num_envs, task=TaskConfig(architecture=architecture, **task), seed=seed)


def posed(env, start, goal):
    """A reset tensordict in which every cell has this problem."""
    state = env.reset()
    state["achieved_goal"] = torch.tensor(start).expand(env.batch_size[0], 3).clone()
    state["desired_goal"] = torch.tensor(goal).expand(env.batch_size[0], 3).clone()
    return state


def rollout(env, steps=12, seed=0):
    """A random rollout with automatic resets."""
    torch.manual_seed(seed)
    return env.rollout(steps, auto_reset=True, break_when_any_done=False)


@architectures
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("num_envs", [1, 5])
def test_specs(architecture, layout, num_envs):
    env = make(architecture, num_envs, layout=layout, noise=NoiseConfig(1.0, 1.0))
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (num_envs, observation_size(layout))
    assert env.action_spec.shape == (num_envs, 4)


@architectures
def test_reset_gives_fresh_problems_in_reach(architecture):
    env = make(architecture, 200)
    state = env.reset()
    for key in ("achieved_goal", "desired_goal"):
        assert env.rules.cell.reaches(state[key]).any(-1).all()
        assert len(state[key].unique(dim=0)) == 200
    assert (state["previous_arm"] == -1).all()
    assert (state["transfers"] == 0).all()
    assert not state["done"].any()
    assert not torch.equal(env.reset()["achieved_goal"], state["achieved_goal"])


@architectures
@pytest.mark.parametrize("rows", [[0], [1, 4, 7], list(range(8))])
def test_partial_reset_touches_only_the_reset_cells(architecture, rows):
    env = make(architecture, 8)
    state = rollout(env, 5)[:, -1]
    state = step_mdp(state)
    mask = torch.zeros(8, 1, dtype=torch.bool)
    mask[rows] = True
    state["_reset"] = mask
    before = state.clone()
    after = env.reset(state)
    kept = ~mask[:, 0]
    for key in ("observation", "achieved_goal", "desired_goal", "previous_arm", "epsilon", "transfers"):
        assert torch.equal(after[key][kept], before[key][kept]), key
    assert (after["achieved_goal"][rows] != before["achieved_goal"][rows]).any(-1).all()
    assert (after["transfers"][rows] == 0).all()
    assert (after["previous_arm"][rows] == -1).all()
    assert env.rules.cell.reaches(after["desired_goal"]).any(-1).all()
    expected = observe(env.rules, "relative", after["achieved_goal"], after["desired_goal"], after["previous_arm"][:, 0])
    torch.testing.assert_close(after["observation"], expected)


@architectures
def test_a_rollout_equals_its_problems_stepped_through_the_rules_one_by_one(architecture):
    env = make(architecture, 6, epsilon_deg=30.0, max_steps=5)
    history = rollout(env, 40)
    outcomes = set()
    for row in history.reshape(-1):
        after = row["next"]
        result = env.rules.step(
            row["achieved_goal"],
            row["desired_goal"],
            row["previous_arm"][0],
            row["action"],
            transfers_left=5 - row["transfers"][0],
            epsilon_rad=row["epsilon"][0],
        )
        torch.testing.assert_close(after["achieved_goal"], result.pose, atol=1e-4, rtol=0)
        torch.testing.assert_close(after["placed"], result.placed, atol=1e-4, rtol=0)
        assert after["reward"] == result.reward
        assert after["terminated"] == result.terminated
        assert after["feasible"] == result.feasible
        assert after["previous_arm"] == result.previous_arm
        assert after["transfers"] == row["transfers"] + result.transfers
        assert after["done"] == (after["terminated"] | after["truncated"])
        assert torch.equal(after["desired_goal"], row["desired_goal"])
        if not after["truncated"]:
            assert after["outcome"] == result.outcome
        seen = observe(env.rules, "relative", result.pose, row["desired_goal"], result.previous_arm, row["epsilon"][0])
        torch.testing.assert_close(after["observation"], seen, atol=1e-3, rtol=0)
        outcomes.add(int(after["outcome"]))
    assert outcomes >= {Outcome.NONE, Outcome.TIMEOUT, Outcome.SUCCESS} - ({Outcome.TIMEOUT} if architecture == "B" else set())


@architectures
def test_cells_do_not_influence_each_other(architecture):
    """The same problems and actions in another order give the same transitions in that order."""
    env = make(architecture, 50, epsilon_deg=30.0)
    state = env.rand_action(env.reset())
    order = torch.randperm(50, generator=torch.Generator().manual_seed(0))
    plain, shuffled = env.step(state.clone())["next"], env.step(state[order].clone())["next"]
    for key in (*FIELDS, "reward", "terminated", "truncated"):
        torch.testing.assert_close(shuffled[key], plain[key][order], msg=key)


@architectures
def test_the_seed_decides(architecture):
    first, again, other = (rollout(make(architecture, seed=seed, noise=NoiseConfig(2.0, 1.0))) for seed in (3, 3, 4))
    for key in (*FIELDS, "action"):
        assert torch.equal(first[key], again[key]), key
    assert not torch.equal(first["achieved_goal"], other["achieved_goal"])


@architectures
def test_reaching_the_limit_truncates(architecture):
    """Twenty placements in the middle of the table; a goal that one arm alone can only reach the wrong way round."""
    env = make(architecture, 2)
    state = posed(env, [0.0, 0.0, 0.0], [200.0, 180.0, -math.pi / 2])
    for count in range(1, 21):
        state["action"] = torch.tensor([-1.0, -1.0, 0.0, 0.0]).expand(2, 4)
        stepped = env.step(state)
        after = stepped["next"]
        assert (after["transfers"] == count).all()
        assert not after["terminated"].any()
        assert (after["truncated"] == (count == 20)).all()
        assert (after["done"] == (count == 20)).all()
        assert (after["outcome"] == (Outcome.TIMEOUT if count == 20 else Outcome.NONE)).all()
        assert (after["reward"] == -1).all()
        state = step_mdp(stepped)


def test_success_with_the_last_transfer_is_no_truncation():
    env = make("B", 1)
    state = posed(env, [0.0, 0.0, 0.0], [200.0, 180.0, math.pi / 2])
    state["transfers"] = torch.full((1, 1), 19)
    state["action"] = torch.tensor([[1.0, -1.0, 0.0, 0.0]])
    after = env.step(state)["next"]
    assert (after["terminated"].item(), after["truncated"].item(), after["outcome"].item()) == (True, False, Outcome.SUCCESS)


@pytest.mark.parametrize(("used", "solved"), [(18, True), (19, False)])
def test_architecture_a_counts_the_external_transfer_against_the_limit(used, solved):
    env = make("A", 1)
    state = posed(env, [200.0, 180.0, math.pi / 2], [-200.0, -180.0, math.pi / 2])
    state["transfers"] = torch.full((1, 1), used)
    state["action"] = torch.tensor([[-1.0, -1.0, 0.0, 0.0]])
    after = env.step(state)["next"]
    assert after["transfers"] == 20
    assert (after["terminated"].item(), after["truncated"].item()) == (solved, not solved)
    assert after["outcome"] == (Outcome.SUCCESS if solved else Outcome.TIMEOUT)


def test_epsilon_is_drawn_log_uniformly_inside_its_range():
    env = make("B", 20_000)
    assert env.reset()["epsilon"].unique().tolist() == pytest.approx([math.radians(5)])
    env.set_epsilon_range(1.0, 16.0)
    epsilon = torch.rad2deg(env.reset()["epsilon"])
    assert epsilon.min() >= 1 - 1e-5
    assert epsilon.max() <= 16 + 1e-4
    assert torch.quantile(epsilon, torch.tensor([0.25, 0.5, 0.75])).tolist() == pytest.approx([2, 4, 8], rel=0.05)
    env.set_epsilon_range(2.0, 2.0)
    assert env.reset()["epsilon"].unique().tolist() == pytest.approx([math.radians(2)])


def test_epsilon_stays_for_an_episode_and_judges_it():
    env = make("B", 2)
    off = math.radians(10)
    state = posed(env, [0.0, 0.0, 0.0], [200.0, 180.0, math.pi / 2 + off])
    state["epsilon"] = torch.tensor([[off * 0.9], [off * 1.1]])
    state["action"] = torch.tensor([1.0, -1.0, 0.0, 0.0]).expand(2, 4)
    after = env.step(state)["next"]
    assert after["outcome"][:, 0].tolist() == [Outcome.WRONG_ORIENTATION, Outcome.SUCCESS]
    assert torch.equal(after["epsilon"], state["epsilon"])


@pytest.mark.parametrize("bounds", [(0.0, 5.0), (-1.0, 5.0), (math.nan, 5.0), (5.0, 1.0), (1.0, math.inf), (1.0, math.nan)])
def test_bad_epsilon_ranges_are_named(bounds):
    with pytest.raises(InvalidSetting, match="epsilon"):
        make().set_epsilon_range(*bounds)


@pytest.mark.parametrize("count", [0, -3])
def test_a_batch_needs_a_cell(count):
    with pytest.raises(InvalidSetting, match="num_envs"):
        SupervisorEnv(count)


def test_noise_has_the_set_size_and_spares_refused_transfers():
    env = make("B", 20_000, noise=NoiseConfig(position_mm=2.0, yaw_deg=3.0))
    state = posed(env, [200.0, 180.0, 0.5], [0.0, 0.0, 0.0])
    action = torch.tensor([-1.0, -1.0, 0.0, 0.0]).repeat(20_000, 1)
    action[10_000:, 1] = 1  # the right arm cannot
    after = env.step(TensorDict({**state, "action": action}, env.batch_size))["next"]
    offset = after["placed"][:10_000] - torch.tensor([0.0, 0.0, 0.5 - math.pi / 2])
    assert offset.std(0).tolist() == pytest.approx([2, 2, math.radians(3)], rel=0.04)
    assert (offset.mean(0).abs() < 0.1).all()
    assert torch.equal(after["placed"][10_000:], state["achieved_goal"][10_000:])
