"""The interactive cell from within, for one thread: what is under way, and what becomes of it when something is changed."""

from __future__ import annotations

from collections import deque

import numpy as np
import torch
from numpy.typing import NDArray

from marl_handover.cell import NO_ARM
from marl_handover.cell.build import CellModel
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.control.interactive.motion_program import FreePaths, MotionPrograms
from marl_handover.control.interactive.policy_adapter import MOST_TRANSFERS, Placement, PolicyAdapter, Score
from marl_handover.control.interactive.world_state import WorldState
from marl_handover.control.transfers import SAME_MM, TransferCommand
from marl_handover.errors import WorkFailed
from marl_handover.motion.planner import MotionPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.wording import counted

Floats = NDArray[np.float64]

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
        decider: the supervisor.
        model: the cell.
        planner: of its arms.
        seed: of the problems.
    """

    def __init__(self, adapter: PolicyAdapter, model: CellModel, planner: MotionPlanner, seed: int) -> None:
        self.adapter, self.programs = adapter, MotionPrograms(FreePaths(planner))
        self.world, self.score = WorldState(model, planner.home_rad, np.zeros(3)), Score()
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
            if not (paths.parked(joints) or paths.clear_of_block(arm, samples, block[:2])):
                self.message = f"arm {ARM_LETTERS[arm]} is in the way there"
                return False
        self.message = f"block taken from the hand of {ARM_LETTERS[world.arm]}" if world.held else "block moved"
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

    def proceed(self) -> None:
        """Nothing moves: the next transfer, if there is one."""
        world, paths = self.world, self.programs.paths
        self._command = self._next_command(world.pose, self._previous)
        program = [self.programs.home(arm, q, world.pose) for arm, q in enumerate(world.joints_rad) if not paths.parked(q)]
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
            self.message = f"{ARM_LETTERS[command.arm]} has put the block down"

    def _next_command(self, pose: Floats, previous: int) -> TransferCommand | None:
        """The next order, one that can be carried out; None: the episode has ended."""
        if self.adapter.there(pose, self.goal):
            self._conclude(DONE, "the block is at the goal")
            return None
        refused: TransferCommand | None = None
        while self.transfers < MOST_TRANSFERS:
            command = self.adapter.command(pose, self.goal, previous)
            if command is None:
                self._conclude(STUCK, "the policy wants no arm to move")
                return None
            if command.feasible:
                return command
            self.transfers += 1
            if refused is not None and _same(refused, command):
                self._conclude(STUCK, f"the policy orders what arm {ARM_LETTERS[command.arm]} cannot reach")
                return None
            refused = command
        self._conclude(STUCK, f"not solved in {MOST_TRANSFERS} transfers")
        return None

    def _replan_held(self) -> None:
        """The block is in the hand: what it was picked up for may have changed."""
        world, mine = self.world, self._command
        assert mine is not None
        # Where it was picked up may be the goal by now: then it is put back.
        wanted = None if self.adapter.there(world.pose, self.goal) else self._next_command(world.pose, self._previous)
        target = wanted if wanted is not None and wanted.arm == world.arm else self._put_down(mine)
        trouble = ""
        if not np.array_equal(target.place_mm, mine.place_mm):
            try:
                world.start(self.programs.diverted(world, target))
            except WorkFailed as failure:
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
            self.message = f"{ARM_LETTERS[command.arm]} takes the block {what}"


def _same(one: TransferCommand, other: TransferCommand) -> bool:
    """Whether two orders are the same."""
    return (one.arm, one.final) == (other.arm, other.final) and bool(abs(one.place_mm - other.place_mm).max() < SAME_MM)
