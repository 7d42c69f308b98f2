"""The closed loop: see (object, goal) -> decide (policy) -> plan (arm) -> move (backend) -> see again; method sections 3 and 7.

Everything is judged by the one rule book, from what is measured. A missed grasp or a displaced object only changes the next observation.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell import NO_ARM, build_whole_cell
from marl_handover.config import LoopConfig, MotionConfig
from marl_handover.control.outage import Outage, policy_without
from marl_handover.control.transfers import (
    SAME_MM,
    SAME_RAD,
    Episode,
    Transfer,
    TransferCommand,
    TransferResult,
    moved,
)
from marl_handover.envs.backends import Backend, make_backend
from marl_handover.envs.cycle_check import Refusal
from marl_handover.errors import HandoverError
from marl_handover.motion.executor import ROLL_RAD
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import OutOfArmsReach, TransferMotion
from marl_handover.policies import ResigningPolicy, SupervisorPolicy
from marl_handover.task.episode import conclude, final_transfer, measured_verdict, nobody_moves
from marl_handover.task.rules import Outcome, Rules, Verdict


@runtime_checkable
class TracksObject(Protocol):
    """A backend whose object others may move: it looks before each decision."""

    same: tuple[float, float]
    """Poses nearer than this, in mm and rad, are the same as far as it can measure."""

    def watch(self) -> Floats | None:
        """Where the object lies now (3,); None if it has been out of sight since the last transfer, for longer than there is patience."""


@runtime_checkable
class HasChartInset(Protocol):
    """A backend that places so inexactly that hand-overs have to keep clear of the edge of the shared space."""

    chart_inset: float
    """The part of the chart that hand-overs keep to."""


@runtime_checkable
class HasGroundTruth(Protocol):
    """A backend that knows where the object truly is, for reports only."""

    def true_pose(self) -> Floats:
        """The true pose (3,)."""


@runtime_checkable
class Stoppable(Protocol):
    """A backend whose arms have to be stopped when a session breaks off."""

    def halt(self) -> None:
        """Stop all arms where they are."""


class RecordsEpisodes(Protocol):
    """Whoever keeps what goes on in an episode."""

    def episode(self, run: _Run, /) -> AbstractContextManager[None]:
        """A block around an episode that has begun; at its end ``run`` says how it ended."""


Observer = Callable[[Transfer], None]

HOPELESS = frozenset({Refusal.TIPPED, Refusal.STALLED})
"""After these there is no use in another transfer."""

REFUSED = Verdict(np.float64(-1.0), np.bool_(True), np.int64(Outcome.WRONG_POSITION))
"""Architecture A's verdict on a transfer that an arm refused."""


@dataclass
class _Run:
    """An episode while it goes on."""

    goal: Floats
    pose: Floats
    policy: SupervisorPolicy
    previous: int = NO_ARM
    lost_at: int | None = None
    attempt: int = 0
    ended: str | None = None
    transfers: list[Transfer] = field(default_factory=list)


