"""An action's numbers and the choices that they stand for: final, which arm, towards which receiver, where.

Of a pair they are (final, arm, alpha, beta), positive for final and for the second arm; the receiver is the other one. Of N arms, N != 2,
they are (final, a score an arm, a score a receiver, alpha, beta): 2 N + 3 of them, and the greatest scores count. What they do is told by
:meth:`~marl_handover.task.rules.Rules.decode`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import Floats


def action_of(final: ArrayLike, arm: ArrayLike, receiver: ArrayLike, place: ArrayLike, num_arms: int) -> Floats:
    """Actions (..., size) of choices: final bool (...), arm and receiver int (...), place (..., 2)."""
    ahead = np.where(final, 1.0, -1.0)[..., None]
    if num_arms == 2:
        who = [_signs(np.asarray(arm) > 0)[..., None]]
    else:
        who = [_signs(np.asarray(chosen)[..., None] == np.arange(num_arms)) for chosen in (arm, receiver)]
    return np.concatenate([ahead, *who, np.asarray(place, float)], -1)


def choices_of(action: Floats, num_arms: int) -> dict[str, Any]:
    """The AEC supervisor's action of numbers (size,): ``final``, ``arm``, ``place`` (2,), and ``receiver`` unless there are two arms."""
    chosen: dict[str, Any] = {"final": int(action[0] > 0)}
    if num_arms == 2:
        chosen["arm"] = int(action[1] > 0)
    else:
        chosen["arm"], chosen["receiver"] = int(action[1 : 1 + num_arms].argmax()), int(action[1 + num_arms : 1 + 2 * num_arms].argmax())
    return {**chosen, "place": np.asarray(action[-2:], np.float32)}


def _signs(chosen: NDArray[np.bool_]) -> Floats:
    return np.where(chosen, 1.0, -1.0)
