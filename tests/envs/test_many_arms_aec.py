"""Environments of 3 to 8 arms: PettingZoo's own tests, TorchRL's, equality with the rule book and the batched environment."""

from __future__ import annotations

import warnings
from itertools import product

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.test import api_test, seed_test
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

from marl_handover.config import TaskConfig
from marl_handover.envs import SupervisorEnv, handover_aec
from marl_handover.envs.flat_aec import FlatAEC
from marl_handover.errors import UnknownChoice
from marl_handover.motion.executor import ExecutorAgent, arm_agents
from marl_handover.policies import ResigningPolicy, load
from marl_handover.policies.policy import NobodyMoves
from marl_handover.task.actions import action_of, choices_of
from marl_handover.task.rules import Outcome, Rules
from tests.layouts import line, model_of, ring

SUPERVISOR = "supervisor"
COUNTS = range(2, 9)
PLACE = np.zeros(2, np.float32)
architectures = pytest.mark.parametrize("architecture", ["A", "B"])


def executors_of(model):
    return {agent: ExecutorAgent(agent, model, "direct") for agent in arm_agents(model.cell)}


def command(env, executors, action):
    """A decision from end to end: the supervisor's turn and those of the arms it leads to."""
    env.step(action)
    while env.agent_selection != SUPERVISOR:
        env.step(executors[env.agent_selection].act(env.observe(env.agent_selection)))


@architectures
@pytest.mark.parametrize(("count", "layout"), [(3, ring), (4, line), (6, ring), (8, ring)])
def test_pettingzoos_api_test(count, layout, architecture):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # on Dict spaces and agents' names, as of the pair
        api_test(handover_aec.env(cell=model_of(count, layout), architecture=architecture), num_cycles=200)


@pytest.mark.parametrize(("count", "backend"), [(3, "kinematic"), (5, "noisy"), (8, "kinematic")])
def test_pettingzoos_seed_test(count, backend):
    seed_test(lambda: handover_aec.env(cell=model_of(count), backend=backend), num_cycles=60)


@architectures
@pytest.mark.parametrize("count", COUNTS)
def test_torchrls_and_gymnasiums_checkers(count, architecture):
    cell = model_of(count).cell
    check_env_specs(SupervisorEnv(16, cell, TaskConfig(layout="raw", architecture=architecture), seed=0), seed=0)
    env = gymnasium.make(f"marl_handover/Supervisor{architecture}-v0", cell=cell)
    assert env.action_space.shape == ((4,) if count == 2 else (1 + 2 * count + 2,))
    check_env(env.unwrapped, skip_render_check=True)


def test_torchrls_wrapper_plays_three_arms():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        env = PettingZooWrapper(handover_aec.env(cell=model_of(3)), use_mask=True)
    env.set_seed(0)
    torch.manual_seed(0)
    check_env_specs(env)


def test_as_vectors_it_tells_of_commands_that_ask_no_arm():
    flat = FlatAEC(handover_aec.raw_env(cell=model_of(3), architecture="A"))
    assert flat.action_space(SUPERVISOR).shape == (9,)
    flat.reset(seed=0)
    for made in (1, 2):
        flat.step(action_of(False, 1, 1, PLACE, 3).astype(np.float32))
        assert flat.infos[SUPERVISOR]["transfers"] == made
        assert (flat.infos[SUPERVISOR]["feasible"], flat.infos[SUPERVISOR]["ignored"]) == (0.0, 0.0)


@pytest.mark.parametrize("count", COUNTS)
def test_agents_and_spaces_are_as_the_interface_says(count):
    env = handover_aec.raw_env(cell=model_of(count))
    assert env.possible_agents == [SUPERVISOR, *(f"arm_a{k}" for k in range(count))]
    acts, sees = env.action_space(SUPERVISOR), env.observation_space(SUPERVISOR)
    assert sees["previous_arm"].n == count + 1
    assert sees["legal"].n == (4 if count == 2 else count + count**2)
    assert list(acts) == ["final", "arm", *(() if count == 2 else ("receiver",)), "place"]
    assert [acts[key].n for key in acts if key != "place"] == [2, count, *(() if count == 2 else (count,))]
    assert env.observation_space("arm_a0")["other_joints"].shape == (5 * (count - 1),)


def test_an_executor_plays_an_arm_by_its_name():
    model = model_of(3)
    assert [ExecutorAgent(f"arm_a{k}", model).arm for k in range(3)] == [0, 1, 2]
    with pytest.raises(UnknownChoice, match="choose one of: arm_a0, arm_a1, arm_a2"):
        ExecutorAgent("arm_left", model)


