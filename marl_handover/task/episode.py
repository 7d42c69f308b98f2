"""An episode under the rule book, decision by decision: the one stepper of exact arms, numpy or torch, one problem or a batch.

:func:`advance` takes a decision, counts transfers and tells when an episode is over; :func:`play` does so to the end for a whole batch,
:func:`go_on` for episodes that are under way, up to a number of transfers if need be. Environments, plans and what a policy means to do
next use the first, evaluation the others.

Where transfers are carried out one by one and measured, an episode takes the same steps: :func:`final_transfer` before and after each
command, :func:`measured_verdict` of what came of it, :func:`conclude`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from marl_handover.arrays import Array, namespace
from marl_handover.cell.batch import CellBatch
from marl_handover.cell.symmetry import NO_ARM
from marl_handover.task.rules import External, Outcome, Rules, Transition, Verdict

Act = Callable[[Array, Array, Array], Array]
"""pose (n, 3), goal (n, 3), previous_arm (n,) -> action (n, 4); a row that is not a number: no arm moves."""

Noise = Callable[[int], Array]
"""Number of cells -> placement noise (n, 3)."""


class Episodes(NamedTuple):
    """How a batch of episodes ended: outcome int (n,), transfers int (n,), pose (n, 3)."""

    outcome: Array
    transfers: Array
    pose: Array


class Underway(NamedTuple):
    """A batch of episodes that have begun.

    ``outcome`` (n,) is NONE while one goes on; ``transfers`` (n,) made; ``pose`` (n, 3) and ``previous_arm`` (n,) now; ``goal`` (n, 3).
    """

    outcome: Array
    transfers: Array
    pose: Array
    previous_arm: Array
    goal: Array


class Decision(NamedTuple):
    """One decision of the running episodes, for whoever watches.

    ``episode`` (m,) numbers; ``pose``, ``goal`` (m, 3) and ``previous_arm`` (m,) before it; ``made`` (m,) transfers before it; ``result``.
    """

    episode: Array
    pose: Array
    goal: Array
    previous_arm: Array
    made: Array
    result: Transition


Observer = Callable[[Decision], None]


class Stepped(NamedTuple):
    """What a decision did within an episode, each (...).

    ``result``; ``transfers`` made so far; ``truncated``: none is left, without a verdict; ``outcome``: that of the result, or a time-out;
    ``idle``: no arm was to move; None where that may not be.
    """

    result: Transition
    transfers: Array
    truncated: Array
    outcome: Array
    idle: Array | None

    @property
    def over(self) -> Array:
        """Whether the episode ends here."""
        return self.result.terminated | self.truncated


def advance(
    rules: Rules,
    pose: Array,
    goal: Array,
    previous_arm: Array,
    action: Array,
    made: Array,
    *,
    epsilon_rad: Array | float | None = None,
    noise: Array | None = None,
    final_noise: Array | None = None,
    may_wait: bool = False,
) -> Stepped:
    """One decision of episodes that have ``made`` (...) transfers; the other arguments are those of :meth:`Rules.step`.

    ``may_wait``: an action that is not a number says that no arm is to move. A policy that says so of the same object will never move one:
    a time-out at once. There is no transfer then, but the episode has used up all it had, or waiting for ever would be the quickest end.
    """
    xp, limit = namespace(pose), rules.config.max_steps
    left = limit - made
    result = rules.step(
        pose, goal, previous_arm, action, transfers_left=left, epsilon_rad=epsilon_rad, noise=noise, final_noise=final_noise
    )
    total, idle = made + result.transfers, None
    if may_wait:
        idle = nobody_moves(action) & (result.external_arm < 0)
        result, total = _without(result, idle), xp.where(idle, limit, total)
    return Stepped(result, total, *conclude(result.terminated, result.outcome, total, limit), idle)


def conclude(terminated: Array, outcome: Array, made: Array | int, limit: int) -> tuple[Array, Array]:
    """Whether episodes (...) with ``made`` of ``limit`` transfers end here for want of more, without a verdict; and the outcome then."""
    truncated = ~terminated & (made >= limit)
    return truncated, namespace(outcome).where(truncated, int(Outcome.TIMEOUT), outcome)


def final_transfer(rules: Rules, pose: Array, goal: Array) -> External | None:
    """Architecture A's final transfer of an object at ``pose`` (3,), goal (3,), if an arm can do it; None in architecture B."""
    external = rules.external(pose, goal) if rules.external_finish else None
    return None if external is None or external.arm < 0 else external


