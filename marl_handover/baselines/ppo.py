"""PPO on the boxed action, with TorchRL's clipped loss and generalised advantages."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from marl_handover.config import bounded
from marl_handover.learning.algorithm import Algorithm, register_algorithm
from marl_handover.learning.networks import action_spec, mlp
from marl_handover.learning.settings import OnPolicyConfig, TrainConfig
from marl_handover.task.observations import observation_size
from marl_handover.task.rules import Rules


@dataclass
class PpoConfig(OnPolicyConfig):
    """PPO with a clipped objective on the boxed action; on-policy, so no replay and no hindsight."""

    name: str = "ppo"
    learning_rate: float = bounded(5e-4, 1e-8, 10.0)
    batch_size: int = bounded(512, 1, 65_536)
    gae_lambda: float = bounded(0.95, 0.0, 1.0)
    clip: float = bounded(0.2, 1e-6, 1e3)
    entropy: float = bounded(0.003, 0.0, 1e3)
    max_grad_norm: float = bounded(0.5, 1e-9, 1e9)
    hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))


@register_algorithm(PpoConfig)
class Ppo(Algorithm):
    """On-policy: :meth:`update` takes a whole roll-out (num_envs, time)."""

    kind = "box"
    config: PpoConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        inputs = observation_size(rules.config.layout)
        self.net = mlp(inputs, self.config.hidden, 2 * rules.action_size).to(self.device)
        self.policy = gaussian_policy(self.net, rules.action_size, self.device)
        value = ValueOperator(mlp(inputs, self.config.hidden, 1).to(self.device), in_keys=["observation"])
        self.loss = ClipPPOLoss(
            self.policy,
            value,
            clip_epsilon=self.config.clip,
            entropy_coeff=self.config.entropy,
            normalize_advantage=True,
            functional=False,
        ).to(self.device)
        self.advantage = GAE(gamma=self.config.gamma, lmbda=self.config.gae_lambda, value_network=value)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=self.config.learning_rate, fused=True)

    def actor(self) -> nn.Module:
        """The network from observation to action parameters; its first outputs are the mean before the tanh."""
        return self.net

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """An action drawn from the policy."""
        loc, scale = NormalParamExtractor()(self.net(observation))
        # Kept off the walls of the box, where the density of a tanh-Gaussian is not finite.
        noise = self._gaussian(loc.shape)
        return (loc + scale * noise).tanh().clamp(-1 + 1e-6, 1 - 1e-6)

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The mean action."""
        return self.net(observation)[..., : self.rules.action_size].tanh()

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """``epochs`` passes over the roll-out in minibatches. Each pass counts as one gradient step a minibatch."""
        batch["next", "reward"] = batch["next", "reward"] * self.config.reward_scale
        with torch.no_grad():
            batch["action_log_prob"] = self.policy.get_dist(batch).log_prob(batch["action"])
            self.advantage(batch)
        flat = batch.reshape(-1)
        size = self.config.batch_size
        losses = {}
        for _ in range(self.config.epochs):
            order = torch.randperm(len(flat), generator=self.generator, device=self.device)
            for rows in order.split(size):
                losses = self.loss(flat[rows])
                self.optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(self.loss.parameters(), self.config.max_grad_norm)
                self.optimizer.step()
        return {"loss_critic": losses["loss_critic"].detach(), "loss_actor": losses["loss_objective"].detach()}


def gaussian_policy(net: nn.Module, actions: int, device: torch.device) -> ProbabilisticActor:
    """Tanh-Gaussian policy of a network (n, size) -> (n, 2 * actions): means, then raw scales."""
    parameters = TensorDictModule(nn.Sequential(net, NormalParamExtractor()), in_keys=["observation"], out_keys=["loc", "scale"])
    spec = action_spec(actions, device)
    return ProbabilisticActor(parameters, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True, spec=spec)
