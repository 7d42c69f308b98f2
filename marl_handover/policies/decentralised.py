"""Trained arms that take turns, asked as if they were a supervisor; evaluated in numpy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import select
from marl_handover.cell import NO_ARM
from marl_handover.policies.files import network_layers
from marl_handover.policies.network import NetworkPolicy
from marl_handover.policies.policy import Floats
from marl_handover.task.observations import ARM_FIELDS, observe
from marl_handover.task.rules import Rules

FINISH, PASS, PLACE = 0, 1, 2
"""An arm's branches, as the networks have them (``marl_handover.baselines.decentralised``)."""


class TurnsPolicy(NetworkPolicy):
    """Two arms' policies as one supervisor.

    It asks the arm whose turn it is: the other one than that which moved last; L at first. If that arm passes, it asks the other. If both
    pass, nobody would ever move: the answer is not a number.

    Args:
        rules: the rule book to act under.
        name: what it was loaded as.
        arrays: weights, from a policy file: one network for both arms, or one each.
        about: what the file says of them.
    """

    def __init__(self, rules: Rules, name: str, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        super().__init__(rules, name, arrays, about)
        self.networks = [network_layers(arrays, about, number) for number in range(about["networks"])]

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """What the first arm that does not pass wants: its likeliest branch, and the mean place."""
        logits, places = self._said(pose, goal)
        branch = logits.argmax(-1)
        first = np.where(np.asarray(previous_arm) == 0, 1, 0)
        arm = np.where(select(branch, first) == PASS, 1 - first, first)
        chosen = select(branch, arm)
        return np.where((chosen == PASS)[..., None], math.nan, self._decision(arm, chosen, places))

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """All branches of the arm that was to act, the likeliest first, then all of the other one's; nobody passes."""
        logits, places = self._said(pose, goal)
        logits[..., PASS] = -math.inf
        order = np.argsort(-logits, -1, kind="stable")[..., :-1]
        arm = np.where(action[..., 1] > 0, 1, 0)
        ranked = [(asked, np.take_along_axis(order, asked[..., None, None], -2)[..., 0, :]) for asked in (arm, 1 - arm)]
        found = [self._decision(asked, branches[..., rank], places) for asked, branches in ranked for rank in range(branches.shape[-1])]
        return np.stack(found, -2)

    def _said(self, pose: Floats, goal: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Logits (..., arms, 2 + components) of each arm's branches, and its places (..., arms, components, 2) on the table."""
        both = observe(self.rules, "relative", pose, goal, np.full(np.shape(pose)[:-1], NO_ARM)).astype(np.float32)
        blocks = both.reshape(*both.shape[:-1], -1, len(ARM_FIELDS))
        sign = self._sign(blocks)
        out = self._asked(self._harmonics(np.where(sign[..., None] < 0, blocks * self.odd, blocks)))
        components = self.about["modes"]
        places = np.tanh(out[..., PLACE + components : PLACE + 3 * components]).reshape(*out.shape[:-1], components, 2)
        signs = np.stack(np.broadcast_arrays(sign, self.beta_sign), -1)
        return out[..., : PLACE + components], places * signs[..., None, :]

    @staticmethod
    def _decision(arm: NDArray[np.int64], branch: NDArray[np.int64], places: NDArray[np.float32]) -> Floats:
        """Actions (..., 4) of branches (...) of arms (...)."""
        own = np.take_along_axis(places, arm[..., None, None, None], -3)[..., 0, :, :]
        place = np.take_along_axis(own, np.asarray(np.maximum(branch - PLACE, 0))[..., None, None], -2)[..., 0, :]
        return np.stack([np.where(branch == FINISH, 1.0, -1.0), 2.0 * arm - 1.0, place[..., 0], place[..., 1]], -1)

    def _asked(self, blocks: NDArray[np.float32]) -> NDArray[np.float32]:
        """Outputs (..., arms, outputs) of each arm's network for its block."""
        if len(self.networks) == 1:
            return self._forward(blocks)
        return np.stack([self._forward(blocks[..., arm, :], layers) for arm, layers in enumerate(self.networks)], -2)
