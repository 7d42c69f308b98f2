"""The interactive cell: goal or block may be changed at any time, in mid-motion too, and the arms re-plan at once.

A cell of exact, kinematic arms in simulated time, for a person to play with. Wishes may come from any thread, and so may calls of
:meth:`InteractiveCell.advance`, which take turns. What is wished last is done; what was planned for an older wish is dropped.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats, wrap
from marl_handover.cell import Cell
from marl_handover.cell.build import CellModel
from marl_handover.config import CellConfig, MotionConfig, require_at_least, require_seed
from marl_handover.control.interactive.controller import InteractiveController, Placement, PolicyAdapter
from marl_handover.control.interactive.world_state import projected
from marl_handover.errors import HandoverError, InvalidSetting, NotFinite
from marl_handover.motion.planner import MotionPlanner
from marl_handover.policies import SupervisorPolicy
from marl_handover.task.rules import Rules

__all__ = ["InteractiveCell", "Placement", "Snapshot"]

NEXT = -1
"""Instead of a problem's seed."""


class Snapshot(NamedTuple):
    """The cell at one moment.

    Attributes:
        t_s: simulated time.
        joints_rad: (num_arms, 5).
        grip_open: of each arm.
        T_world_block: (4, 4) in mm, of the middle of the block's underside, x along its yaw.
        block: (3,) x_mm, y_mm, yaw_rad of the block seen from above, also while it is carried.
        goal: (3,).
        state: waiting, moving, paused, stopped, broken, done or stuck.
        arm: the moving arm, -1 for none.
        phase: approach, grasp, lift, transfer, lower, release, retreat; "" if nothing moves.
        plan: the placements to come, by the policy's own rollout on the rule book.
        transfers: carried out since the episode began or was changed last.
        optimal: the fewest from there; 0 if none was needed, or there is no plan.
        episodes, solved: that have ended, and with the block at the goal.
        ratio: mean of transfers over optimum of solved episodes; nan at first.
        message: the last event, refusal or error, one line.
    """

    t_s: float
    joints_rad: Floats
    grip_open: tuple[bool, ...]
    T_world_block: Floats
    block: Floats
    goal: Floats
    state: str
    arm: int
    phase: str
    plan: tuple[Placement, ...]
    transfers: int
    optimal: int
    episodes: int
    solved: int
    ratio: float
    message: str


@dataclass(frozen=True)
class _Wishes:
    """What was wished since the last look; of each kind, the newest."""

    goal: Floats | None = None
    block: Floats | None = None
    adapter: PolicyAdapter | None = None
    policy: SupervisorPolicy | None = None
    layout: CellConfig | None = None
    problem: int | None = None
    since: float = math.nan


