"""What a policy means to do from here: its own rollout on the rule book."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.policies import SupervisorPolicy
from marl_handover.task.episode import advance

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
    ahead: list[Placement] = []
    over = False
    while not over:
        action = policy.act(here, there, np.asarray(previous))
        stepped = advance(rules, here, there, previous, action, np.int64(len(ahead)), may_wait=True)
        result, over = stepped.result, bool(stepped.over)
        if bool(stepped.idle):
            break
        external = int(result.external_arm)
        if bool(result.feasible):
            ahead.append(Placement(np.array(result.placed, float), int(result.command.arm), bool(result.command.final)))
        if external >= 0:
            ahead.append(Placement(np.array(result.pose, float), external, True))
        if not (bool(result.feasible) or external >= 0):
            break
        here, previous = np.asarray(result.pose, float), result.previous_arm
    return ahead
