"""Training one policy for every cell: what it does is what its file does, resumed is uninterrupted, every row of its memory is true."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from marl_handover import policies
from marl_handover.cell.batch import CellBatch, LayoutPool
from marl_handover.commands.train import resumed
from marl_handover.config import LayoutConfig, TaskConfig
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.checkpoint import policy_arrays, run_arrays, save_policy
from marl_handover.learning.collector import BatchedCollector
from marl_handover.learning.graph_network import HandoverGraphs, chosen
from marl_handover.learning.graph_sac import GraphSac
from marl_handover.learning.replay import HindsightReplayBuffer
from marl_handover.learning.settings import HindsightConfig, ReplayConfig
from marl_handover.learning.trainer import Trainer
from marl_handover.policies.graph_policy import GraphPolicy
from marl_handover.policies.registry import content_hash
from marl_handover.task.observations import observe
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules
from tests.graph_policies import balanced_weights, lead

MIXED = [
    LayoutConfig(arms=[2, 5], r_min_mm=[120.0, 160.0], r_max_mm=[215.0, 260.0], yaw_deg=[60.0, 132.0], obstacles=[0, 3]),
    LayoutConfig(arms=[2, 4], spacing_mm=[60.0, 250.0], apart_mm=60.0, obstacles=[0, 2], radius_mm=[5.0, 20.0]),
]
IN_RANDOM_CELLS = "layouts=[{arms: [2, 4], obstacles: [0, 2]}, {arms: [2, 3], spacing_mm: [80, 250], apart_mm: 70}]"


def learner(small, **settings):
    """A learner of random weights in 40 random cells, a row each, and a problem in each: starts, goals, arms that moved last."""
    pool = LayoutPool.random(MIXED, 40, np.random.default_rng(3))
    cells = CellBatch(pool, np.repeat(np.arange(40), 5))
    rules = Rules(cells, TaskConfig(layout="graph"))
    config = small("graph_sac", *(f"algorithm.{key}={value}" for key, value in settings.items()))
    made = GraphSac(rules, config, torch.Generator().manual_seed(2))
    start, goal = sample_problems(cells, 200, torch.Generator().manual_seed(4), torch.float32)
    previous = torch.from_numpy(np.random.default_rng(5).integers(-1, pool.n_arms[cells.layout]))
    for name, (weight, bias) in balanced_weights(rules, start.double().numpy(), goal.double().numpy(), shape=made.shape).items():
        for network in (made.network, made.average):
            network[name].weight.data.copy_(torch.from_numpy(weight.T))
            network[name].bias.data.copy_(torch.from_numpy(bias))
    return made, config, start, goal, previous


@pytest.mark.parametrize("settings", [{}, {"mixture_components": 1, "rounds": 0}, {"slack": "false", "width": 32}])
def test_the_file_of_a_learner_does_what_the_learner_does(small, settings):
    """In torch and in numpy: the same arms, receivers and ends, and the same hand-over angle."""
    made, config, start, goal, previous = learner(small, **settings)
    arrays = policy_arrays(made, config, "a test")
    policy = GraphPolicy(made.rules, "a test", arrays, {"shape": made.shape._asdict(), "layers": len(made.average)})
    expected = made.act(observe(made.rules, "graph", start, goal, previous)).double().numpy()
    pose, aim = start.double().numpy(), goal.double().numpy()
    found = policy.act(pose, aim, previous.numpy())
    ahead = lead(policy, pose, aim, previous.numpy()) > 3e-3
    assert ahead.mean() > 0.3
    one, other = (made.rules.decode(action) for action in (found, expected))
    np.testing.assert_array_equal(one.final[ahead], other.final[ahead])
    np.testing.assert_array_equal(one.arm[ahead], other.arm[ahead])
    passing = ahead & ~one.final
    assert 20 < passing.sum() < ahead.sum()
    np.testing.assert_array_equal(one.receiver[passing], other.receiver[passing])
    np.testing.assert_allclose(found[passing, -2], expected[passing, -2], atol=2e-4)


@pytest.mark.parametrize("how", ["act", "explore", "random_action"])
def test_actions_lead_to_the_angle_at_which_the_learner_thinks_that_the_next_arm_has_it(small, how, monkeypatch):
    """What the network reckons with, the rule book does: the receiver carries the object at the angle of the place that was chosen."""
    import marl_handover.learning.graph_sac as module

    made, _, start, goal, previous = learner(small)
    choices = []

    def watched(*arguments):
        choices.append((arguments[0], chosen(*arguments)))
        return choices[-1][1]

    monkeypatch.setattr(module, "chosen", watched)
    action = getattr(made, how)(observe(made.rules, "graph", start, goal, previous))
    graph, choice = choices[-1]
    result = made.rules.step(start, goal, previous, action)
    passing = ~choice.final
    edge = choice.edge[passing]
    assert passing.sum() > 30
    assert result.feasible[passing].all()
    receiver = graph.receiver[edge]
    expected = graph.angle[graph.giver[edge]] + graph.middle[edge] + graph.half[edge] * choice.place[passing]
    seen = observe(made.rules, "graph", result.pose, goal, result.previous_arm)
    after = HandoverGraphs(seen, made.rules.cell.num_arms)
    row = {(int(problem), int(arm)): number for number, (problem, arm) in enumerate(zip(after.problem, after.arm, strict=True))}
    rows = [row[int(graph.problem[each]), int(graph.arm[each])] for each in receiver]
    assert after.reaches_object[rows].all()
    away = torch.remainder(after.angle[rows] - expected + math.pi, 2 * math.pi) - math.pi
    assert away.abs().max() < 2e-3


@pytest.mark.parametrize("half_turns", [0, 1])
def test_the_learner_rewards_finishing_as_the_rule_book_does(small, half_turns):
    """Arm by arm: what it says of finishing from the graph alone is what the rule book pays for that final transfer."""
    made, _, start, goal, previous = learner(small)
    goal = goal.clone()
    goal[::2, 2] = start[::2, 2] + half_turns * math.pi  # some of them are nearly there
    graph = made.graphs(observe(made.rules, "graph", start, goal, previous))
    reward, count = made.rules.config.reward, made.rules.cell.num_arms
    earned = made._finish_reward(graph) / made.config.reward_scale
    close = ((graph.angle - graph.goal_angle + math.pi) % (2 * math.pi) - math.pi).abs() - graph.epsilon
    paid = []
    for problem, arm in zip(graph.problem.tolist(), graph.arm.tolist(), strict=True):
        who = torch.full((1, count), -1.0)
        who[0, arm] = 1.0
        action = torch.cat([torch.ones(1, 1), who, who, torch.zeros(1, 2)], -1)
        one = slice(problem, problem + 1)
        rules = Rules(made.rules.cell.take(torch.tensor([problem])), made.rules.config)
        paid.append(float(rules.step(start[one], goal[one], previous[one], action).reward))
    able, sure = graph.reaches_object, close.abs() > 1e-4
    assert 0 < (earned[able] == reward.success).sum() < able.sum()
    np.testing.assert_array_equal(earned[able & sure].numpy(), torch.tensor(paid)[able & sure].numpy())


def test_one_seed_makes_one_run_and_another_another(small, table, tmp_path):
    runs = {}
    for name, seed in (("one", 1), ("same", 1), ("other", 2)):
        trainer = Trainer(
            small("graph_sac", IN_RANDOM_CELLS, "steps=640", "evaluation_interval=320", "evaluation_episodes=20", f"seed={seed}"),
            tmp_path / name,
        )
        trainer.run()
        assert len(trainer.env.layouts) > trainer.config.algorithm.layouts_at_once  # new cells were drawn
        runs[name] = trainer.algorithm.average.state_dict()
    assert table(tmp_path / "one") == table(tmp_path / "same")
    assert table(tmp_path / "one") != table(tmp_path / "other")
    for key, value in runs["one"].items():
        assert torch.equal(value, runs["same"][key])
        assert not torch.equal(value, runs["other"][key])


class Killed(Exception):
    pass


@pytest.mark.parametrize("layouts", [IN_RANDOM_CELLS, "cell=al5a"])
def test_a_resumed_run_is_the_uninterrupted_run(small, table, tmp_path, monkeypatch, layouts):
    """Also once new cells have taken the place of the first ones."""
    settings = (layouts, "steps=960", "evaluation_interval=320", "checkpoint_interval=480", "evaluation_episodes=20")
    whole = Trainer(small("graph_sac", *settings), tmp_path / "whole")
    whole.run()
    killed = Trainer(small("graph_sac", *settings), tmp_path / "killed")
    report = killed._report

    def watched(recorder):
        report(recorder)
        if killed.counters.step >= 640:
            raise Killed

    monkeypatch.setattr(killed, "_report", watched)
    with pytest.raises(Killed):
        killed.run()
    continued = resumed(tmp_path / "killed")
    assert continued.counters.step == 480
    if layouts == IN_RANDOM_CELLS:
        assert len(continued.env.layouts) > continued.config.algorithm.layouts_at_once
        for mine, theirs in zip(continued.env.layouts.layouts, whole.env.layouts.layouts, strict=False):
            np.testing.assert_array_equal(mine[0], theirs[0])
            np.testing.assert_array_equal(mine[1], theirs[1])
    continued.run()
    assert len(continued.env.layouts) == len(whole.env.layouts)
    for name, part in whole.algorithm.modules().items():
        mine = continued.algorithm.modules()[name].state_dict()
        torch.testing.assert_close(mine, part.state_dict(), rtol=0, atol=0)
    mine, theirs = (vars(trainer.counters) for trainer in (continued, whole))
    assert {**mine, "wall_s": 0} == {**theirs, "wall_s": 0}
    assert mine["gradient_step"] > 0
    assert table(tmp_path / "killed") == table(tmp_path / "whole")


def test_a_run_is_its_policy_file(small, tmp_path):
    trainer = Trainer(small("graph_sac", IN_RANDOM_CELLS, "steps=512", "evaluation_interval=256"), tmp_path / "run")
    trainer.run()
    save_policy(tmp_path / "policy.npz", run_arrays(tmp_path / "run"))
    best = trainer.best["actor"]
    arrays = run_arrays(tmp_path / "run")
    for index, name in enumerate(trainer.algorithm.average):
        np.testing.assert_array_equal(arrays[f"weight_{index}"], best[f"{name}.weight"].numpy().T)
        np.testing.assert_array_equal(arrays[f"bias_{index}"], best[f"{name}.bias"].numpy())
    run, file = (policies.load(str(path)) for path in (tmp_path / "run", tmp_path / "policy.npz"))
    cell = policies.load("pretrained_any").rules.cell
    start, goal = (part.numpy() for part in sample_problems(cell, 100, torch.Generator().manual_seed(0)))
    found = [policy.under(Rules(cell, TaskConfig())).act(start, goal, np.full(100, -1)) for policy in (run, file)]
    np.testing.assert_array_equal(*found)
    assert content_hash(str(tmp_path / "run")) == content_hash(str(tmp_path / "policy.npz"))


def memory(steps=120, epsilon_deg=5.0, **settings):
    """A memory of 32 rows of random cells, played by actions that often are possible."""
    pool = LayoutPool.random(MIXED, 24, np.random.default_rng(11))
    env = SupervisorEnv(32, task=TaskConfig(layout="graph", epsilon_deg=epsilon_deg), seed=0, layouts=pool)
    draw = torch.Generator().manual_seed(1)
    replay = HindsightReplayBuffer(env.rules, ReplayConfig(capacity=4000, hindsight=HindsightConfig(**settings)), env, draw)
    collector, count = BatchedCollector(env), env.rules.cell.num_arms
    known = pool.number >= 0

    def explore(observation):
        cells, pose = env.rules_of(collector.current).cell, collector.current["achieved_goal"]
        action = torch.rand(32, 2 * count + 3, generator=draw) * 2 - 1
        action[:, 0] -= 0.7
        reach = cells.reaches(pose)
        action[:, 1 : 1 + count] = torch.where(reach, action[:, 1 : 1 + count], -1.0)
        arm = action[:, 1 : 1 + count].argmax(-1).numpy()
        shares = torch.from_numpy(known[cells.layout, arm])
        action[:, 1 + count : 1 + 2 * count] = torch.where(shares, action[:, 1 + count : 1 + 2 * count], -1.0)
        return action

    for _ in range(steps):
        rows = collector.collect(explore).rows
        if rows is not None:
            replay.extend(rows)
    assert len(replay) > 1000
    return replay, pool


@pytest.mark.parametrize(
    "settings",
    [
        {"strategy": "future", "ratio": 0.7, "near_miss_ratio": 0.4, "random_ratio": 0.3},
        {"strategy": "final", "ratio": 1.0, "near_miss_ratio": 0.0, "random_ratio": 0.0},
        {"strategy": "episode", "ratio": 0.5, "near_miss_ratio": 0.8, "near_miss_epsilons": 2.0, "random_ratio": 0.5},
        {"strategy": "none"},
    ],
)
def test_every_row_of_the_memory_is_judged_so_in_its_own_cell(settings):
    """Reward, end, what is left where, and what is seen of it: each row again, alone, by the rule book of its own cell."""
    replay, pool = memory(**settings)
    batch = replay.sample(150)
    layout = replay.rules.cell.layout
    assert len(np.unique(layout)) == len(pool)
    count, solved = replay.rules.cell.num_arms, 0
    for row in range(150):
        one = Rules(CellBatch(pool, layout[row : row + 1]), replay.rules.config)
        part = batch[row : row + 1]
        epsilon = part["epsilon"][:, 0].double()
        pose, goal = part["achieved_goal"].double(), part["desired_goal"].double()
        truth = one.step(pose, goal, part["previous_arm"][:, 0], part["action"].double(), epsilon_rad=epsilon)
        assert truth.reward.float() == part["next", "reward"][:, 0], row
        assert truth.terminated == part["next", "terminated"][:, 0]
        solved += int(truth.reward > 0)
        if truth.feasible:
            off = (truth.placed.float() - part["next", "achieved_goal"])[0]
            assert off[:2].abs().max() < 1e-2
            assert abs(math.remainder(float(off[2]), 2 * math.pi)) < 1e-4
        if not truth.terminated:
            expected = observe(one, "graph", part["next", "achieved_goal"], part["desired_goal"], truth.previous_arm, part["epsilon"][:, 0])
            np.testing.assert_allclose(part["next", "observation"], expected, atol=1e-5)
        assert bool(one.cell.reaches(goal).any())
    assert count >= 4
    if settings["strategy"] != "none":
        assert batch["hindsight"].float().mean() > 0.2
        assert solved > 3


def test_a_goal_that_is_drawn_anew_lies_where_an_arm_of_that_cell_reaches():
    replay, _ = memory(strategy="future", ratio=0.0, near_miss_ratio=0.0, random_ratio=1.0)
    batch = replay.sample(1000)
    assert replay.rules.cell.reaches(batch["desired_goal"]).any(-1).all()
    own = {tuple(goal) for goal in replay[:]["desired_goal"].tolist()}
    assert sum(tuple(goal) not in own for goal in batch["desired_goal"].tolist()) > 300


def test_validation_is_posed_in_cells_that_training_does_not_draw(small, tmp_path):
    trainer = Trainer(small("graph_sac", IN_RANDOM_CELLS, "evaluation_episodes=80"), tmp_path)
    rules, start, goal, optimal = trainer.validation
    drawn = {arms.tobytes() for arms, _ in trainer.env.layouts.layouts}
    watched = rules.cell.pool.layouts
    assert len(watched) == 20
    assert not drawn & {arms.tobytes() for arms, _ in watched}
    assert (optimal > 0).all()
    assert len(start) == len(goal) == len(optimal) > 60
    again = Trainer(small("graph_sac", IN_RANDOM_CELLS, "evaluation_episodes=80"), tmp_path).validation
    assert torch.equal(start, again.start)


@pytest.mark.slow
def test_a_minute_in_one_cell_teaches_it(small, tmp_path):
    given = ("cell=triangle", "steps=6000", "num_envs=64", "evaluation_interval=100000", "evaluation_episodes=300")
    stage = "curriculum=[{epsilon_low_deg: 5, epsilon_high_deg: 15}]"
    own = [
        f"algorithm.{each}" for each in ("width=32", "rounds=2", "learning_starts=500", "batch_size=64", "env_steps_per_gradient_step=8")
    ]
    trainer = Trainer(small("graph_sac", *given, stage, *own), tmp_path)
    before = trainer.evaluate()["success_rate"]
    after = trainer.run()["validation"]
    assert before < 0.5
    assert after["success_rate"] > 0.8
    assert after["steps_ratio"] < 1.3
