"""What a policy means to do from here: its own rollout on the rule book."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.learning.rollout import nobody_moves
from marl_handover.policies import SupervisorPolicy

Floats = NDArray[np.float64]


class Placement(NamedTuple):
    """A placement to come: ``pose`` (3,) in mm and rad, the arm that places, and whether that is to end the episode."""

    pose: Floats
    arm: int
    final: bool


def foresee(policy: SupervisorPolicy, pose: ArrayLike, goal: ArrayLike, previous_arm: int) -> list[Placement]:
    """The transfers that ``policy`` orders if arms are exact, as many as an episode allows at most.

    Args:
        policy: the supervisor.
        pose: of the object (3,), in mm and rad.
        goal: where it is to go (3,).
        previous_arm: index of the arm that moved last, -1 for none.
    """
    rules, here, there = policy.rules, np.asarray(pose, float), np.asarray(goal, float)
    previous = np.int64(previous_arm)
    limit = rules.config.max_steps
    ahead: list[Placement] = []
    while len(ahead) < limit:
        action = policy.act(here, there, np.asarray(previous))
        early = rules.external_finish and bool(rules.can_finish(here, there).any())
        if bool(nobody_moves(action)) and not early:
            break
        result = rules.step(here, there, previous, action, transfers_left=np.int64(limit - len(ahead)))
        external = int(result.external_arm)
        if bool(result.feasible):
            ahead.append(Placement(np.array(result.placed, float), int(result.command.arm), bool(result.command.final)))
        if external >= 0:
            ahead.append(Placement(np.array(result.pose, float), external, True))
        if bool(result.terminated) or not (bool(result.feasible) or external >= 0):
            break
        here, previous = np.asarray(result.pose, float), result.previous_arm
    return ahead
