"""What a supervisor policy answers, and a shield that repairs its answers. Nothing here needs torch.

A policy answers two calls: ``policy(observation)`` takes one observation of the AEC supervisor (``state``, ``goal``,
``previous_arm`` 0 none, 1 L, 2 R, or 1 + the arm's index) and returns its action (``final``, ``arm``, ``place``, and ``receiver`` unless
there are two arms); ``policy.act(pose, goal, previous_arm)`` takes batches (n, 3), (n, 3), (n,) (-1 none, 0 L, 1 R), or single problems
(3,), (3,), (), and returns actions (n, size) or (size,), 4 numbers for a pair (:mod:`marl_handover.task.actions`).

``policy.predict(observation)`` is what Stable-Baselines3's models have: it takes what any environment of the package shows.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats, as_kind
from marl_handover.errors import InvalidSetting, WorkFailed, listed
from marl_handover.task.actions import action_of, choices_of
from marl_handover.task.observations import last_arm
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Outcome, Rules

SHIELDED = "shielded:"
"""Before a policy's name."""


class NobodyMoves(WorkFailed):
    """A policy was asked for a command, and wants no arm to move. ``why``: what it says about that; may be empty."""

    def __init__(self, policy: str, why: str = "") -> None:
        self.policy, self.why = policy, why
        reason = why or "asked the same again it says the same, so it will never move one"
        super().__init__(f"policy {policy!r} wants no arm to move; {reason}")


