"""Trained policies that decide and move, evaluated in numpy. Their rule book judges motions with torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.envs.centralised import CentralisedRules
from marl_handover.errors import InvalidSetting
from marl_handover.motion.batched_paths import mirrored_numbers, transfer_features
from marl_handover.policies.actor import NetworkPolicy
from marl_handover.policies.files import network_layers
from marl_handover.policies.policy import Floats, SupervisorPolicy
from marl_handover.task.rules import Rules


class CentralisedPolicy(NetworkPolicy):
    """A trained actor of the centralised formulation: actions are (final, arm, alpha, beta) and its motion's numbers.

    Args:
        rules: the rule book to act under, motions included.
        name: what it was loaded as.
        arrays: weights, from a policy file.
        about: what the file says of them.
    """

    def __init__(self, rules: Rules, name: str, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        super().__init__(rules, name, arrays, about)
        self.hybrid = about["kind"] == "centralised"
        self.moving = network_layers(arrays, about, 1) if self.hybrid else self.layers

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The likeliest branch, its mean place and the mean motion there."""
        if not self.hybrid:
            outputs = self._forward(self._observation(pose, goal, previous_arm))
            return np.tanh(outputs[..., : self.rules.action_size])
        return self._with_motion(super().act(pose, goal, previous_arm), pose, goal)

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """All branches with their motions, the likeliest first, where it has branches."""
        others = super().alternatives(action, pose, goal, previous_arm)
        if not self.hybrid:
            return others
        return self._with_motion(others, *(np.broadcast_to(part[..., None, :], (*others.shape[:-1], 3)) for part in (pose, goal)))

    def under(self, rules: Rules) -> SupervisorPolicy:
        """The same policy under another rule book that judges motions.

        Raises:
            InvalidSetting: for one that does not: then executors would move the arms.
        """
        if not isinstance(rules, CentralisedRules):
            raise self._refusal()
        return super().under(rules)

    def require_executors(self) -> None:
        """Refused: its motions are its own.

        Raises:
            InvalidSetting: always.
        """
        raise self._refusal()

    def _refusal(self) -> InvalidSetting:
        return InvalidSetting("policy", self.name, "of another variant; this one's motions are its own (backend=kinematic only)")

    def _with_motion(self, decision: Floats, pose: Floats, goal: Floats) -> Floats:
        """Actions (..., 4 + M) of decisions (..., 4)."""
        cell = self.rules.cell
        command = Rules.decode(self.rules, decision)
        to = np.where(command.final[..., None], goal[..., :2], command.place_mm)
        way, sign = transfer_features(cell, command.arm, pose[..., :2], to, self.about["canonical"])
        outputs = self._forward(way.astype(np.float32), self.moving)
        numbers = np.tanh(outputs[..., : outputs.shape[-1] // 2])
        return np.concatenate([decision, mirrored_numbers(numbers, sign)], -1)