class ClosedLoop:
    """A supervisor, the arms' planner and a backend at work together.

    The *first verdict* is the rule book's, at the first final placement (architecture B) or the first external finish (A), at
    ``max_steps`` transfers at the latest. A transfer that the arm or the backend refuses is a wrong position. After any other verdict than
    success the loop tries again, with the object where it lies, until the object is at the goal or ``settings.transfers`` are spent. It is
    *stuck* if the object has tipped over or stays out of sight, if an arm does nothing time and again, or if a command is refused and then
    given again about an object that has not moved. With arms out of order it ends *unreachable* where the others cannot solve it any more.

    Args:
        policy: the supervisor, under the rules that judge it; its cell may be that of some of the arms.
        planner: of the motions of all arms; those out of order stand in their way.
        backend: what carries them out.
        settings: limits of the loop.

    Raises:
        InvalidSetting: on a limit out of its own, or fewer transfers than the rules' ``max_steps``.
    """

    def __init__(self, policy: SupervisorPolicy, planner: MotionPlanner, backend: Backend, settings: LoopConfig | None = None) -> None:
        self.policy, self.planner, self.backend, self.settings = policy, planner, backend, settings or LoopConfig()
        self.rules: Rules = _whole(policy.rules, planner)
        self.settings.validate(self.rules.config.max_steps)
        self.limit = self.settings.transfers
        self.recorder: RecordsEpisodes | None = None
        """Is asked to record every episode."""
        self._same = backend.same if isinstance(backend, TracksObject) else (SAME_MM, SAME_RAD)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is not None and isinstance(self.backend, Stoppable):
            self.backend.halt()
        self.backend.close()

    def play(
        self,
        start: Floats,
        goal: Floats,
        seed: int = 0,
        observer: Observer | None = None,
        goals: Callable[[], Floats] | None = None,
        outage: Outage | None = None,
    ) -> Episode:
        """One problem, start and goal (3,) in mm and rad, to its end.

        Args:
            start: where the object is, or is put.
            goal: where it is to go.
            seed: of the backend.
            observer: is shown every transfer once it is judged.
            goals: the goal at present, asked before every decision and at the end; a transfer under way when it changes is finished.
            outage: an arm that goes out of order.

        Raises:
            InvalidSetting: of an outage, as :func:`~marl_handover.control.outage.policy_without`.
        """
        begun = time.perf_counter()
        left = self.policy if outage is None else policy_without(self.policy, outage.arm)
        run = _Run(np.asarray(goal, float), self.backend.reset(np.asarray(start, float), seed), self.policy)
        with nullcontext() if self.recorder is None else self.recorder.episode(run):
            while self._goes_on(run, goals):
                first = len(run.transfers)
                if outage is not None and run.lost_at is None and first >= outage.after:
                    run.policy, run.lost_at = left, first
                self._decide(run)
                if run.ended is None:
                    self._conclude(run)
                if observer is not None:
                    for transfer in run.transfers[first:]:
                        observer(transfer)
        return Episode(run.goal, tuple(run.transfers), str(run.ended), time.perf_counter() - begun, run.lost_at)

    def _goes_on(self, run: _Run, goals: Callable[[], Floats] | None) -> bool:
        """Take up a new goal, and an object that somebody moved; whether there is anything left to do."""
        if goals is not None and moved(run.goal, goal := np.asarray(goals(), float)):
            run.goal = goal
            if len(run.transfers) < self.limit:
                run.ended = None
            elif run.ended == "success" and not self._at_goal(run):
                run.ended = "transfers"
        if run.ended is None and isinstance(self.backend, TracksObject):
            pose = self.backend.watch()
            if pose is None:
                run.ended = "stuck"
            else:
                run.pose = pose
        return run.ended is None

    def _decide(self, run: _Run) -> None:
        """One decision: the policy's command and, in architecture A, the final transfer of an object that can be finished."""
        if self._finish(run):
            return
        self._command(run)
        if run.ended is not None or run.transfers[-1].terminated or len(run.transfers) >= self._room(run):
            return
        if self._finish(run):  # the reward stands with the command
            command, external = run.transfers[-2:]
            run.transfers[-2:] = replace(command, reward=command.reward + 1 + external.reward), replace(external, reward=0.0)

    def _command(self, run: _Run) -> None:
        """Ask the policy and have its command carried out."""
        rules, seen = run.policy.rules, self._seen(run)
        action = run.policy.act(seen, run.goal, rules.cell.numbered(run.previous, self.rules.cell))
        if bool(nobody_moves(action)):
            self._wait(run)
            return
        told = transfer_command(rules, seen, run.goal, action)
        command = self._numbered(told, rules)
        result = self._move(run.pose, command, seen)
        verdict = measured_verdict(rules, result.pose, run.goal, np.bool_(command.final), np.bool_(result.tried))
        if rules.external_finish and command.feasible and not result.tried:
            # A command that the rule book forbids costs a transfer, as on exact arms; an arm that refuses ends the attempt.
            verdict = REFUSED
        penalty = rules.motion_penalty(np.int64(told.arm), run.pose, result.pose)
        self._record(run, command, result, verdict._replace(reward=verdict.reward - penalty))

    def _wait(self, run: _Run) -> None:
        """No arm is to move, now or later: a time-out. The entry has a command to nobody, which nobody carried out."""
        command = TransferCommand(max(int(run.previous), 0), False, np.zeros(2), run.pose[:2], run.pose, False)
        why = run.policy.unsolvable_because(self._seen(run), run.goal) if isinstance(run.policy, ResigningPolicy) else ""
        result = TransferResult(run.pose, Refusal.DECLINED, why or "the policy wants no arm to move")
        self._record(run, command, result, Verdict(np.float64(0), np.bool_(False), np.int64(Outcome.NONE)))
        run.transfers[-1] = replace(run.transfers[-1], truncated=True, outcome=Outcome.TIMEOUT)
        run.ended = "unreachable" if why else "stuck"

    def _finish(self, run: _Run) -> bool:
        """Architecture A's final transfer, if an arm can do it; whether it was commanded."""
        seen = self._seen(run)
        finish = finish_command(run.policy.rules, seen, run.goal)
        if finish is None:
            return False
        command = self._numbered(finish, run.policy.rules)
        result = self._move(run.pose, command, seen)
        verdict = self.rules.external_verdict(result.pose, run.goal, np.int64(command.arm)) if result.tried else REFUSED
        self._record(run, command, result, verdict)
        return True

    def _seen(self, run: _Run) -> Floats:
        return run.policy.rules.cell.clamp_to_workspace(run.pose, self.settings.reach_slack_mm)

    def _numbered(self, command: TransferCommand, rules: Rules) -> TransferCommand:
        """A command under the rules of some of the arms, its arms counted as all are."""
        arm, receiver = (int(number) for number in self.rules.cell.numbered([command.arm, command.receiver], rules.cell))
        return command._replace(arm=arm, receiver=receiver)

    @staticmethod
    def _record(run: _Run, command: TransferCommand, result: TransferResult, verdict: Verdict) -> None:
        reward, terminated, outcome = float(verdict.reward), bool(verdict.terminated), Outcome(int(verdict.outcome))
        run.transfers.append(Transfer(run.attempt, run.goal, command, run.pose, run.previous, result, reward, terminated, False, outcome))
        run.pose = result.pose
        if result.tried or moved(run.transfers[-1].before, result.pose):
            run.previous = command.arm

    def _move(self, pose: Floats, command: TransferCommand, seen: Floats) -> TransferResult:
        """Plan and carry out a transfer of the object measured at ``pose``, which the supervisor has ``seen``."""
        if not command.feasible:
            return TransferResult(pose, Refusal.OUT_OF_REACH)
        try:
            motion = self._plan(command, pose, seen)
        except HandoverError as failure:
            reason = Refusal.OUT_OF_REACH if isinstance(failure, OutOfArmsReach) else Refusal.DECLINED
            return TransferResult(pose, reason, str(failure))
        execution = self.backend.execute(command.arm, motion.paths)
        truth = self.backend.true_pose() if isinstance(self.backend, HasGroundTruth) else None
        duration_s = self.planner.timed(motion).duration_s if execution.duration_s is None else execution.duration_s
        return TransferResult(execution.pose, execution.refusal, "", motion.planning_ms, duration_s, execution.path_mm, truth)

    def _plan(self, command: TransferCommand, pose: Floats, seen: Floats) -> TransferMotion:
        joints = self.backend.joints_rad()
        own, other = self._settled(command.arm, joints[command.arm]), np.delete(joints, command.arm, axis=0)
        try:
            return self.planner.plan_paths(command.arm, pose[:2], command.place_mm, own, other)
        except OutOfArmsReach:
            if np.array_equal(seen, pose):
                raise
            return self.planner.plan_paths(command.arm, seen[:2], command.place_mm, own, other)

    def _settled(self, index: int, joints_rad: Floats) -> Floats:
        """An arm's measured joints (5,) as a plan can begin with: a servo's droop past a limit or off roll 0 is taken away."""
        arm = self.planner.model.arms[index]
        wanted = np.clip(joints_rad, arm.lower_rad, arm.upper_rad)
        wanted[4] = 0.0
        return np.where(abs(wanted - joints_rad) <= ROLL_RAD, wanted, joints_rad)

    def _room(self, run: _Run) -> int:
        """Transfers by which the present attempt has to end."""
        return self.rules.config.max_steps if run.attempt == 0 else self.limit

    def _conclude(self, run: _Run) -> None:
        """End the attempt, or the episode, if that is due after a decision."""
        last, count = run.transfers[-1], len(run.transfers)
        there = self._at_goal(run) and last.result.refusal not in (Refusal.TIPPED, Refusal.UNSEEN)
        if run.attempt > 0 and there:
            last = replace(last, terminated=True, outcome=Outcome.SUCCESS)
        truncated, outcome = conclude(np.bool_(last.terminated), np.int64(last.outcome), count, self._room(run))
        run.transfers[-1] = last = replace(last, truncated=bool(truncated), outcome=Outcome(int(outcome)))
        if there and last.over:
            run.ended = "success"
        elif last.result.refusal in HOPELESS or (run.attempt > 0 and last.repeats(run.transfers[-2], *self._same)):
            run.ended = "stuck"
        elif count >= self.limit:
            run.ended = "transfers"
        elif last.over:
            run.attempt += 1

    def _at_goal(self, run: _Run) -> bool:
        """Whether the object lies at the goal, whoever put it there."""
        verdict = self.rules.external_verdict(run.pose, run.goal, np.int64(run.transfers[-1].command.arm))
        return int(verdict.outcome) == Outcome.SUCCESS