class SupervisorPolicy(ABC):
    """A supervisor of one cell.

    Attributes:
        rules: the rule book it acts under; ``rules.epsilon_rad`` is the accuracy it aims at.
        name: what it was loaded as.
        about: what its file says of it; empty if it was not trained.
    """

    variant = "hierarchical"
    any_cell = False  # whether it acts in any other cell, too, once it is under that one's rule book
    batch_of_cells = False  # whether it acts in many cells at once, too, one a row

    def __init__(self, rules: Rules, name: str) -> None:
        self.rules, self.name = rules, name
        self.about: dict[str, Any] = {}

    @abstractmethod
    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """Actions (..., size): final, arm, alpha, beta of a pair. One that is not a number: no arm is to move."""

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """What it would rather do if it could not do ``action`` (..., size): (..., k, size), the best first.

        Here: another final, then the other arm, then both, at the same place. They must hold all four choices. Of N arms: the same arm
        first, then all others, each with every receiver that it shares a place with.
        """
        if self.rules.cell.num_arms != 2:
            return self._others_of_many(action)
        chosen = np.where(action[..., None, :2] > 0, 1.0, -1.0) * np.array([[-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
        rest = np.broadcast_to(action[..., None, 2:], (*chosen.shape[:-1], action.shape[-1] - 2))
        return np.concatenate([chosen, rest], -1)

    def _others_of_many(self, action: Floats) -> Floats:
        """All choices of a cell of N arms at the place of ``action`` (..., size), the most similar first: (..., k, size)."""
        graph, count = self.rules.cell.graph, self.rules.cell.num_arms
        ends = [(1, arm, (*graph.neighbours(arm), arm)[0]) for arm in range(count)]  # the receiver means nothing
        choices = [(0, arm, receiver) for arm in range(count) for receiver in graph.neighbours(arm)] + ends
        final, arm, receiver = (np.array(column) for column in zip(*choices, strict=True))
        was_final, was_arm = action[..., :1] > 0, action[..., 1 : 1 + count].argmax(-1)[..., None]
        order = np.argsort(2 * (arm != was_arm) + (final != was_final), -1, kind="stable")
        place = np.broadcast_to(action[..., None, -2:], (*order.shape, 2))
        return action_of(final[order] > 0, arm[order], receiver[order], place, count)

    def under(self, rules: Rules) -> SupervisorPolicy:
        """The same policy acting under another rule book, with another epsilon for instance."""
        other = copy(self)
        other.rules = rules
        return other

    def require_executors(self) -> None:  # noqa: B027 - most do
        """Raise :class:`InvalidSetting` if it does not leave the motions to executors. Here: it does."""

    def __call__(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The AEC supervisor's action for its observation.

        Raises:
            InvalidSetting: of a policy whose motions are its own: where a supervisor is asked, executors move the arms.
            NobodyMoves: it wants no arm to move, which is no action there.
        """
        self.require_executors()
        pose, goal = np.asarray(observation["state"], float), np.asarray(observation["goal"], float)
        action = self.act(pose, goal, np.asarray(observation["previous_arm"]) - 1)
        if np.isnan(action).any():
            raise NobodyMoves(self.name)
        return choices_of(action, self.rules.cell.num_arms)

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True) -> tuple[Any, Any]:
        """The action for what an environment shows, and ``state`` as it was: these policies remember nothing.

        Args:
            observation: of the Gymnasium environments, one cell or many (poses in mm and rad), with the layout ``object``; of the batched
                TorchRL environment; or of the AEC supervisor.
            state: handed back.
            episode_start: not looked at.
            deterministic: True; these policies do not draw.

        Returns:
            The environment's action (..., size), a tensor where the observation holds tensors; of the AEC supervisor a mapping.

        Raises:
            InvalidSetting: for another observation, or ``deterministic=False``.
            NobodyMoves: it wants no arm to move.
        """
        if not deterministic:
            raise InvalidSetting("deterministic", deterministic, f"True: {self.name} always says what it holds for best")
        if isinstance(observation, Mapping) and "state" in observation:
            return self(observation), state
        try:
            shown = [observation[key] for key in ("achieved_goal", "desired_goal")]
            last = observation["previous_arm"][..., 0] if "previous_arm" in observation else last_arm(observation["observation"])
        except (KeyError, TypeError, IndexError) as error:
            forms = "achieved_goal, desired_goal and observation or previous_arm; or state, goal and previous_arm"
            raise InvalidSetting("observation", observation, f"a mapping with {forms}") from error
        pose, goal = (np.asarray(each, np.float64) for each in shown)
        action = self.act(pose, goal, np.asarray(last, np.int64))
        if np.isnan(action).any():
            raise NobodyMoves(self.name)
        return as_kind(action, shown[0]), state

    def __repr__(self) -> str:
        """What it is, and where it acts."""
        config = self.rules.config
        return (
            f"{type(self).__name__}({self.name!r}, architecture={config.architecture!r}, cell={self.rules.cell.config.name!r}, "
            f"epsilon_deg={math.degrees(self.rules.epsilon_rad):g})"
        )


class ShieldedPolicy(SupervisorPolicy):
    """Another policy, kept from transfers that fail on exact arms.

    A decision fails if the arm cannot do it or, in architecture B, if it is final and leaves more than epsilon. What fails gives way to the
    first of the policy's own :meth:`~SupervisorPolicy.alternatives` that does not; every other decision stays as it is. They include a
    hand-over by either arm, so one of them is possible wherever any arm reaches the object; where none does, nothing is repaired.

    That no arm is to move is left alone as well: arms that take turns and wait for each other are no failure one step ahead.

    Attributes:
        inner: the policy.
        repaired: decisions that were repaired since it was made.
    """

    def __init__(self, inner: SupervisorPolicy) -> None:
        super().__init__(inner.rules, SHIELDED + inner.name)
        self.inner, self.about = inner, inner.about
        self.variant, self.any_cell = inner.variant, inner.any_cell
        self.repaired = 0

    def under(self, rules: Rules) -> SupervisorPolicy:
        """The same policy and the shield under another rule book; it counts anew."""
        return ShieldedPolicy(self.inner.under(rules))

    def require_executors(self) -> None:
        """As the policy."""
        self.inner.require_executors()

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The policy's decision, or what it is repaired to."""
        action = self.inner.act(pose, goal, previous_arm)
        failing = self._fails(pose, goal, action) & ~np.isnan(action).any(-1)  # that no arm moves is no failure
        if not failing.any():
            return action
        rows = np.nonzero(np.atleast_1d(failing))[0]
        before, aim = pose.reshape(-1, 3)[rows], goal.reshape(-1, 3)[rows]
        safe = np.array(action).reshape(-1, action.shape[-1])
        others = self.inner.alternatives(safe[rows], before, aim, np.atleast_1d(previous_arm)[rows])
        ends = np.broadcast_to(before[:, None], (*others.shape[:-1], 3)), np.broadcast_to(aim[:, None], (*others.shape[:-1], 3))
        refused = self._fails(*ends, others)
        repaired = ~refused.all(-1)
        safe[rows[repaired]] = others[repaired, refused[repaired].argmin(-1)]
        self.repaired += int(repaired.sum())
        return safe.reshape(action.shape)

    def _fails(self, pose: Floats, goal: Floats, action: Floats) -> NDArray[np.bool_]:
        """Which decisions (...) would fail."""
        rules, command = self.rules, self.rules.decode(action)
        placed, feasible = rules.transfer(pose, goal, command)
        if rules.external_finish:
            # Where an arm can finish already, the decision is ignored.
            return np.asarray(~(feasible | rules.can_finish(pose, goal).any(-1)))
        outcome = rules.judge(placed, goal, command.final, feasible).outcome
        return np.asarray((outcome == int(Outcome.WRONG_ORIENTATION)) | (outcome == int(Outcome.WRONG_POSITION)))


class ResigningPolicy(SupervisorPolicy):
    """Another policy, for a cell with arms out of order: it says so when the goal cannot be reached any more.

    Where the exact planner knows no plan, no arm is to move. Every other decision is the policy's own.

    Attributes:
        inner: the policy.
        planner: of the arms that are left.
    """

    def __init__(self, inner: SupervisorPolicy) -> None:
        super().__init__(inner.rules, inner.name)
        self.inner, self.about, self.planner = inner, inner.about, ExactPlanner(inner.rules)
        self.variant, self.any_cell = inner.variant, inner.any_cell

    def under(self, rules: Rules) -> SupervisorPolicy:
        """The same policy under another rule book."""
        return ResigningPolicy(self.inner.under(rules))

    def require_executors(self) -> None:
        """As the policy."""
        self.inner.require_executors()

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The policy's."""
        return self.inner.alternatives(action, pose, goal, previous_arm)

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The policy's decision, or that no arm is to move."""
        solvable = self.planner.plan(pose, goal).transfers > 0
        return np.where(solvable[..., None], self.inner.act(pose, goal, previous_arm), np.nan)

    def __call__(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """As of any policy; :class:`NobodyMoves` says why."""
        why = self.unsolvable_because(np.asarray(observation["state"], float), np.asarray(observation["goal"], float))
        if why:
            raise NobodyMoves(self.name, why)
        return super().__call__(observation)

    def unsolvable_because(self, pose: Floats, goal: Floats) -> str:
        """Why the goal (3,) cannot be reached from ``pose`` (3,) any more; empty if it can."""
        why = self.planner.unsolvable_because(pose, goal)
        return why and f"the goal cannot be reached any more, with {listed(self.rules.cell.names)} alone: {why}"
