"""The paper's view of the action: all four numbers in one box. SAC and TD3."""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ValueOperator
from torchrl.objectives import SoftUpdate, TD3Loss

from marl_handover.learning.algorithm import Algorithm, compiled, stepped
from marl_handover.learning.algorithm_settings import BoxSacConfig, Td3Config
from marl_handover.learning.networks import Branches, TwinMLP, mlp, squashed_sample
from marl_handover.learning.settings import TrainConfig
from marl_handover.task.observations import observation_size
from marl_handover.task.rules import Rules

BOX_LOG_STD_RANGE = (-20.0, 2.0)
"""As Stable-Baselines3 has it."""


class StateActionValue(nn.Module):
    """Q(observation, action) of one network: (n, size), (n, actions) -> (n, 1)."""

    def __init__(self, inputs: int, hidden: list[int], actions: int) -> None:
        super().__init__()
        self.net = mlp(inputs + actions, hidden, 1)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Values of a batch."""
        return self.net(torch.cat([observation, action], -1))


class BoxSacLoss(nn.Module):
    """The losses of SAC on one squashed Gaussian of all numbers, with both values in one batched product.

    Args:
        net: observations (n, size) -> (n, 2 * actions): means, then logarithms of deviations.
        value: observation and action (n, size + actions) -> (2, n).
        config: the algorithm's settings.
    """

    def __init__(self, net: nn.Sequential, value: TwinMLP, config: BoxSacConfig) -> None:
        super().__init__()
        self.net, self.value, self.config = net, value, config
        self.target = copy.deepcopy(value).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.zeros(()))

    def drawn(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (n, actions) of standard normal ``noise``, and their log-densities (n,)."""
        mean, log_std = self.net(observation).float().chunk(2, -1)
        return squashed_sample(Branches(mean, mean, log_std.clamp(*BOX_LOG_STD_RANGE)), noise)

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


class BoxSac(Algorithm):
    """SAC as the paper used it, with the usual target entropy: minus the number of numbers."""

    kind = "box"
    config: BoxSacConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        inputs, size, hidden = observation_size(rules.config.layout), rules.action_size, self.config.hidden
        value = TwinMLP(inputs + size, hidden, normalised=False)
        self.loss = BoxSacLoss(mlp(inputs, hidden, 2 * size), value, self.config).to(self.device)
        rate = self.config.learning_rate
        self.actor_optimizer = torch.optim.Adam(self.loss.net.parameters(), lr=rate, fused=True)
        self.value_optimizer = torch.optim.Adam(self.loss.value.parameters(), lr=rate, fused=True)
        self.temperature_optimizer = torch.optim.Adam([self.loss.log_temperature], lr=rate)
        self._value_loss = compiled(self.loss.value_loss, config.compile)
        self._actor_loss = compiled(self.loss.actor_loss, config.compile)

    def actor(self) -> nn.Module:
        """The network from observation to action parameters; its first outputs are the mean before the tanh."""
        return self.loss.net

    def modules(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """The loss module holds all networks and the temperature."""
        return {
            "loss": self.loss,
            "actor_optimizer": self.actor_optimizer,
            "value_optimizer": self.value_optimizer,
            "temperature_optimizer": self.temperature_optimizer,
        }

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
        return torch.randn(count, self.rules.action_size, generator=self.generator, device=self.device)


class Td3(Algorithm):
    """TD3: deterministic policy, delayed, with smoothed targets; TorchRL's own loss."""

    kind = "box"
    config: Td3Config

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        inputs = observation_size(rules.config.layout)
        self.net = mlp(inputs, self.config.hidden, rules.action_size).to(self.device)
        policy = TensorDictModule(nn.Sequential(self.net, nn.Tanh()), in_keys=["observation"], out_keys=["action"])
        network = StateActionValue(inputs, self.config.hidden, rules.action_size).to(self.device)
        value = ValueOperator(network, in_keys=["observation", "action"])
        spec = box_spec(rules.action_size, self.device)
        loss = TD3Loss(policy, value, num_qvalue_nets=2, loss_function="l2", action_spec=spec, policy_noise=self.config.target_noise)
        self.loss = loss.to(self.device)
        self.loss.make_value_estimator(gamma=self.config.gamma)
        self.target = SoftUpdate(self.loss, tau=self.config.tau)
        rate = self.config.learning_rate
        self.actor_optimizer = torch.optim.Adam(list(loss.actor_network_params.flatten_keys().values()), lr=rate, fused=True)
        self.value_optimizer = torch.optim.Adam(list(loss.qvalue_network_params.flatten_keys().values()), lr=rate, fused=True)
        self.updates = 0

    def modules(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """Loss module (actor, values, targets) and optimisers."""
        return {"loss": self.loss, "actor_optimizer": self.actor_optimizer, "value_optimizer": self.value_optimizer}

    def actor(self) -> nn.Module:
        """The network from observation to action before the tanh."""
        return self.net

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The policy's action."""
        return self.net(observation).tanh()

    def state_dict(self) -> dict[str, Any]:
        """As the base class, and the count that delays the policy."""
        return {**super().state_dict(), "updates": self.updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        super().load_state_dict(state)
        self.updates = state["updates"]

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """The policy's action with Gaussian noise, or a uniform one."""
        action = self.act(observation)
        noise = torch.randn(action.shape, generator=self.generator, device=self.device) * self.config.exploration_std
        uniform = self.blind(observation)
        blind = torch.rand(len(action), 1, generator=self.generator, device=self.device) < self.config.random_action
        return torch.where(blind, uniform, (action + noise).clamp(-1, 1))

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One step of the critics; every ``policy_delay``-th also of the policy and the targets."""
        batch = batch.clone(recurse=False)
        batch["next"] = batch["next"].clone(recurse=False)
        batch["next", "reward"] = batch["next", "reward"] * self.config.reward_scale
        losses: TensorDict = self.loss(batch)
        self.value_optimizer.zero_grad()
        self.actor_optimizer.zero_grad()
        (losses["loss_qvalue"] + losses["loss_actor"]).backward()
        self.value_optimizer.step()
        self.updates += 1
        if self.updates % self.config.policy_delay == 0:
            self.actor_optimizer.step()
            self.target.step()
        return {"loss_critic": losses["loss_qvalue"].detach(), "loss_actor": losses["loss_actor"].detach()}


def box_spec(actions: int, device: torch.device) -> Bounded:
    """The action space of one cell."""
    return Bounded(-1.0, 1.0, shape=(actions,), device=device)
