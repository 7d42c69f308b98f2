"""The learners of arms that take turns: what they expect, what they share, what they see; and that training them works."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from marl_handover.baselines.decentralised import PASS, PLACE, Decentralised
from marl_handover.commands.train import resumed
from marl_handover.compose import compose
from marl_handover.config import DecentralisedConfig, TaskConfig
from marl_handover.envs.decentralised import DecentralisedEnv
from marl_handover.errors import InvalidSetting
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.learning.trainer import Trainer
from marl_handover.policies import ExactPolicy
from marl_handover.task.episode import play
from marl_handover.task.observations import ARM_FIELDS
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome

LEARNERS = ("independent", "shared", "ctde")
FIELDS = len(ARM_FIELDS)
PASSING = torch.tensor([-1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def variant():
    return Decentralised()


@pytest.fixture
def learner_of(paper, small, variant):
    def make(learners, *overrides):
        torch.manual_seed(1)
        config = small("sac", "variant=decentralised", f"decentralised.learners={learners}", *overrides)
        config.validate()
        return variant.algorithm(variant.rules(paper, config.task, config), config, torch.Generator().manual_seed(2))

    return make


def made_up(paper, count, learners, seed=0):
    """A batch as the memory gives it, of random decisions that need not be true."""
    random = torch.Generator().manual_seed(seed)
    poses = [sample_problems(paper, count, random, torch.float32) for _ in range(2)]
    action = torch.rand(count, 3, generator=random) * 2 - 1

    def came(pose):
        reward, flag = torch.rand(count, generator=random) * 10 - 5, torch.rand(count, generator=random) < 0.3
        return {"pose": pose, "reward": reward, "terminated": flag}

    batch = {
        "pose": poses[0][0],
        "goal": poses[0][1],
        "epsilon": torch.full((count,), 0.1),
        "turn": torch.arange(count) % 2,
        "action": action,
    }
    batch |= {"hindsight": torch.zeros(count, dtype=torch.bool), "next": came(poses[1][0])}
    if learners != "ctde":
        batch["later"] = {"action": action.flip(0), **came(poses[1][1])}
    return TensorDict(batch, [count])


@pytest.mark.parametrize("learners", LEARNERS)
def test_targets_count_every_decision_once(learner_of, paper, learners):
    """Discounts and rewards by hand: r, or r + g r' up to the own next turn; nothing after the end."""
    learner = learner_of(learners, "algorithm.gamma=0.9")
    batch = made_up(paper, 40, learners)
    present, following = learner.parts[0][0].unpacked(batch)
    for row in range(40):
        first = batch["next"][row]
        if learners == "ctde":
            reward, discount, turn, pose = first["reward"], 0.9 * (not first["terminated"]), 1 - batch["turn"][row], first["pose"]
        else:
            second = batch["later"][row]
            reward = first["reward"] + (0.0 if first["terminated"] else 0.9 * second["reward"])
            discount = 0.81 * (not first["terminated"] and not second["terminated"])
            turn, pose = batch["turn"][row], second["pose"]
        assert float(following["reward"][row]) == pytest.approx(float(reward), abs=1e-5)
        assert float(following["discount"][row]) == pytest.approx(discount, abs=1e-6)
        assert following["turn"][row] == turn
        assert torch.equal(following["pose"][row], pose)
    assert torch.equal(present["passed"], batch["action"][:, 0] < -1 / 3)


