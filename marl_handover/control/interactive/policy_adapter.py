"""What is decided in the interactive cell: the policy's next order, its whole rollout, whether the goal is reached, and the score."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.build import CellModel
from marl_handover.config import LoopConfig, MotionConfig
from marl_handover.control.closed_loop import finish_command, transfer_command
from marl_handover.control.transfers import Placement, TransferCommand, rollout
from marl_handover.errors import InvalidSetting
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.policies import SupervisorPolicy
from marl_handover.task.episode import nobody_moves
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Outcome, Rules, carried

Floats = NDArray[np.float64]

MOST_TRANSFERS = LoopConfig().transfers
"""An episode that takes more is given up."""


class PolicyAdapter:
    """A policy under the exact rule book of the cell.

    Args:
        policy: the supervisor.
        model: the cell; it has to be the policy's own, but for the part of the chart in use.
        motion: how the arms move, whose ways are priced.

    Raises:
        InvalidSetting: of a policy for another cell, or one whose motions are its own.
    """

    def __init__(self, policy: SupervisorPolicy, model: CellModel, motion: MotionConfig) -> None:
        policy.require_executors()
        own = policy.rules.cell.config
        cell = model.cell.with_inset(own.chart_inset)
        if cell.config != own:
            raise InvalidSetting("policy", policy.name, f"one for the cell {model.cell.config.name!r}; this one is for {own.name!r}")
        self.rules = Rules(cell, policy.rules.config, motion_cost(cell, policy.rules.config, motion))
        self.policy = policy.under(self.rules)
        self.exact = ExactPlanner(self.rules)

    def command(self, pose: Floats, goal: Floats, previous: int) -> TransferCommand | None:
        """What is to be done with a block at ``pose`` (3,); None: the policy wants no arm to move.

        Architecture A's final transfer, where an arm can do it, comes before the policy's wishes.
        """
        if (finish := finish_command(self.rules, pose, goal)) is not None:
            return finish
        action = self.policy.act(pose, goal, np.asarray(previous))
        return None if bool(nobody_moves(action)) else transfer_command(self.rules, pose, goal, action)

    def placed(self, pose: Floats, arm: int, place_mm: Floats) -> Floats:
        """Pose (3,) of a block that ``arm`` takes from ``pose`` to ``place_mm`` (2,)."""
        turn = self.rules.cell.polar(place_mm)[1][arm] - self.rules.cell.polar(pose)[1][arm]
        return np.asarray(carried(pose, place_mm, turn), float)

    def there(self, pose: Floats, goal: Floats) -> bool:
        """Whether a block at ``pose`` (3,) is at the goal."""
        return int(self.rules.external_verdict(pose, goal, np.int64(0)).outcome) == Outcome.SUCCESS

    def optimum(self, pose: Floats, goal: Floats) -> int:
        """The fewest transfers; 0 at the goal, and where there is no plan."""
        return 0 if self.there(pose, goal) else int(self.exact.plan(pose, goal).transfers)

    def rollout(self, pose: Floats, goal: Floats, previous: int, first: TransferCommand | None) -> tuple[Placement, ...]:
        """The placements from ``pose`` (3,) on, if everybody does as told; ``first`` has been ordered already."""
        if first is None or not first.feasible:
            return ()
        plan = [Placement(first.predicted, first.arm, first.final)]
        if not self.there(first.predicted, goal):
            plan += rollout(self.policy, first.predicted, goal, first.arm)
        return tuple(plan[: self.rules.config.max_steps])


@dataclass
class Score:
    """Episodes that came to an end, how many of them with the block at the goal, and how long those took against the optimum."""

    episodes: int = 0
    solved: int = 0
    _ratios: float = 0.0
    _rated: int = 0

    def add(self, solved: bool, transfers: int, optimal: int) -> None:
        """One more episode."""
        self.episodes += 1
        self.solved += solved
        if solved and optimal > 0:
            self._ratios, self._rated = self._ratios + transfers / optimal, self._rated + 1

    @property
    def ratio(self) -> float:
        """Transfers over the optimum, the mean of solved episodes; nan at first."""
        return self._ratios / self._rated if self._rated else math.nan