def test_the_optimised_executor_keeps_clear_of_all_parked_arms():
    """Motions of three arms, judged for collision by the environment."""
    model, task = model_of(3), TaskConfig()
    env = handover_aec.raw_env(cell=model, task=task, backend_options={"check_collisions": True})
    agents, policy = {agent: ExecutorAgent(agent, model) for agent in arm_agents(model.cell)}, load("exact", model.cell, task)
    for seed in range(4):
        env.reset(seed=seed)
        while not (env.terminations[SUPERVISOR] or env.truncations[SUPERVISOR]):
            command(env, agents, policy(env.observe(SUPERVISOR)))
            assert env.infos[SUPERVISOR]["refusal"] in (None, "no_path")
        assert env.infos[SUPERVISOR]["outcome"] == "success" or env.infos[SUPERVISOR]["refusal"] == "no_path"


def test_choices_and_numbers_are_each_others_inverse():
    draw = np.random.default_rng(0)
    for count in COUNTS:
        for _ in range(20):
            final, arm, receiver = int(draw.integers(2)), int(draw.integers(count)), int(draw.integers(count))
            place = draw.uniform(-1, 1, 2)
            found = choices_of(action_of(final, arm, receiver, place, count), count)
            assert (found["final"], found["arm"], found.get("receiver", receiver)) == (final, arm, receiver)
            np.testing.assert_allclose(found["place"], place, rtol=1e-6)


@architectures
@settings(max_examples=25, deadline=None)
@given(count=st.sampled_from(list(COUNTS)), layout=st.sampled_from([ring, line]), seed=st.integers(0, 2**31), k=st.sampled_from([1, 2, 4]))
def test_it_is_the_rule_book_and_the_batched_environment_step_for_step(architecture, count, layout, seed, k):
    """Random problems and actions, an optimal one thrown in; exact arms. To the last bit against the rule book in float64; against the
    batched environment, which is float32, to rounding, up to where a decision within rounding of a threshold falls on the other side.
    """
    model = model_of(count, layout)
    task = TaskConfig(architecture=architecture, epsilon_deg=20.0, max_steps=6, layout="raw", symmetry_order=k)
    env, batch, rules = handover_aec.raw_env(cell=model, task=task), SupervisorEnv(1, model.cell, task), Rules(model.cell, task)
    exact, random, executors = load("exact", model.cell, task), np.random.default_rng(seed), executors_of(model)
    env.reset(seed=seed)
    pose, goal, previous, left, same, done = env._pose, env._goal, np.int64(-1), task.max_steps, True, False
    state = batch.reset()
    state["achieved_goal"], state["desired_goal"] = (torch.tensor(array[None], dtype=torch.float32) for array in (pose, goal))
    while not done:
        action = random.uniform(-1, 1, rules.action_size).astype(np.float32)
        if random.random() < 0.7:
            action = exact.act(pose, goal, previous).astype(np.float32)
        seen = env.observe(SUPERVISOR)
        assert env.observation_space(SUPERVISOR).contains(seen)
        expected = rules.step(pose, goal, previous, action.astype(float), transfers_left=np.asarray(left))
        command(env, executors, choices_of(action, count))
        left -= int(expected.transfers)
        info, reward = env.infos[SUPERVISOR], env.rewards[SUPERVISOR]
        terminated, truncated = env.terminations[SUPERVISOR], env.truncations[SUPERVISOR]
        outcome = Outcome.TIMEOUT if truncated else Outcome(int(expected.outcome))
        np.testing.assert_array_equal(env._pose, expected.pose)
        assert (reward, terminated, truncated) == (float(expected.reward), bool(expected.terminated), not terminated and left == 0)
        assert (info["transfers"], info["outcome"]) == (task.max_steps - left, outcome.name.lower())
        assert env._previous == expected.previous_arm
        if same:
            after = batch.step(state.set("action", torch.tensor(action[None])))["next"]
            same = int(after["outcome"]) == outcome and int(after["transfers"]) == info["transfers"]
            if same:
                np.testing.assert_allclose(after["achieved_goal"][0, :2], expected.pose[:2], atol=1e-3)
                assert float(after["reward"]) == pytest.approx(reward, abs=1e-4)
                assert (bool(after["terminated"]), bool(after["truncated"])) == (terminated, truncated)
                assert int(after["previous_arm"]) == expected.previous_arm
                state = after.exclude("reward")
        pose, previous, done = expected.pose, expected.previous_arm, terminated or truncated


