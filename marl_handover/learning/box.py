"""The paper's view of the action: all four numbers in one box. SAC and TD3 with TorchRL's own losses."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate, TD3Loss

from marl_handover.learning.algorithm import Algorithm
from marl_handover.learning.algorithm_settings import BoxSacConfig, OffPolicyConfig, Td3Config
from marl_handover.learning.networks import mlp
from marl_handover.learning.settings import TrainConfig
from marl_handover.task.observations import observation_size
from marl_handover.task.rules import Rules


class StateActionValue(nn.Module):
    """Q(observation, action) of one network: (n, size), (n, actions) -> (n, 1)."""

    def __init__(self, inputs: int, hidden: list[int], actions: int) -> None:
        super().__init__()
        self.net = mlp(inputs + actions, hidden, 1)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Values of a batch."""
        return self.net(torch.cat([observation, action], -1))


class BoxAlgorithm(Algorithm):
    """Shared parts: TorchRL modules, Adam, scaled rewards, target update."""

    kind = "box"
    config: OffPolicyConfig
    net: nn.Sequential

    def _finish(self, loss: Any, actor_parameters: list[nn.Parameter], value_parameters: list[nn.Parameter]) -> None:
        self.loss = loss.to(self.device)
        self.loss.make_value_estimator(gamma=self.config.gamma)
        self.target = SoftUpdate(self.loss, tau=self.config.tau)
        rate = self.config.learning_rate
        self.actor_optimizer = torch.optim.Adam(actor_parameters, lr=rate, fused=True)
        self.value_optimizer = torch.optim.Adam(value_parameters, lr=rate, fused=True)

    def modules(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """Loss module (actor, values, targets) and optimisers."""
        return {"loss": self.loss, "actor_optimizer": self.actor_optimizer, "value_optimizer": self.value_optimizer}

    def actor(self) -> nn.Module:
        """The network from observation to action parameters; its first outputs are the mean before the tanh."""
        return self.net

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The mean action."""
        return self.net(observation)[..., : self.rules.action_size].tanh()

    def _scaled(self, batch: TensorDictBase) -> TensorDictBase:
        """The batch with rewards times ``reward_scale``."""
        batch = batch.clone(recurse=False)
        batch["next"] = batch["next"].clone(recurse=False)
        batch["next", "reward"] = batch["next", "reward"] * self.config.reward_scale
        return batch


class BoxSac(BoxAlgorithm):
    """SAC as the paper used it."""

    config: BoxSacConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        inputs = observation_size(rules.config.layout)
        self.net = mlp(inputs, self.config.hidden, 2 * rules.action_size).to(self.device)
        self.policy = gaussian_policy(self.net, rules.action_size, self.device)
        network = StateActionValue(inputs, self.config.hidden, rules.action_size).to(self.device)
        value = ValueOperator(network, in_keys=["observation", "action"])
        spec = box_spec(rules.action_size, self.device)
        loss = SACLoss(self.policy, value, num_qvalue_nets=2, loss_function="l2", action_spec=spec)
        self._finish(
            loss, list(loss.actor_network_params.flatten_keys().values()), list(loss.qvalue_network_params.flatten_keys().values())
        )
        self.temperature_optimizer = torch.optim.Adam([self.loss.log_alpha], lr=self.config.learning_rate)

    def modules(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """As the base class, and the temperature's optimiser."""
        return {**super().modules(), "temperature_optimizer": self.temperature_optimizer}

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """An action drawn from the policy."""
        loc, raw_scale = self.net(observation).chunk(2, -1)
        scale = NormalParamExtractor()(torch.cat([loc, raw_scale], -1))[1]
        noise = torch.randn(loc.shape, generator=self.generator, device=self.device)
        return (loc + scale * noise).tanh()

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One step of all three losses."""
        optimizers = (self.actor_optimizer, self.value_optimizer, self.temperature_optimizer)
        losses = self.loss(self._scaled(batch))
        for optimizer in optimizers:
            optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        for optimizer in optimizers:
            optimizer.step()
        self.target.step()
        return {
            "loss_critic": losses["loss_qvalue"].detach(),
            "loss_actor": losses["loss_actor"].detach(),
            "temperature_place": losses["alpha"].detach(),
            "entropy_place": losses["entropy"].detach(),
        }


class Td3(BoxAlgorithm):
    """TD3: deterministic policy, delayed, with smoothed targets."""

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
        self._finish(
            loss, list(loss.actor_network_params.flatten_keys().values()), list(loss.qvalue_network_params.flatten_keys().values())
        )
        self.updates = 0

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
        losses: TensorDict = self.loss(self._scaled(batch))
        self.value_optimizer.zero_grad()
        self.actor_optimizer.zero_grad()
        (losses["loss_qvalue"] + losses["loss_actor"]).backward()
        self.value_optimizer.step()
        self.updates += 1
        if self.updates % self.config.policy_delay == 0:
            self.actor_optimizer.step()
            self.target.step()
        return {"loss_critic": losses["loss_qvalue"].detach(), "loss_actor": losses["loss_actor"].detach()}


def gaussian_policy(net: nn.Module, actions: int, device: torch.device) -> ProbabilisticActor:
    """Tanh-Gaussian policy of a network (n, size) -> (n, 2 * actions): means, then raw scales."""
    parameters = TensorDictModule(nn.Sequential(net, NormalParamExtractor()), in_keys=["observation"], out_keys=["loc", "scale"])
    spec = box_spec(actions, device)
    return ProbabilisticActor(parameters, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True, spec=spec)


def box_spec(actions: int, device: torch.device) -> Bounded:
    """The action space of one cell."""
    return Bounded(-1.0, 1.0, shape=(actions,), device=device)
