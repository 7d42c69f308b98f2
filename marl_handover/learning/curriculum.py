"""Stages of epsilon."""

from __future__ import annotations

from collections.abc import Sequence

from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.settings import StageConfig


class Curriculum:
    """Any number of stages; a stage ends at an environment step or at a measured success rate, whichever comes first."""

    def __init__(self, stages: Sequence[StageConfig], env: SupervisorEnv) -> None:
        self.stages, self.env = list(stages), env
        self.label = ""

    def enter(self, stage: int) -> None:
        """Set the environment's range; stored transitions are re-judged at it when they are sampled."""
        config = self.stages[stage]
        self.env.set_epsilon_range(config.epsilon_low_deg, config.epsilon_high_deg)
        low, high = config.epsilon_low_deg, config.epsilon_high_deg
        self.label = f"{low:g}°" if low == high else f"{low:g}-{high:g}°"

    def stage_after(self, stage: int, step: int, success_rate: float) -> int:
        """The stage to be in, given where training stands."""
        while stage < len(self.stages) - 1:
            config = self.stages[stage]
            out_of_time = 0 < config.until_step <= step
            if not (out_of_time or success_rate >= config.until_success):
                break
            stage += 1
            success_rate = 0.0  # one success ends one stage
        return stage
