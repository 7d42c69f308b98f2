"""Transfers of an episode of the closed loop: commanded, carried out, judged; the lines that a trace has of them; and those to come."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats, wrap
from marl_handover.cell import Cell
from marl_handover.cell.symmetry import ARM_LETTERS, NO_ARM
from marl_handover.envs.cycle_check import FAILURES
from marl_handover.learning.evaluation import judged_by
from marl_handover.policies import SupervisorPolicy
from marl_handover.task.episode import advance
from marl_handover.task.rules import Outcome, Rules

SAME_MM, SAME_RAD = 0.01, 1e-4
"""Poses nearer than this are the same: nothing was moved."""


def moved(before: Floats, after: Floats, same_mm: float = SAME_MM, same_rad: float = SAME_RAD) -> bool:
    """Whether an object measured at pose ``before`` (3,) is elsewhere, or turned, at ``after`` (3,)."""
    return bool(abs(after[:2] - before[:2]).max() >= same_mm or abs(wrap(after[2] - before[2])) >= same_rad)


class TransferResult(NamedTuple):
    """What came of a command to an arm.

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


class TransferCommand(NamedTuple):
    """What an arm is told.

    Attributes:
        arm: index.
        final: whether it is to end the episode.
        chart: (2,) alpha and beta; 0 for the external final transfer of architecture A.
        place_mm: (2,) where the object is to go.
        predicted: (3,) where the rule book says that exact arms leave it.
        feasible: whether the rule book lets the arm do it.
        receiver: index of the arm that shares the place; -1 if there is none.
    """

    arm: int
    final: bool
    chart: Floats
    place_mm: Floats
    predicted: Floats
    feasible: bool
    receiver: int = NO_ARM


@dataclass(frozen=True)
class Transfer:
    """One transfer of the loop.

    Attributes:
        attempt: 0 up to the first verdict; every later verdict counts one on.
        goal: (3,) at the time.
        command: what the arm was told.
        before: (3,) measured pose.
        previous_arm: index, -1 for none.
        result: what came of it.
        reward: r_A or r_B.
        terminated, truncated: whether its attempt ends here, by verdict or for want of transfers.
        outcome: NONE while the attempt goes on.
    """

    attempt: int
    goal: Floats
    command: TransferCommand
    before: Floats
    previous_arm: int
    result: TransferResult
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
        mine, its = self.command, other.command
        if self.result.tried or other.result.tried or (mine.arm, mine.final) != (its.arm, its.final):
            return False
        return not moved(self.before, other.before, same_mm, same_rad) and bool(abs(mine.place_mm - its.place_mm).max() < same_mm)


@dataclass(frozen=True)
class Episode:
    """A whole episode.

    Attributes:
        goal: (3,), the last one if it was changed.
        transfers: in order.
        ended: ``success``, ``transfers`` (none left), ``stuck`` or, with arms out of order, ``unreachable``.
        wall_s: wall-clock time it took.
        lost_at: transfers that were made when an arm went out of order; None: none did.
    """

    goal: Floats
    transfers: tuple[Transfer, ...]
    ended: str
    wall_s: float
    lost_at: int | None = None

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


def trace_text(episodes: Sequence[Episode], rules: Rules) -> str:
    """All lines, episode by episode; what came after the first verdict has an ``attempt`` above 0."""
    rows = [
        {"episode": number, "step": step, **transfer_row(transfer, rules)}
        for number, episode in enumerate(episodes)
        for step, transfer in enumerate(episode.transfers)
    ]
    return "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)


def transfer_row(transfer: Transfer, rules: Rules) -> dict[str, Any]:
    """One line: the fields of a kinematic trace with measured poses, and what only a motion has."""
    command, result, labels = transfer.command, transfer.result, rules.cell.labels
    receiver = None if command.final or command.receiver < 0 else labels[command.receiver]
    return {
        "state": transfer.before.tolist(),
        "goal": transfer.goal.tolist(),
        "previous_arm": labels[transfer.previous_arm] if transfer.previous_arm >= 0 else None,
        "arm": labels[command.arm],
        **({} if labels == ARM_LETTERS else {"receiver": receiver}),
        "final": command.final,
        "place": command.place_mm.tolist(),
        "alpha": float(command.chart[0]),
        "beta": float(command.chart[1]),
        "next_state": result.pose.tolist(),
        "reward": transfer.reward,
        "terminated": transfer.terminated,
        "truncated": transfer.truncated,
        "outcome": None if transfer.outcome is Outcome.NONE else transfer.outcome.name.lower(),
        **judged_by(rules),
        "attempt": transfer.attempt,
        "refusal": result.refusal and str(result.refusal),
        "detail": result.detail,
        "planning_ms": result.planning_ms,
        "duration_s": result.duration_s,
        "path_mm": result.path_mm,
    }


class Placement(NamedTuple):
    """A placement to come: ``pose`` (3,) in mm and rad, the arm that places, and whether that is to end the episode."""

    pose: Floats
    arm: int
    final: bool


def rollout(policy: SupervisorPolicy, pose: ArrayLike, goal: ArrayLike, previous_arm: int, whole: Cell | None = None) -> list[Placement]:
    """The transfers that ``policy`` orders if arms are exact, as many as an episode allows at most.

    Args:
        policy: the supervisor.
        pose: of the object (3,), in mm and rad.
        goal: where it is to go (3,).
        previous_arm: index of the arm that moved last, -1 for none.
        whole: the cell whose arms are counted, if some of them are out of order; else the policy's own.
    """
    rules, here, there = policy.rules, np.asarray(pose, float), np.asarray(goal, float)
    cell = rules.cell if whole is None else whole
    previous = rules.cell.numbered(previous_arm, cell)
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
            arm = int(cell.numbered(result.command.arm, rules.cell))
            ahead.append(Placement(np.array(result.placed, float), arm, bool(result.command.final)))
        if external >= 0:
            ahead.append(Placement(np.array(result.pose, float), int(cell.numbered(external, rules.cell)), True))
        if not (bool(result.feasible) or external >= 0):
            break
        here, previous = np.asarray(result.pose, float), result.previous_arm
    return ahead
