"""``variant=centralised``: one policy decides and moves, and its motions are judged like the executors'."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from marl_handover.cell import Cell, load_cell
from marl_handover.config import TaskConfig
from marl_handover.envs.centralised import CentralisedRules
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.centralised_sac import CentralisedBoxSac, CentralisedSac
from marl_handover.learning.replay import HindsightReplayBuffer
from marl_handover.learning.settings import TrainConfig
from marl_handover.learning.variants import Variant


class MotionReplayBuffer(HindsightReplayBuffer):
    """Hindsight whose batches also say ``feasible``: a critic is to tell refusals from misses.

    Goals change as ever. A motion that was allowed stays so, since the hand-over that becomes final goes the same way; a refused
    transfer keeps its goal.
    """

    def _assembled(self, batch: TensorDictBase, reward: Tensor, terminated: Tensor) -> TensorDict:
        assembled = super()._assembled(batch, reward, terminated)
        assembled["feasible"] = batch["feasible"]
        return assembled


class Centralised(Variant):
    """The centralised formulation; architecture B."""

    algorithms: ClassVar[dict[str, Any]] = {"sac": CentralisedSac, "box_sac": CentralisedBoxSac}

    def rules(self, cell: Cell, task: TaskConfig, config: TrainConfig) -> CentralisedRules:
        """The rule book with motions."""
        return CentralisedRules(cell, task, config.centralised)

    def env(self, config: TrainConfig, device: torch.device) -> SupervisorEnv:
        """The batch of cells; their actions are decision and motion."""
        cell = load_cell(config.cell)
        rules = self.rules(cell, config.task, config)
        return SupervisorEnv(config.num_envs, cell, config.task, device, seed=config.seed + 1, rules=rules)

    def replay(self, env: SupervisorEnv, config: TrainConfig, generator: torch.Generator) -> MotionReplayBuffer:
        """The memory that the learners draw from."""
        return MotionReplayBuffer(env.rules, config.replay, env, generator)
