"""A policy whose decisions are checked one step ahead by the rule book, and repaired where they would fail."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_handover.policies.policy import Floats, SupervisorPolicy
from marl_handover.task.rules import Outcome, Rules

SHIELDED = "shielded:"
"""Before a policy's name."""


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
        self.variant = inner.variant
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