@pytest.mark.parametrize("learners", ["shared", "ctde"])
def test_soft_value_is_the_sum_over_what_one_arm_can_choose(learner_of, paper, learners):
    learner = learner_of(learners, "algorithm.mixture_components=2")
    loss = learner.parts[0][0]
    state, _ = loss.unpacked(made_up(paper, 12, learners))
    noise = torch.randn(12, 1, 2, 2, generator=torch.Generator().manual_seed(3))
    found = loss.soft_value(loss.critic, state, noise).value
    branches = loss.actor(state["observation"])
    heat = loss.log_temperatures.exp()
    for row in range(12):
        raw = branches.mean[row, 0] + branches.log_std[row, 0].exp() * noise[row, 0]
        probability = branches.logits[row, 0].softmax(-1)
        one = {key: value[row : row + 1] for key, value in state.items()}
        values = [loss.critic.value_final(one["observation"]).min(), loss.critic.value_place(one["blocks"], torch.ones(1)).min()]
        for mode in range(2):
            place = raw[mode].tanh()
            after, _ = loss.afterstates(one, place[None, None, None])
            normal = torch.distributions.Normal(branches.mean[row, 0, mode], branches.log_std[row, 0, mode].exp())
            density = (normal.log_prob(raw[mode]) - torch.log(1 - place**2)).sum()
            values.append(loss.critic.value_place(after).min() - heat[0] * density)
        expected = sum(p * (value - heat[1] * p.log()) for p, value in zip(probability, values, strict=True))
        torch.testing.assert_close(found[row], expected, atol=1e-3, rtol=1e-3)


