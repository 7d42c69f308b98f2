"""The paper's view of the action: SAC on all four numbers at once, in one squashed Gaussian."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from marl_handover.config import bounded
from marl_handover.learning.algorithm import Algorithm, compiled, register_algorithm, stepped
from marl_handover.learning.networks import ActionDistribution, TwinMLP, mlp, squashed_sample
from marl_handover.learning.settings import OffPolicyConfig, TrainConfig
from marl_handover.task.observations import observation_size
from marl_handover.task.rules import Rules

FLAT_LOG_STD_RANGE = (-20.0, 2.0)
"""As Stable-Baselines3 has it."""


@dataclass
class FlatSacConfig(OffPolicyConfig):
    """SAC with all four action numbers in one squashed Gaussian, thresholded by the environment, as in the paper."""

    name: str = "flat_sac"
    learning_rate: float = bounded(5e-4, 1e-8, 10.0)
    hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))


class FlatSacLoss(nn.Module):
    """The losses of SAC on one squashed Gaussian of all numbers, with both values in one batched product.

    Args:
        net: observations (n, size) -> (n, 2 * actions): means, then logarithms of deviations.
        value: observation and action (n, size + actions) -> (2, n).
        config: the algorithm's settings.
    """

    def __init__(self, net: nn.Sequential, value: TwinMLP, config: FlatSacConfig) -> None:
        super().__init__()
        self.net, self.value, self.config = net, value, config
        self.target = copy.deepcopy(value).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.zeros(()))

    def drawn(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (n, actions) of standard normal ``noise``, and their log-densities (n,)."""
        mean, log_std = self.net(observation).float().chunk(2, -1)
        return squashed_sample(ActionDistribution(mean, mean, log_std.clamp(*FLAT_LOG_STD_RANGE)), noise)

    def value_loss(self, observation: Tensor, action: Tensor, reward: Tensor, terminated: Tensor, after: Tensor, noise: Tensor) -> Tensor:
        """Squared error of both values, summed over the two; ``reward`` and ``terminated`` (n,)."""
        with torch.no_grad():
            following, log_prob = self.drawn(after, noise)
            future = self.target(torch.cat([after, following], -1)).amin(0) - self.log_temperature.exp() * log_prob
            target = self.config.reward_scale * reward + self.config.gamma * torch.where(terminated, 0.0, future)
        return (self.value(torch.cat([observation, action], -1)) - target).square().mean(1).sum()

    def actor_loss(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Loss of the actor, and the mean entropy of its actions, for the temperature."""
        action, log_prob = self.drawn(observation, noise)
        value = self.value(torch.cat([observation, action], -1)).amin(0)
        return (self.log_temperature.detach().exp() * log_prob - value).mean(), -log_prob.mean().detach()


@register_algorithm(FlatSacConfig)
class FlatSac(Algorithm):
    """SAC as the paper used it, with the usual target entropy: minus the number of numbers."""

    kind = "box"
    stored = ("loss", "actor_optimizer", "value_optimizer", "temperature_optimizer")
    config: FlatSacConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        inputs, size, hidden = observation_size(rules.config.layout), rules.action_size, self.config.hidden
        value = TwinMLP(inputs + size, hidden, normalised=False)
        self.loss = FlatSacLoss(mlp(inputs, hidden, 2 * size), value, self.config).to(self.device)
        rate = self.config.learning_rate
        self.actor_optimizer = torch.optim.Adam(self.loss.net.parameters(), lr=rate, fused=True)
        self.value_optimizer = torch.optim.Adam(self.loss.value.parameters(), lr=rate, fused=True)
        self.temperature_optimizer = torch.optim.Adam([self.loss.log_temperature], lr=rate)
        self._value_loss = compiled(self.loss.value_loss, config.compile)
        self._actor_loss = compiled(self.loss.actor_loss, config.compile)

    def actor(self) -> nn.Module:
        """The network from observation to action parameters; its first outputs are the mean before the tanh."""
        return self.loss.net

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """An action drawn from the policy."""
        return self.loss.drawn(observation, self._noise(len(observation)))[0]

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The mean action."""
        return self.loss.net(observation)[..., : self.rules.action_size].tanh()

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One step of the values, the actor, the temperature and the target."""
        seen, following = batch["observation"], batch["next"]
        earned = following["reward"][:, 0], following["terminated"][:, 0]
        value_loss = self._value_loss(seen, batch["action"], *earned, following["observation"], self._noise(len(batch)))
        stepped(self.value_optimizer, value_loss)
        self.loss.value.requires_grad_(False)
        actor_loss, entropy = self._actor_loss(seen, self._noise(len(batch)))
        stepped(self.actor_optimizer, actor_loss)
        self.loss.value.requires_grad_(True)
        stepped(self.temperature_optimizer, self.loss.log_temperature * (entropy + self.rules.action_size))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.loss.target.parameters()), list(self.loss.value.parameters()), self.config.tau)
        return {
            "loss_critic": value_loss.detach(),
            "loss_actor": actor_loss.detach(),
            "temperature_place": self.loss.log_temperature.detach().exp(),
            "entropy_place": entropy,
        }

    def _noise(self, count: int) -> Tensor:
        return self._gaussian((count, self.rules.action_size))
