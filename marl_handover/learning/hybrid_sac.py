"""Hybrid SAC: soft actor-critic for a choice (arm, final, mixture component) with a continuous place (alpha, beta) in some of its branches.

The expectation over the branches is exact: V = sum_i p_i [Q_i - a_place log pi_i(place)] - a_branch sum_i p_i log p_i, where
the final branches have no place. Two temperatures, one for each kind of choice. Besides the soft gradient, the actor's mean
is drawn towards the best of a few random places wherever the critic finds that place better by a margin: gradients alone
leave some states in a poor local optimum, and a deterministic policy then cycles there for ever.
"""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from marl_handover.learning.algorithm import Algorithm, compiled, register_algorithm, stepped
from marl_handover.learning.networks import AfterstateCritic, HybridActor, arm_blocks, chosen_action, squashed_sample
from marl_handover.learning.settings import SacConfig, TrainConfig
from marl_handover.task.observations import observe
from marl_handover.task.rules import Command, Rules

Network = TypeVar("Network", bound=nn.Module)


class SoftValue(NamedTuple):
    """Soft value (n,) of a policy, with what it was made of."""

    value: Tensor
    probability: Tensor  # (n, arms, 1 + components)
    branch_entropy: Tensor  # (n,)
    place_log_prob: Tensor  # (n, arms, components)
    mean: Tensor  # (n, arms, components, 2), in (-1, 1)


