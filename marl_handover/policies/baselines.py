"""Policies that learned nothing: the exact planner, chance, and a greedy rule."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import select
from marl_handover.policies.policy import Floats, SupervisorPolicy
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Rules


class ExactPolicy(SupervisorPolicy):
    """The exact planner in closed loop: the yardstick."""

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules, "exact")
        self.planner = ExactPlanner(rules)

    def under(self, rules: Rules) -> SupervisorPolicy:
        """A planner for that rule book."""
        return ExactPolicy(rules)

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The first action of an optimal plan."""
        return self.planner.act(pose, goal)


class RandomPolicy(SupervisorPolicy):
    """Uniform actions."""

    def __init__(self, rules: Rules, seed: int = 0) -> None:
        super().__init__(rules, "random")
        self.generator = np.random.default_rng(seed)

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """Anything."""
        return self.generator.uniform(-1.0, 1.0, (*pose.shape[:-1], 4))


class GreedyPolicy(SupervisorPolicy):
    """Nearest arm: finishes when an arm can; else the nearer arm hands over, at the place of a few that leaves the other the
    least error.
    """

    PLACES = 33

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules, "greedy")

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """One greedy step ahead."""
        cell = self.rules.cell
        able = self.rules.can_finish(pose, goal)
        finish = able.any(-1)
        square, yaw = cell.polar(pose)
        near = np.where(cell.within(square, yaw), square, math.inf).argmin(-1)
        alpha = np.linspace(-1.0, 1.0, self.PLACES)
        table = cell.chart.to_table(alpha, 0 * alpha)
        turn = cell.polar(table)[1] - yaw[..., None, :]
        placed_theta = pose[..., 2, None] + select(turn, np.broadcast_to(near[..., None], turn.shape[:-1]))
        placed = np.concatenate([np.broadcast_to(table, (*placed_theta.shape, 2)), placed_theta[..., None]], -1)
        error = abs(self.rules.finishing_error(placed, np.broadcast_to(goal[..., None, :], placed.shape)))
        other = np.broadcast_to((1 - near)[..., None], placed_theta.shape)
        best = select(error, other).argmin(-1)
        arm = np.where(finish, able.argmax(-1), near)
        return np.stack([np.where(finish, 1.0, -1.0), np.where(arm > 0, 1.0, -1.0), alpha[best], 0.0 * alpha[best]], -1)
