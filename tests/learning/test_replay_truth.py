"""Every transition that the memory answers with is one the rule book would have made."""

from __future__ import annotations

import math

import pytest
import torch

from marl_handover.config import NoiseConfig
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.replay import HindsightReplayBuffer
from marl_handover.learning.settings import HindsightConfig, ReplayConfig
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


NOISE = NoiseConfig(position_mm=2.0, yaw_deg=2.0)


def noisy_again(replay, batch):
    """The sampled decisions, taken again with noise of their own."""
    random = torch.Generator().manual_seed(77)
    scale = torch.tensor([2.0, 2.0, math.radians(2.0)])
    draws = [torch.randn(len(batch), 3, generator=random) * scale for _ in range(2)]
    previous, epsilon = torch.full((len(batch),), -1), batch["epsilon"][:, 0]
    problem = batch["achieved_goal"], batch["desired_goal"], previous, batch["action"]
    return replay.rules.step(*problem, epsilon_rad=epsilon, noise=draws[0], final_noise=draws[1])


@pytest.mark.parametrize("epsilon_deg", [1.0, 5.0])
@pytest.mark.parametrize("strategy", ["final", "future"])
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_under_noise_memory_tells_of_as_many_successes_as_there_are(replay_of, architecture, strategy, epsilon_deg):
    replay = replay_of(architecture, steps=500, capacity=10000, strategy=strategy, ratio=0.8, epsilon_deg=epsilon_deg, noise=NOISE)
    batch = replay.sample(12000)
    batch = batch[batch["hindsight"][:, 0] & (batch["final"][:, 0] | (architecture == "A"))]
    truth = noisy_again(replay, batch)
    told, real = (
        float((reward == (20 if architecture == "B" else 0)).float().mean()) for reward in (batch["next", "reward"], truth.reward)
    )
    assert 0.02 < real < 0.95
    assert abs(told - real) < 0.05
    ends = batch["next", "terminated"].float().mean() - truth.terminated.float().mean()
    assert abs(float(ends)) < 0.05


def test_under_noise_a_later_goal_does_not_choose_this_rows_noise(replay_of):
    """How often some arm could finish from where a hand-over was told to have left the object."""
    replay = replay_of("B", steps=400, finals=0.0, ratio=1.0, near_miss_ratio=0.0, random_ratio=0.0, epsilon_deg=2.0, noise=NOISE)
    batch = replay.sample(12000)
    batch = batch[batch["hindsight"][:, 0] & ~batch["final"][:, 0]]
    goal, epsilon = batch["desired_goal"], batch["epsilon"][:, 0]
    places = batch["next", "achieved_goal"], noisy_again(replay, batch).placed
    told, real = (float(replay.rules.can_finish(pose, goal, epsilon).any(-1).float().mean()) for pose in places)
    assert 0.1 < real < 0.9
    assert abs(told - real) < 0.05


def test_a_missed_grasp_is_a_failure_in_hindsight(made_up_episodes, paper, rules_of):
    """On arms whose placements are measured: the gripper closed, opened at its place, and the object was still where it had been."""
    rules = Rules(paper, rules_of(paper).config, physical=True)
    env = SupervisorEnv(1, paper, rules.config, seed=0, rules=rules)
    config = ReplayConfig(capacity=100, hindsight=HindsightConfig(strategy="final", ratio=1.0, near_miss_ratio=0.0, random_ratio=0.0))
    replay = HindsightReplayBuffer(rules, config, env, torch.Generator().manual_seed(0))
    rows = made_up_episodes([1, 1])
    rows["achieved_goal"] = torch.tensor([[-20.0, 10.0, 0.5], [15.0, -12.0, 1.0]])
    rows["action"] = torch.tensor([[-1.0, -1.0, 0.5, 0.5], [-1.0, 1.0, -0.5, 0.2]])
    planned, able = rules.transfer(rows["achieved_goal"], rows["desired_goal"], rules.decode(rows["action"]))
    assert able.all()
    rows["placed"] = torch.stack([rows["achieved_goal"][0], planned[1]])
    replay.extend(rows)
    batch = replay.sample(200)
    assert batch["hindsight"].all()
    assert batch["final"].all()
    missed = (batch["next", "achieved_goal"] == batch["achieved_goal"]).all(-1)
    assert 0 < missed.sum() < 200
    assert torch.equal(batch["next", "reward"][:, 0], torch.where(missed, -30.0, 20.0))


@pytest.mark.parametrize("ignored", [False, True])
def test_in_a_what_an_arm_refused_it_refuses_again(made_up_episodes, paper, rules_of, ignored):
    """A command that was ignored, as the episode was solved at its start, is carried out once told of another goal."""
    rules = rules_of(paper, "A")
    env = SupervisorEnv(1, paper, rules.config, seed=0)
    config = ReplayConfig(capacity=100, hindsight=HindsightConfig(strategy="none"))
    replay = HindsightReplayBuffer(rules, config, env, torch.Generator().manual_seed(0))
    rows = made_up_episodes([1])
    rows["achieved_goal"] = rows["placed"] = torch.tensor([[-20.0, 10.0, 0.5]])
    rows["desired_goal"] = torch.tensor([[120.0, -120.0, 2.5]])
    rows["action"] = torch.tensor([[-1.0, -1.0, 0.5, 0.5]])
    rows["feasible"] = torch.zeros(1, 1, dtype=torch.bool)
    rows["ignored"] = torch.full((1, 1), ignored)
    planned, able = rules.transfer(rows["achieved_goal"], rows["desired_goal"], rules.decode(rows["action"]))
    assert able.all()
    assert not rules.can_finish(rows["achieved_goal"], rows["desired_goal"]).any()
    replay.extend(rows)
    expected = planned if ignored else rows["achieved_goal"]
    torch.testing.assert_close(replay.sample(20)["next", "achieved_goal"], expected.expand(20, 3))


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
