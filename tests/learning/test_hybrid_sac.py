"""The losses of the hybrid SAC: what they expect, what they train, what they leave alone."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch

from marl_handover.learning.hybrid_sac import HybridSac, chosen_action, squashed_sample, unpacked
from marl_handover.learning.networks import arm_blocks
from marl_handover.learning.variant import Variant
from marl_handover.task.observations import observe


@pytest.fixture(scope="module", params=["A", "B"])
def replay(replay_of, request):
    return replay_of(request.param, steps=40)


@pytest.fixture
def learner(replay, small) -> HybridSac:
    torch.manual_seed(1)
    config = small("sac", "algorithm.mixture_components=2", "algorithm.candidates=4")
    return Variant().algorithm(replay.rules, config, torch.Generator().manual_seed(2))


@pytest.fixture
def batch(replay):
    return replay.sample(64)


def gradients(module):
    return sum(0.0 if p.grad is None else float(p.grad.abs().sum()) for p in module.parameters())


def weights(module):
    return [parameter.detach().clone() for parameter in module.parameters()]


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def noise_of(learner, batch):
    return learner._gaussian((len(batch), 2, learner.config.mixture_components, 2))


def critic_loss(learner, batch, **changed):
    torch.manual_seed(5)
    present, following = unpacked(batch)
    noise = torch.randn(len(batch), 2, learner.config.mixture_components, 2)
    return learner.loss.critic_loss(present, {**following, **changed}, noise)


def test_critic_loss_trains_the_critic_only(learner, batch):
    critic_loss(learner, batch).backward()
    assert gradients(learner.loss.critic) > 0
    assert gradients(learner.loss.actor) == gradients(learner.loss.target) == 0
    assert learner.loss.log_temperatures.grad is None


def test_an_update_steps_each_part_from_its_own_loss(learner, batch):
    learner.update(batch)  # leaves the actor loss's gradients on the critic behind
    clean = deepcopy(learner)
    clean.critic_optimizer.zero_grad()
    frozen = deepcopy(learner)
    before = {name: weights(getattr(learner.loss, name)) for name in ("actor", "critic", "target")}
    for group in frozen.actor_optimizer.param_groups:
        group["lr"] = 0.0
    for one in (learner, clean, frozen):
        one.generator = torch.Generator().manual_seed(7)
        one.update(batch)
    after = {name: weights(getattr(learner.loss, name)) for name in before}
    assert not any(same(before[name], after[name]) for name in before)
    assert same(after["critic"], weights(clean.loss.critic)), "gradients of the actor loss reached the critic's step"
    assert same(after["critic"], weights(frozen.loss.critic)), "the critic's step depends on the actor's"
    assert same(before["actor"], weights(frozen.loss.actor)), "the critic's loss moved the actor"
    tau = learner.config.tau
    for old, now, critic in zip(before["target"], after["target"], after["critic"], strict=True):
        torch.testing.assert_close(now, (1 - tau) * old + tau * critic)


def test_optimizers_hold_disjoint_parameters(learner):
    held = {
        name: {id(p) for group in part.param_groups for p in group["params"]}
        for name, part in learner.modules().items()
        if isinstance(part, torch.optim.Optimizer)
    }
    assert held["actor_optimizer"] == {id(p) for p in learner.loss.actor.parameters()}
    assert held["critic_optimizer"] == {id(p) for p in learner.loss.critic.parameters()}
    assert held["temperature_optimizer"] == {id(learner.loss.log_temperatures)}


def test_only_unfinished_transitions_bootstrap(learner, batch):
    over = torch.ones(len(batch), dtype=torch.bool)
    before = {flag: float(critic_loss(learner, batch, terminated=flag & over).detach()) for flag in (True, False)}
    with torch.no_grad():
        for parameter in learner.loss.target.parameters():
            parameter.add_(1.0)
    assert float(critic_loss(learner, batch, terminated=over).detach()) == before[True]
    assert float(critic_loss(learner, batch, terminated=~over).detach()) != before[False]


def test_terminated_target_is_the_scaled_reward(learner, batch):
    """With a critic that is zero everywhere, the loss is twice the mean squared scaled reward."""
    with torch.no_grad():
        for parameter in learner.loss.critic.parameters():
            parameter.zero_()
    reward = torch.randn(len(batch))
    loss = critic_loss(learner, batch, terminated=torch.ones(len(batch), dtype=torch.bool), reward=reward)
    assert float(loss.detach()) == pytest.approx(2 * float((learner.config.reward_scale * reward).square().mean()), rel=1e-5)


def test_candidates_draw_the_mean_only_where_they_are_better(learner, batch):
    present, _ = unpacked(batch)
    own = learner.loss.actor(present["observation"]).mean.tanh()
    mean = own.detach()
    anywhere, still = torch.rand(len(batch), 2, 8, 2) * 2 - 1, torch.zeros(len(batch), 2, 1, 2)
    assert learner.loss._candidate_loss(present, own, mean, still) == 0  # no better than what is there
    learner.config.candidate_margin = 1e6
    assert learner.loss._candidate_loss(present, own, anywhere, still) == 0  # not better by enough
    learner.config.candidate_margin = 0.0
    loss = learner.loss._candidate_loss(present, own, anywhere, still)
    loss.backward()
    assert loss > 0
    assert gradients(learner.loss.actor) > 0
    assert gradients(learner.loss.critic) == 0


def test_what_is_kept_is_the_average_of_the_actors_last_steps(learner, batch):
    kept = [parameter.clone() for parameter in learner.actor().parameters()]
    for _ in range(3):
        learner.update(batch)
        trained = list(learner.loss.actor.parameters())
        kept = [old + learner.config.actor_tau * (new.detach() - old) for old, new in zip(kept, trained, strict=True)]
    for own, expected in zip(learner.actor().parameters(), kept, strict=True):
        torch.testing.assert_close(own, expected, rtol=1e-5, atol=1e-7)
    assert any(bool((own != new).any()) for own, new in zip(learner.actor().parameters(), trained, strict=True))


def test_value_is_the_mean_over_sampled_branches(learner, batch, replay):
    """The exact expectation against 200,000 branches drawn from the policy, with values looked up through the rule book."""
    learner.loss.log_temperatures.data = torch.tensor([-0.5, 0.3])
    row, rules, critic = batch[:1], replay.rules, learner.loss.critic
    present, _ = unpacked(row)
    noise = noise_of(learner, row)
    with torch.no_grad():
        exact = learner.loss.soft_value(critic, present, noise)
        branches = learner.loss.actor(present["observation"])
        place, place_log_prob = squashed_sample(branches, noise)
        log_prob = branches.logits.flatten().log_softmax(-1)
        choices = branches.logits.shape[-1]
        value = torch.empty(2 * choices)
        for branch in range(2 * choices):
            arm, choice = divmod(branch, choices)
            blocks = present["observation"].view(1, 2, -1)
            if choice == 0:
                value[branch] = critic.value_final(blocks[:, arm]).amin()
                continue
            action = torch.tensor([[-1.0, 2.0 * arm - 1.0, *place[0, arm, choice - 1]]])
            placed, feasible = rules.transfer(present["pose"], present["goal"], rules.decode(action))
            last = torch.where(feasible, arm, present["previous_arm"])  # an arm that does not reach the object has not moved it
            after = observe(rules, "relative", placed, present["goal"], last, present["epsilon"]).view(1, 2, -1)
            q = critic.value_place(after if arm == 0 else after.flip(1)).amin()
            value[branch] = q - learner.loss.log_temperatures[0].exp() * place_log_prob[0, arm, choice - 1]
        drawn = torch.multinomial(log_prob.exp(), 200_000, replacement=True)
        returns = (value - learner.loss.log_temperatures[1].exp() * log_prob)[drawn]
    error = float(returns.std()) / len(drawn) ** 0.5
    assert float(exact.value) == pytest.approx(float(returns.mean()), abs=5 * error + 1e-5)
    assert float(exact.probability.sum()) == pytest.approx(1.0, abs=1e-5)


def test_exploration_draws_the_branches_by_their_probability(learner, batch):
    learner.config.random_place = learner.config.deterministic_env_fraction = 0.0
    observation = batch["observation"][:1].expand(20_000, -1)
    action = learner.explore(observation)
    probability = learner.loss.actor(observation[:1]).logits.flatten().softmax(-1).view(2, -1)
    for arm in range(2):
        rows = action[:, 1] == 2 * arm - 1
        final = rows & (action[:, 0] > 0)
        assert float(rows.double().mean()) == pytest.approx(float(probability[arm].sum()), abs=0.02)
        assert float(final.double().mean()) == pytest.approx(float(probability[arm, 0]), abs=0.02)
    assert action.abs().max() <= 1
    if learner.rules.external_finish:
        assert (action[:, 0] < 0).all()


def test_chosen_action_takes_the_largest_logit():
    logits = torch.tensor([[[0.0, 1.0, 2.0], [0.5, 0.1, 0.2]], [[0.0, 1.0, 2.0], [3.0, 0.1, 0.2]]])
    place = torch.arange(16.0).view(2, 2, 2, 2) / 20
    action = chosen_action(logits, place)
    torch.testing.assert_close(action[0], torch.tensor([-1.0, -1.0, 0.1, 0.15]))
    assert action[1, :2].tolist() == [1.0, 1.0]


def test_temperature_rises_while_its_entropy_is_too_low(learner):
    for which, surplus in ((0, -1.0), (1, 1.0)):
        entropy = torch.zeros(2)
        entropy[which] = surplus
        learner.loss.log_temperatures.grad = None
        learner.loss.temperature_loss(entropy[1], entropy[0], (0.0, 0.0)).backward()
        gradient = learner.loss.log_temperatures.grad
        assert gradient[which] * surplus > 0  # descent raises the temperature where the surplus is negative
        assert gradient[1 - which] == 0


def test_afterstates_are_what_the_rule_book_says_follows(learner, batch):
    """Also for arms that refuse, after which the previous arm stays what it was."""
    present, _ = unpacked(batch)
    place = torch.rand(len(batch), 2, 1, 2) * 2 - 1
    blocks, penalty = learner.loss.afterstates(present, place)
    for arm in range(2):
        action = torch.cat([torch.tensor([[-1.0, 2.0 * arm - 1]]).expand(len(batch), 2), place[:, arm, 0]], -1)
        rules = learner.rules
        result = rules.step(present["pose"], present["goal"], present["previous_arm"], action, epsilon_rad=present["epsilon"])
        after = torch.where(result.feasible, arm, present["previous_arm"])
        seen = arm_blocks(observe(rules, "relative", result.placed, present["goal"], after, present["epsilon"]))
        commanded = result.transfers > (result.external_arm >= 0)  # architecture A ignores commands of solved problems
        torch.testing.assert_close(blocks[commanded, arm, 0], seen.roll(-arm, -2)[commanded])
        expected = learner.loss.config.reward_scale * rules.motion_penalty(torch.full((len(batch),), arm), present["pose"], result.placed)
        torch.testing.assert_close(penalty[commanded, arm, 0], expected[commanded])
    assert not result.feasible.all()