@pytest.mark.parametrize("layout", [ring, line])
def test_legal_says_what_can_be_carried_out(layout):
    """For every command of random problems: it is refused as out of reach if and only if it is not legal."""
    model, answers = model_of(4, layout), set()
    env, executors = handover_aec.raw_env(cell=model), executors_of(model)
    for seed, arm, receiver, final in product(range(6), range(4), range(4), range(2)):
        env.reset(seed=seed)
        legal = bool(env.observe(SUPERVISOR)["legal"][arm if final else 4 + 4 * arm + receiver])
        command(env, executors, {"final": final, "arm": arm, "receiver": receiver, "place": PLACE})
        assert (env.infos[SUPERVISOR]["refusal"] == "out_of_reach") == (not legal)
        answers.add((legal, final))
    assert len(answers) == 4
    env = handover_aec.raw_env(cell=model, architecture="A")
    env.reset(seed=0)
    assert not env.observe(SUPERVISOR)["legal"][:4].any()


@architectures
@pytest.mark.parametrize(
    ("receiver", "reason"),
    [({"receiver": 0}, "out_of_reach"), ({"receiver": 3}, "out_of_reach"), ({}, "wrong_shape"), ({"receiver": 7}, "wrong_shape")],
    ids=["the arm itself", "one too far away", "none", "one that is not there"],
)
def test_a_command_without_a_place_asks_no_arm(receiver, reason, architecture):
    env = handover_aec.raw_env(cell=model_of(4, line), architecture=architecture)
    env.reset(options={"state": [0.0, 200.0, 0.0], "goal": [835.0, 10.0, 0.0]})
    before = env._pose
    env.step({"final": 0, "arm": 0, "place": PLACE, **receiver})
    assert env.agent_selection == SUPERVISOR
    assert (env.infos[SUPERVISOR]["refusal"], env.terminations[SUPERVISOR]) == (reason, architecture == "B")
    np.testing.assert_array_equal(env._pose, before)


@architectures
@pytest.mark.parametrize(("count", "layout"), [(3, ring), (4, line), (6, ring), (8, ring)])
def test_the_exact_policy_plays_it_through_the_public_calls(count, layout, architecture):
    model, task = model_of(count, layout), TaskConfig(architecture=architecture)
    policy, env, executors = load("exact", model.cell, task), handover_aec.env(cell=model, task=task), executors_of(model)
    for seed in range(5):
        env.reset(seed=seed)
        fewest = int(policy.planner.plan(env.unwrapped._pose, env.unwrapped._goal).transfers)
        for agent in env.agent_iter():
            observation, _, terminated, truncated, info = env.last()
            assert env.observation_space(agent).contains(observation)
            if terminated or truncated:
                if agent == SUPERVISOR:
                    assert (info["outcome"], info["transfers"]) == ("success", fewest)
                env.step(None)
                continue
            action = policy(observation) if agent == SUPERVISOR else executors[agent].act(observation)
            assert env.action_space(agent).contains({key: np.asarray(value) for key, value in action.items()})
            env.step(action)


@pytest.mark.parametrize("names", [["a0", "a2"], ["a2", "a3"], ["a1"], ["a1", "a2", "a3"]])
def test_arms_out_of_order_have_no_agent_and_stand_in_the_way(names):
    """Agents, legal commands and transfers are those of the others; joints are of all."""
    model = model_of(4)
    env = handover_aec.raw_env(cell=model, enabled=names)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # as above
        api_test(handover_aec.env(cell=model, enabled=names), num_cycles=60)
    assert env.possible_agents == [SUPERVISOR, *(f"arm_{name}" for name in names)]
    supervisor, arms = ResigningPolicy(load("exact", env.rules.cell)), executors_of(model)
    outcomes, resigned = [], []
    for seed in range(12):
        env.reset(seed=seed)
        home, can_finish = env.backend.joints_rad(), bool(env.rules.can_finish(env._pose, env._goal).any())
        while env.agents and not (env.terminations[SUPERVISOR] or env.truncations[SUPERVISOR]):
            agent = env.agent_selection
            seen = env.observe(agent)
            assert env.observation_space(agent).contains(seen)
            try:
                env.step(supervisor(seen) if agent == SUPERVISOR else arms[agent].act(seen))
            except NobodyMoves as stop:
                resigned.append((stop.why, can_finish))
                break
        else:
            outcomes.append(env.infos[SUPERVISOR]["outcome"])
        still = [name not in names for name in model.cell.names]
        np.testing.assert_array_equal(env.backend.joints_rad()[still], home[still])
    assert set(outcomes) <= {"success"}
    assert bool(outcomes) == bool(env.rules.cell.graph.edges)
    assert all("the goal cannot be reached any more, with" in why and not could for why, could in resigned)
    assert len(outcomes) + len(resigned) == 12
