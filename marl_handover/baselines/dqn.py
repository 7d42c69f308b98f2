"""Double DQN over a grid of shared positions: the discretised predecessor of the paper's method, *reconstructed*.

Only the paper's section on related work is at hand: the shared space discretised; DQN; for architecture A two policies "due to how the
information of the goal configuration was implemented"; for architecture B "extensive reward shaping and extensive and complex pretraining,
with multiple networks". What is made of these words here:

- A choice is an arm and a place of the grid; in architecture B also an arm that finishes.
- A: one network for each arm that would finish. Each is told the goal only as that arm has it (where it is in the arm's own polar
  coordinates, and how it would be turned in the gripper), and is rewarded when *that* arm can finish. The better of the two decides,
  of those whose arm reaches the goal.
- B: one network values the hand-overs, another one finishing. Shaping is potential-based, on the smallest orientation error that an arm
  could finish with now, so it does not change which policy is best. Pre-training is a curriculum of epsilon, before it the second network
  alone.

Hindsight, which the predecessor did not have, is a setting of the replay memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate

from marl_handover.baselines.dqn_grid import finishing_potential, goal_reach, grid_actions, grid_points, seen_by_finishers
from marl_handover.cell.symmetry import LEFT, RIGHT
from marl_handover.config import LAYOUTS, bounded, chosen
from marl_handover.errors import InvalidSetting
from marl_handover.learning.algorithm import Algorithm, register_algorithm
from marl_handover.learning.networks import mlp
from marl_handover.learning.settings import OffPolicyConfig, TrainConfig
from marl_handover.task.observations import observation_size
from marl_handover.task.rules import Rules


@dataclass
class DqnConfig(OffPolicyConfig):
    """Double DQN over a grid of places: the discretised predecessor, reconstructed from the paper's few words about it."""

    name: str = "dqn"
    layout: str = chosen("raw", LAYOUTS)
    learning_rate: float = bounded(5e-4, 1e-8, 10.0)
    hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))
    grid_mm: float = bounded(20.0, 2.0, 200.0)  # spacing of the places
    random_start: float = bounded(1.0, 0.0, 1.0)  # share of random decisions, falling linearly from start ...
    random_end: float = bounded(0.05, 0.0, 1.0)
    random_until: float = bounded(0.5, 1e-6, 1000.0)  # ... to end at this fraction of training
    shaping: float = bounded(0.0, 0.0, 1e6)  # potential-based reward for half a turn towards an orientation an arm can finish with
    finishing_first: int = bounded(0, 0, 10**9)  # of architecture B: gradient steps that only train when to finish, before all others

    def validate(self) -> None:
        """As the base class, and what only this algorithm has."""
        super().validate()
        if self.layout not in ("raw", "relative"):
            raise InvalidSetting("algorithm.layout", self.layout, "'raw' or 'relative' for algorithm=dqn")
        if self.exploration != "chart":
            raise InvalidSetting("algorithm.exploration", self.exploration, "'chart' for algorithm=dqn, whose grid is even on the table")


class Choices(nn.Module):
    """The values of architecture B's choices: hand-overs from one network, finishing from another, as one vector."""

    def __init__(self, place: nn.Module, finish: nn.Module) -> None:
        super().__init__()
        self.place, self.finish = place, finish

    def forward(self, observation: Tensor) -> Tensor:
        """(n, size) -> (n, choices)."""
        return torch.cat([self.place(observation), self.finish(observation)], -1)


