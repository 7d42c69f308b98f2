"""Every transition from turn to turn that the memory answers with is one that both arms would have made."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch

from marl_handover.baselines.turn_replay import TurnReplay
from marl_handover.cell import load_cell
from marl_handover.config import DecentralisedConfig, NoiseConfig, TaskConfig
from marl_handover.envs.decentralised import DecentralisedEnv
from marl_handover.learning.replay import EpisodeWriter
from marl_handover.learning.settings import HindsightConfig, ReplayConfig
from tests.symmetries import GROUP


def environment(decisions, noise=0.0):
    task = TaskConfig(max_steps=6, noise=NoiseConfig(position_mm=noise, yaw_deg=noise))
    return DecentralisedEnv(16, load_cell("paper"), task, seed=0, settings=DecentralisedConfig(decisions_per_transfer=decisions))


@cache
def played(decisions, noise=0.0):
    """Whole episodes of 16 cells in which arms that reach the object pass it on, wait, and now and then end it; some are refused."""
    env, random, rows = environment(decisions, noise), torch.Generator().manual_seed(1), []
    writer = EpisodeWriter(16, env.rules.max_decisions, env.device)
    current = env.reset()
    for _ in range(300 if noise else 80):
        action = torch.rand(16, 3, generator=random) * 2 - 1
        able = env.rules.cell.reaches(current["achieved_goal"]).gather(-1, 1 - current["previous_arm"])[:, 0]
        refused, final, waits = (torch.rand(16, generator=random) < share for share in (0.05, 0.1, 0.2))
        choice = torch.where(final, 1.0, torch.where(waits | (~able & ~refused), -1.0, 0.0))
        current["action"] = torch.cat([choice[:, None], action[:, 1:]], -1)
        transition, current = env.step_and_maybe_reset(current)
        finished = writer.add(transition)
        if finished is not None:
            rows.append(finished)
    return torch.cat(rows)


@pytest.fixture(scope="module")
def memory_of():
    """``memory_of(**settings)``: a memory of what was :func:`played`."""

    def make(to_next_turn=True, separate=False, decisions=3, noise=0.0, **settings):
        hindsight = HindsightConfig(**{key: settings.pop(key) for key in list(settings) if key in HindsightConfig.__annotations__})
        config = ReplayConfig(**{"capacity": 4000, **settings}, hindsight=hindsight)
        env = environment(decisions, noise)
        replay = TurnReplay(env.rules, config, env, torch.Generator().manual_seed(2), to_next_turn, separate)
        replay.extend(played(decisions, noise).clone())
        return replay

    return make


def simulated(replay, batch, pose, turn, action):
    """A decision taken again under the rule book, in double precision."""
    numbers = (value.double() for value in (pose, batch["goal"]))
    return replay.rules.take_turn(*numbers, turn, action.double(), batch["epsilon"].double())


def assert_same(truth, found, rows):
    """Reward, end flag and the pose that is left, on ``rows``."""
    wrong = (truth.reward.float() != found["reward"]) | (truth.terminated != found["terminated"])
    assert not wrong[rows].any(), f"{int(wrong[rows].sum())} of {int(rows.sum())} are not true"
    difference = (truth.placed.float() - found["pose"])[rows & truth.feasible]
    difference[:, 2] = torch.remainder(difference[:, 2] + math.pi, 2 * math.pi) - math.pi
    assert difference[:, :2].abs().max() < 1e-2
    assert difference[:, 2].abs().max() < 1e-4


def assert_true(replay, batch):
    """The decision, and then the answer, each simulated from what went before."""
    first = simulated(replay, batch, batch["pose"], batch["turn"], batch["action"])
    everything = torch.ones_like(first.terminated)
    assert_same(first, batch["next"], everything)
    if replay.to_next_turn:
        going = ~first.terminated
        assert going.any()
        answer = simulated(replay, batch, first.placed, 1 - batch["turn"], batch["later"]["action"])
        assert_same(answer, batch["later"], going)


KINDS = {"ctde": (False, False), "shared": (True, False), "independent": (True, True)}


@pytest.mark.parametrize("symmetry", [False, True])
@pytest.mark.parametrize("strategy", ["none", "final", "future", "episode"])
@pytest.mark.parametrize("kind", KINDS)
def test_relabelled_transitions_are_true(memory_of, kind, strategy, symmetry):
    to_next_turn, separate = KINDS[kind]
    settings = {"strategy": strategy, "ratio": 0.7, "near_miss_ratio": 0.4, "random_ratio": 0.3, "symmetry": symmetry}
    replay = memory_of(to_next_turn=to_next_turn, separate=separate, **settings)
    batch = replay.sample(2000)
    assert_true(replay, batch)
    if strategy != "none":
        assert 0.2 < batch["hindsight"].float().mean() < 0.7


@pytest.mark.parametrize("kind", KINDS)
def test_true_at_every_epsilon_of_a_range_with_goals_of_other_rows(memory_of, kind):
    to_next_turn, separate = KINDS[kind]
    replay = memory_of(
        to_next_turn=to_next_turn, separate=separate, ratio=0.5, near_miss_ratio=0.8, near_miss_epsilons=2.0, random_ratio=1.0
    )
    replay.env.set_epsilon_range(0.5, 40.0)
    batch = replay.sample(3000)
    assert batch["epsilon"].min() < math.radians(1) < math.radians(20) < batch["epsilon"].max()
    assert_true(replay, batch)
    finals = batch["hindsight"] & (batch["action"][:, 0] > 1 / 3)
    assert set(batch["next"]["reward"][finals].tolist()) == {20.0, -30.0}  # near misses show both sides of the boundary


def test_every_kind_of_answer_is_there(memory_of):
    """Success by either arm, failure by either, passes, and more than one transfer from a goal."""
    batch = memory_of(ratio=0.7).sample(4000)
    passed = batch["action"][:, 0] < -1 / 3
    later = batch["later"]["action"][:, 0] < -1 / 3
    going = ~batch["next"]["terminated"]
    assert (passed & ~later & going).any()
    assert (~passed & later & going).any()
    assert {20.0, -30.0, -1.0, -0.5} == set(batch["next"]["reward"].tolist())
    assert {20.0, -30.0, -1.0, -0.5} == set(batch["later"]["reward"][going].tolist())
    assert (batch["later"]["reward"][batch["hindsight"] & going] == 20.0).any(), "the other arm's answer is never the goal"


def test_a_pass_never_becomes_final_nor_ends_anything(memory_of):
    replay = memory_of(ratio=1.0)
    stored = replay[:]
    waits = {tuple(row) for row in stored["action"][replay.rules.passes(stored["action"])].tolist()}
    batch = replay.sample(3000)
    own = torch.tensor([(-1.0, *row) in waits for row in batch["action"][:, 1:].tolist()])
    assert own.any()
    assert (batch["action"][own, 0] == -1.0).all()
    assert not batch["next"]["terminated"][own].any()


@pytest.mark.parametrize("strategy", ["final", "future", "episode"])
def test_a_placement_that_reaches_its_new_goal_is_final(memory_of, strategy):
    """Also where only passes followed it, so that the later pose was its own."""
    batch = memory_of(strategy=strategy, ratio=1.0, near_miss_ratio=0.0, symmetry=False).sample(3000)
    there = batch["hindsight"] & (batch["next"]["pose"] == batch["goal"]).all(-1)
    assert there.sum() > 100
    assert (batch["action"][there, 0] == 1.0).all()
    assert (batch["next"]["reward"][there] == 20.0).all()
    assert not (batch["hindsight"] & (batch["pose"] == batch["goal"]).all(-1)).any(), "the object was at its goal before"


def test_what_was_cut_off_before_the_next_turn_is_left_out(memory_of):
    replay = memory_of(strategy="none", random_ratio=0.0, decisions=1)
    stored = replay[:]
    cut = (stored["remaining"][:, 0] == 0) & ~stored["terminated"][:, 0]
    assert cut.sum() > 20
    places = {tuple(row) for row in stored["action"][cut].tolist()}
    assert not any(tuple(row) in places for row in replay.sample(3000)["action"].tolist())
    replay.to_next_turn = False
    assert any(tuple(row) in places for row in replay.sample(3000)["action"].tolist())


@pytest.mark.parametrize("symmetry", [False, True])
def test_separate_learners_never_get_the_other_arms_turns(memory_of, symmetry):
    """Rows alternate between the arms, and each is a stored one of that arm's own, mirrored only in its own frame."""
    replay = memory_of(separate=True, strategy="none", random_ratio=0.0, symmetry=symmetry)
    batch = replay.sample(2000)
    assert torch.equal(batch["turn"], torch.arange(2000) % 2)
    stored = replay[:]
    turn = replay.rules.turn_of(stored["previous_arm"][:, 0])
    known = [{(round(x, 3), round(y, 3)) for x, y in stored["achieved_goal"][turn == arm, :2].tolist()} for arm in (0, 1)]
    turned = 0
    for arm, (x, y) in zip(batch["turn"].tolist(), batch["pose"][:, :2].tolist(), strict=True):
        direct, mirrored = ((round(sign * x, 3), round(y, 3)) in known[arm] for sign in (1, -1))
        assert direct or (symmetry and mirrored)
        turned += not direct
    assert bool(turned) is symmetry


