"""Every transition that the memory answers with is one the rule book would have made."""

from __future__ import annotations

import math

import pytest
import torch

from marl_handover.learning.replay import HindsightReplayBuffer
from marl_handover.task.rules import Rules


def executed(replay, batch):
    """The sampled decisions, taken again under the rule book in double precision."""
    previous = torch.full((len(batch),), -1)
    arguments = (batch[key].double() for key in ("achieved_goal", "desired_goal"))
    return replay.rules.step(*arguments, previous, batch["action"].double(), epsilon_rad=batch["epsilon"][:, 0].double())


def assert_true(replay, batch):
    """Reward, end flag and, unless the episode ends, the pose that is left."""
    truth = executed(replay, batch)
    wrong = (truth.reward.float() != batch["next", "reward"][:, 0]) | (truth.terminated != batch["next", "terminated"][:, 0])
    assert not wrong.any(), f"{int(wrong.sum())} of {len(batch)} relabelled transitions are not true ones"
    going = truth.feasible & ~truth.terminated if replay.rules.external_finish else truth.feasible
    assert going.any()
    difference = (truth.placed.float() - batch["next", "achieved_goal"])[going]
    difference[:, 2] = torch.remainder(difference[:, 2] + math.pi, 2 * math.pi) - math.pi
    assert difference[:, :2].abs().max() < 1e-2
    assert difference[:, 2].abs().max() < 1e-4


@pytest.mark.parametrize("symmetry", [False, True])
@pytest.mark.parametrize("strategy", ["none", "final", "future", "episode"])
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_relabelled_transitions_are_true(replay_of, architecture, strategy, symmetry):
    replay = replay_of(architecture, strategy=strategy, ratio=0.7, near_miss_ratio=0.4, random_ratio=0.0, symmetry=symmetry)
    assert_true(replay, replay.sample(3000))


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_transitions_with_another_transitions_goal_are_true(replay_of, architecture):
    replay = replay_of(architecture, strategy="future", ratio=0.0, random_ratio=1.0)
    assert_true(replay, replay.sample(3000))


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_transitions_are_true_at_every_epsilon_of_a_range(replay_of, architecture):
    replay = replay_of(architecture, ratio=0.7, near_miss_ratio=0.8, near_miss_epsilons=2.0)
    replay.env.set_epsilon_range(0.5, 40.0)
    batch = replay.sample(3000)
    assert batch["epsilon"].min() < math.radians(1) < math.radians(20) < batch["epsilon"].max()
    assert_true(replay, batch)
    rewards = batch["next", "reward"][batch["hindsight"] & batch["final"]]
    if architecture == "B":
        assert set(rewards.tolist()) == {20.0, -30.0}  # near misses show both sides of the boundary


def test_observations_are_those_of_the_relabelled_problem(replay_of):
    from marl_handover.task.observations import observe

    replay = replay_of("B", ratio=0.7, symmetry=True)
    batch = replay.sample(500)
    truth = executed(replay, batch)
    going = ~batch["next", "terminated"][:, 0]
    expected = observe(
        replay.rules, "relative", truth.placed, batch["desired_goal"].double(), truth.previous_arm, batch["epsilon"][:, 0].double()
    )
    found = batch["next", "observation"][going].double()
    difference = (expected[going] - found).abs()
    assert (difference.max(-1).values < 1e-2).double().mean() > 0.99  # a wrapped angle may jump at its cut


def test_strategy_none_relabels_nothing(replay_of):
    replay = replay_of("B", strategy="none")
    own = {tuple(row) for row in replay[:]["desired_goal"].tolist()}
    pairs = {(*pose, *goal) for pose, goal in zip(replay[:]["achieved_goal"].tolist(), replay[:]["desired_goal"].tolist(), strict=True)}
    batch = replay.sample(2000)
    assert not batch["hindsight"].any()
    assert {tuple(goal) for goal in batch["desired_goal"].tolist()} <= own
    found = {(*pose, *goal) for pose, goal in zip(batch["achieved_goal"].tolist(), batch["desired_goal"].tolist(), strict=True)}
    assert found <= pairs, "some transitions got another transition's goal"


def test_uncorrected_end_flags_stay_as_stored(replay_of):
    """What Stable-Baselines3 does: the reward says solved, the flag says the episode goes on."""
    settings = {"finals": 0.0, "strategy": "future", "ratio": 1.0, "near_miss_ratio": 0.0, "random_ratio": 0.0}
    for corrected in (True, False):
        replay = replay_of("B", correct_terminated=corrected, **settings)
        batch = replay.sample(2000)
        solved = batch["next", "reward"][:, 0] == 20.0
        assert solved.sum() > 200
        assert bool(batch["next", "terminated"][solved].all()) is corrected
        assert bool(batch["next", "terminated"][solved].any()) is corrected


def test_stored_transitions_are_judged_at_the_present_epsilon(replay_of):
    replay = replay_of("B", finals=0.5, strategy="none", random_ratio=0.0, epsilon_deg=5.0)
    for epsilon_deg in (5.0, 60.0, 1.0):
        replay.env.set_epsilon_range(epsilon_deg, epsilon_deg)
        batch = replay.sample(3000)
        truth = executed(replay, batch)
        finals = batch["final"][:, 0] & truth.feasible
        error = replay.rules.orientation_error(truth.placed[:, 2], batch["desired_goal"][:, 2].double()).abs()[finals]
        expected = torch.where(error <= math.radians(epsilon_deg), 20.0, -30.0)
        assert torch.equal(batch["next", "reward"][finals, 0], expected)
        assert batch["next", "terminated"][finals].all()
        if epsilon_deg == 60.0:
            assert len(expected.unique()) == 2
        assert torch.allclose(batch["epsilon"], torch.tensor(math.radians(epsilon_deg)))


def test_a_refused_transfer_is_never_relabelled(replay_of):
    replay = replay_of("B", steps=100, ratio=1.0, random_ratio=1.0)
    stored = replay[:]
    refused = {tuple(row) for row in stored["achieved_goal"][~stored["feasible"][:, 0]].tolist()}
    assert len(refused) > 10
    batch = replay.sample(4000)
    rows = torch.tensor([tuple(pose) in refused for pose in batch["achieved_goal"].tolist()])
    assert rows.any()
    assert not batch["hindsight"][rows].any()
    assert (batch["next", "reward"][rows] == -30.0).all()


def test_reward_function_that_torchrl_asks_for_is_the_rule_book(replay_of):
    replay = replay_of("B", ratio=0.0, random_ratio=0.0, finals=0.5)
    assert isinstance(replay, HindsightReplayBuffer)
    assert isinstance(replay.rules, Rules)
    rows = replay[:]
    rows["final"] = replay.rules.decode(rows["action"]).final
    verdict = replay.rules.judge(rows["placed"], rows["desired_goal"], rows["final"], rows["feasible"][:, 0], rows["epsilon"][:, 0])
    assert torch.equal(replay.reward_fn(rows)[:, 0], verdict.reward)
    assert len(verdict.reward.unique()) >= 2