def _whole(rules: Rules, planner: MotionPlanner) -> Rules:
    """The rules of all arms."""
    whole = planner.model.cell
    if rules.cell.config.enabled is None:
        return rules
    return Rules(whole.with_inset(rules.cell.config.chart_inset), rules.config, rules.motion_cost, physical=rules.measured)


def transfer_command(rules: Rules, pose: Floats, goal: Floats, action: Floats) -> TransferCommand:
    """What a supervisor's ``action`` (size,) tells an arm to do with an object at ``pose`` (3,), goal (3,).

    A place in what two arms share that share nothing is where the object lies.
    """
    command = rules.decode(action)
    predicted, feasible = rules.transfer(pose, goal, command)
    arm, receiver = int(command.arm), int(command.receiver)
    space = rules.cell.graph.edges.get((min(arm, receiver), max(arm, receiver)))
    chart = np.zeros(2) if space is None else np.array(space.from_table(command.place_mm), float)
    target = goal[:2] if command.final else pose[:2] if space is None else command.place_mm
    return TransferCommand(arm, bool(command.final), chart, target, predicted, bool(feasible), receiver)


def finish_command(rules: Rules, pose: Floats, goal: Floats) -> TransferCommand | None:
    """Architecture A's final transfer of an object at ``pose`` (3,), if an arm can do it; None in architecture B."""
    external = final_transfer(rules, pose, goal)
    return None if external is None else TransferCommand(int(external.arm), True, np.zeros(2), goal[:2], external.pose, True)


