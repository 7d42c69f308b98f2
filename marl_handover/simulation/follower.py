"""The simulated cell with arms that follow something else: servos that are emulated elsewhere, on a clock that somebody else moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.simulation.arm import SERVO_S
from marl_handover.simulation.engine import Touch
from marl_handover.simulation.world import CONTROL_S, SimulatedCell

_LOOK_EVERY = round(CONTROL_S / SERVO_S)
_OPEN_SLACK_MM = 0.5
_STILL_RAD, _STILL_MM = 1e-9, 1e-6
_REST_S = 1.0


class ServoState(NamedTuple):
    """Where servos stand: joints (num_arms, 5) in rad; fingers (num_arms,), mm from closed, each, if nothing were between them."""

    joints_rad: Floats
    gripper_mm: Floats


class ServoFollower:
    """Lets the physics of ``cell`` follow ``servos`` up to any time.

    A world in which no servo has moved for a second is at rest and is not computed; so waiting costs nothing.

    Args:
        cell: the physics, reset.
        servos: time in s, never going back -> where the servos stand then.
        t_s: the time now.
    """

    def __init__(self, cell: SimulatedCell, servos: Callable[[float], ServoState], t_s: float = 0.0) -> None:
        self.cell, self._servos = cell, servos
        self.collisions: dict[str, Touch] = {}
        """The first touch of each two bodies that must not, since somebody last emptied it."""
        self.grasps: list[tuple[int, float]] = []
        """Arm and time of every grasp of the pin, since somebody last emptied it."""
        self._begin_s, self._steps, self._still = t_s, 0, 0
        self._last = servos(t_s)
        self._open_mm = cell.motion.finger_travel_mm - _OPEN_SLACK_MM
        self._pin_mm = cell.model.cell.config.block.pin_diameter_mm / 2
        self._holding: set[int] = set()
        self._fine = False

    @property
    def now_s(self) -> float:
        """Up to when the world is computed."""
        return self._begin_s + self._steps * SERVO_S

    def disturbed(self) -> None:
        """Somebody touched the object: the world is not at rest."""
        self._still = 0

    def advance(self, t_s: float) -> None:
        """Let the world follow up to ``t_s``, in whole steps of :data:`SERVO_S`."""
        while self.now_s + SERVO_S <= t_s + 1e-9:
            self._steps += 1
            state = self._servos(self.now_s)
            moved = _differ(state, self._last)
            self._still = 0 if moved else self._still + 1
            if self._still * SERVO_S < _REST_S:
                self._step(state)
            self._last = state

    def _step(self, state: ServoState) -> None:
        cell = self.cell
        speeds = (state.joints_rad - self._last.joints_rad) / SERVO_S
        for arm, body in enumerate(cell.arms):
            body.aim(self._last.joints_rad[arm], speeds[arm], float(state.gripper_mm[arm]))
        # Fingers that are not wide open may be on the pin.
        fine = bool((state.gripper_mm < self._open_mm).any())
        if fine != self._fine:
            self._fine = fine
            cell.engine.fine(fine)
        cell.engine.advance(SERVO_S)
        if self._steps % _LOOK_EVERY == 0:
            self._look(state)

    def _look(self, state: ServoState) -> None:
        """Who holds the pin, and what touches what."""
        for arm, opening in enumerate(state.gripper_mm):
            if opening < self._pin_mm:
                holds = self.cell.grasp(arm)
            else:
                self.cell.release(arm)
                holds = opening < self._open_mm and self.cell.held(arm)
            if holds and arm not in self._holding:
                self.grasps.append((arm, self.now_s))
            (self._holding.add if holds else self._holding.discard)(arm)
        for name, touch in self.cell.collisions(self._holding).items():
            self.collisions.setdefault(name, touch)


def _differ(one: ServoState, other: ServoState) -> bool:
    return bool(np.abs(one.joints_rad - other.joints_rad).max() > _STILL_RAD or np.abs(one.gripper_mm - other.gripper_mm).max() > _STILL_MM)