def test_afterstates_are_where_the_acting_arm_puts_the_object(learner_of, paper):
    learner = learner_of("ctde")
    loss, rules = learner.parts[0][0], learner.rules
    state, _ = loss.unpacked(made_up(paper, 30, "ctde"))
    place = torch.rand(30, 1, 1, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1
    after, _ = loss.afterstates(state, place)
    action = torch.cat([torch.zeros(30, 1), place[:, 0, 0]], -1)
    placed = rules.take_turn(state["pose"], state["goal"], state["turn"], action).placed
    expected = loss.blocks(placed, state["goal"], state["turn"], state["epsilon"])
    torch.testing.assert_close(after[:, 0, 0], expected)
    env = DecentralisedEnv(30, paper, TaskConfig())
    seen = env.view(placed, state["goal"], state["turn"], state["epsilon"], torch.zeros(30))
    torch.testing.assert_close(expected[:, 0], seen[:, :FIELDS])


@pytest.mark.parametrize(("learners", "sees"), [("independent", False), ("shared", False), ("ctde", True)])
def test_only_a_centralised_critic_sees_the_other_arms_block(learner_of, paper, learners, sees):
    loss = learner_of(learners).parts[0][0]
    state, _ = loss.unpacked(made_up(paper, 20, learners))
    other = state["blocks"].clone()
    other[:, 1] += 1.0
    same = torch.equal(loss.critic.value_place(state["blocks"]), loss.critic.value_place(other))
    assert same is not sees


def test_independent_learners_share_nothing(learner_of, paper):
    """What R lived through does not move a single weight of L."""
    batch = made_up(paper, 32, "independent")
    other = batch.clone()
    for key in ("pose", "goal", "action"):
        other[key][1::2] = batch[key][1::2].flip(0)
    other["next"]["reward"][1::2] += 3.0
    one, two = (learner_of("independent") for _ in range(2))
    one.update(batch)
    two.update(other)
    left, right = ([list(learner.parts[arm][0].parameters()) for learner in (one, two)] for arm in (0, 1))
    assert all(torch.equal(a, b) for a, b in zip(*left, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(*right, strict=True))
    assert not {id(p) for p in one.parts[0][0].parameters()} & {id(p) for p in one.parts[1][0].parameters()}


@pytest.mark.parametrize("learners", LEARNERS)
def test_an_update_moves_every_part(learner_of, paper, learners):
    learner = learner_of(learners)
    losses = learner.parts[0][0](made_up(paper, 32, learners))
    assert all(torch.isfinite(value) for value in losses.values())
    before = [parameter.clone() for loss, _, _ in learner.parts for parameter in loss.parameters()]
    learner.update(made_up(paper, 32, learners))
    after = [parameter for loss, _, _ in learner.parts for parameter in loss.parameters()]
    assert all(not torch.equal(one, other) for one, other in zip(before, after, strict=True))


def test_an_arm_that_always_passes_learns_to_do_better(learner_of, paper):
    """A branch of probability 1e-9 that is clearly better gets likelier; the gradient of the expected value alone would be as small."""
    learner = learner_of("shared", "algorithm.candidates=0")
    loss = learner.parts[0][0]
    state, _ = loss.unpacked(made_up(paper, 64, "shared"))
    with torch.no_grad():
        loss.actor.net[-1].bias[PASS] += 20.0
        loss.critic.final.biases[-1] += 10.0
    branches = loss.actor(state["observation"])
    assert (branches.logits.softmax(-1)[..., PASS] > 0.999).all()
    none = torch.zeros(0, 1, 0, 2)
    value, _, _ = loss.actor_loss(state, torch.zeros(64, 1, 1, 2), none, none)
    value.backward()
    assert loss.actor.net[-1].bias.grad[0] < -0.5
    assert loss.actor.net[-1].bias.grad[PASS] > 0.5


def test_exploration_does_not_wait_for_an_arm_that_waits(learner_of, paper):
    env = DecentralisedEnv(400, paper, TaskConfig(), seed=1)
    seen = env.reset()["observation"]
    reaches = seen[:, ARM_FIELDS.index("reaches_object")] > 0
    waited = torch.arange(400) % 2 == 0
    seen[:, FIELDS + 1] = waited.float()
    learner = learner_of("shared")
    with torch.no_grad():
        learner.actors[0].net[-1].bias[PASS] += 50.0
    passed = learner.rules.passes(learner.explore(seen))
    assert torch.equal(passed, ~(reaches & waited))
    assert learner.rules.passes(learner.act(seen)).all()


@pytest.mark.parametrize("learners", LEARNERS)
def test_each_arm_asks_its_own_network(learner_of, paper, learners):
    learner = learner_of(learners)
    env = DecentralisedEnv(50, paper, TaskConfig(), seed=1)
    seen = env.reset()["observation"]
    left, right = (seen[:, FIELDS] == side for side in (-1.0, 1.0))
    before = learner.act(seen)
    with torch.no_grad():
        for parameter in learner.average[0].parameters():
            parameter.add_(0.3)
    after = learner.act(seen)
    assert not torch.equal(before[left], after[left])
    assert torch.equal(before[right], after[right]) is (learners == "independent")


def test_episodes_in_which_both_pass_time_out_and_have_used_up_their_time(learner_of, variant, paper):
    learner = learner_of("shared")
    problems = sample_problems(paper, 50, torch.Generator().manual_seed(1), torch.float32)
    with torch.no_grad():
        learner.average[0].net[-1].bias[PASS] += 1e3
    episodes = variant.play(learner, *problems)
    assert (episodes.outcome == int(Outcome.TIMEOUT)).all()
    assert (episodes.transfers == learner.rules.config.max_steps).all()
    assert torch.equal(episodes.pose, problems[0])
    assert learner.parts[0][0].actor.components == 1
    assert PLACE == PASS + 1


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_nobody_moves_where_the_policy_says_nothing(paper, rules_of, architecture):
    """Half of the episodes of an exact policy are left alone from their second decision on."""
    rules = rules_of(paper, architecture)
    start, goal = (part.numpy() for part in sample_problems(paper, 200, torch.Generator().manual_seed(3)))
    exact = ExactPolicy(rules)
    whole = play(rules, exact.act, start, goal)
    shown = []

    def act(pose, goal, previous):
        action = exact.act(pose, goal, previous)
        action[(previous >= 0) & (goal[:, 0] > 0)] = math.nan
        return action

    cut = play(rules, act, start, goal, observer=lambda decision: shown.append(decision.result.transfers.sum()))
    first = 2 if architecture == "A" else 1  # A: a transfer, and the external one after it
    idle = (goal[:, 0] > 0) & (whole.transfers > first)
    assert idle.sum() > 30
    assert (cut.outcome[idle] == int(Outcome.TIMEOUT)).all()
    assert (cut.transfers[idle] == rules.config.max_steps).all(), "or waiting for ever would shorten the mean"
    for part, kept in zip(cut, whole, strict=True):
        assert (part[~idle] == kept[~idle]).all()
    assert sum(shown) == cut.transfers[~idle].sum() + idle.sum(), "what is seen of an idle one is its single transfer"


@pytest.mark.parametrize("learners", LEARNERS)
def test_a_resumed_run_is_the_uninterrupted_run(small, table, tmp_path, learners):
    overrides = (
        "variant=decentralised",
        f"decentralised.learners={learners}",
        "evaluation_interval=128",
        "checkpoint_interval=192",
        "evaluation_episodes=20",
    )
    whole = Trainer(small("sac", *overrides, "steps=320"), tmp_path / "whole")
    whole.run()
    half = Trainer(small("sac", *overrides, "steps=320"), tmp_path / "half")

    def die(row):
        if row["step"] >= 256:
            raise KeyboardInterrupt

    half.on_evaluation = die
    with pytest.raises(KeyboardInterrupt):
        half.run()
    continued = resumed(tmp_path / "half")
    assert 192 <= continued.counters.step < 256
    continued.run()
    for one, other in zip(whole.algorithm.losses.parameters(), continued.algorithm.losses.parameters(), strict=True):
        assert torch.equal(one, other)
    assert continued.counters.gradient_step == whole.counters.gradient_step > 0
    assert table(tmp_path / "half") == table(tmp_path / "whole")


@pytest.mark.slow
def test_arms_without_a_supervisor_learn_to_work_together(small, tmp_path):
    stage = "curriculum=[{epsilon_low_deg:15,epsilon_high_deg:15}]"
    pace = ("learning_starts=500", "env_steps_per_gradient_step=8", "batch_size=96", "actor_hidden=[64,64]", "critic_hidden=[64,64]")
    own = (f"algorithm.{setting}" for setting in pace)
    watch = ("num_envs=32", "steps=8192", "evaluation_episodes=300", "evaluation_interval=100000", "task.epsilon_deg=15", stage)
    config = small("sac", "variant=decentralised", "decentralised.learners=shared", *own, *watch)
    assert Trainer(config, tmp_path).run()["validation"]["success_rate"] > 0.85  # (1.00, 1.00)


def test_only_transfers_count_as_steps(small, tmp_path):
    trainer = Trainer(small("sac", "variant=decentralised"), tmp_path)
    decided = moved = 0
    for _ in range(20):
        collected = trainer.collector.collect(trainer.algorithm.random_action)
        executed = collected.transition["next", "executed"]
        assert torch.equal(executed[:, 0], collected.transition["action"][:, 0] >= -1 / 3)
        assert collected.steps == int(executed.sum())
        decided, moved = decided + 16, moved + collected.steps
    assert 0.5 < moved / decided < 0.8


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ("task.architecture=A", "architecture"),
        ("source=aec", "source"),
        ("task.noise.observed_mm=1", "task.noise.observed_mm"),
        ("task.noise.observed_deg=1", "task.noise.observed_deg"),
        ("centralised.motion=flat", "centralised.motion"),
        ("workers=3", "workers"),
        ("replay.correct_terminated=false", "correct_terminated"),
        ("replay.capacity=900", "capacity"),
        ("algorithm.batch_size=33", "batch_size"),
        ("decentralised.pass_reward=0.1", "pass_reward"),
    ],
)
def test_what_cannot_be_is_refused_by_name(small, setting, named):
    with pytest.raises(InvalidSetting, match=named):
        small("sac", "variant=decentralised", "decentralised.learners=independent", setting).validate()


def test_passing_for_ever_never_pays_and_one_pass_is_cheaper_than_a_transfer():
    """The default price of a pass, against the longest plan that problems need, at the default discount."""
    config = compose(TrainConfig, [], groups={"algorithm": ALGORITHMS})
    gamma, reward, wait = config.algorithm.gamma, config.task.reward, DecentralisedConfig().pass_reward
    solution = sum(gamma**k * reward.step for k in range(config.task.max_steps - 1)) + gamma ** (config.task.max_steps - 1) * reward.success
    assert wait / (1 - gamma) < solution
    for transfers in range(1, 7):
        plan = [sum(gamma**k * reward.step for k in range(n - 1)) + gamma ** (n - 1) * reward.success for n in (transfers, transfers + 1)]
        assert wait + gamma * plan[0] > plan[1]
