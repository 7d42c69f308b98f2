"""What a supervisor policy answers. Nothing here needs torch.

A policy answers two calls: ``policy(observation)`` takes one observation of the AEC supervisor (``state``, ``goal``,
``previous_arm`` 0 none, 1 L, 2 R) and returns its action (``final``, ``arm``, ``place``); ``policy.act(pose, goal,
previous_arm)`` takes batches (n, 3), (n, 3), (n,) (-1 none, 0 L, 1 R), or single problems (3,), (3,), (), and returns
actions (n, 4) or (4,).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import WorkFailed
from marl_handover.task.rules import Rules

Floats = NDArray[np.float64]


class NobodyMoves(WorkFailed):
    """A policy was asked for a command, and wants no arm to move."""

    def __init__(self, policy: str) -> None:
        self.policy = policy
        super().__init__(f"policy {policy!r} wants no arm to move; asked the same again it says the same, so it will never move one")


class SupervisorPolicy(ABC):
    """A supervisor of one cell.

    Attributes:
        rules: the rule book it acts under; ``rules.epsilon_rad`` is the accuracy it aims at.
        name: what it was loaded as.
        about: what its file says of it; empty if it was not trained.
    """

    variant = "hierarchical"

    def __init__(self, rules: Rules, name: str) -> None:
        self.rules, self.name = rules, name
        self.about: dict[str, Any] = {}

    @abstractmethod
    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """Actions: final, arm, alpha, beta. One that is not a number: no arm is to move."""

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """What it would rather do if it could not do ``action`` (..., size): (..., k, size), the best first.

        Here: another final, then the other arm, then both, at the same place. They must hold all four choices.
        """
        chosen = np.where(action[..., None, :2] > 0, 1.0, -1.0) * np.array([[-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
        rest = np.broadcast_to(action[..., None, 2:], (*chosen.shape[:-1], action.shape[-1] - 2))
        return np.concatenate([chosen, rest], -1)

    def under(self, rules: Rules) -> SupervisorPolicy:
        """The same policy acting under another rule book, with another epsilon for instance."""
        other = copy(self)
        other.rules = rules
        return other

    def require_executors(self) -> None:  # noqa: B027 - most do
        """Raise :class:`InvalidSetting` if it does not leave the motions to executors. Here: it does."""

    def __call__(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The AEC supervisor's action for its observation.

        Raises:
            InvalidSetting: of a policy whose motions are its own: where a supervisor is asked, executors move the arms.
            NobodyMoves: it wants no arm to move, which is no action there.
        """
        self.require_executors()
        pose, goal = np.asarray(observation["state"], float), np.asarray(observation["goal"], float)
        action = self.act(pose, goal, np.asarray(observation["previous_arm"]) - 1)
        if np.isnan(action).any():
            raise NobodyMoves(self.name)
        return {"final": int(action[0] > 0), "arm": int(action[1] > 0), "place": np.asarray(action[2:], np.float32)}
