"""Actions of the hierarchy as agents send them, which may be anything, and what they say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.envs.cycle_check import Refusal
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.motion.trajectory import PickPlacePaths

Floats = NDArray[np.float64]

REASONS = (Refusal.DECLINED, Refusal.OUT_OF_REACH, Refusal.NO_PATH)
"""What an arm's ``reason`` stands for; numbers as in :mod:`marl_handover.motion.executor`."""

SNAP_RAD = 1e-6
"""A control point this far beyond a joint's limit is put on it: float32 rounding, not a command."""


def read_command(action: Any, num_arms: int) -> Floats | Refusal:
    """The supervisor's action as the rule book's (4,), or why it is none."""
    final, arm, place = _choice(action, "final", 2), _choice(action, "arm", num_arms), _numbers(action, "place", (2,))
    if isinstance(final, Refusal):
        return final
    if isinstance(arm, Refusal):
        return arm
    if isinstance(place, Refusal):
        return place
    return np.array([2.0 * final - 1.0, 2.0 * arm - 1.0, *place])


def read_cycle(action: Any, control_points: int, arm: ArmModel) -> PickPlacePaths | Refusal:
    """An arm's action as paths, or why it is none."""
    grasp, release = _choice(action, "grasp", 2), _choice(action, "release", 2)
    for value in (grasp, release):
        if isinstance(value, Refusal):
            return value
    if not (grasp and release):
        reason = _choice(action, "reason", len(REASONS)) if "reason" in action else 0  # who declines need not say why
        return reason if isinstance(reason, Refusal) else REASONS[reason]
    paths = _numbers(action, "paths", (3, control_points, len(arm.lower_rad)))
    if isinstance(paths, Refusal):
        return paths
    inside = np.clip(paths, arm.lower_rad, arm.upper_rad)
    return PickPlacePaths(*np.where(abs(paths - inside) <= SNAP_RAD, inside, paths))


def _choice(action: Any, key: str, count: int) -> int | Refusal:
    number = _numbers(action, key, ())
    if isinstance(number, Refusal):
        return number
    return int(number) if number in range(count) else Refusal.WRONG_SHAPE


def _numbers(action: Any, key: str, shape: tuple[int, ...]) -> Floats | Refusal:
    """Finite numbers of that shape; a single one may come wrapped."""
    if not isinstance(action, Mapping) or key not in action:
        return Refusal.WRONG_SHAPE
    try:
        values = np.asarray(action[key], float)
    except (TypeError, ValueError, ArithmeticError, RuntimeError):  # what numpy and torch find wrong with it
        return Refusal.WRONG_SHAPE
    if shape == () and values.size == 1:
        values = values.reshape(())
    if values.shape != shape:
        return Refusal.WRONG_SHAPE
    return values if np.isfinite(values).all() else Refusal.NOT_FINITE
