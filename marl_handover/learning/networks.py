"""Networks of the supervisor. Small on purpose: good features and few gradient steps win (method section 4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.data import Bounded

from marl_handover.cell import Cell
from marl_handover.task.observations import ARM_FIELDS, ODD_FIELDS

LOG_STD_RANGE = (-6.0, 1.0)


def mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Linear layers with ReLU between: (..., inputs) -> (..., outputs)."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ReLU()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


class TwinMLP(nn.Module):
    """Two scalar networks of one shape, evaluated in one batched product: (n, inputs) -> (2, n); with layer norm if ``normalised``."""

    def __init__(self, inputs: int, hidden: Sequence[int], normalised: bool = True) -> None:
        super().__init__()
        self.normalised = normalised
        widths = [inputs, *hidden, 1]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_in, fan_out in pairwise(widths):
            bound = 1 / math.sqrt(fan_in)
            self.weights.append(nn.Parameter(torch.empty(2, fan_in, fan_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(2, 1, fan_out).uniform_(-bound, bound)))

    def forward(self, x: Tensor) -> Tensor:
        """Both networks' values."""
        x = x.expand(2, *x.shape)
        last = len(self.weights) - 1
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if index < last:
                x = F.relu(F.layer_norm(x, (x.shape[-1],)) if self.normalised else x)
        return x[..., 0]


class Canonicalize(nn.Module):
    """Folds the symmetry M_x: turns each arm's block so that the sine of its hand-over angle is never negative.

    Where the hand-over has no bearing (that sine is 0), the sine of the finishing error decides.
    """

    odd: Tensor

    def __init__(self, enabled: bool) -> None:
        super().__init__()
        self.enabled = enabled
        self.index = (ARM_FIELDS.index("sin_hand_over"), ARM_FIELDS.index("sin_finish_error"))
        odd = torch.tensor([-1.0 if name in ODD_FIELDS else 1.0 for name in ARM_FIELDS])
        self.register_buffer("odd", odd, persistent=False)

    def forward(self, blocks: Tensor) -> tuple[Tensor, Tensor]:
        """Blocks (..., m, fields) are turned by the sign, (..., 1), of their first block; both are returned."""
        hand_over, finish = (blocks[..., 0, index : index + 1] for index in self.index)
        first = torch.where(hand_over == 0, finish, hand_over)
        sign = torch.where(first < 0, -1.0, 1.0) if self.enabled else torch.ones_like(first)
        return torch.where(sign[..., None] < 0, blocks * self.odd, blocks), sign


ANGLES = (("cos_finish_error", "sin_finish_error"), ("cos_hand_over", "sin_hand_over"))


class AngleFeatures(nn.Module):
    """Appends the cosines and sines of 2, 4, ... 2^count times each angle of a block, for sharper functions of it."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count
        self.index = [(ARM_FIELDS.index(cosine), ARM_FIELDS.index(sine)) for cosine, sine in ANGLES]
        self.width = len(ARM_FIELDS) + 2 * len(ANGLES) * count

    def forward(self, blocks: Tensor) -> Tensor:
        """Blocks (..., fields) -> (..., width)."""
        parts = [blocks]
        for cosine_index, sine_index in self.index:
            cosine, sine = blocks[..., cosine_index], blocks[..., sine_index]
            for _ in range(self.count):
                cosine, sine = cosine.square() - sine.square(), 2 * sine * cosine
                parts.append(torch.stack([cosine, sine], -1))
        return torch.cat(parts, -1)


class ActionDistribution(NamedTuple):
    """What the actor says of every branch. Branch 0 of an arm is final, the others are its mixture components.

    Attributes:
        logits: (n, num_arms, 1 + components).
        mean: (n, num_arms, components, 2), of (alpha, beta) before the tanh, in table coordinates.
        log_std: like ``mean``.
    """

    logits: Tensor
    mean: Tensor
    log_std: Tensor


def squashed(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Reparametrised numbers in (-1, 1) and their log-densities, elementwise."""
    raw = mean + log_std.exp() * noise
    log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    # log(1 - tanh(x)^2), stable at saturation
    log_prob = log_prob - 2 * (math.log(2) - raw - F.softplus(-2 * raw))
    return raw.tanh(), log_prob  # in this order: gradients are summed in the order of what they come through


