"""Whole episodes in, goals of the same episode out; every cell and every episode has recognisable poses."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import HERReplayBuffer, LazyTensorStorage

from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.replay import EpisodeWriter, HindsightReplayBuffer
from marl_handover.learning.settings import HindsightConfig, ReplayConfig

EPSILON_RAD = torch.pi / 36


def step_of_all_cells(time, done):
    """One transition of all cells: cell ``i`` goes from (i, time) to (i, time + 1)."""
    count = len(done)
    cell = torch.arange(count, dtype=torch.float32)
    pose = torch.stack([cell, torch.full_like(cell, time), 0 * cell], -1)
    flag = torch.tensor(done)[:, None]
    following = {
        "placed": pose + torch.tensor([0.0, 1.0, 0.0]),
        "feasible": torch.ones_like(flag),
        "epsilon": torch.full((count, 1), 0.1),
        "terminated": flag,
        "done": flag,
    }
    root = {"achieved_goal": pose, "desired_goal": 0 * pose, "previous_arm": flag.long(), "action": torch.zeros(count, 4)}
    return TensorDict({**root, "next": TensorDict(following, [count])}, [count])


@given(st.lists(st.lists(st.booleans(), min_size=3, max_size=3), min_size=1, max_size=25))
@settings(max_examples=30)
def test_writer_hands_over_whole_contiguous_episodes(pattern):
    limit, cells = 6, 3
    writer = EpisodeWriter(cells, limit, torch.device("cpu"))
    begun = [0] * cells
    for time, done in enumerate(pattern):
        done = [flag or time + 1 - begun[cell] == limit for cell, flag in enumerate(done)]
        rows = writer.add(step_of_all_cells(time, done))
        expected = []
        for cell in range(cells):
            if done[cell]:
                length = time + 1 - begun[cell]
                expected += [(cell, begun[cell] + index, index, length - 1 - index) for index in range(length)]
                begun[cell] = time + 1
        if not expected:
            assert rows is None
            continue
        found = torch.cat([rows["achieved_goal"][:, :2], rows["elapsed"], rows["remaining"]], -1)
        assert found.tolist() == [list(map(float, row)) for row in expected]
        assert torch.equal(rows["placed"][:, 1], rows["achieved_goal"][:, 1] + 1)
        assert torch.equal(rows["terminated"][:, 0], rows["remaining"][:, 0] == 0)


def test_writer_continues_from_its_state():
    one, other = (EpisodeWriter(2, 5, torch.device("cpu")) for _ in range(2))
    for time in range(3):
        one.add(step_of_all_cells(time, [False, time == 1]))
    other.load_state_dict(one.state_dict())
    last = step_of_all_cells(3, [True, True])
    assert (one.add(last) == other.add(last)).all()


def memory(paper, rules_of, capacity, seed=0, **hindsight):
    env = SupervisorEnv(1, paper, rules_of(paper).config, seed=seed)
    hindsight = {"ratio": 1.0, "random_ratio": 0.0, "near_miss_ratio": 0.5, "near_miss_epsilons": 1.5, **hindsight}
    config = ReplayConfig(capacity=capacity, hindsight=HindsightConfig(**hindsight))
    return HindsightReplayBuffer(env.rules, config, env, torch.Generator().manual_seed(seed))


def assert_goals_of_own_episode(batch, strategy, last_step):
    """Goals are poses of the row's own episode that the strategy allows, turned by 1.5 epsilon at most."""
    chosen = batch["hindsight"][:, 0]
    own, goal = batch["next", "achieved_goal"][chosen], batch["desired_goal"][chosen]
    assert torch.equal(goal[:, 0], own[:, 0]), "a goal leaked from another episode"
    assert (goal[:, 2].abs() <= 1.5 * EPSILON_RAD + 1e-6).all()
    final = torch.tensor([last_step[int(number)] for number in own[:, 0]], dtype=torch.float32)
    assert (goal[:, 1] >= 0).all()
    assert (goal[:, 1] <= final).all()
    if strategy == "final":
        assert torch.equal(goal[:, 1], final)
    if strategy == "future":
        assert (goal[:, 1] >= own[:, 1]).all()
    kept = batch["desired_goal"][~chosen]
    assert (kept == torch.tensor([-1.0, -1.0, 0.0])).all()
    # The transition's own result is what makes it final.
    assert torch.equal(batch["final"][chosen, 0], goal[:, 1] == own[:, 1])
    assert not batch["final"][~chosen].any()


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
@given(lengths=st.lists(st.integers(1, 8), min_size=1, max_size=12), seed=st.integers(0, 10_000))
@settings(max_examples=10)
def test_goals_never_leak_across_episodes(paper, rules_of, made_up_episodes, strategy, lengths, seed):
    replay = memory(paper, rules_of, 200, seed, strategy=strategy)
    replay.extend(made_up_episodes(lengths))
    batch = replay.sample(100)
    assert batch["hindsight"].all()
    assert_goals_of_own_episode(batch, strategy, [length - 1 for length in lengths])


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
@given(lengths=st.lists(st.integers(1, 8), min_size=8, max_size=40), seed=st.integers(0, 10_000))
@settings(max_examples=10)
def test_a_full_ring_never_reads_an_overwritten_episode(paper, rules_of, made_up_episodes, strategy, lengths, seed):
    capacity = 24
    replay = memory(paper, rules_of, capacity, seed, strategy=strategy)
    for number, length in enumerate(lengths):
        replay.extend(made_up_episodes([length], first=number))
        batch = replay.sample(40)
        assert_goals_of_own_episode(batch, strategy, [length - 1 for length in lengths])
        if strategy != "episode":  # later rows are always there
            assert batch["hindsight"].all()
    newest = set(range(len(lengths)))
    while sum(lengths[number] for number in newest) - lengths[min(newest)] >= min(capacity, sum(lengths)):
        newest.discard(min(newest))
    assert set(batch["next", "achieved_goal"][:, 0].int().tolist()) <= newest


