"""TD3 on all four numbers of the action at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ValueOperator
from torchrl.objectives import SoftUpdate, TD3Loss

from marl_handover.config import bounded
from marl_handover.learning.algorithm import Algorithm, register_algorithm
from marl_handover.learning.networks import action_spec, mlp
from marl_handover.learning.settings import OffPolicyConfig, TrainConfig
from marl_handover.task.observations import observation_size
from marl_handover.task.rules import Rules


@dataclass
class Td3Config(OffPolicyConfig):
    """TD3 on the boxed action."""

    name: str = "td3"
    learning_rate: float = bounded(5e-4, 1e-8, 10.0)
    hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))
    policy_delay: int = bounded(2, 1, 1000)
    exploration_std: float = bounded(0.3, 0.0, 10.0)
    random_action: float = bounded(0.2, 0.0, 1.0)  # share of exploration actions drawn uniformly
    target_noise: float = bounded(0.1, 0.0, 10.0)


class StateActionValue(nn.Module):
    """Q(observation, action) of one network: (n, size), (n, actions) -> (n, 1)."""

    def __init__(self, inputs: int, hidden: list[int], actions: int) -> None:
        super().__init__()
        self.net = mlp(inputs + actions, hidden, 1)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Values of a batch."""
        return self.net(torch.cat([observation, action], -1))


@register_algorithm(Td3Config)
class Td3(Algorithm):
    """TD3: deterministic policy, delayed, with smoothed targets; TorchRL's own loss."""

    kind = "box"
    stored = ("loss", "actor_optimizer", "value_optimizer")
    config: Td3Config

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        inputs = observation_size(rules.config.layout)
        self.net = mlp(inputs, self.config.hidden, rules.action_size).to(self.device)
        policy = TensorDictModule(nn.Sequential(self.net, nn.Tanh()), in_keys=["observation"], out_keys=["action"])
        network = StateActionValue(inputs, self.config.hidden, rules.action_size).to(self.device)
        value = ValueOperator(network, in_keys=["observation", "action"])
        spec = action_spec(rules.action_size, self.device)
        loss = TD3Loss(policy, value, num_qvalue_nets=2, loss_function="l2", action_spec=spec, policy_noise=self.config.target_noise)
        self.loss = loss.to(self.device)
        self.loss.make_value_estimator(gamma=self.config.gamma)
        self.target = SoftUpdate(self.loss, tau=self.config.tau)
        rate = self.config.learning_rate
        self.actor_optimizer = torch.optim.Adam(list(loss.actor_network_params.flatten_keys().values()), lr=rate, fused=True)
        self.value_optimizer = torch.optim.Adam(list(loss.qvalue_network_params.flatten_keys().values()), lr=rate, fused=True)
        self.updates = 0

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
        noise = self._gaussian(action.shape) * self.config.exploration_std
        uniform = self.random_action(observation)
        random = self._uniform((len(action), 1)) < self.config.random_action
        return torch.where(random, uniform, (action + noise).clamp(-1, 1))

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