def measured_verdict(rules: Rules, placed: Array, goal: Array, final: Array, tried: Array) -> Verdict:
    """The verdict on a commanded transfer after which the object was measured at ``placed`` (3,); in architecture A there is none yet.

    ``final``: whether it was to end the episode; ``tried``: whether it took place, well or badly.
    """
    if rules.external_finish:
        return rules.external_verdict(placed, goal, np.int64(NO_ARM))
    return rules.judge(placed, goal, final, tried)


def play(
    rules: Rules,
    act: Act | Callable[[Rules], Act],
    pose: Array,
    goal: Array,
    epsilon_rad: float | None = None,
    noise: Noise | None = None,
    observer: Observer | None = None,
) -> Episodes:
    """Play every problem, pose and goal (n, 3), to its end."""
    return Episodes(*go_on(rules, act, begin(pose, goal), epsilon_rad, noise, observer)[:3])


def begin(pose: Array, goal: Array) -> Underway:
    """Episodes with the starts and goals (n, 3), before the first decision."""
    zero = namespace(pose).zeros_like(pose[:, 0])
    none = namespace(pose).where(zero == 0, int(Outcome.NONE), 0)
    return Underway(none, none, pose, none - 1, goal)


def go_on(
    rules: Rules,
    act: Act | Callable[[Rules], Act],
    episodes: Underway,
    epsilon_rad: float | None = None,
    noise: Noise | None = None,
    observer: Observer | None = None,
    *,
    rows: Array | None = None,
    until: Array | None = None,
) -> Underway:
    """Play the episodes that go on to their ends, or until they have ``until`` (n,) transfers. Only running ones are computed.

    For a batch of cells ``act`` takes the rules of the rows that run, and returns the policy that acts under them.
    ``rows``: bool (n,), which of them; all if None.
    """
    xp, in_cells = namespace(episodes.pose), isinstance(rules.cell, CellBatch)
    outcome, transfers, ended, previous_arm, goals = episodes
    waits = outcome == int(Outcome.NONE)
    waits = waits if rows is None else waits & rows
    running = xp.arange(len(goals))[waits if until is None else waits & (transfers < until)]
    pose, goal, previous = ended[running], goals[running], previous_arm[running]
    while len(running):
        made = transfers[running]
        here_rules = rules.of_rows(running)
        policy: Any = act(here_rules) if in_cells else act  # type: ignore[call-arg]
        action = policy(pose, goal, previous)
        noises = [None if noise is None else noise(len(pose)) for _ in range(2)]
        stepped = advance(
            here_rules,
            pose,
            goal,
            previous,
            action,
            made,
            epsilon_rad=epsilon_rad,
            noise=noises[0],
            final_noise=noises[1],
            may_wait=True,
        )
        result = stepped.result
        if observer is not None:
            observer(Decision(running, pose, goal, previous, made, result))
        outcome, transfers = _put(outcome, running, stepped.outcome), _put(transfers, running, stepped.transfers)
        ended, previous_arm = _put(ended, running, result.pose), _put(previous_arm, running, result.previous_arm)
        going = ~stepped.over if until is None else ~stepped.over & (stepped.transfers < until[running])
        running, pose, goal, previous = running[going], result.pose[going], goal[going], result.previous_arm[going]
    return Underway(outcome, transfers, ended, previous_arm, goals)


def nobody_moves(action: Array) -> Array:
    """Where a policy says that no arm is to move: bool (...) of actions (..., size), which are not numbers there."""
    return namespace(action).isnan(action).any(-1)


def _without(result: Transition, idle: Array) -> Transition:
    """The result of decisions, with a time-out and no transfer where these were ``idle`` (n,)."""
    xp = namespace(result.pose)
    if not bool(idle.any()):
        return result
    return result._replace(
        transfers=xp.where(idle, 0, result.transfers),
        reward=xp.where(idle, 0 * result.reward, result.reward),
        terminated=result.terminated | idle,
        outcome=xp.where(idle, int(Outcome.TIMEOUT), result.outcome),
    )


def _put(array: Array, index: Array, values: Array) -> Array:
    """A copy of ``array`` with rows replaced."""
    copy: Any = array.clone() if hasattr(array, "clone") else array.copy()
    copy[index] = values
    return copy
