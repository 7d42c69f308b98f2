"""Networks of the centralised policy: the supervisor's, and beside them what moves the arm and what foresees refusals."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from marl_handover.cell import Cell
from marl_handover.config import CentralisedConfig
from marl_handover.learning.algorithm_settings import SacConfig
from marl_handover.learning.networks import LOG_STD_RANGE, AfterstateCritic, HybridActor, arm_blocks, mlp
from marl_handover.motion.transfer_features import FIELDS, mirrored_numbers, transfer_features
from marl_handover.task.observations import ARM_FIELDS


class MotionActor(HybridActor):
    """Decides as :class:`HybridActor` does, and draws the motion of a branch from the way it goes.

    All that a motion earns is not to be refused, and that depends on both its ends in the acting arm's frame: its network sees no more.

    Args:
        cell: the cell.
        config: of the learner.
        count: numbers of a motion.
    """

    scale: Tensor

    def __init__(self, cell: Cell, config: SacConfig, count: int) -> None:
        super().__init__(cell, config.actor_hidden, config.modes, True, config.canonical, config.harmonics)
        self.cell, self.canonical, self.count = cell, config.canonical, count
        self.move = mlp(len(FIELDS), config.actor_hidden, 2 * count)
        last = self.move[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():  # all zeros to begin with: with offsets, the executors' first guess
            last.weight.mul_(0.01)
            last.bias.zero_()
        self.places = [ARM_FIELDS.index(name) for name in ("x", "y", "goal_x", "goal_y")]
        self.register_buffer("scale", torch.tensor([1.0, cell.arms[0].mirror] * 2) * cell.r_max_mm, persistent=False)

    def positions(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """World positions (n, 2) in mm of object and goal, as observations (n, size) show them."""
        seen = arm_blocks(observation)[..., 0, :][..., self.places] * self.scale
        return seen[..., :2], seen[..., 2:]

    def way(self, arm: Tensor, from_mm: Tensor, to_mm: Tensor) -> tuple[Tensor, Tensor]:
        """Features (..., fields) and sign (...) of ways; see :func:`transfer_features`."""
        return transfer_features(self.cell, arm, from_mm, to_mm, self.canonical)

    def motion(self, way: Tensor) -> tuple[Tensor, Tensor]:
        """Mean before the tanh and log of the deviation, (..., M), of the motions for ways (..., fields), folded as they are."""
        mean, log_std = self.move(way).chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD_RANGE)

    def with_motion(self, observation: Tensor, decision: Tensor, noise: Tensor) -> Tensor:
        """Actions (n, 4 + M) of decisions (n, 4); ``noise`` (n, M) in deviations."""
        arm, final = (decision[:, 1] > 0).long(), decision[:, :1] > 0
        start, goal = self.positions(observation)
        place = self.cell.chart.to_table(decision[:, 2], decision[:, 3])
        way, sign = self.way(arm, start, torch.where(final, goal, place))
        mean, log_std = self.motion(way)
        return torch.cat([decision, mirrored_numbers((mean + log_std.exp() * noise).tanh(), sign)], -1)


class MotionCritic(AfterstateCritic):
    """Twin values of the branches if their motions are made, and how likely those are to be refused.

    What a refusal costs is known, and that it ends the episode; so the value of a branch is (1 - p) V + p failure. V is the
    hierarchical critic; p is learned from what was refused.
    """

    def __init__(self, config: SacConfig, centralised: CentralisedConfig, count: int) -> None:
        super().__init__(config.critic_hidden, config.final_hidden, config.canonical, config.harmonics)
        self.refusal = mlp(len(FIELDS) + count, centralised.refusal_hidden, 1)

    def refused_logit(self, way: Tensor, numbers: Tensor) -> Tensor:
        """Log-odds (...) that motions (..., M) on ways (..., fields) are refused, both folded."""
        logit: Tensor = self.refusal(torch.cat([way, numbers], -1))
        return logit[..., 0]