class HybridSacLoss(LossModule):
    """The three losses, over one batch of judged transitions (see :class:`HindsightReplayBuffer`)."""

    actor: HybridActor
    critic: AfterstateCritic
    target: AfterstateCritic

    def __init__(self, rules: Rules, actor: HybridActor, critic: AfterstateCritic, target: AfterstateCritic, config: SacConfig) -> None:
        super().__init__()
        self.rules, self.config = rules, config
        self.actor, self.critic, self.target = actor, critic, target
        start = math.log(config.initial_temperature)
        self.log_temperatures = nn.Parameter(torch.tensor([start, start]))  # of places, of branches

    def afterstates(self, batch: dict[str, Tensor], place: Tensor) -> tuple[Tensor, Tensor]:
        """What follows if each arm placed at ``place`` (n, arms, m, 2), and what the way there costs.

        Blocks (n, arms, m, 2, fields), the acting arm's first, and (n, arms, m): an afterstate does not know where it was come from.
        ``batch`` gives ``pose``, ``goal``, ``previous_arm`` and ``epsilon``.
        """
        arms = self.rules.cell.num_arms
        shape = place.shape[:-1]
        arm = torch.arange(arms, device=place.device)[:, None].expand(shape)
        command = Command(
            torch.zeros(shape, dtype=torch.bool, device=place.device), arm, self.rules.cell.shared.to_table(place[..., 0], place[..., 1])
        )
        pose, goal = (batch[key][:, None, None].expand(*shape, 3) for key in ("pose", "goal"))
        before, epsilon = (batch[key][:, None, None].expand(shape) for key in ("previous_arm", "epsilon"))
        placed, feasible = self.rules.transfer(pose, goal, command)
        blocks = arm_blocks(observe(self.rules, "relative", placed, goal, torch.where(feasible, arm, before), epsilon))
        penalty = self.config.reward_scale * self.rules.motion_penalty(arm, pose, placed)
        return torch.stack([blocks[:, index].roll(-index, -2) for index in range(arms)], 1), penalty

    def soft_value(self, critic: AfterstateCritic, batch: dict[str, Tensor], noise: Tensor) -> SoftValue:
        """Soft value of the present policy under ``critic``, from ``pose``, ``goal``, ``epsilon`` and ``observation``."""
        branches = self.actor(batch["observation"])
        place, place_log_prob = squashed_sample(branches, noise)
        following, penalty = self.afterstates(batch, place)
        place_value = critic.value_place(following).amin(0) - penalty
        final_value = critic.value_final(arm_blocks(batch["observation"])).amin(0)
        temperature = self.log_temperatures.detach().exp()
        log_probability = branches.logits.flatten(1).log_softmax(-1).view_as(branches.logits)
        probability = log_probability.exp()
        branch_entropy = -(probability * log_probability).sum((-2, -1))
        value = (
            (probability[..., 1:] * (place_value - temperature[0] * place_log_prob)).sum((-2, -1))
            + (probability[..., 0] * final_value).sum(-1)
            + temperature[1] * branch_entropy
        )
        return SoftValue(value, probability, branch_entropy, place_log_prob, branches.mean.tanh())

    def critic_loss(self, batch: dict[str, Tensor], following: dict[str, Tensor], noise: Tensor) -> Tensor:
        """Squared error of both critics on the branch that was taken, summed over the two."""
        with torch.no_grad():
            future = self.soft_value(self.target, following, noise).value
            alive = torch.where(following["terminated"], 0.0, 1.0)
            target = self.config.reward_scale * following["reward"] + self.config.gamma * alive * future
        blocks, after = arm_blocks(batch["observation"]), arm_blocks(following["observation"])
        second = batch["arm"][:, None, None] == 1
        own = torch.where(second, blocks.flip(-2), blocks)[:, 0]
        after = torch.where(second, after.flip(-2), after)
        penalty = self.config.reward_scale * self.rules.motion_penalty(batch["arm"], batch["pose"], following["pose"])
        value = torch.where(batch["final"], self.critic.value_final(own), self.critic.value_place(after) - penalty)
        return (value - target).square().mean(1).sum()

    def actor_loss(self, batch: dict[str, Tensor], noise: Tensor, candidates: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Loss of the actor, then the mean branch entropy and the mean place entropy, for the temperatures."""
        soft = self.soft_value(self.critic, batch, noise)
        weight = soft.probability[..., 1:].detach()
        place_entropy = -(weight * soft.place_log_prob).sum() / weight.sum().clamp_min(1e-6)
        loss = -soft.value.mean()
        if candidates.numel():
            some = {key: value[: len(candidates)] for key, value in batch.items()}
            loss = loss + self.config.candidate_weight * self._candidate_loss(some, soft.mean[: len(candidates)], candidates, offsets)
        return loss, soft.branch_entropy.mean().detach(), place_entropy.detach()

    def _candidate_loss(self, batch: dict[str, Tensor], mean: Tensor, candidates: Tensor, offsets: Tensor) -> Tensor:
        """Squared distance of each arm's best component to the *nearest* of some places that beat it by the margin.

        The nearest, not the best: between two equally good regions, drawing towards now one, now the other would leave the
        mean in the bad middle. The places are ``candidates`` (n, arms, m, 2), and the ``mean`` (n, arms, components, 2) moved by
        ``offsets`` (n, arms, k, 2).
        """
        components = mean.shape[2]
        with torch.no_grad():
            component_value, component = self._place_value(batch, mean).max(-1)
        chosen = mean.gather(2, component[..., None, None].expand(-1, -1, 1, 2)) if components > 1 else mean
        with torch.no_grad():
            places = torch.cat([candidates, (chosen + offsets).clamp(-1.0, 1.0)], 2)
            gain = self._place_value(batch, places) - component_value[..., None] - self.config.candidate_margin
        distance = (chosen - places).square().sum(-1)
        nearest = torch.where(gain > 0, distance.detach(), torch.inf).argmin(-1, keepdim=True)
        weight = gain.gather(-1, nearest).clamp(0.0, 1.0)
        return (weight * distance.gather(-1, nearest)).sum((-2, -1)).mean()

    def _place_value(self, batch: dict[str, Tensor], places: Tensor) -> Tensor:
        """The lower of both critics' values (n, arms, m) of places (n, arms, m, 2)."""
        following, penalty = self.afterstates(batch, places)
        return self.critic.value_place(following).amin(0) - penalty

    def temperature_loss(self, branch_entropy: Tensor, place_entropy: Tensor, targets: tuple[float, float]) -> Tensor:
        """Raises a temperature whose entropy (of places, of branches) is below its target."""
        surplus = torch.stack([place_entropy - targets[0], branch_entropy - targets[1]])
        return (self.log_temperatures.exp() * surplus).sum()

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """``loss_qvalue`` and ``loss_actor`` of a sampled batch, TorchRL style; training uses the parts above."""
        batch, following = unpacked(tensordict)
        shape = (len(tensordict), self.rules.cell.num_arms, self.actor.components, 2)
        noise = torch.randn(2, *shape, device=tensordict.device)
        none = torch.zeros(0, shape[1], 0, 2, device=tensordict.device)
        critic = self.critic_loss(batch, following, noise[0])
        actor, branch, place = self.actor_loss(batch, noise[1], none, none)
        return TensorDict({"loss_qvalue": critic, "loss_actor": actor, "entropy_branch": branch, "entropy_place": place})


def averaging(module: Network) -> Network:
    """A copy to hold the average of a module that is trained; without gradients."""
    return copy.deepcopy(module).requires_grad_(False)


def unpacked(batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Plain dictionaries, cheap to compile over, of a sampled batch: the present and what followed."""
    present = {
        "observation": batch["observation"],
        "pose": batch["achieved_goal"],
        "goal": batch["desired_goal"],
        "epsilon": batch["epsilon"][:, 0],
        "previous_arm": batch["previous_arm"][:, 0],
        "arm": batch["arm"][:, 0],
        "final": batch["final"][:, 0],
    }
    following = {
        "previous_arm": batch["next", "previous_arm"][:, 0],
        "observation": batch["next", "observation"],
        "pose": batch["next", "achieved_goal"],
        "goal": batch["desired_goal"],
        "epsilon": batch["epsilon"][:, 0],
        "reward": batch["next", "reward"][:, 0],
        "terminated": batch["next", "terminated"][:, 0],
    }
    return present, following


@register_algorithm(SacConfig)
class HybridSac(Algorithm):
    """Networks, optimisers and temperatures around :class:`HybridSacLoss`."""

    kind = "hybrid"
    stored = ("loss", "average", "actor_optimizer", "critic_optimizer", "temperature_optimizer")
    config: SacConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        own = self.config
        can_finish = not rules.external_finish
        actor = HybridActor(rules.cell, own.actor_hidden, own.mixture_components, can_finish, self.folds, own.harmonics).to(self.device)
        critic = AfterstateCritic(own.critic_hidden, own.final_hidden, self.folds, own.harmonics).to(self.device)
        target = AfterstateCritic(own.critic_hidden, own.final_hidden, self.folds, own.harmonics).to(self.device).requires_grad_(False)
        target.load_state_dict(critic.state_dict())
        self.loss = HybridSacLoss(rules, actor, critic, target, own).to(self.device)
        self._optimise(actor, critic, [self.loss.log_temperatures])
        self._critic_loss = compiled(self.loss.critic_loss, config.compile)
        self._actor_loss = compiled(self.loss.actor_loss, config.compile)

    def _optimise(self, actor: nn.Module, critic: nn.Module, temperatures: list[nn.Parameter]) -> None:
        """Make the optimisers of all three, the actor's average, and the first target entropies."""
        rate = self.config.learning_rate
        self.actor_optimizer = torch.optim.Adam(actor.parameters(), lr=rate, fused=True)
        self.critic_optimizer = torch.optim.Adam(critic.parameters(), lr=rate, fused=True)
        self.temperature_optimizer = torch.optim.Adam(temperatures, lr=self.config.temperature_rate)
        self.average = averaging(actor)
        self.targets = self._targets(0.0)

    @property
    def folds(self) -> bool:
        """Whether the networks fold the symmetry M_x: as the settings say, where the cell has it."""
        return self.config.canonical and self.rules.cell.is_foldable

    def _targets(self, fraction: float) -> tuple[float, float]:
        """Target entropies of places and branches; they fall until ``entropy_until`` so that the last policies are nearly deterministic."""
        own, done = self.config, min(1.0, fraction / self.config.entropy_until)
        place = own.place_entropy_start + done * (own.place_entropy_end - own.place_entropy_start)
        branch = own.branch_entropy_start * (own.branch_entropy_end / own.branch_entropy_start) ** done
        return place, branch

    def schedule(self, fraction: float) -> None:
        """Learning rate and target entropies."""
        super().schedule(fraction)
        for group in self.temperature_optimizer.param_groups:
            group["lr"] = self.config.temperature_rate
        self.targets = self._targets(fraction)

    def trained(self) -> nn.Module:
        """The policy network that is trained, and explores."""
        return self.loss.actor

    def actor(self) -> nn.Module:
        """The policy network that is judged and kept: an average over the last steps. After a single one it is good here and bad there."""
        return self.average

    def about(self) -> dict[str, Any]:
        """How the actor reads its blocks."""
        return {"modes": self.config.mixture_components, "canonical": self.folds, "harmonics": self.config.harmonics}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`; a checkpoint from before there was an average starts one from the actor it has."""
        older = {} if "average" in state else {"average": self.trained().state_dict()}
        super().load_state_dict({**state, **older})
        if older:
            self.average.load_state_dict(self.trained().state_dict())

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """A branch and a place drawn from the policy."""
        branches = self.loss.actor(observation)
        # Some cells follow the deterministic policy: where that goes in circles, its states must get into the memory.
        exploring = torch.arange(len(observation), device=self.device) >= int(self.config.deterministic_env_fraction * len(observation))
        place, _ = squashed_sample(branches, self._gaussian(branches.mean.shape) * exploring[:, None, None, None])
        uniform = self._uniform(branches.logits.flatten(1).shape)
        gumbel = -(-uniform.clamp_min(1e-20).log()).log()
        anywhere = self._uniform(place.shape[:-1]) < self.config.random_place
        anywhere &= exploring[:, None, None]
        place = torch.where(anywhere[..., None], self.uniform.spread(self._anywhere(place.shape)), place)
        return chosen_action(branches.logits, place, gumbel * exploring[:, None])

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The likeliest branch and its mean place."""
        branches = self.average(observation)
        return chosen_action(branches.logits, branches.mean.tanh())

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One step of the critics, the actor, the temperatures and the target."""
        present, following = unpacked(batch)
        shape = (len(batch), self.rules.cell.num_arms, self.config.mixture_components, 2)
        critic_loss = self._critic_loss(present, following, self._gaussian(shape))
        stepped(self.critic_optimizer, critic_loss)
        tried = (int(shape[0] * self.config.candidate_share), shape[1], self.config.candidates, 2)
        self.loss.critic.requires_grad_(False)
        actor_loss, branch_entropy, place_entropy = self._actor_loss(
            present, self._gaussian(shape), self._anywhere(tried), self._nearby(tried)
        )
        stepped(self.actor_optimizer, actor_loss)
        self.loss.critic.requires_grad_(True)
        stepped(self.temperature_optimizer, self.loss.temperature_loss(branch_entropy, place_entropy, self.targets))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.loss.target.parameters()), list(self.loss.critic.parameters()), self.config.tau)
            self._average()
        return {
            "loss_critic": critic_loss.detach(),
            "loss_actor": actor_loss.detach(),
            "entropy_branch": branch_entropy,
            "entropy_place": place_entropy,
            "temperature_place": self.loss.log_temperatures.detach()[0].exp(),
            "temperature_branch": self.loss.log_temperatures.detach()[1].exp(),
        }

    def _average(self) -> None:
        """Let the average follow the trained actor by a step."""
        torch._foreach_lerp_(list(self.average.parameters()), list(self.trained().parameters()), self.config.actor_tau)

    def _nearby(self, shape: tuple[int, ...]) -> Tensor:
        """Offsets in the chart, of sizes from a hundredth to a third."""
        return 10 ** -(0.5 + 1.5 * self._uniform((*shape[:-1], 1))) * self._gaussian(shape)
