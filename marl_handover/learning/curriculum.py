"""Stages of epsilon: their settings, and which one training is in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from marl_handover.config import EPSILON_DEG, bounded

if TYPE_CHECKING:
    from marl_handover.envs.supervisor_env import SupervisorEnv


@dataclass
class StageConfig:
    """One stage of the curriculum: each episode's epsilon is drawn log-uniformly from [low, high]."""

    epsilon_low_deg: float = bounded(5.0, *EPSILON_DEG)
    epsilon_high_deg: float = bounded(5.0, *EPSILON_DEG)
    until_step: int = bounded(0, 0, 10**9)  # environment step that ends the stage; 0 = the end of training
    until_success: float = bounded(1.0, 0.0, 1.0)  # a success rate in evaluation that ends it earlier; 1 = never


def wide_first() -> list[StageConfig]:
    """Ranges of epsilon that end lower and lower.

    At a small epsilon a place that takes a transfer more than another is a sharp peak of the value, and a policy that is at it stays; at a
    large one the peaks are wide and it moves to the best. A step from 3 to 0.7 degrees at once is too large: in one run of five the policy
    forgets the larger epsilons as well, and has not learned them again by the end.
    """
    wide = [StageConfig(8.0, 15.0, until_step=8_000), StageConfig(3.0, 12.0, until_step=12_000)]
    return [*wide, StageConfig(1.5, 12.0, until_step=16_000), StageConfig(0.7, 12.0)]


def down_to(epsilon_deg: float, stages: Sequence[StageConfig]) -> list[StageConfig]:
    """The same stages for one accuracy: the last one goes down to it, and none goes below.

    The wider epsilons stay: at a small one alone nearly nothing is solved, so nearly nothing is learned.
    """
    lows = [*(max(stage.epsilon_low_deg, epsilon_deg) for stage in stages[:-1]), epsilon_deg]
    highs = (max(stage.epsilon_high_deg, epsilon_deg) for stage in stages)
    return [replace(stage, epsilon_low_deg=low, epsilon_high_deg=high) for stage, low, high in zip(stages, lows, highs, strict=True)]


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
