"""The ladder in Gymnasium, TorchRL and PettingZoo: each library's own checks, the same problems as the same numbers, regret."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test
from torchrl.envs.utils import check_env_specs, step_mdp

from marl_handover.envs.ladder import gymnasium_env, pettingzoo_env, torchrl_env
from marl_handover.errors import UnknownChoice
from marl_handover.motion.executor import ExecutorAgent, arm_agents
from marl_handover.policies import load
from marl_handover.task.ladder import TRAINING, rung, rungs
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import regret

NAMES = [each.name for each in rungs()]
every_rung = pytest.mark.parametrize("name", NAMES)
EXACT = [each.name for each in rungs() if not each.noise.position_mm]
FIRST = 100
SUPERVISOR = "supervisor"


def gymnasium_problems(env, count):
    rows = []
    for _ in range(count):
        seen, info = env.reset()
        rows.append(np.append(np.concatenate([seen["achieved_goal"], seen["desired_goal"]]), info["optimum"]))
    return np.array(rows, np.float32)


def torchrl_problems(env, count):
    rows = []
    while sum(map(len, rows)) < count:
        seen = env.reset()
        rows.append(torch.cat([seen["achieved_goal"], seen["desired_goal"], seen["optimum"].float()], -1).numpy())
    return np.concatenate(rows)[:count]


def pettingzoo_problems(env, count):
    rows = []
    for _ in range(count):
        env.reset()
        seen = env.observe(SUPERVISOR)
        rows.append(np.append(np.concatenate([seen["state"], seen["goal"]]), env.unwrapped.problems.optimum))
    return np.array(rows, np.float32)


@every_rung
def test_three_libraries_give_the_same_first_problems(name):
    of = rung(name)
    first = np.concatenate([*of.fixed[:2], of.fixed.optimum[:, None]], 1)[:FIRST]
    made = {
        "Gymnasium": gymnasium_problems(gymnasium.make(f"marl_handover/{of.id}"), FIRST),
        "TorchRL, all at once": torchrl_problems(torchrl_env(name, FIRST), FIRST),
        "TorchRL, some at once": torchrl_problems(torchrl_env(name, 16), FIRST),
        "PettingZoo": pettingzoo_problems(pettingzoo_env(name), FIRST),
    }
    for library, rows in made.items():
        assert rows.dtype == np.float32
        np.testing.assert_array_equal(rows, first, library)


@every_rung
def test_each_librarys_own_checks_pass(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # on Dict spaces and agents' names, as of every cell
        check_env(gymnasium.make(f"marl_handover/{rung(name).id}").unwrapped)
        check_env_specs(torchrl_env(name, 3))
        check_env_specs(torchrl_env(name, 3, TRAINING, "raw"))
        api_test(pettingzoo_env(name), num_cycles=40)


def exact_answer(env):
    """What the exact planner says to a Gymnasium environment's problem."""
    planner = ExactPlanner(env.unwrapped.rules)
    return lambda seen: planner.act(*(np.asarray(seen[key], float) for key in ("achieved_goal", "desired_goal"))).astype(np.float32)


@pytest.mark.parametrize("name", EXACT)
def test_the_exact_planner_has_no_regret_in_gymnasium(name):
    env = gymnasium_env(name)
    act = exact_answer(env)
    for number in range(20):
        seen, info = env.reset()
        assert "regret" not in info
        over = False
        while not over:
            seen, _, terminated, truncated, info = env.step(act(seen))
            over = terminated or truncated
        assert (info["regret"], info["optimum"]) == (0, rung(name).fixed.optimum[number])
        assert info["transfers"] == info["optimum"]


def test_a_failure_costs_all_that_was_allowed():
    env = gymnasium_env("pair")
    _, info = env.reset(options={"problem": 0})
    *_, over = env.step(np.array([1.0, 1.0, 0.0, 0.0], np.float32))
    assert over["outcome"] == "wrong_position"
    assert over["regret"] == 20 - info["optimum"]


