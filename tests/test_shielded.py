"""The shield: what would fail one step ahead is repaired, everything else is left alone."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.config import TaskConfig
from marl_handover.errors import CheckpointMismatch, UnknownChoice
from marl_handover.policies import ShieldedPolicy, SupervisorPolicy
from marl_handover.task.episode import play
from marl_handover.task.rules import Outcome
from tests.symmetries import GROUP

architectures = pytest.mark.parametrize("architecture", ["A", "B"])


def failing(rules, start, goal, previous, action):
    """By playing it: decisions that end badly or that the arm refuses."""
    result = rules.step(start, goal, previous, action)
    bad = np.isin(result.outcome, [Outcome.WRONG_ORIENTATION, Outcome.WRONG_POSITION])
    return bad | (~result.feasible & (result.external_arm < 0)) if rules.external_finish else bad


@architectures
@pytest.mark.parametrize("name", ["random", "greedy", "pretrained"])
def test_no_shielded_episode_ends_wrong(paper, draw, architecture, name):
    name = f"pretrained_{architecture.lower()}" if name == "pretrained" else name
    policy = policies.load(f"shielded:{name}", paper, TaskConfig(architecture=architecture))
    bare = policies.load(name, paper, TaskConfig(architecture=architecture))
    problems = draw(paper, 500, 1)[:2]
    results = []
    outcome = play(policy.rules, policy.act, *problems, observer=lambda decision: results.append(decision.result)).outcome
    assert np.isin(outcome, [Outcome.SUCCESS, Outcome.TIMEOUT]).all()
    assert all((result.feasible | (result.external_arm >= 0)).all() for result in results), "no arm was asked for what it cannot do"
    if architecture == "B":  # in A a refusal only costs a step
        assert (outcome == int(Outcome.SUCCESS)).mean() >= (play(bare.rules, bare.act, *problems).outcome == int(Outcome.SUCCESS)).mean()
    assert policy.repaired > (20 if name == "random" else -1)


@architectures
def test_exact_is_left_alone(paper, draw, architecture):
    policy = policies.load("shielded:exact", paper, TaskConfig(architecture=architecture))
    problem = draw(paper, 2000, 2)[:3]
    np.testing.assert_array_equal(policy.act(*problem), policies.load("exact", paper, TaskConfig(architecture=architecture)).act(*problem))
    assert policy.repaired == 0


class Scripted(SupervisorPolicy):
    """Gives the actions it was told."""

    def __init__(self, rules, actions):
        super().__init__(rules, "scripted")
        self.actions = actions

    def act(self, pose, goal, previous_arm):
        return self.actions


@architectures
def test_only_what_fails_is_repaired_and_by_the_first_alternative_that_does_not(cell, rules_of, draw, architecture):
    start, goal, previous, action = draw(cell, 3000, 3)
    rules = rules_of(cell, architecture, epsilon_deg=20.0)
    inner = Scripted(rules, action)
    policy = ShieldedPolicy(inner)
    found = policy.act(start, goal, previous)
    bad = failing(rules, start, goal, previous, action)
    assert 0.1 < bad.mean() < 0.9
    assert policy.repaired == bad.sum()
    np.testing.assert_array_equal(found[~bad], action[~bad])
    assert not failing(rules, start, goal, previous, found).any()
    others = inner.alternatives(action, start, goal, previous)
    for row in np.nonzero(bad)[0][:200]:
        tried = [option for option in others[row] if not failing(rules, start[row], goal[row], previous[row], option)]
        np.testing.assert_array_equal(found[row], tried[0])


@architectures
def test_the_mirror_law_holds(paper, rules_of, draw, architecture):
    """Shielding the mirrored decisions about the mirrored problems is mirroring the shielded ones."""
    start, goal, previous, action = draw(paper, 2000, 4)
    rules = rules_of(paper, architecture)
    found = ShieldedPolicy(Scripted(rules, action)).act(start, goal, previous)
    for symmetry in GROUP[1:]:
        mirrored = ShieldedPolicy(Scripted(rules, symmetry.action(action)))
        image = mirrored.act(symmetry.pose(start), symmetry.pose(goal), symmetry.arm(previous))
        np.testing.assert_allclose(image[:, 2:], symmetry.action(found)[:, 2:], atol=1e-12)
        np.testing.assert_array_equal(image[:, :2] > 0, symmetry.action(found)[:, :2] > 0)


@architectures
def test_ranking_of_a_trained_policy_starts_with_its_decision_and_holds_every_branch(paper, draw, architecture):
    policy = policies.load(f"pretrained_{architecture.lower()}", paper)
    problem = draw(paper, 300, 5)[:3]
    action = policy.act(*problem)
    ranked = policy.alternatives(action, *problem)
    assert ranked.shape == (300, 4, 4)
    np.testing.assert_array_equal(ranked[:, 0], action)
    branches = np.sort(2 * (ranked[..., 0] > 0) + (ranked[..., 1] > 0), -1)
    np.testing.assert_array_equal(branches, np.broadcast_to([0, 1, 2, 3], branches.shape))
    one = policy.alternatives(action[0], *(part[0] for part in problem))
    np.testing.assert_allclose(one, ranked[0], atol=1e-5)


@pytest.mark.parametrize("name", ["random", "pretrained_b"])
def test_one_problem_is_a_batch_of_one(paper, draw, name):
    start, goal, previous, _ = draw(paper, 60, 6)
    singly, batched = (policies.load(f"shielded:{name}", paper, seed=1) for _ in range(2))
    alone = np.stack([singly.act(*problem) for problem in zip(start, goal, previous, strict=True)])
    rows = np.concatenate([batched.act(start[i : i + 1], goal[i : i + 1], previous[i : i + 1]) for i in range(60)])
    np.testing.assert_allclose(alone, rows, atol=1e-5)
    assert singly.repaired == batched.repaired
    assert not failing(singly.rules, start, goal, previous, alone).any()


def test_an_object_out_of_all_reach_is_left_to_the_policy(paper, rules_of):
    action = np.array([[1.0, 1.0, 0.0, 0.0]])
    policy = ShieldedPolicy(Scripted(rules_of(paper), action))
    far, goal = np.array([[900.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(policy.act(far, goal, np.array([-1])), action)
    assert policy.repaired == 0


def test_names_and_other_rules(paper, draw):
    shielded = policies.adapted("shielded:random", seed=3, epsilon_deg=40.0, architecture="A")
    assert (shielded.name, shielded.variant, shielded.rules.config.architecture) == ("shielded:random", "hierarchical", "A")
    assert shielded.inner.rules is shielded.rules
    shielded.act(*draw(paper, 200, 7)[:3])
    assert shielded.repaired > 0
    assert shielded.under(shielded.rules).repaired == 0
    with pytest.raises(CheckpointMismatch, match="architecture"):
        policies.adapted("shielded:pretrained_b", architecture="A")
    with pytest.raises(UnknownChoice, match="shielded:NAME"):
        policies.load("shielded:exakt")
