"""Playing whole episodes of a policy on the batched rules, numpy or torch alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from marl_handover.arrays import Array, namespace
from marl_handover.task.rules import Outcome, Rules, Transition

Act = Callable[[Array, Array, Array], Array]
"""pose (n, 3), goal (n, 3), previous_arm (n,) -> action (n, 4); a row that is not a number: no arm moves."""

Noise = Callable[[int], Array]
"""Number of cells -> placement noise (n, 3)."""


class Episodes(NamedTuple):
    """How a batch of episodes ended: outcome int (n,), transfers int (n,), pose (n, 3)."""

    outcome: Array
    transfers: Array
    pose: Array


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


def play(
    rules: Rules,
    act: Act,
    pose: Array,
    goal: Array,
    epsilon_rad: float | None = None,
    noise: Noise | None = None,
    observer: Observer | None = None,
) -> Episodes:
    """Play every problem, pose and goal (n, 3), to its end. Only running episodes are computed.

    Where no arm is to move, a policy that says the same of the same object will never move one: a time-out at once. The decision that the
    observer sees has no transfer, but the episode has used up all it had, or waiting for ever would be the quickest way to end.
    """
    xp = namespace(pose)
    count, limit = len(pose), rules.config.max_steps
    zero = xp.zeros_like(pose[:, 0])
    outcome = xp.where(zero == 0, int(Outcome.TIMEOUT), 0)
    transfers = xp.where(zero == 0, 0, 1)
    previous = transfers - 1
    running = xp.arange(count)
    ended = pose
    while len(running):
        here, there = pose, goal
        action = act(here, there, previous)
        made = transfers[running]
        result = rules.step(
            here,
            there,
            previous,
            action,
            transfers_left=limit - made,
            epsilon_rad=epsilon_rad,
            noise=None if noise is None else noise(len(here)),
            final_noise=None if noise is None else noise(len(here)),
        )
        idle = nobody_moves(action) & (result.external_arm < 0)
        result = _without(result, idle)
        if observer is not None:
            observer(Decision(running, here, there, previous, made, result))
        total = xp.where(idle, limit, made + result.transfers)
        over = result.terminated | (total >= limit)
        verdict = xp.where(result.terminated, result.outcome, int(Outcome.TIMEOUT))
        outcome, transfers = _put(outcome, running, verdict), _put(transfers, running, total)
        ended = _put(ended, running, result.pose)
        going = ~over
        running, pose, goal, previous = running[going], result.pose[going], there[going], result.previous_arm[going]
    return Episodes(outcome, transfers, ended)


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
