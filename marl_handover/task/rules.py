"""The rule book: what a command does to the object, what it earns, when an episode ends. Batched and pure.

Every environment of the package is a thin skin over :class:`Rules`. All arrays may be numpy or torch; shapes are (...) for a
batch of problems, (..., 3) for poses (x_mm, y_mm, theta_rad). Arms are indices, any number of them; ``previous_arm`` is -1 before the first
transfer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from enum import IntEnum
from typing import Any, NamedTuple

from marl_handover.arrays import Array, length, namespace, one_where, select, wrap
from marl_handover.cell.arm import REACH_TOLERANCE_MM
from marl_handover.cell.batch import CellBatch
from marl_handover.cell.cell import Cell
from marl_handover.cell.symmetry import NO_ARM
from marl_handover.config import REWARDS, TaskConfig

MotionCost = Callable[[Cell, Array, Array, Array], Array]
"""Cost in mm, shape (...), of a transfer: cell, arm (...), from_mm (..., 2), to_mm (..., 2). Eq. (3) of the paper."""

ROUNDING_RAD = 1e-5
"""An orientation that was foreseen within epsilon does not fail by float32 rounding."""


class Outcome(IntEnum):
    """How an episode ended; NONE while it goes on."""

    NONE = 0
    SUCCESS = 1
    WRONG_ORIENTATION = 2
    WRONG_POSITION = 3
    TIMEOUT = 4


class Command(NamedTuple):
    """A decoded action: ``final`` bool (...), ``arm`` int (...), ``place_mm`` (..., 2), ``receiver`` int (...).

    The place lies in what arm and receiver share; of a final transfer receiver and place mean nothing.
    """

    final: Array
    arm: Array
    place_mm: Array
    receiver: Array = NO_ARM


class Verdict(NamedTuple):
    """What a transfer earned: reward (...), terminated bool (...), outcome int (...)."""

    reward: Array
    terminated: Array
    outcome: Array


class Finishing(NamedTuple):
    """Each arm's final transfer, if it were done now; all (..., num_arms).

    ``able``: it reaches object and goal and leaves at most epsilon; ``error_rad``: the orientation error left; ``turn_rad``:
    the turn of the object.
    """

    able: Array
    error_rad: Array
    turn_rad: Array


class External(NamedTuple):
    """Architecture A's final transfer: ``arm`` int (...), -1 where none can finish; ``pose`` (..., 3), where the object is to be then."""

    arm: Array
    pose: Array


class Transition(NamedTuple):
    """Result of one decision.

    ``placed`` is the pose after the commanded transfer; ``pose`` also includes the external final transfer of architecture A,
    done by ``external_arm`` (-1 where there was none). ``transfers`` counts both. ``feasible`` is False where the arm refused
    or, in architecture A, where the command was ignored because the episode was solved at its start.
    """

    pose: Array
    previous_arm: Array
    placed: Array
    command: Command
    feasible: Array
    external_arm: Array
    transfers: Array
    reward: Array
    terminated: Array
    outcome: Array


def straight_line_mm(cell: Cell, arm: Array, start_mm: Array, end_mm: Array) -> Array:
    """Length of the straight line from pick-up to drop-off: the simplest :data:`MotionCost`."""
    return length(end_mm - start_mm)


def carried(pose: Array, target_mm: Array, turn_rad: Array) -> Array:
    """Pose (..., 3) of an object taken from ``pose`` to ``target_mm`` (..., 2) by a gripper that turns by ``turn_rad`` (...) on the way."""
    return namespace(pose).concat([target_mm, wrap(pose[..., 2] + turn_rad)[..., None]], -1)