@pytest.mark.parametrize("kind", KINDS)
def test_under_noise_memory_tells_of_as_many_successes_as_there_are(memory_of, kind):
    """Finished again, with noise of its own; and a pass leaves the object exactly where it is."""
    replay = memory_of(*KINDS[kind], noise=2.0, ratio=0.8, random_ratio=0.0)
    batch = replay.sample(12000)
    passed = replay.rules.passes(batch["action"])
    assert torch.equal(batch["next", "pose"][passed], batch["pose"][passed])
    batch = batch[batch["hindsight"] & replay.rules.command(batch["action"], batch["turn"]).final]
    scale = torch.tensor([2.0, 2.0, math.radians(2.0)])
    noise = torch.randn(len(batch), 3, generator=torch.Generator().manual_seed(7)) * scale
    truth = replay.rules.take_turn(batch["pose"], batch["goal"], batch["turn"], batch["action"], batch["epsilon"], noise)
    told, real = (float((reward == 20).float().mean()) for reward in (batch["next", "reward"], truth.reward))
    assert 0.3 < real < 0.95
    assert abs(told - real) < 0.05


def test_shared_learners_get_all_four_mirror_images(memory_of):
    plain, mirrored = (memory_of(strategy="none", random_ratio=0.0, symmetry=symmetry) for symmetry in (False, True))
    known = {tuple(round(x, 2) for x in row[:2]) for row in plain[:]["achieved_goal"].tolist()}
    batch = mirrored.sample(2000)
    images = {
        number: sum(tuple(round(x, 2) for x in row[:2]) in known for row in element.pose(batch["pose"]).tolist()) / 2000
        for number, element in enumerate(GROUP)
    }
    assert all(0.2 < share < 0.35 for share in images.values())


def test_reward_function_that_torchrl_asks_for_is_the_rule_book(memory_of):
    replay = memory_of()
    rows = replay[:]
    reward = replay.reward_fn(rows)[:, 0]
    turn = replay.rules.turn_of(rows["previous_arm"][:, 0])
    again = replay.rules.take_turn(rows["achieved_goal"], rows["desired_goal"], turn, rows["action"], rows["epsilon"][:, 0])
    assert torch.equal(reward, again.reward)
    assert set(reward.tolist()) == {20.0, -30.0, -1.0, -0.5}
