"""Two arms that take turns, asked as one supervisor: the same in numpy as in torch, and asked in the right order."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from marl_handover import cli, policies
from marl_handover.baselines.decentralised import FINISH, PASS, PLACE, Decentralised
from marl_handover.commands.plan import solve
from marl_handover.compose import compose
from marl_handover.config import DecentralisedConfig
from marl_handover.envs.decentralised import TurnRules, own_view
from marl_handover.errors import CheckpointMismatch
from marl_handover.learning.checkpoint import policy_arrays, run_arrays, save_policy
from marl_handover.learning.evaluation import evaluate
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.learning.trainer import Trainer
from marl_handover.policies import actor as actors
from marl_handover.policies.policy import NobodyMoves
from marl_handover.task.episode import nobody_moves, play
from marl_handover.task.observations import observe
from marl_handover.task.rules import Outcome

LEARNERS = ("independent", "shared", "ctde")


@pytest.fixture(scope="module")
def made(paper, draw, tmp_path_factory):
    """``made(learners, *overrides, waits=0.5)``: an algorithm with random weights that passes in half of the cases, and its policy file."""

    def make(learners, *overrides, waits=0.5):
        given = ["compile=off", "variant=decentralised", f"decentralised.learners={learners}", "algorithm.actor_hidden=[32]", *overrides]
        config = compose(TrainConfig, given, groups={"algorithm": ALGORITHMS})
        config.validate()
        torch.manual_seed(4)
        variant = Decentralised()
        algorithm = variant.algorithm(variant.rules(paper, config.task, config), config, torch.Generator().manual_seed(0))
        start, goal, previous, _ = draw(paper, 500, 9)
        blocks = torch.tensor(observe(algorithm.rules, "relative", start, goal, previous).astype(np.float32)).unflatten(-1, (2, -1))
        with torch.no_grad():
            for actor in algorithm.average.children():
                logits = actor(blocks.flatten(0, 1)).logits[:, 0]
                lead = logits[:, PASS] - logits[:, [FINISH, *range(PLACE, logits.shape[-1])]].amax(-1)
                actor.net[-1].bias[PASS] -= lead.quantile(1 - waits)
        path = tmp_path_factory.mktemp("policy") / "policy.npz"
        save_policy(path, policy_arrays(algorithm, config, "a test"))
        return algorithm, path

    return make


@pytest.mark.parametrize("settings", [(), ("algorithm.mixture_components=3",), ("algorithm.canonical=false", "algorithm.harmonics=0")])
@pytest.mark.parametrize("learners", LEARNERS)
def test_the_policy_asks_the_torch_actors_in_turn(paper, draw, made, learners, settings):
    algorithm, path = made(learners, *settings)
    policy = policies.load(str(path))
    start, goal, previous, _ = draw(paper, 400, 1)
    found = policy.act(start, goal, previous)
    both = torch.tensor(observe(policy.rules, "relative", start, goal, 0 * previous - 1).astype(np.float32))
    said = [algorithm.act(own_view(both, torch.full((400,), arm), torch.zeros(400))).numpy() for arm in (0, 1)]
    asked = {"first": 0, "second": 0, "nobody": 0}
    for row in range(400):
        first = {-1: 0, 0: 1, 1: 0}[int(previous[row])]
        willing = [arm for arm in (first, 1 - first) if said[arm][row, 0] >= -1 / 3]
        if not willing:
            assert np.isnan(found[row]).all()
            asked["nobody"] += 1
            continue
        choice, alpha, beta = said[willing[0]][row]
        expected = [1.0 if choice > 1 / 3 else -1.0, 1.0 if willing[0] else -1.0, alpha, beta * (1.0 if willing[0] else -1.0)]
        np.testing.assert_allclose(found[row], expected, atol=1e-5)
        asked["first" if willing[0] == first else "second"] += 1
    assert min(asked.values()) > 10, asked
    one_by_one = [policy.act(*problem) for problem in zip(start[:50], goal[:50], previous[:50], strict=True)]
    np.testing.assert_allclose(one_by_one, found[:50], atol=1e-5)


@pytest.mark.parametrize("learners", LEARNERS)
def test_evaluation_and_validation_play_the_same_episodes(paper, draw, made, learners):
    algorithm, path = made(learners, waits=0.2)
    policy = policies.load(str(path))
    start, goal = draw(paper, 300, 2)[:2]
    found = evaluate(policy.rules, policy.act, (start, goal)).episodes
    expected = Decentralised().play(algorithm, torch.tensor(start).float(), torch.tensor(goal).float())
    same = (found.outcome == expected.outcome.numpy()) & (found.transfers == expected.transfers.numpy())
    assert same.mean() > 0.98  # float32 and float64 may part at a threshold
    assert len(set(found.outcome.tolist())) >= 2


@pytest.mark.parametrize("settings", [(), ("algorithm.mixture_components=3",)])
@pytest.mark.parametrize("learners", LEARNERS)
def test_alternatives_are_all_that_the_networks_have_but_passing(paper, draw, made, learners, settings):
    _, path = made(learners, *settings)
    policy = policies.load(str(path))
    start, goal, previous, _ = draw(paper, 300, 3)
    action = policy.act(start, goal, previous)
    moves = ~np.isnan(action).any(-1)
    action, problem = action[moves], (start[moves], goal[moves], previous[moves])
    ranked = policy.alternatives(action, *problem)
    count = 1 + policy.about["modes"]
    assert ranked.shape == (moves.sum(), 2 * count, 4)
    np.testing.assert_array_equal(ranked[:, 0], action)
    np.testing.assert_array_equal(ranked[:, :count, 1], np.broadcast_to(action[:, None, 1], (len(action), count)))
    np.testing.assert_array_equal(ranked[:, count:, 1], np.broadcast_to(-action[:, None, 1], (len(action), count)))
    assert ((ranked[:, :count, 0] > 0).sum(-1) == 1).all()
    assert ((ranked[:, count:, 0] > 0).sum(-1) == 1).all()
    one = policy.alternatives(action[0], *(part[0] for part in problem))
    np.testing.assert_allclose(one, ranked[0], atol=1e-5)


def test_a_shielded_one_ends_in_success_or_not_at_all(paper, draw, made):
    """What fails is repaired by places of the arms' networks; that both pass is no failure one step ahead, and stays."""
    _, path = made("shared", waits=0.2)
    bare, shielded = (policies.load(f"{prefix}{path}") for prefix in ("", "shielded:"))
    problems = draw(paper, 300, 4)[:2]
    before, after = (play(policy.rules, policy.act, *problems).outcome for policy in (bare, shielded))
    assert np.isin(after, [Outcome.SUCCESS, Outcome.TIMEOUT]).all()
    assert (after == int(Outcome.TIMEOUT)).any()
    assert not np.isin(before, [Outcome.SUCCESS, Outcome.TIMEOUT]).all()
    assert shielded.repaired > 20


