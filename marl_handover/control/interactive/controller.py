"""The interactive cell from within, for one thread: what the policy decides, what is under way, and what becomes of it on a change."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from marl_handover.arrays import Floats
from marl_handover.cell import NO_ARM, Cell
from marl_handover.cell.build import CellModel
from marl_handover.config import LoopConfig, MotionConfig
from marl_handover.control.closed_loop import finish_command, transfer_command
from marl_handover.control.interactive.motion_program import FreePaths, MotionPrograms
from marl_handover.control.interactive.world_state import WorldState, projected
from marl_handover.control.transfers import SAME_MM, Placement, TransferCommand, rollout
from marl_handover.errors import InvalidSetting, WorkFailed, counted
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.motion.planner import MotionPlanner
from marl_handover.policies import SupervisorPolicy
from marl_handover.task.episode import nobody_moves
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules

MOST_TRANSFERS = LoopConfig().transfers
"""An episode that takes more is given up."""


def _reaches(cell: Cell) -> list[tuple[Any, ...]]:
    """Where each arm of a cell stands and what it reaches: cells whose settings say the same in other words are alike."""
    return [(arm.base, arm.r_min_mm, arm.r_max_mm, arm.yaw_rad) for arm in cell.arms] + [(cell.config.chart_inset,), cell.pick_heights_mm]


class PolicyAdapter:
    """A policy under the exact rule book of the cell.

    Arms are counted as the cell has them; those that are out of order for the policy stand in it, and do nothing.

    Args:
        policy: the supervisor.
        model: the cell; it has to be the policy's own, but for the part of the chart in use.
        motion: how the arms move, whose ways are priced.

    Raises:
        InvalidSetting: of a policy for another cell, or one whose motions are its own.
    """

    def __init__(self, policy: SupervisorPolicy, model: CellModel, motion: MotionConfig) -> None:
        policy.require_executors()
        own = policy.rules.cell.config
        cell = model.cell.with_inset(own.chart_inset)
        if own.enabled is not None:
            cell = cell.with_arms(own.enabled)
        if _reaches(cell) != _reaches(policy.rules.cell):
            raise InvalidSetting("policy", policy.name, f"one for the cell {model.cell.config.name!r}; this one is for {own.name!r}")
        self.cell = model.cell
        self.rules = Rules(cell, policy.rules.config, motion_cost(cell, policy.rules.config, motion))
        self.policy = policy.under(self.rules)
        self.exact = ExactPlanner(self.rules)

    def command(self, pose: Floats, goal: Floats, previous: int) -> TransferCommand | None:
        """What is to be done with a block at ``pose`` (3,); None: the policy wants no arm to move.

        Architecture A's final transfer, where an arm can do it, comes before the policy's wishes.
        """
        command = finish_command(self.rules, pose, goal)
        if command is None:
            if self.rules.cell.config.enabled is not None and self.why_unsolvable(pose, goal):
                return None
            action = self.policy.act(pose, goal, self.rules.cell.numbered(previous, self.cell))
            if bool(nobody_moves(action)):
                return None
            command = transfer_command(self.rules, pose, goal, action)
        arm, receiver = self.cell.numbered([command.arm, command.receiver], self.rules.cell).tolist()
        return command._replace(arm=arm, receiver=receiver)

    def why_unsolvable(self, pose: Floats, goal: Floats) -> str:
        """Why the arms that are in order cannot bring the block from ``pose`` (3,) to ``goal`` (3,); empty if they can."""
        return "" if self.there(pose, goal) else self.exact.unsolvable_because(pose, goal)

    def there(self, pose: Floats, goal: Floats) -> bool:
        """Whether a block at ``pose`` (3,) is at the goal."""
        return int(self.rules.external_verdict(pose, goal, np.int64(0)).outcome) == Outcome.SUCCESS

    def optimum(self, pose: Floats, goal: Floats) -> int:
        """The fewest transfers; 0 at the goal, and where there is no plan."""
        return 0 if self.there(pose, goal) else int(self.exact.plan(pose, goal).transfers)

    def rollout(self, pose: Floats, goal: Floats, previous: int, first: TransferCommand | None) -> tuple[Placement, ...]:
        """The placements from ``pose`` (3,) on, if everybody does as told; ``first`` has been ordered already."""
        if first is None or not first.feasible:
            return ()
        plan = [Placement(first.predicted, first.arm, first.final)]
        if not self.there(first.predicted, goal):
            plan += rollout(self.policy, first.predicted, goal, first.arm, self.cell)
        return tuple(plan[: self.rules.config.max_steps])


@dataclass
class Score:
    """Episodes that came to an end, how many of them with the block at the goal, and how long those took against the optimum."""

    episodes: int = 0
    solved: int = 0
    _ratios: float = 0.0
    _rated: int = 0

    def add(self, solved: bool, transfers: int, optimal: int) -> None:
        """One more episode."""
        self.episodes += 1
        self.solved += solved
        if solved and optimal > 0:
            self._ratios, self._rated = self._ratios + transfers / optimal, self._rated + 1

    @property
    def ratio(self) -> float:
        """Transfers over the optimum, the mean of solved episodes; nan at first."""
        return self._ratios / self._rated if self._rated else math.nan


DRAWS = 100
"""Random problems looked at for one that can be solved, and whose block does not land on a hand."""

DONE, STUCK = "done", "stuck"


class InteractiveController:
    """Arms, block and goal, and the policy that is at it.

    Attributes:
        body: arms and block.
        goal: (3,).
        plan: the placements to come.
        transfers, optimal: since the episode began or was changed last.
        ended: "", done or stuck.
        score: of the episodes that have ended.
        message: the last event.

    Args:
        adapter: of the supervisor.
        model: the cell.
        planner: of its arms.
        seed: of the problems.
    """

    def __init__(self, adapter: PolicyAdapter, model: CellModel, planner: MotionPlanner, seed: int) -> None:
        self.adapter, self.programs = adapter, MotionPrograms(FreePaths(planner))
        self.world, self.score = WorldState(model, planner.homes_rad, np.zeros(3)), Score()
        self.goal, self.ended, self.message = np.zeros(3), "", ""
        self.plan: tuple[Placement, ...] = ()
        self.transfers, self.optimal = 0, 0
        self._generator = torch.Generator().manual_seed(seed)
        self._command: TransferCommand | None = None
        self._previous = NO_ARM
        self._open = False
        self.pose_problem(None)
        self._reopen()

    @property
    def moving(self) -> bool:
        """Whether an arm has something to do."""
        return bool(self.world.program)

    def pose_problem(self, seed: int | None) -> bool:
        """A random block and goal, the next ones or those of ``seed``; False if every block drawn would have landed on a hand."""
        generator = self._generator if seed is None else torch.Generator().manual_seed(seed)
        for _ in range(DRAWS):
            block, goal = (np.asarray(poses[0]) for poses in sample_problems(self.adapter.rules.cell, 1, generator))
            if self.adapter.optimum(block, goal) > 0 and self.put(block):
                self.goal, self._previous, self.message = goal, NO_ARM, "new problem"
                return True
        self.message = "found no new problem that can be solved"
        return False

    def put(self, block: Floats) -> bool:
        """The block lies at ``block`` (3,), unless an arm is there and cannot be kept off."""
        world, paths = self.world, self.programs.paths
        for arm, joints in enumerate(world.joints_rad):
            samples = self.programs.stop(world).joints_rad if arm == world.arm else joints[None]
            if not (paths.parked(arm, joints) or paths.clear_of_block(arm, samples, block[:2])):
                self.message = f"arm {self._label(arm)} is in the way there"
                return False
        self.message = f"block taken from the hand of {self._label(world.arm)}" if world.held else "block moved"
        world.put(block)
        return True

    def replan(self, block_moved: bool) -> None:
        """Decide afresh, and let the arms do it from where they are; plans one path."""
        self._reopen()
        world, planned = self.world, self.programs.paths.planned
        if not world.program:
            self.proceed()
        elif world.held:
            self._replan_held()
        else:
            self._command = self._next_command(world.pose, self._previous)
            try:
                world.start(self.programs.redirected(world, self._command, block_moved))
                self._show()
            except WorkFailed as failure:
                self._helpless(failure)
        if self.programs.paths.planned == planned:
            self.prepare()

    def lay_out(self, adapter: PolicyAdapter, planner: MotionPlanner) -> None:
        """The cell is another one: decide afresh, and go on from where the arms are that stay; plans a path or two.

        Arms that stand elsewhere now are parked at once. What they held lies where it was seen from above, if an arm reaches that.
        """
        before, world = self.world, self.world.relaid(planner.model, planner.homes_rad)
        if before.held and not world.held:
            seen = projected(before.T_world_block())
            world.put(seen if adapter.rules.cell.reaches(seen[:2]).any() else before.pose)
        self._previous = int(planner.model.cell.numbered(self._previous, before.model.cell))
        if self._command is not None:
            self._command = self._command._replace(arm=int(planner.model.cell.numbered(self._command.arm, before.model.cell)))
        self.adapter, self.programs, self.world = adapter, MotionPrograms(FreePaths(planner)), world
        self._reopen()
        try:
            if not world.program:
                self.proceed()
                self.prepare()
            elif world.held:
                self._replan_held(anew=True)
            else:
                self._command = self._next_command(world.pose, self._previous)
                world.start(self.programs.redirected(world, self._command, True))
                self._show()
        except WorkFailed:
            self._park()
            self.prepare()

    def _park(self) -> None:
        """All arms are put into their parked poses by hand, and go on from there."""
        world, arm = self.world, self.world.arm
        if world.held:
            seen = projected(world.T_world_block())
            world.put(seen if self.adapter.rules.cell.reaches(seen[:2]).any() else world.pose)
        world.program.clear()
        world.joints_rad[:], world.opened[:] = self.programs.paths.homes_rad, 1.0
        self.ended = ""
        self.proceed()
        self.message = f"{self._label(arm)} had no way on, and was parked by hand; {self.message}"

    def _label(self, arm: int) -> str:
        return self.adapter.cell.labels[arm]

    def proceed(self) -> None:
        """Nothing moves: the next transfer, if there is one."""
        world, paths = self.world, self.programs.paths
        self._command = self._next_command(world.pose, self._previous)
        program = [self.programs.home(arm, q, world.pose) for arm, q in enumerate(world.joints_rad) if not paths.parked(arm, q)]
        if self._command is not None:
            program += self.programs.cycle(self._command, world.pose)
        world.start(program)
        self._show()

    def prepare(self) -> None:
        """Plan the next piece that is not planned yet, if there is one."""
        for index, segment in enumerate(self.world.program):
            if segment.track is None and segment.way is not None:
                try:
                    self.world.program[index] = segment._replace(track=segment.way())
                except WorkFailed as failure:
                    self._without(index, failure)
                return

    def step(self, dt_s: float) -> float:
        """Move for at most ``dt_s``; what is left when the program has ended."""
        while dt_s > 0.0 and self.world.ready:
            dt_s, ended = self.world.step(dt_s)
            if ended == "carry":
                self._placed()
        return dt_s

    def _placed(self) -> None:
        """The block stands on the table where it was brought."""
        command = self._command
        assert command is not None
        # The hand is exact to rounding, but for the very edge of its reach, where it may be 20 um off.
        self.world.put(command.predicted)
        self.transfers += 1
        self._previous, self.plan = command.arm, self.plan[1:]
        if self.adapter.there(command.predicted, self.goal):
            self._conclude(DONE, f"at the goal after {counted(self.transfers, 'transfer')}, optimum {self.optimal}")
        else:
            self.message = f"{self._label(command.arm)} has put the block down"

    def _next_command(self, pose: Floats, previous: int) -> TransferCommand | None:
        """The next order, one that can be carried out; None: the episode has ended."""
        if self.adapter.there(pose, self.goal):
            self._conclude(DONE, "the block is at the goal")
            return None
        refused: TransferCommand | None = None
        while self.transfers < MOST_TRANSFERS:
            command = self.adapter.command(pose, self.goal, previous)
            if command is None:
                self._conclude(STUCK, self.adapter.why_unsolvable(pose, self.goal) or "the policy wants no arm to move")
                return None
            if command.feasible:
                return command
            self.transfers += 1
            if refused is not None and _same(refused, command):
                self._conclude(STUCK, f"the policy orders what arm {self._label(command.arm)} cannot reach")
                return None
            refused = command
        self._conclude(STUCK, f"not solved in {MOST_TRANSFERS} transfers")
        return None

    def _replan_held(self, anew: bool = False) -> None:
        """The block is in the hand: what it was picked up for may have changed. ``anew``: so has what is around the arm.

        Raises :class:`WorkFailed` if there is no way on; unless ``anew`` the arm goes on as it does.
        """
        world, mine = self.world, self._command
        assert mine is not None
        # Where it was picked up may be the goal by now: then it is put back.
        wanted = None if self.adapter.there(world.pose, self.goal) else self._next_command(world.pose, self._previous)
        target = wanted if wanted is not None and wanted.arm == world.arm else self._put_down(mine)
        trouble = ""
        if anew or not np.array_equal(target.place_mm, mine.place_mm):
            try:
                world.start(self.programs.diverted(world, target))
            except WorkFailed as failure:
                if anew:
                    raise
                target, trouble = mine._replace(final=False), f"the block goes on to where it was going: {failure}"
        self._command = target
        self._show()
        self.message = trouble or self.message

    def _put_down(self, mine: TransferCommand) -> TransferCommand:
        """Where a hand that is not to have the block puts it: on where it was going, or back if that leaves fewer transfers."""
        back = TransferCommand(mine.arm, False, np.zeros(2), self.world.pose[:2], self.world.pose, True)
        there, here = (self._left(it.predicted) for it in (mine, back))
        return back if here < there else mine._replace(final=False)

    def _left(self, pose: Floats) -> int:
        """Fewest transfers from ``pose``; more than any if there is no plan."""
        if self.adapter.there(pose, self.goal):
            return 0
        return self.adapter.optimum(pose, self.goal) or MOST_TRANSFERS

    def _without(self, index: int, failure: WorkFailed) -> None:
        """Piece ``index`` of the program has no motion. A hand that holds the block puts it down all the same, and stays there."""
        world = self.world
        if world.held:
            world.program = deque(list(world.program)[:index])
            self._conclude(STUCK, str(failure))
        else:
            self._helpless(failure)

    def _helpless(self, failure: WorkFailed) -> None:
        """There is no way to do what was ordered: an empty hand under way goes home or, if there is no way either, stops."""
        world = self.world
        self._command, self.plan = None, ()
        self._conclude(STUCK, str(failure))
        try:
            world.start(self.programs.redirected(world, None, True))
        except WorkFailed:
            world.start([world.program[0]._replace(kind="retreat", track=self.programs.stop(world))])

    def _reopen(self) -> None:
        """Count anew: the episode has begun, or was changed."""
        self.transfers, self.optimal = 0, self.adapter.optimum(self.world.pose, self.goal)
        self.ended, self._open = "", True

    def _conclude(self, how: str, message: str) -> None:
        """The episode has ended; it counts if there was anything to do."""
        if self._open and not (how == DONE and self.optimal == 0):
            self.score.add(how == DONE, self.transfers, self.optimal)
        self.ended, self.message, self._open = how, message, False

    def _show(self) -> None:
        """What is to come, and what is being done."""
        command = self._command
        self.plan = self.adapter.rollout(self.world.pose, self.goal, self._previous, command)
        if command is not None and not self.ended:
            what = "to the goal" if command.final else f"to ({command.place_mm[0]:z.0f}, {command.place_mm[1]:z.0f}) mm"
            self.message = f"{self._label(command.arm)} takes the block {what}"


def _same(one: TransferCommand, other: TransferCommand) -> bool:
    """Whether two orders are the same."""
    return (one.arm, one.final) == (other.arm, other.final) and bool(abs(one.place_mm - other.place_mm).max() < SAME_MM)