@pytest.mark.parametrize("name", ["pair", "triangle"])
def test_the_exact_policy_has_no_regret_in_pettingzoo(name):
    env = pettingzoo_env(name)
    model = env.unwrapped.model
    policy = load("exact", model.cell, rung(name).task())
    executors = {agent: ExecutorAgent(agent, model, "direct") for agent in arm_agents(model.cell)}
    for number in range(5):
        env.reset()
        while not any(env.terminations.values()):
            agent = env.agent_selection
            env.step(policy(env.observe(agent)) if agent == SUPERVISOR else executors[agent].act(env.observe(agent)))
        assert env.infos[SUPERVISOR]["optimum"] == rung(name).fixed.optimum[number]
        assert env.infos[SUPERVISOR]["regret"] == 0


def test_torchrl_cells_that_end_get_the_next_problems_in_order():
    of, count = rung("triangle"), 8
    env = torchrl_env("triangle", count)
    planner = ExactPlanner(env.rules)
    state, given, ended = env.reset(), list(range(count)), []
    for _ in range(20):
        pose, goal = state["achieved_goal"], state["desired_goal"]
        for row, number in enumerate(given):
            np.testing.assert_array_equal(goal[row].numpy(), of.fixed.goal[number])
            assert int(state["optimum"][row]) == of.fixed.optimum[number]
        state["action"] = planner.act(pose, goal)
        stepped = env.step(state)["next"]
        done = stepped["done"][:, 0]
        ended += regret(stepped["outcome"], stepped["transfers"], stepped["optimum"], 20)[done].flatten().tolist()
        stepped["_reset"] = stepped["done"]
        state = step_mdp(env.step(state)) if not done.any() else env.reset(stepped)
        for row in torch.nonzero(done)[:, 0].tolist():
            given[row] = max(given) + 1
    assert ended
    assert set(ended) == {0}


def test_a_seed_begins_the_file_again_and_decides_the_noise():
    def ways(seed):
        env = gymnasium_env("pair_noisy")
        act, rows = exact_answer(env), []
        env.reset(seed=3)
        seen, _ = env.reset(seed=seed)
        for _ in range(6):
            seen, _, terminated, truncated, _ = env.step(act(seen))
            rows.append(seen["achieved_goal"])
            if terminated or truncated:
                seen, _ = env.reset()
        return np.array(rows)

    np.testing.assert_array_equal(ways(1), ways(1))
    assert not np.array_equal(ways(1), ways(2))
    env = gymnasium_env("pair_noisy")
    first = env.reset()[0]["achieved_goal"]
    env.reset()
    np.testing.assert_array_equal(env.reset(seed=7)[0]["achieved_goal"], first)


def test_without_a_seed_two_environments_are_alike():
    for split in ("evaluation", TRAINING):
        one, other = (gymnasium_problems(gymnasium_env("triangle_discs", split), 20) for _ in range(2))
        np.testing.assert_array_equal(one, other)
    for make in (gymnasium_env, pettingzoo_env):
        env = make("pair", TRAINING)
        problems = gymnasium_problems if make is gymnasium_env else pettingzoo_problems
        assert not np.array_equal(problems(env, 5), problems(env, 5))


def test_a_vector_of_environments_can_share_the_file_out():
    envs = gymnasium.make_vec("marl_handover/Ladder-2-Pair-v0", num_envs=2)
    seen = [env.reset(options={"problem": number}) for number, env in enumerate(envs.envs)]
    for number, (observation, info) in enumerate(seen):
        np.testing.assert_array_equal(observation["achieved_goal"], rung("pair").fixed.start[number])
        assert info["optimum"] == rung("pair").fixed.optimum[number]
    envs.close()


def test_a_problem_of_ones_own_has_its_optimum():
    env, fixed = gymnasium_env("triangle"), rung("triangle").fixed
    _, info = env.reset(options={"state": fixed.start[7].tolist(), "goal": fixed.goal[7].tolist()})
    assert info["optimum"] == fixed.optimum[7]


@pytest.mark.parametrize("make", [gymnasium_env, torchrl_env, pettingzoo_env])
def test_unknown_names_are_told_with_those_that_are_known(make):
    with pytest.raises(UnknownChoice, match=r"ladder = 'none' is not known; choose one of: pair, pair_1deg"):
        make("none")
    with pytest.raises(UnknownChoice, match=r"split = 'test'"):
        make("pair", split="test")