class InteractiveCell:
    """Exact arms, a block and a goal to play with.

    An arm whose hand is empty brakes and goes for what is decided now. A block in the hand keeps its orientation to the hand, so the
    decision is made from where it was picked up: if it names the same arm, the hand turns to the new place in mid-air; else the block is
    put down where it was going, or back where it came from if that leaves fewer transfers. A block dragged out of the hand is taken from
    it. A block dragged to where an arm is, or cannot be kept off, stays where it was.

    The cell itself may be changed, too, if its policy acts in any cell: :meth:`set_layout`. Where a layout cannot be, the state is broken,
    the message says why, and nothing moves until one comes that can. Obstacles keep blocks off; arms do not go around them.

    While paused, stopped or broken, simulated time stands still. A stop is latched: :meth:`resume` does nothing until :meth:`clear`, after
    which the cell is paused; clearing alone moves nothing. What is wished before the clear, and was not begun at the stop, is dropped.

    Args:
        policy: the supervisor.
        model: its cell, in which arms that are out of order stand, too.
        motion: how the arms move.
        seed: of the problems; the first one is there at once.

    Raises:
        InvalidSetting: of a policy for another cell, or whose motions are its own; of a setting out of its limits.
    """

    def __init__(self, policy: SupervisorPolicy, model: CellModel, motion: MotionConfig | None = None, seed: int = 0) -> None:
        require_seed(seed)
        self.model, self.motion = model, motion or MotionConfig()
        planner = MotionPlanner(model.without_obstacles(), self.motion)
        planner.warm_up()
        self._controller = InteractiveController(PolicyAdapter(policy, model, self.motion), model, planner, seed)
        self._policy, self._layout, self._fault = policy, policy.rules.cell.config, ""
        self._first = self._layout, model, planner
        self._lock, self._advancing = threading.Lock(), threading.Lock()
        self._wishes, self._paused, self._stopped = _Wishes(), False, False
        self.stops = 0
        """How often it was stopped."""
        self._t_s, self._since = 0.0, math.nan
        self.last_replan_ms = math.nan
        """From the last wish that changed a motion to the first sample of the new one, wall time; nan at first."""

    def set_goal(self, pose: ArrayLike) -> bool:
        """The goal is at ``pose`` (3,): x_mm, y_mm, yaw_rad.

        Returns:
            Whether it is taken up: not while stopped.

        Raises:
            OutOfReach, NotFinite, InvalidSetting: of the pose.
        """
        return self._wish(goal=self._checked("goal", pose))

    def set_block(self, pose: ArrayLike) -> bool:
        """The block lies at ``pose`` (3,), also if a hand holds it now. Returns and raises as :meth:`set_goal`."""
        return self._wish(block=self._checked("block", pose))

    def set_policy(self, policy: SupervisorPolicy) -> bool:
        """Another supervisor. Returns as :meth:`set_goal`; raises :class:`InvalidSetting` as the constructor does.

        In a layout that was set it is put under the rule book of that, and the state is broken if it cannot be.
        """
        policy.require_executors()
        adapter = None if self._relaid else PolicyAdapter(policy, self.model, self.motion)
        return self._wish(adapter=adapter, policy=policy)

    def set_layout(self, config: CellConfig) -> bool:
        """Other places of arms, other arms or obstacles, some arms out of order: spaces, optimum, plan and motion follow at once.

        Arms that stay where they are go on from there; those that do not are parked. Returns as :meth:`set_goal`.
        """
        return self._wish(layout=config)

    def kept_clear(self) -> Floats:
        """Places (2, 2) of block and goal, which nothing new is to be put on."""
        return np.stack([self._controller.world.pose[:2], self._controller.goal[:2]])

    @property
    def layout(self) -> CellConfig:
        """The layout that was taken up last, also if it cannot be."""
        return self._layout

    @property
    def in_order(self) -> Cell:
        """The cell of the arms that are in order."""
        return self._controller.adapter.rules.cell

    def new_problem(self, seed: int | None = None) -> bool:
        """A random block and goal: those of ``seed``, else the next ones. An episode under way is given up, and not counted.

        Returns as :meth:`set_goal`.
        """
        if seed is not None:
            require_seed(seed)
        return self._wish(problem=NEXT if seed is None else seed, goal=None, block=None)

    def pause(self) -> None:
        """Time stands still."""
        with self._lock:
            self._paused = True

    def resume(self) -> None:
        """Time goes on, unless stopped."""
        with self._lock:
            self._paused = self._paused and self._stopped

    def toggle(self) -> None:
        """Pause, or resume if it is paused: as things are now, whatever was shown last."""
        with self._lock:
            self._paused = not self._paused or self._stopped

    def stop(self) -> None:
        """No arm moves any more when this returns, until :meth:`clear` and then :meth:`resume`."""
        with self._lock:
            self._stopped = self._paused = True
            self._wishes = _Wishes()
            self.stops += 1

    def clear(self) -> None:
        """Take the stop back; the cell is paused then."""
        with self._lock:
            self._stopped = False

    def advance(self, dt_s: float) -> Snapshot:
        """Let ``dt_s`` of simulated time pass. It takes no longer than to decide once and to plan a path or two.

        Raises:
            InvalidSetting: time does not go back.
        """
        require_at_least("dt_s", dt_s, 0)
        with self._advancing:
            return self._advance(dt_s)

    def _advance(self, dt_s: float) -> Snapshot:
        with self._lock:
            wishes, self._wishes = self._wishes, _Wishes()
        replanned = not math.isnan(wishes.since)
        if replanned:
            self._take(wishes)
        else:
            self._controller.prepare()
        left = self._step(dt_s, dt_s)
        if not replanned and self._idle():
            self._controller.proceed()
            self._controller.prepare()
            self._step(left, 0.0)
        if self._paused:
            self._since = math.nan  # nothing to be measured: the motion waits for the user
        elif not math.isnan(self._since) and self._controller.moving:
            self.last_replan_ms, self._since = 1e3 * (time.perf_counter() - self._since), math.nan
        return self._snapshot()

    def _take(self, wishes: _Wishes) -> None:
        """Do what was wished."""
        controller = self._controller
        changed = block_moved = False
        self._policy = wishes.policy or self._policy
        if wishes.layout is not None or (wishes.policy is not None and self._relaid):
            self._lay_out(wishes.layout or self._layout)
            self._since = wishes.since
        elif wishes.adapter is not None:
            controller.adapter, changed = wishes.adapter, True
        if self._fault:
            controller.goal = controller.goal if wishes.goal is None else wishes.goal
            if wishes.block is not None:
                controller.world.put(wishes.block)
            return
        if wishes.problem is not None and controller.pose_problem(None if wishes.problem == NEXT else wishes.problem):
            changed = block_moved = True
        if wishes.goal is not None:
            controller.goal, changed = wishes.goal, True
        if wishes.block is not None and controller.put(wishes.block):
            changed = block_moved = True
        if changed:
            controller.replan(block_moved)
            self._since = wishes.since

    def _lay_out(self, config: CellConfig) -> None:
        """Take up a layout, or note why it cannot be."""
        self._layout = config
        try:
            model, planner, policy = self._laid(config)
            adapter = PolicyAdapter(policy, model, self.motion)
        except HandoverError as error:
            self._fault = str(error)
            return
        self.model, self._fault = model, ""
        self._controller.lay_out(adapter, planner)

    def _laid(self, config: CellConfig) -> tuple[CellModel, MotionPlanner, SupervisorPolicy]:
        """Cell, planner and policy of a layout. Raises whatever cannot be."""
        first, model, planner = self._first
        if config == first:
            return model, planner, self._policy
        model = self.model.relaid(config)
        planner = self._controller.programs.paths.planner.relaid(model.without_obstacles())
        if not self._policy.any_cell:
            choices = "one for every cell, as exact, greedy, random or pretrained_any, once arms or obstacles are changed"
            raise InvalidSetting("policy", self._policy.name, choices)
        cell = model.cell if config.enabled is None else model.cell.with_arms(config.enabled)
        rules = Rules(cell.with_inset(self._policy.rules.cell.config.chart_inset), self._policy.rules.config)
        return model, planner, self._policy.under(rules)

    @property
    def _relaid(self) -> bool:
        """Whether the cell is not, or is not to be, the one that it was made with."""
        return bool(self._fault) or self.model is not self._first[1]

    def _step(self, dt_s: float, passed_s: float) -> float:
        """Move for ``dt_s`` while ``passed_s`` pass, if time does pass; what is left of ``dt_s`` when nothing moves any more."""
        with self._lock:
            if self._paused or self._fault:
                return 0.0
            self._t_s += passed_s
            return self._controller.step(dt_s)

    def _idle(self) -> bool:
        return not (self._paused or self._fault or self._controller.moving or self._controller.ended)

    def _wish(self, **wish: object) -> bool:
        with self._lock:
            if not self._stopped:
                self._wishes = replace(self._wishes, since=time.perf_counter(), **wish)  # type: ignore[arg-type]
            return not self._stopped

    def _checked(self, what: str, pose: ArrayLike) -> Floats:
        """A pose (3,) that an arm reaches, its yaw wrapped."""
        array = np.array(pose, float)
        if array.shape != (3,):
            raise InvalidSetting(what, np.shape(pose), "three numbers: x_mm, y_mm, yaw_rad")
        if not np.isfinite(array).all():
            raise NotFinite(what, array.tolist())
        if not self._fault:
            self.in_order.require_reached(what, array)
        array[2] = wrap(array[2])
        return array

    def _snapshot(self) -> Snapshot:
        controller, world = self._controller, self._controller.world
        T_world_block = world.T_world_block()
        return Snapshot(
            self._t_s,
            world.joints_rad.copy(),
            tuple(bool(opened > 0.5) for opened in world.opened),
            T_world_block,
            projected(T_world_block),
            controller.goal.copy(),
            self._state(),
            world.arm,
            world.phase(),
            controller.plan,
            controller.transfers,
            controller.optimal,
            controller.score.episodes,
            controller.score.solved,
            controller.score.ratio,
            self._fault or controller.message,
        )

    def _state(self) -> str:
        if self._stopped:
            return "stopped"
        if self._paused:
            return "paused"
        if self._fault:
            return "broken"
        if self._controller.moving:
            return "moving"
        return self._controller.ended or "waiting"