def make_loop(
    policy: SupervisorPolicy, backend: str, motion: MotionConfig | None = None, settings: LoopConfig | None = None, **options: Any
) -> ClosedLoop:
    """A closed loop around a policy, in the policy's own cell; arms that are out of order there stand in it.

    Transfers are priced as these arms move. On arms that are not exact, placements are judged with their tolerance, and the hand-overs
    keep away from the edge of the shared space: ``settings.chart_inset``, or the backend's own if that is smaller.

    Args:
        policy: the supervisor.
        backend: its name, as for :func:`~marl_handover.envs.backends.make_backend`.
        motion: how the arms move.
        settings: limits of the loop.
        options: for the backend.

    Raises:
        UnknownChoice, InvalidSetting: for a name or a setting that cannot be.
    """
    motion, settings = motion or MotionConfig(), settings or LoopConfig()
    settings.validate(policy.rules.config.max_steps)
    enabled = policy.rules.cell.config.enabled
    model = build_whole_cell(policy.rules.cell.config)
    planner = MotionPlanner(model, motion)
    planner.warm_up()
    made = make_backend(backend, model, policy.rules.config, motion, **options)
    inset = min(settings.chart_inset, model.cell.config.chart_inset, made.chart_inset if isinstance(made, HasChartInset) else 1.0)
    cell = model.cell if made.exact else model.cell.with_inset(inset)
    cell = cell if enabled is None else cell.with_arms(enabled)
    price = motion_cost(cell, policy.rules.config, motion)
    rules = Rules(cell, policy.rules.config, price, physical=not made.exact)
    return ClosedLoop(policy.under(rules), planner, made, settings)
