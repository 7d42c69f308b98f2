"""What is kept of an episode of the closed loop: every transfer, with what it was judged to be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import wrap
from marl_handover.envs.cycle_check import FAILURES
from marl_handover.task.rules import Outcome, Rules

Floats = NDArray[np.float64]

SAME_MM, SAME_RAD = 0.01, 1e-4
"""Poses nearer than this are the same: nothing was moved."""


def moved(before: Floats, after: Floats, same_mm: float = SAME_MM, same_rad: float = SAME_RAD) -> bool:
    """Whether an object measured at pose ``before`` (3,) is elsewhere, or turned, at ``after`` (3,)."""
    return bool(abs(after[:2] - before[:2]).max() >= same_mm or abs(wrap(after[2] - before[2])) >= same_rad)


class Done(NamedTuple):
    """What came of an order to an arm.

    ``pose`` (3,) measured afterwards; ``refusal``: a value of :class:`~marl_handover.envs.cycle_check.Refusal`, or None;
    ``detail``: the arm's words about it; ``planning_ms``; ``duration_s`` and ``path_mm`` of the motion, 0 if there was none;
    ``truth`` (3,): where the object truly is then, None where nobody knows better than ``pose``.
    """

    pose: Floats
    refusal: str | None
    detail: str = ""
    planning_ms: float = 0.0
    duration_s: float = 0.0
    path_mm: float = 0.0
    truth: Floats | None = None

    @property
    def true(self) -> Floats:
        """The best there is: ``truth``, else ``pose``."""
        return self.pose if self.truth is None else self.truth

    @property
    def tried(self) -> bool:
        """Whether the transfer took place, well or badly, and is judged by where the object lies.

        Else it was refused, or left an object that had better not be handled, as after a collision; that may have moved too.
        """
        return self.refusal is None or self.refusal in FAILURES


class Order(NamedTuple):
    """What an arm is told.

    Attributes:
        arm: index.
        final: whether it is to end the episode.
        chart: (2,) alpha and beta; 0 for the external final transfer of architecture A.
        place_mm: (2,) where the object is to go.
        predicted: (3,) where the rule book says that exact arms leave it.
        feasible: whether the rule book lets the arm do it.
    """

    arm: int
    final: bool
    chart: Floats
    place_mm: Floats
    predicted: Floats
    feasible: bool


def ordered(rules: Rules, pose: Floats, goal: Floats, action: Floats) -> Order:
    """What a supervisor's ``action`` (4,) orders to be done with an object at ``pose`` (3,), goal (3,)."""
    command = rules.decode(action)
    predicted, feasible = rules.transfer(pose, goal, command)
    chart = np.array(rules.cell.chart.from_table(command.place_mm), float)
    target = goal[:2] if command.final else command.place_mm
    return Order(int(command.arm), bool(command.final), chart, target, predicted, bool(feasible))


def finishing(rules: Rules, pose: Floats, goal: Floats) -> Order | None:
    """Architecture A's final transfer of an object at ``pose`` (3,), if an arm can do it; None in architecture B."""
    if not rules.external_finish:
        return None
    external = rules.external(pose, goal)
    return Order(int(external.arm), True, np.zeros(2), goal[:2], external.pose, True) if external.arm >= 0 else None


@dataclass(frozen=True)
class Transfer:
    """One transfer of the loop.

    Attributes:
        attempt: 0 up to the first verdict; every later verdict counts one on.
        goal: (3,) at the time.
        order: what the arm was told.
        before: (3,) measured pose.
        previous_arm: index, -1 for none.
        done: what came of it.
        reward: r_A or r_B.
        terminated, truncated: whether its attempt ends here, by verdict or for want of transfers.
        outcome: NONE while the attempt goes on.
    """

    attempt: int
    goal: Floats
    order: Order
    before: Floats
    previous_arm: int
    done: Done
    reward: float
    terminated: bool
    truncated: bool
    outcome: Outcome

    @property
    def over(self) -> bool:
        """Whether its attempt ends here."""
        return self.terminated or self.truncated

    def repeats(self, other: Transfer, same_mm: float = SAME_MM, same_rad: float = SAME_RAD) -> bool:
        """Whether both are the same order about an object that has not moved, refused both times; as far as measuring can tell."""
        mine, its = self.order, other.order
        if self.done.tried or other.done.tried or (mine.arm, mine.final) != (its.arm, its.final):
            return False
        return not moved(self.before, other.before, same_mm, same_rad) and bool(abs(mine.place_mm - its.place_mm).max() < same_mm)


@dataclass(frozen=True)
class Episode:
    """A whole episode.

    Attributes:
        goal: (3,), the last one if it was changed.
        transfers: in order.
        ended: ``success``, ``transfers`` (none left) or ``stuck``.
        wall_s: wall-clock time it took.
    """

    goal: Floats
    transfers: tuple[Transfer, ...]
    ended: str
    wall_s: float

    @property
    def first(self) -> tuple[Transfer, ...]:
        """The transfers up to the first verdict."""
        return tuple(transfer for transfer in self.transfers if transfer.attempt == 0)

    @property
    def outcome(self) -> Outcome:
        """The first verdict."""
        return self.first[-1].outcome

    @property
    def solved(self) -> bool:
        """Whether the object came to lie at the goal in the end."""
        return self.ended == "success"