def squashed_sample(branches: ActionDistribution, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Reparametrised places (n, arms, components, 2) in (-1, 1) and their log-densities (n, arms, components)."""
    place, log_prob = squashed(branches.mean, branches.log_std, noise)
    return place, log_prob.sum(-1)


def chosen_action(logits: Tensor, place: Tensor, noise: Tensor | None = None) -> Tensor:
    """Actions (n, 4) of the branch with the largest logit, after adding ``noise`` to the flattened logits.

    ``logits`` (n, arms, 1 + components); ``place`` (n, arms, components, 2).
    """
    flat = logits.flatten(1) if noise is None else logits.flatten(1) + noise
    branch = flat.argmax(-1)
    arm, choice = branch // logits.shape[-1], branch % logits.shape[-1]
    rows = torch.arange(len(logits), device=logits.device)
    where = place[rows, arm, (choice - 1).clamp_min(0)]
    final = torch.where(choice == 0, 1.0, -1.0)
    return torch.cat([torch.stack([final, 2.0 * arm - 1.0], -1), where], -1)


def arm_blocks(observation: Tensor) -> Tensor:
    """The ``relative`` layout (..., num_arms * fields) as one block an arm (..., num_arms, fields)."""
    return observation.unflatten(-1, (-1, len(ARM_FIELDS)))


class HybridActor(nn.Module):
    """One network for both arms, each seeing the problem in its own mirrored frame.

    Args:
        cell: the cell, for how each arm sees it.
        hidden: widths.
        components: mixture components an arm.
        can_finish: whether there is a final branch (architecture B); without one its logit is minus infinity.
        canonical: fold the symmetry M_x, where the cell has it.
        harmonics: see :class:`AngleFeatures`.
    """

    place_sign: Tensor

    def __init__(self, cell: Cell, hidden: Sequence[int], components: int, can_finish: bool, canonical: bool, harmonics: int) -> None:
        super().__init__()
        self.components, self.can_finish = components, can_finish
        self.canonicalize, self.features = Canonicalize(canonical), AngleFeatures(harmonics)
        self.net = mlp(self.features.width, hidden, 1 + 5 * components)
        last = self.net[-1]
        if components > 1 and isinstance(last, nn.Linear):  # start the components apart, so that they do not learn the same thing
            with torch.no_grad():
                last.bias[1 + components : 1 + 3 * components : 2] = torch.linspace(-0.8, 0.8, components)
        self.register_buffer("place_sign", torch.tensor(cell.views, dtype=torch.float32), persistent=False)

    def forward(self, observation: Tensor) -> ActionDistribution:
        """ActionDistribution of observations (n, size) of the ``relative`` layout."""
        blocks, sign = self.canonicalize(arm_blocks(observation).unsqueeze(-2))
        out = self.net(self.features(blocks.squeeze(-2)))
        components = self.components
        logits = out[..., : 1 + components]
        if not self.can_finish:
            logits = torch.cat([torch.full_like(logits[..., :1], -1e9), logits[..., 1:]], -1)
        mean = out[..., 1 + components : 1 + 3 * components].unflatten(-1, (components, 2))
        log_std = out[..., 1 + 3 * components :].unflatten(-1, (components, 2)).clamp(*LOG_STD_RANGE)
        across, along = (self.place_sign[:, axis, None].expand(mean.shape[:-1]) for axis in range(2))
        return ActionDistribution(logits, mean * torch.stack([sign * across, along], -1), log_std)


class AfterstateCritic(nn.Module):
    """Twin values of the branches.

    Where an arm puts the object is known from kinematics, so the value of placing it is read off the observation that
    *follows* (the acting arm's block first), and the value of finishing off the acting arm's present block.
    """

    def __init__(self, place_hidden: Sequence[int], final_hidden: Sequence[int], canonical: bool, harmonics: int) -> None:
        super().__init__()
        self.canonicalize, self.features = Canonicalize(canonical), AngleFeatures(harmonics)
        self.place = TwinMLP(2 * self.features.width, place_hidden)
        self.final = TwinMLP(self.features.width, final_hidden)

    def value_place(self, following: Tensor) -> Tensor:
        """Values (2, ...) of afterstates (..., 2, fields): the acting arm's block, then the other's."""
        blocks, _ = self.canonicalize(following)
        return self.place(self.features(blocks).flatten(-2).flatten(0, -2)).unflatten(-1, following.shape[:-2])

    def value_final(self, block: Tensor) -> Tensor:
        """Values (2, ...) of finishing, from the acting arm's blocks (..., fields)."""
        blocks, _ = self.canonicalize(block.unsqueeze(-2))
        return self.final(self.features(blocks.squeeze(-2)).flatten(0, -2)).unflatten(-1, block.shape[:-1])


def action_spec(actions: int, device: torch.device) -> Bounded:
    """The action space of one cell."""
    return Bounded(-1.0, 1.0, shape=(actions,), device=device)
