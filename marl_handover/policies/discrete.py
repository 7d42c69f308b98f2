"""Trained policies that choose from a grid of places, evaluated in numpy (:mod:`marl_handover.baselines.dqn`)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.baselines.dqn_grid import goal_reach, grid_actions, seen_by_finishers
from marl_handover.policies.files import network_layers
from marl_handover.policies.network import NetworkPolicy
from marl_handover.policies.policy import Floats
from marl_handover.task.rules import Rules


class DiscretePolicy(NetworkPolicy):
    """The choice with the highest value; architecture A has a network for each finishing arm, B one for hand-overs and one for finishing.

    Args:
        rules: the rule book to act under. Places keep their position on the table, also in another chart.
        name: what it was loaded as.
        arrays: weights, from a policy file.
        about: what the file says of them.
    """

    def __init__(self, rules: Rules, name: str, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        super().__init__(rules, name, arrays, about)
        self.networks = [network_layers(arrays, about, number) for number in range(about["networks"])]
        self.points_mm = np.array(about["points_mm"])

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The best choice."""
        return self._actions()[self.values(pose, goal, previous_arm).argmax(-1)]

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """All choices, the best first."""
        return self._actions()[np.argsort(-self.values(pose, goal, previous_arm), -1, kind="stable")]

    def values(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> NDArray[np.float32]:
        """Values (..., choices)."""
        observation = self._observation(pose, goal, previous_arm)
        if not self.rules.external_finish:
            return np.concatenate([self._forward(observation, layers) for layers in self.networks], -1)
        layout = self.about["layout"]
        seen = seen_by_finishers(self.rules, layout, observation)
        value = np.stack([self._forward(seen[..., arm, :], layers) for arm, layers in enumerate(self.networks)], -1)
        return np.where(goal_reach(self.rules, layout, observation)[..., None, :], value, -math.inf).max(-1)

    def _actions(self) -> Floats:
        return grid_actions(self.rules.cell.chart, self.points_mm, not self.rules.external_finish)
