"""Laws of the networks: mirror symmetry, the batched twins, the doubled angles."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn import functional as F
from torchrl.modules import TanhNormal

from marl_handover.learning.hybrid_sac import squashed_sample
from marl_handover.learning.networks import ActionDistribution, AngleFeatures, HybridActor, TwinMLP, arm_blocks
from marl_handover.learning.variant import Variant
from marl_handover.task.observations import ARM_FIELDS, observe
from tests.symmetries import GROUP, flips_x


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def problems(draw, cell, count=200):
    """Poses, goals and previous arms, torch double."""
    start, goal, previous, _ = draw(cell, count, 3)
    return torch.tensor(start), torch.tensor(goal), torch.tensor(previous)


def seen(rules, pose, goal, previous, symmetry):
    """The observation of the mirrored problem."""
    return observe(rules, "relative", symmetry.pose(pose), symmetry.pose(goal), symmetry.arm(previous))


@pytest.mark.parametrize("symmetry", GROUP)
@pytest.mark.parametrize("can_finish", [True, False])
def test_actor_is_equivariant(cell, rules_of, draw, symmetry, can_finish):
    rules = rules_of(cell)
    actor = HybridActor(cell, [24, 24], components=2, can_finish=can_finish, canonical=True, harmonics=2).double()
    problem = problems(draw, cell)
    plain, mirrored = actor(seen(rules, *problem, GROUP[0])), actor(seen(rules, *problem, symmetry))
    if symmetry.swaps:
        plain = ActionDistribution(*(part.flip(1) for part in plain))
    sign = torch.tensor([-1.0 if flips_x(symmetry) else 1.0, -1.0 if symmetry.swaps else 1.0]).double()
    torch.testing.assert_close(mirrored.logits, plain.logits)
    torch.testing.assert_close(mirrored.mean, plain.mean * sign)
    torch.testing.assert_close(mirrored.log_std, plain.log_std)
    assert plain.mean.abs().min() > 0
    assert bool((plain.logits[..., 0] < -1e8).all()) is not can_finish


def test_actor_that_does_not_fold_is_not_equivariant_along_the_base_line(paper, rules_of, draw):
    actor = HybridActor(paper, [24, 24], components=1, can_finish=True, canonical=False, harmonics=2).double()
    problem, rules = problems(draw, paper), rules_of(paper)
    logits = {symmetry: actor(seen(rules, *problem, symmetry)).logits for symmetry in GROUP}
    along, across = (next(s for s in GROUP if (flips_x(s), s.swaps) == kind) for kind in ((True, False), (False, True)))
    assert (logits[along] - logits[GROUP[0]]).abs().max() > 1e-2
    torch.testing.assert_close(logits[across].flip(1), logits[GROUP[0]])


@pytest.mark.parametrize("symmetry", GROUP)
def test_critic_is_invariant(cell, rules_of, draw, small, symmetry):
    rules = rules_of(cell)
    critic = Variant().algorithm(rules, small("sac", "algorithm.canonical=true"), torch.Generator()).loss.critic.double()
    problem = problems(draw, cell)
    plain, mirrored = (arm_blocks(seen(rules, *problem, element)) for element in (GROUP[0], symmetry))
    if symmetry.swaps:
        mirrored = mirrored.flip(1)
    torch.testing.assert_close(critic.value_final(mirrored), critic.value_final(plain))
    torch.testing.assert_close(critic.value_place(mirrored), critic.value_place(plain))
    assert critic.value_place(plain).shape == (2, len(plain))
    assert critic.value_final(plain).shape == (2, len(plain), 2)
    assert (critic.value_place(plain)[0] - critic.value_place(plain)[1]).abs().max() > 1e-3


def test_twin_product_is_two_networks():
    twin, x = TwinMLP(7, [5, 4]), torch.randn(11, 7)
    for which, found in enumerate(twin(x)):
        h = x
        for index, (weight, bias) in enumerate(zip(twin.weights, twin.biases, strict=True)):
            h = F.linear(h, weight[which].T, bias[which, 0])
            if index < 2:
                h = F.relu((h - h.mean(-1, keepdim=True)) / (h.var(-1, keepdim=True, correction=0) + 1e-5).sqrt())
        torch.testing.assert_close(found, h[:, 0])


def test_a_gradient_of_one_twin_leaves_the_other_alone():
    twin = TwinMLP(3, [4])
    twin(torch.randn(6, 3))[0].sum().backward()
    for parameter in twin.parameters():
        assert parameter.grad[0].abs().sum() > 0
        assert parameter.grad[1].abs().sum() == 0


@pytest.mark.parametrize("count", [0, 1, 3])
def test_harmonics_are_the_doubled_angles(count):
    harmonics = AngleFeatures(count)
    angles = torch.rand(50, 2, dtype=torch.float64) * 2 * math.pi
    block = torch.randn(50, len(ARM_FIELDS), dtype=torch.float64)
    for column, name in enumerate(("finish_error", "hand_over")):
        block[:, ARM_FIELDS.index(f"cos_{name}")] = angles[:, column].cos()
        block[:, ARM_FIELDS.index(f"sin_{name}")] = angles[:, column].sin()
    out = harmonics(block)
    assert out.shape == (50, harmonics.width)
    torch.testing.assert_close(out[:, : len(ARM_FIELDS)], block)
    expected = [f(2**k * angles[:, column]) for column in range(2) for k in range(1, count + 1) for f in (torch.cos, torch.sin)]
    if count:
        torch.testing.assert_close(out[:, len(ARM_FIELDS) :], torch.stack(expected, -1))


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (1.2, -1.0), (-0.4, 0.5), (2.0, -2.5)])
def test_density_of_places_integrates_to_one(mean, log_std):
    raw = torch.linspace(mean - 9 * math.exp(log_std), mean + 9 * math.exp(log_std), 20_001, dtype=torch.float64)
    noise = ((raw - mean) / math.exp(log_std))[:, None, None, None]
    branches = ActionDistribution(torch.zeros(1), torch.full_like(noise, mean), torch.full_like(noise, log_std))
    place, log_prob = squashed_sample(branches, noise)
    torch.testing.assert_close(place.flatten(), raw.tanh())
    assert float(torch.trapezoid(log_prob.flatten().exp(), place.flatten())) == pytest.approx(1.0, abs=1e-4)


def test_density_of_places_is_torchrls():
    mean, log_std, noise = torch.randn(3, 40, 2, 3, 2, dtype=torch.float64)
    log_std = 0.5 * log_std - 0.5
    place, log_prob = squashed_sample(ActionDistribution(torch.zeros(1), mean, log_std), noise)
    torch.testing.assert_close(log_prob, TanhNormal(mean, log_std.exp()).log_prob(place), rtol=1e-4, atol=1e-4)
    assert torch.isfinite(squashed_sample(ActionDistribution(torch.zeros(1), 1000 * mean, log_std), noise)[1]).all()
