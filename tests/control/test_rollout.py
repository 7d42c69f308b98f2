"""What is foreseen is what the policy does on exact arms: the rows of ``plan`` say the same."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.commands.plan import solve
from marl_handover.control.transfers import rollout
from marl_handover.learning.evaluation import random_problems


@pytest.mark.parametrize("name", ["exact", "pretrained_b", "pretrained_a"])
def test_the_plan_command_agrees(name):
    policy = policies.adapted(name)
    for start, goal in zip(*random_problems(policy.rules, 40, 3), strict=True):
        ahead = rollout(policy, start, goal, -1)
        rows = [row for row in solve(policy, start, goal)["transfers"] if not row["refused"]]
        assert [("LR"[step.arm], step.final) for step in ahead] == [(row["arm"], row["final"]) for row in rows]
        np.testing.assert_allclose([step.pose for step in ahead], [row["to"] for row in rows], atol=1e-9)


def test_a_policy_that_moves_nobody_foresees_nothing():
    policy = policies.adapted("exact")
    policy.act = lambda pose, goal, previous: np.full(4, np.nan)
    assert rollout(policy, [-60.0, 20.0, 0.7], [50.0, 25.0, 3.0], -1) == []