@register_algorithm(DqnConfig)
class Dqn(Algorithm):
    """Networks, TorchRL's losses and the grid."""

    kind = "discrete"
    stored = ("losses", "optimizer")
    config: DqnConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        chart = rules.cell.paper_chart("algorithm=dqn")
        self.points_mm = grid_points(chart, self.config.grid_mm)
        self.two_policies = rules.external_finish
        actions = grid_actions(chart, self.points_mm, not self.two_policies)
        self.actions = torch.tensor(actions, dtype=torch.float32, device=self.device)
        self.points = torch.tensor(self.points_mm, dtype=torch.float32, device=self.device)
        arms = rules.cell.num_arms
        inputs, places = observation_size(rules.config.layout), arms * len(self.points_mm)
        outputs = (places, places) if self.two_policies else (places, arms)
        self.nets = nn.ModuleList([mlp(inputs, self.config.hidden, size) for size in outputs]).to(self.device)
        whole = list(self.nets) if self.two_policies else [Choices(*self.nets)]
        self.losses = nn.ModuleList([self._loss(net) for net in whole]).to(self.device)
        self.targets = [SoftUpdate(loss, tau=self.config.tau) for loss in self.losses]
        self.optimizer = torch.optim.Adam(self.nets.parameters(), lr=self.config.learning_rate, fused=True)
        self.random_share, self.updates = self.config.random_start, 0

    def _loss(self, net: nn.Module) -> DQNLoss:
        actor = QValueActor(net, in_keys=["observation"], action_space="categorical")
        loss = DQNLoss(actor, action_space="categorical", double_dqn=True, loss_function="smooth_l1")
        loss.make_value_estimator(gamma=self.config.gamma)
        return loss

    def state_dict(self) -> dict[str, Any]:
        """As the base class, and how far exploration and pre-training are."""
        return {**super().state_dict(), "random_share": self.random_share, "updates": self.updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        super().load_state_dict(state)
        self.random_share, self.updates = state["random_share"], state["updates"]

    def actor(self) -> nn.Module:
        """All networks that values come from."""
        return self.nets

    def exported(self) -> list[list[nn.Linear]]:
        """Of A: the policy of each finishing arm; of B: hand-overs, finishing."""
        return [[layer for layer in net.modules() if isinstance(layer, nn.Linear)] for net in self.nets]

    def about(self) -> dict[str, Any]:
        """The places, in mm."""
        return {"points_mm": self.points_mm.tolist()}

    def schedule(self, fraction: float) -> None:
        """Learning rate and share of random decisions."""
        super().schedule(fraction)
        own, done = self.config, min(1.0, fraction / self.config.random_until)
        self.random_share = own.random_start + done * (own.random_end - own.random_start)

    def values(self, observation: Tensor) -> Tensor:
        """Values (n, choices) of all choices."""
        if not self.two_policies:
            return torch.cat([net(observation) for net in self.nets], -1)
        seen = seen_by_finishers(self.rules, self.rules.config.layout, observation)
        value = torch.stack([net(seen[:, arm]) for arm, net in enumerate(self.nets)], -1)
        reach = goal_reach(self.rules, self.rules.config.layout, observation)
        return torch.where(reach[:, None], value, -math.inf).amax(-1)

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The choice with the highest value."""
        return self.actions[self.values(observation).argmax(-1)]

    def random_action(self, observation: Tensor) -> Tensor:
        """Uniform choices."""
        index = torch.randint(len(self.actions), (len(observation),), generator=self.generator, device=self.device)
        return self.actions[index]

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """The best choice, or a random one."""
        random = self._uniform((len(observation), 1)) < self.random_share
        return torch.where(random, self.random_action(observation), self.act(observation))

    def index(self, action: Tensor, arm: Tensor, final: Tensor) -> Tensor:
        """Numbers (n,) of the choices that stored actions (n, 4) were: by the nearest place, whatever rounding did to it."""
        place = self.rules.cell.shared.to_table(action[:, 2], action[:, 3])
        nearest = torch.cdist(place, self.points).argmin(-1)
        count = len(self.points)
        return torch.where(final, self.rules.cell.num_arms * count + arm, arm * count + nearest)

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One gradient step of all networks."""
        parts = self._of_two(batch) if self.two_policies else [self._of_one(batch)]
        total = self.points.new_zeros(())
        for loss, part in zip(self.losses, parts, strict=True):
            if len(part):
                total = total + loss(part)["loss"]
        if total.requires_grad:
            self.optimizer.zero_grad()
            total.backward()
            self.optimizer.step()
            for target in self.targets:
                target.step()
        self.updates += 1
        return {"loss_critic": total.detach()}

    def _of_one(self, batch: TensorDictBase) -> TensorDict:
        """Architecture B's batch for the loss; in pre-training only what shows when to finish."""
        final = batch["final"][:, 0]
        rows = final if self.updates < self.config.finishing_first else torch.ones_like(final)
        after, terminated = batch["next", "observation"], batch["next", "terminated"]
        potentials = [finishing_potential(self.rules, pose, batch["desired_goal"]).amax(-1) for pose in self._ends(batch)]
        reward = self._shaped(batch["next", "reward"][:, 0], terminated[:, 0], *potentials)
        return self._transitions(batch, batch["observation"], after, reward, terminated)[rows]

    def _of_two(self, batch: TensorDictBase) -> list[TensorDict]:
        """Architecture A's batches: to each policy what bears on its own arm.

        Left out are goals out of that arm's reach, and decisions that were ignored because the episode was solved at its start.
        """
        layout, goal, epsilon = self.rules.config.layout, batch["desired_goal"], batch["epsilon"][:, 0]
        pose, placed = self._ends(batch)
        ignored = self.rules.can_finish(pose, goal, epsilon).any(-1)
        reach, solved = self.rules.cell.reaches(goal), self.rules.can_finish(placed, goal, epsilon)
        before, after = (seen_by_finishers(self.rules, layout, part["observation"]) for part in (batch, batch["next"]))
        potentials = [finishing_potential(self.rules, end, goal) for end in (pose, placed)]
        parts = []
        for arm in (LEFT, RIGHT):
            done = solved[:, arm]
            step = torch.where(done, 0.0, -1.0)
            reward = self._shaped(step, done, *(potential[:, arm] for potential in potentials))
            rows = self._transitions(batch, before[:, arm], after[:, arm], reward, done[:, None])
            parts.append(rows[reach[:, arm] & ~ignored])
        return parts

    @staticmethod
    def _ends(batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        return batch["achieved_goal"], batch["next", "achieved_goal"]

    def _shaped(self, reward: Tensor, terminated: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Scaled rewards (n,) with gamma * potential after - potential before; there is none after the end."""
        gain = self.config.gamma * torch.where(terminated, 0.0, after) - before
        return self.config.reward_scale * (reward + self.config.shaping * gain)

    def _transitions(self, batch: TensorDictBase, before: Tensor, after: Tensor, reward: Tensor, terminated: Tensor) -> TensorDict:
        index = self.index(batch["action"], batch["arm"][:, 0], batch["final"][:, 0])
        following = {"observation": after, "reward": reward[:, None], "terminated": terminated, "done": terminated}
        return TensorDict({"observation": before, "action": index, "next": following}, batch.batch_size, device=batch.device)