def test_every_goal_of_an_episode_is_drawn(paper, rules_of, made_up_episodes):
    for strategy, expected in (("future", {2, 3, 4}), ("final", {4}), ("episode", {0, 1, 2, 3, 4})):
        replay = memory(paper, rules_of, 50, strategy=strategy)
        replay.extend(made_up_episodes([3, 5, 4]))
        batch = replay.sample(2000)
        own = batch["next", "achieved_goal"]
        rows = (own[:, 0] == 1) & (own[:, 1] == 2)
        assert set(batch["desired_goal"][rows, 1].int().tolist()) == expected


@pytest.mark.parametrize("ratio", [0.0, 0.25, 0.8])
def test_the_hindsight_ratio_is_kept(paper, rules_of, made_up_episodes, ratio):
    replay = memory(paper, rules_of, 50, ratio=ratio)
    replay.extend(made_up_episodes([5, 5, 5]))
    share = float(replay.sample(4000)["hindsight"].double().mean())
    assert share == pytest.approx(ratio, abs=4 * (ratio * (1 - ratio) / 4000) ** 0.5)


def test_near_misses_fill_their_range_and_ratio(paper, rules_of, made_up_episodes):
    replay = memory(paper, rules_of, 50, near_miss_ratio=0.3, near_miss_epsilons=2.0)
    replay.extend(made_up_episodes([5, 5, 5]))
    turn = replay.sample(4000)["desired_goal"][:, 2].abs() / EPSILON_RAD
    assert float((turn > 0).double().mean()) == pytest.approx(0.3, abs=0.03)
    assert 1.9 < turn.max() <= 2.0 + 1e-5


def test_torchrls_default_relabels_from_before_the_action_and_ours_from_after(paper, rules_of, made_up_episodes):
    """The trap of method section 4: ``achieved_goal`` of the root is the state that the action found, not the one it left."""
    rows = made_up_episodes([4])  # the last action found the object at step 2 and left it at step 3
    done = (rows["remaining"] == 0).clone()
    stock = HERReplayBuffer(
        reward_fn=lambda batch: torch.zeros(len(batch), 1), her_ratio=1.0, strategy="final", storage=LazyTensorStorage(50), batch_size=20
    )
    judged = TensorDict({"done": done, "terminated": done.clone(), "reward": torch.zeros(4, 1)}, [4])
    stock.extend(TensorDict({**rows.select("achieved_goal", "desired_goal"), "next": judged}, [4]))
    assert set(stock.sample()["desired_goal"][:, 1].tolist()) == {2.0}
    ours = memory(paper, rules_of, 50, strategy="final", near_miss_ratio=0.0)
    ours.extend(rows)
    assert set(ours.sample(20)["desired_goal"][:, 1].tolist()) == {3.0}