class Rules:
    """The decision problem of one cell, or of a batch of cells with a row each (method section 3).

    :meth:`step` is a decision from end to end. Who executes transfers elsewhere composes it from the same pieces: :meth:`decode`,
    :meth:`transfer`, then :meth:`judge` (architecture B) or :meth:`external` and :meth:`external_verdict` (A).
    ``physical`` says that placements are measured, though the task's settings have no noise.
    """

    def __init__(self, cell: Any, config: TaskConfig, motion_cost: MotionCost = straight_line_mm, *, physical: bool = False) -> None:
        config.validate()
        self.cell = cell
        self.config = config
        self.motion_cost = motion_cost
        self.epsilon_rad = math.radians(config.epsilon_deg)
        self.noisy = config.noise.position_mm > 0 or config.noise.yaw_deg > 0
        self.measured = self.noisy or physical
        if cell.num_arms != 2:
            self.action_size = 2 * cell.num_arms + 3

    action_size = 4  # numbers in an action of a pair; N arms: final, a score an arm, a score a receiver, alpha, beta

    def on(self, cell: Cell | CellBatch) -> Rules:
        """The same rules for another cell, or batch of cells, with as many arms."""
        other = copy(self)
        other.cell = cell
        return other

    def of_rows(self, rows: Array) -> Rules:
        """The rules of some rows (by number, or a mask) of a batch of cells; of one cell itself."""
        cell = self.cell.take(rows)
        return self if cell is self.cell else self.on(cell)

    @property
    def external_finish(self) -> bool:
        """Architecture A: the final transfer is found by kinematics, not by the policy."""
        return self.config.architecture == "A"

    def orientation_error(self, theta_rad: Array, goal_theta_rad: Array) -> Array:
        """Signed error in rad, wrapped modulo the block's symmetry 2 pi / k; elementwise."""
        k = self.config.symmetry_order
        return wrap((theta_rad - goal_theta_rad) * k) / k

    def finishing(self, pose: Array, goal: Array, epsilon_rad: Array | float | None = None) -> Finishing:
        """What each arm would do to the object by taking it to the goal now."""
        reached, yaw = self.cell.seen(pose)
        goal_reached, goal_yaw = self.cell.seen(goal)
        turn = goal_yaw - yaw
        error = self.orientation_error(pose[..., 2:3] + turn, goal[..., 2:3])
        return Finishing(reached & goal_reached & (abs(error) <= self._epsilon(epsilon_rad)), error, turn)

    def finishing_error(self, pose: Array, goal: Array) -> Array:
        """Orientation error each arm would leave if it took the object to the goal now: rad, (..., num_arms). Ignores reach."""
        return self.finishing(pose, goal).error_rad

    def can_finish(self, pose: Array, goal: Array, epsilon_rad: Array | float | None = None) -> Array:
        """Which arms can put the object at the goal within epsilon: bool (..., num_arms)."""
        return self.finishing(pose, goal, epsilon_rad).able

    def decode(self, action: Array) -> Command:
        """Command of an action whose numbers are in [-1, 1].

        Of a pair (..., 4): final, arm, alpha, beta; a positive first or second number means final / R. Of N arms (..., 2 N + 3): final, a
        score an arm, a score a receiver, alpha, beta; the greatest scores say who moves the object, and in the space shared with whom the
        place lies. An arm and a receiver that share nothing have no place there: NaN, which nobody reaches.
        """
        xp, count = namespace(action), self.cell.num_arms
        final = action[..., 0] > 0
        if self.external_finish:
            final = xp.zeros_like(final)
        alpha, beta = xp.clip(action[..., -2], -1.0, 1.0), xp.clip(action[..., -1], -1.0, 1.0)
        if count == 2:
            arm, space = xp.where(action[..., 1] > 0, 1, 0), self.cell.graph.edges.get((0, 1))
            return Command(final, arm, math.nan * action[..., -2:] if space is None else space.to_table(alpha, beta), 1 - arm)
        arm, receiver = xp.argmax(action[..., 1 : 1 + count], -1), xp.argmax(action[..., 1 + count : 1 + 2 * count], -1)
        return Command(final, arm, self.cell.place_mm(arm, receiver, alpha, beta), receiver)

    def transfer(self, pose: Array, goal: Array, command: Command) -> tuple[Array, Array]:
        """Where a command takes the object on exact hardware, and whether the arm can do it: ((..., 3), bool (...)).

        theta' = theta + psi_b(p') - psi_b(p). A refused transfer leaves the object where it is.
        """
        reached, yaw = self.cell.seen(pose)
        target = one_where(command.final, goal[..., :2], command.place_mm)
        target_reached, target_yaw = self.cell.seen(target)
        feasible = select(reached & target_reached, command.arm)
        moved = carried(pose, target, select(target_yaw - yaw, command.arm))
        return one_where(feasible, moved, pose), feasible

    def judge(self, placed: Array, goal: Array, final: Array, feasible: Array, epsilon_rad: Array | float | None = None) -> Verdict:
        """Reward r_A or r_B of a transfer that left the object at ``placed``; a pure function, also used for hindsight.

        Architecture A: 0 and the end if an arm could now finish within epsilon, else -1. Architecture B: +20 and the end at the
        goal within epsilon; -30 and the end for a refused transfer or a final one that missed; else -1.
        """
        xp = namespace(placed)
        reward, one = self.config.reward, xp.ones_like(placed[..., 0])
        if self.external_finish:
            solved = self.can_finish(placed, goal, epsilon_rad).any(-1)
            return Verdict(xp.where(solved, 0 * one, -one), solved, xp.where(solved, int(Outcome.SUCCESS), int(Outcome.NONE)))
        distance = xp.sqrt(((placed[..., :2] - goal[..., :2]) ** 2).sum(-1))
        there = distance <= xp.where(final, self.tolerance_mm * one, REACH_TOLERANCE_MM * one)
        turned = abs(self.orientation_error(placed[..., 2], goal[..., 2])) <= self._epsilon(epsilon_rad, per_arm=False)
        success = feasible & there & turned
        failure = ~feasible | (final & ~success)
        earned = xp.where(success, reward.success * one, xp.where(failure, reward.failure * one, reward.step * one))
        missed = xp.where(feasible & there, int(Outcome.WRONG_ORIENTATION), int(Outcome.WRONG_POSITION))
        outcome = xp.where(success, int(Outcome.SUCCESS), xp.where(failure, missed, int(Outcome.NONE)))
        return self._own_reward(Verdict(earned, success | failure, outcome), placed, goal)

    def _own_reward(self, verdict: Verdict, placed: Array, goal: Array) -> Verdict:
        """The verdict with the reward that the function of a plugin makes of it, if the settings name one."""
        name = self.config.reward.function
        return verdict._replace(reward=REWARDS[name](self, verdict, placed, goal)) if name else verdict

    def motion_penalty(self, arm: Array, pose: Array, placed: Array) -> Array:
        """What a commanded transfer costs for its path, (...): motion_weight * path cost in mm / 100; it does not depend on the goal."""
        weight = self.config.reward.motion_weight
        if weight == 0:
            return 0 * placed[..., 0]
        return weight * self.motion_cost(self.cell, arm, pose[..., :2], placed[..., :2]) / 100

    @property
    def tolerance_mm(self) -> float:
        """How far from the goal position a final placement may land: 1 um on exact hardware, else the setting."""
        return self.config.position_tolerance_mm if self.measured else REACH_TOLERANCE_MM

    def external(self, pose: Array, goal: Array, room: Array | bool = True, epsilon_rad: Array | float | None = None) -> External:
        """Architecture A's choice for an object at ``pose``: the arm that finishes within epsilon, where there is ``room`` for it."""
        xp = namespace(pose)
        finishing = self.finishing(pose, goal, epsilon_rad)
        solved = finishing.able.any(-1) & room
        # The arm that leaves the smaller error: a rule that favours neither side keeps the mirror law.
        error = abs(finishing.error_rad)
        nearest = xp.argmin(xp.where(finishing.able, error, error + 2 * math.pi), -1)
        final_pose = carried(pose, goal[..., :2], select(finishing.turn_rad, nearest))
        return External(xp.where(solved, nearest, -1), one_where(solved, final_pose, pose))

    def external_verdict(self, pose: Array, goal: Array, external_arm: Array, epsilon_rad: Array | float | None = None) -> Verdict:
        """Reward r_A of a decision after which ``external_arm`` (-1: none) took the object and left it at ``pose``.

        On exact hardware the final transfer does what was foreseen; otherwise it is what came of it that counts.
        """
        xp = namespace(pose)
        solved, one = external_arm >= 0, xp.ones_like(pose[..., 0])
        offset = xp.sqrt(((pose[..., :2] - goal[..., :2]) ** 2).sum(-1))
        left = abs(self.orientation_error(pose[..., 2], goal[..., 2]))
        there, turned = offset <= self.tolerance_mm, left <= self._epsilon(epsilon_rad, per_arm=False) + ROUNDING_RAD
        missed = xp.where(there, int(Outcome.WRONG_ORIENTATION), int(Outcome.WRONG_POSITION))
        outcome = xp.where(solved, xp.where(there & turned, int(Outcome.SUCCESS), missed), int(Outcome.NONE))
        return Verdict(xp.where(solved & there & turned, 0 * one, -one), solved, outcome)

    def step(
        self,
        pose: Array,
        goal: Array,
        previous_arm: Array,
        action: Array,
        *,
        transfers_left: Array | None = None,
        epsilon_rad: Array | float | None = None,
        noise: Array | None = None,
        final_noise: Array | None = None,
    ) -> Transition:
        """Apply one decision to a batch.

        Args:
            pose: (..., 3).
            goal: (..., 3).
            previous_arm: int (...), -1 for none.
            action: (..., 4) as in :meth:`decode`.
            transfers_left: int (...), transfers allowed from here; architecture A finishes externally only within it.
            epsilon_rad: scalar or (...); the setting's value if None.
            noise: (..., 3) offset of what is placed: mm, mm, rad.
            final_noise: (..., 3) the same for architecture A's external transfer.
        """
        xp = namespace(pose)
        command = self.decode(action)
        placed, feasible = self.transfer(pose, goal, command)
        if noise is not None:
            placed = self._displaced(placed, one_where(feasible, noise, 0 * noise))
        if not self.external_finish:
            verdict = self.judge(placed, goal, command.final, feasible, epsilon_rad)
            none, one = 0 * command.arm - 1, 0 * command.arm + 1
            after = xp.where(feasible, command.arm, previous_arm)
            reward = verdict.reward - self.motion_penalty(command.arm, pose, placed)
            return Transition(placed, after, placed, command, feasible, none, one, reward, verdict.terminated, verdict.outcome)
        return self._step_external(pose, goal, previous_arm, command, placed, feasible, transfers_left, epsilon_rad, final_noise)

    def _step_external(
        self,
        pose: Array,
        goal: Array,
        previous_arm: Array,
        command: Command,
        placed: Array,
        feasible: Array,
        transfers_left: Array | None,
        epsilon_rad: Array | float | None,
        final_noise: Array | None,
    ) -> Transition:
        """Architecture A: an object that can be finished is finished; before the command, if it can be already then."""
        xp = namespace(pose)
        early = self.can_finish(pose, goal, epsilon_rad).any(-1)  # solved at the start: the action is ignored
        placed, feasible = one_where(early, pose, placed), feasible & ~early
        room = True if transfers_left is None else (early | (transfers_left > 1))
        external = self.external(placed, goal, room, epsilon_rad)
        solved, final_pose = external.arm >= 0, external.pose
        if final_noise is not None:
            final_pose = one_where(solved, self._displaced(final_pose, final_noise), final_pose)
        after = xp.where(solved, external.arm, xp.where(feasible, command.arm, previous_arm))
        transfers = xp.where(early, 0, 1) + xp.where(solved, 1, 0)
        verdict = self.external_verdict(final_pose, goal, external.arm, epsilon_rad)
        reward = verdict.reward - self.motion_penalty(command.arm, pose, placed)
        return Transition(final_pose, after, placed, command, feasible, external.arm, transfers, reward, *verdict[1:])

    def _epsilon(self, epsilon_rad: Array | float | None, per_arm: bool = True) -> Array:
        if epsilon_rad is None:
            return self.epsilon_rad
        if per_arm and not isinstance(epsilon_rad, float) and epsilon_rad.ndim:
            return epsilon_rad[..., None]
        return epsilon_rad

    def _displaced(self, pose: Array, offset: Array) -> Array:
        return carried(pose, pose[..., :2] + offset[..., :2], offset[..., 2])