@pytest.mark.parametrize("prefix", ["", "shielded:"])
def test_arms_that_wait_for_each_other_give_no_command(made, prefix):
    _, path = made("shared", waits=1.0)
    policy = policies.load(f"{prefix}{path}")
    observation = {"state": np.array([-120.0, -60.0, 0.0]), "goal": np.array([150.0, 60.0, 1.0]), "previous_arm": 0}
    with pytest.raises(NobodyMoves, match="no arm to move"):
        policy(observation)
    pose, goal = observation["state"], observation["goal"]
    assert nobody_moves(policy.act(pose, goal, np.int64(-1)))
    plan = solve(policy, pose, goal)
    assert (plan["outcome"], plan["transfers"], plan["waiting"]) == ("timeout", [], True)
    np.testing.assert_array_equal(plan["goal"], goal)


@pytest.mark.parametrize("command", ["plan", "simulate"])
def test_commands_say_that_no_arm_moves(made, capsys, command):
    _, path = made("shared", waits=1.0)
    assert cli.main([command, f"policy={path}", "start=[-120,-60,0]", "goal=[150,60,90]"]) == 1
    captured = capsys.readouterr()
    assert "timeout" in captured.err
    assert ("no arm moves" if command == "plan" else "no arm is to move") in captured.out + captured.err


def test_a_run_directory_is_its_exported_file(paper, draw, tmp_path):
    given = ["preset=decentralised_independent", "compile=off", "algorithm.actor_hidden=[16]"]
    trainer = Trainer(compose(TrainConfig, given, groups={"algorithm": ALGORITHMS}), tmp_path)
    trainer.save()
    save_policy(tmp_path / "policy.npz", run_arrays(tmp_path))
    problem = draw(paper, 50, 2)[:3]
    run, file = (policies.load(str(path)) for path in (tmp_path, tmp_path / "policy.npz"))
    np.testing.assert_array_equal(run.act(*problem), file.act(*problem))
    assert run.variant == "decentralised"
    assert run.about["learners"] == "independent"
    assert len(run.networks) == 2
    with pytest.raises(CheckpointMismatch, match="architecture"):
        policies.adapted(str(tmp_path), architecture="A")


def test_it_needs_no_torch(made):
    code = f"""
import sys
sys.modules["torch"] = None
from marl_handover.policies import load
print(load({str(made("independent")[1])!r}).act(*__import__("numpy").array([[0.0, 100.0, 1.0], [10.0, -120.0, -2.0]]), -1))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.strip(" []\n").split()) == 4


def test_branches_have_one_order(paper):
    """Policies repeat three numbers of the networks, since those need torch."""
    assert (actors.FINISH, actors.PASS, actors.PLACE) == (FINISH, PASS, PLACE)
    assert TurnRules(paper, compose(TrainConfig, []).task, DecentralisedConfig()).action_size == 3
