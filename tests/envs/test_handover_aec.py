"""The hierarchy: PettingZoo's own tests, equality with the batched environment, refusals by name, nothing a policy says raises."""

from __future__ import annotations

import math
import warnings
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pettingzoo.test import api_test, parallel_api_test, render_test, seed_test
from torchrl.envs.libs.pettingzoo import PettingZooWrapper
from torchrl.envs.utils import check_env_specs

from marl_handover.cell import build_cell, cell_config
from marl_handover.config import LoopConfig, MotionConfig, NoiseConfig, RewardConfig, TaskConfig
from marl_handover.control.closed_loop import make_loop
from marl_handover.envs import SupervisorEnv, handover_aec
from marl_handover.envs.backends import KinematicBackend, Refusal
from marl_handover.envs.top_view import GOAL
from marl_handover.errors import InvalidSetting, NotFinite, OutOfReach, UnknownChoice, UnknownKey
from marl_handover.motion.executor import ExecutorAgent
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.policies import load
from marl_handover.task.rules import Outcome, Rules
from tests.canonical_arms import PARKED_DEG

SUPERVISOR, LEFT, RIGHT = "supervisor", "arm_left", "arm_right"
ARMS = (LEFT, RIGHT)
KEYS = ("final", "arm", "place", "paths", "grasp", "release", "reason")
MIDDLE = {"final": 0, "place": np.zeros(2, np.float32)}
EASY = {"state": [0.0, 0.0, 0.0], "goal": [200.0, 180.0, math.pi / 2]}  # the left arm can finish at once
FAR = {
    "state": [200.0, 180.0, 0.0],
    "goal": [-200.0, -180.0, 0.0],
}  # over the middle: the left arm reaches the object, the right one the goal

architectures = pytest.mark.parametrize("architecture", ["A", "B"])
makers = pytest.mark.parametrize("make", [handover_aec.env, handover_aec.raw_env])


@pytest.fixture(scope="module")
def model():
    return build_cell(cell_config("paper"))


@pytest.fixture(scope="module")
def executors(model):
    return {agent: ExecutorAgent(agent, model, "direct") for agent in ARMS}


def begun(model, architecture="B", problem=None, seed=0, **settings):
    env = handover_aec.raw_env(cell=model, architecture=architecture, **settings)
    env.reset(seed=seed, options=problem)
    return env


def obey(env, executors):
    """The queried arm does what it is asked."""
    env.step(executors[env.agent_selection].act(env.observe(env.agent_selection)))


def command(env, executors, arm, final=0, place=(0.0, 0.0)):
    """A decision from end to end: the supervisor's turn and those of the arms it leads to."""
    env.step({"final": final, "arm": arm, "place": np.array(place, np.float32)})
    while env.agent_selection != SUPERVISOR:
        obey(env, executors)


def result(env):
    """Reward, terminated, truncated and infos of the supervisor."""
    return env.rewards[SUPERVISOR], env.terminations[SUPERVISOR], env.truncations[SUPERVISOR], env.infos[SUPERVISOR]


@architectures
@makers
def test_pettingzoos_api_test(make, architecture, model):
    """Its notices are on Dict spaces, agents' names, and agents that differ; interfaces of this project say all three."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        api_test(make(cell=model, architecture=architecture), num_cycles=300)
    known = ("not a NumPy array", "probably should be gymnasium.spaces.box", "named in the format", "different observation space sizes")
    assert [str(warning.message) for warning in caught if not any(words in str(warning.message) for words in known)] == []


@architectures
@pytest.mark.parametrize("backend", ["kinematic", "noisy"])
def test_pettingzoos_seed_test(architecture, backend, model):
    seed_test(lambda: handover_aec.env(cell=model, architecture=architecture, backend=backend), num_cycles=100)


@architectures
def test_pettingzoos_parallel_test(architecture, model):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(handover_aec.parallel_env(cell=model, architecture=architecture), num_cycles=100)


def test_the_parallel_environment_takes_the_turns_of_the_other(model):
    """Every agent acts at random in both; what counts is what the one whose turn it is says."""
    turns, parallel = handover_aec.env(cell=model), handover_aec.parallel_env(cell=model)
    turns.reset(seed=3)
    observations, _ = parallel.reset(seed=3)
    active, steps = "supervisor", 0
    for agent in parallel.possible_agents:
        parallel.action_space(agent).seed(0)
    while parallel.agents:
        assert active == turns.agent_selection
        actions = {agent: parallel.action_space(agent).sample() for agent in parallel.agents}
        observations, rewards, *_, infos = parallel.step(actions)
        turns.step(actions[active])
        assert rewards == turns.rewards
        for agent, seen in observations.items():
            for key, value in turns.observe(agent).items():
                np.testing.assert_array_equal(seen[key], value)
        steps, active = steps + 1, infos["supervisor"].get("active_agent", "")
    assert steps >= 2
    assert turns.terminations["supervisor"] or turns.truncations["supervisor"]


def test_pettingzoos_render_test(model, capsys):
    render_test(lambda render_mode=None: handover_aec.env(cell=model, render_mode=render_mode))
    assert "next arm_" in capsys.readouterr().out


def test_pictures_show_the_goal(model):
    env = begun(model, render_mode="rgb_array")
    picture = env.render()
    assert picture.dtype == np.uint8
    assert (picture == GOAL).all(-1).any()


@architectures
def test_torchrl_plays_it(architecture, model):
    """What its wrapper needs: ``use_mask``, Dict actions, no infos at reset. Done means all agents are."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # on versions of PettingZoo it was tested with
        env = PettingZooWrapper(handover_aec.env(cell=model, architecture=architecture), use_mask=True)
    env.set_seed(0)
    torch.manual_seed(0)
    check_env_specs(env)
    played = env.rollout(120, break_when_any_done=False)
    acting = torch.stack([played[agent, "mask"][:, 0] for agent in (SUPERVISOR, *ARMS)])
    assert (acting.sum(0) == 1).all()
    assert acting[0, ::2].all()
    assert played["next", "done"].sum() == (60 if architecture == "B" else 3)
    assert set(played["next", SUPERVISOR, "reward"].unique().tolist()) <= {-30.0, -1.0, 0.0, 20.0}


@architectures
@pytest.mark.parametrize("motion_weight", [0.0, 0.5])
def test_it_is_the_batched_environment_transition_for_transition(architecture, motion_weight, model, executors):
    """Random problems and actions, a finishing one thrown in where the exact planner has one; with exact arms.

    To the last bit against the rule book in float64; to rounding against the batched environment, which is float32. There, a decision
    within rounding of a threshold may fall on the other side: such episodes are left out from there on, and there must be few.
    """
    task = TaskConfig(architecture=architecture, epsilon_deg=20.0, max_steps=6, reward=RewardConfig(motion_weight=motion_weight))
    env, batch = handover_aec.raw_env(cell=model, task=task), SupervisorEnv(1, model.cell, task)
    rules = Rules(model.cell, task, motion_cost(model.cell, task))
    exact, random = load("exact", model.cell, task), np.random.default_rng(1)
    outcomes, apart, decisions = set(), 0, 0
    for episode in range(150):
        env.reset(seed=episode)
        pose, goal, previous, left, same = env._pose, env._goal, np.int64(-1), task.max_steps, True
        state = batch.reset()
        state["achieved_goal"], state["desired_goal"] = (torch.tensor(array[None], dtype=torch.float32) for array in (pose, goal))
        done = False
        while not done:
            action = random.uniform(-1, 1, 4).astype(np.float32)
            if random.random() < 0.7:
                action = exact.act(pose, goal, previous).astype(np.float32)
            expected = rules.step(pose, goal, previous, action.astype(float), transfers_left=np.asarray(left))
            command(env, executors, int(action[1] > 0), int(action[0] > 0), action[2:])
            left -= int(expected.transfers)
            reward, terminated, truncated, info = result(env)
            outcome = Outcome.TIMEOUT if truncated else Outcome(int(expected.outcome))
            np.testing.assert_array_equal(env._pose, expected.pose)
            assert (reward, terminated, truncated) == (float(expected.reward), bool(expected.terminated), not terminated and left == 0)
            assert (info["transfers"], info["outcome"]) == (task.max_steps - left, outcome.name.lower())
            assert env._previous == expected.previous_arm
            if same:
                after = batch.step(state.set("action", torch.tensor(action[None])))["next"]
                same = int(after["outcome"]) == outcome and int(after["transfers"]) == info["transfers"]
                apart += not same
                if same:
                    np.testing.assert_allclose(after["achieved_goal"][0, :2], expected.pose[:2], atol=1e-3)
                    assert float(after["reward"]) == pytest.approx(reward, abs=1e-4)
                    assert (bool(after["terminated"]), bool(after["truncated"])) == (terminated, truncated)
                    state = after.exclude("reward")
            pose, previous, done = expected.pose, expected.previous_arm, terminated or truncated
            decisions += 1
        outcomes.add(info["outcome"])
    assert decisions > 250
    assert apart <= 1
    assert outcomes == {"success", "timeout"} | ({"wrong_orientation", "wrong_position"} if architecture == "B" else set())


@architectures
@pytest.mark.parametrize("name", ["exact", "pretrained"])
def test_policies_play_it(architecture, name, model, executors):
    """Through the public calls alone; observations and actions are in their spaces."""
    task = TaskConfig(architecture=architecture)
    policy = load("exact", model.cell, task) if name == "exact" else load(f"pretrained_{architecture.lower()}")
    env = handover_aec.env(cell=model, task=task)
    outcomes, shortest = [], load("exact", model.cell, task).planner
    for seed in range(20):
        env.reset(seed=seed)
        fewest = int(shortest.plan(env.unwrapped._pose, env.unwrapped._goal).transfers)
        for agent in env.agent_iter():
            observation, _, terminated, truncated, info = env.last()
            assert env.observation_space(agent).contains(observation)
            if terminated or truncated:
                if agent == SUPERVISOR:
                    outcomes.append(info["outcome"])
                    assert name != "exact" or info["transfers"] == fewest
                env.step(None)
                continue
            action = policy(observation) if agent == SUPERVISOR else executors[agent].act(observation)
            assert env.action_space(agent).contains({key: np.asarray(value) for key, value in action.items()})
            env.step(action)
    assert outcomes.count("success") >= (20 if name == "exact" else 18)


@architectures
def test_the_named_arm_is_asked_and_sees_the_command(architecture, model, executors):
    env = begun(model, architecture, FAR)
    for agent in ARMS:
        assert env.observe(agent)["active"] == 0
    env.step({"final": 0, "arm": 0, "place": np.array([0.5, 0.0], np.float32)})
    assert env.agent_selection == LEFT
    seen, other = env.observe(LEFT), env.observe(RIGHT)
    assert (seen["active"], other["active"], seen["final"]) == (1, 0, 0)
    np.testing.assert_allclose(seen["target"], [0.5 * model.cell.chart.x_max_mm, 0.0], rtol=1e-6)
    np.testing.assert_allclose(seen["object"], FAR["state"])
    np.testing.assert_allclose(seen["joints"], np.radians(PARKED_DEG), rtol=1e-6)


def test_architecture_a_asks_the_finishing_arm_next(model, executors):
    """From the left arm's end to the middle, from there the right one finishes; the supervisor is not asked again."""
    env = begun(model, "A", {"state": [200.0, 180.0, math.pi / 2], "goal": [-200.0, -180.0, math.pi / 2]})
    env.step({**MIDDLE, "arm": 0})
    obey(env, executors)
    assert (env.agent_selection, env.observe(RIGHT)["final"]) == (RIGHT, 1)
    np.testing.assert_allclose(env.observe(RIGHT)["target"], [-200.0, -180.0])
    assert (env.rewards[SUPERVISOR], env.infos[SUPERVISOR]) == (0, {})
    obey(env, executors)
    assert result(env) == (0, True, False, {"refusal": None, "transfers": 2, "outcome": "success"})


@pytest.mark.parametrize("action", [{**MIDDLE, "arm": 1}, None, {"place": math.nan}])
def test_architecture_a_solved_at_its_start_ignores_the_first_command(action, model, executors):
    env = begun(model, "A", EASY)
    env.step(action)
    assert env.agent_selection == LEFT
    obey(env, executors)
    assert result(env) == (0, True, False, {"refusal": None, "transfers": 1, "outcome": "success"})


def test_a_refused_finish_of_architecture_a_ends_it(model):
    env = begun(model, "A", EASY)
    env.step({**MIDDLE, "arm": 0})
    env.step({"grasp": 0, "release": 1})
    assert result(env) == (-1, True, False, {"refusal": "declined", "transfers": 1, "outcome": "wrong_position"})


@pytest.mark.parametrize(
    ("reason", "refusal"), [(None, "declined"), (0, "declined"), (1, "out_of_reach"), (2, "no_path"), (9, "wrong_shape")]
)
def test_the_supervisor_sees_why_an_arm_declines(model, reason, refusal):
    env = begun(model, "B", EASY)
    env.step({**MIDDLE, "arm": 0})
    env.step({"grasp": 0, "release": 0} | ({} if reason is None else {"reason": reason}))
    assert env.infos[SUPERVISOR]["refusal"] == refusal


def test_an_executor_that_finds_no_path_says_so(model):
    """The other arm stands where the object is to go."""
    agent = ExecutorAgent("arm_left", model)
    pick, place, other = np.array([-200.0, 150.0]), np.array([0.0, 0.0]), model.arm.ik([180.0, 0.0, 45.0])[0]
    seen = {"object": np.append(pick, 0.0), "target": place, "joints": np.radians(PARKED_DEG), "other_joints": other}
    action = agent.act(seen)
    assert (action["grasp"], action["release"], action["reason"]) == (0, 0, 2)
    assert "short of the clearance to the other arm" in agent.last_refusal


@architectures
def test_arms_earn_their_path_and_others_nothing(architecture, model, executors):
    """A turn about the base, 200 mm from it: an arc; cumulative rewards are those since the agent's last turn."""
    env = begun(model, architecture, {"state": [0.0, -20.0, 0.0], "goal": [-200.0, -180.0, -3.0]}, refused_reward=-7.0)
    command(env, executors, 0, place=(0.3, 0.0))
    radius_from, radius_to = 200.0, math.hypot(180, 0.3 * model.cell.chart.x_max_mm)
    assert abs(radius_to - radius_from) < 20
    straight = math.dist((0.0, -20.0), (0.3 * model.cell.chart.x_max_mm, 0.0))
    assert -1.3 * straight / 100 < env.rewards[LEFT] <= -straight / 100
    assert env.rewards[LEFT] == -env.infos[LEFT]["path_mm"] / 100
    assert env.rewards[RIGHT] == 0
    assert env._cumulative_rewards[LEFT] == env.rewards[LEFT]
    env.step({**MIDDLE, "arm": 0})
    env.step({"grasp": 0, "release": 0})
    assert (env.rewards[LEFT], env.rewards[RIGHT]) == (-7.0, 0)


def test_legal_says_what_can_be_carried_out(model, executors):
    """For every command of random problems: it is refused as out of reach if and only if it is not legal."""
    env, answers = begun(model, "B"), set()
    for seed, arm, final in product(range(40), range(2), range(2)):
        env.reset(seed=seed)
        legal = bool(env.observe(SUPERVISOR)["legal"][2 * arm + final])
        command(env, executors, arm, final)
        assert (env.infos[SUPERVISOR]["refusal"] == "out_of_reach") == (not legal)
        answers.add((legal, final))
    assert len(answers) == 4
    env = begun(model, "A", FAR)
    np.testing.assert_array_equal(env.observe(SUPERVISOR)["legal"], [1, 0, 0, 0])


def refused(architecture, terminated_reward=-30.0):
    return (terminated_reward, True) if architecture == "B" else (-1.0, False)


NO_COMMANDS = {
    "both arms": ({**MIDDLE, "arm": np.array([0, 1])}, "wrong_shape"),
    "no such arm": ({**MIDDLE, "arm": 2}, "wrong_shape"),
    "half an arm": ({**MIDDLE, "arm": 0.5}, "wrong_shape"),
    "no arm": (MIDDLE, "wrong_shape"),
    "nothing": (None, "wrong_shape"),
    "words": ({**MIDDLE, "arm": "left"}, "wrong_shape"),
    "a vector": (np.zeros(4), "wrong_shape"),
    "three coordinates": ({"final": 0, "arm": 0, "place": np.zeros(3)}, "wrong_shape"),
    "NaN": ({"final": 0, "arm": 0, "place": np.array([math.nan, 0.0])}, "not_finite"),
    "infinite": ({"final": 0, "arm": 0, "place": np.array([0.0, math.inf])}, "not_finite"),
    "NaN arm": ({**MIDDLE, "arm": math.nan}, "not_finite"),
}


@architectures
@pytest.mark.parametrize(("action", "reason"), NO_COMMANDS.values(), ids=NO_COMMANDS)
def test_what_is_no_command_is_refused_and_asks_no_arm(architecture, action, reason, model):
    env = begun(model, architecture, FAR)
    env.step(action)
    outcome = "wrong_position" if architecture == "B" else "none"
    assert result(env) == (*refused(architecture), False, {"refusal": reason, "transfers": 1, "outcome": outcome})
    assert env.agent_selection == SUPERVISOR
    np.testing.assert_array_equal(env._pose, FAR["state"])


@architectures
def test_an_arm_out_of_reach_is_asked_but_in_vain(architecture, model, executors):
    env = begun(model, architecture, FAR)
    env.step({**MIDDLE, "arm": 1})
    assert env.agent_selection == RIGHT
    obey(env, executors)
    assert result(env)[:2] == refused(architecture)
    assert (env.infos[SUPERVISOR]["refusal"], env.rewards[RIGHT], env.rewards[LEFT]) == ("out_of_reach", -10.0, 0)
    np.testing.assert_array_equal(env._pose, FAR["state"])


def answer(executors, env, **changes):
    """The left arm's right answer, with some of it replaced."""
    action = executors[LEFT].act(env.observe(LEFT))
    return {**action, **changes}


def shifted(executors, env, path, point, by):
    paths = answer(executors, env)["paths"].copy()
    paths[path, point] += np.float32(by)
    return {"paths": paths, "grasp": 1, "release": 1}


def stale(executors, env):
    """A cycle for where the object was, 5 mm from where it is."""
    seen = env.observe(LEFT)
    return executors[LEFT].act({**seen, "object": seen["object"] - np.array([5.0, 0.0, 0.0], np.float32)})


BAD_ANSWERS = {
    "nothing": (lambda e, env: None, "wrong_shape"),
    "no paths": (lambda e, env: {"grasp": 1, "release": 1}, "wrong_shape"),
    "too few points": (lambda e, env: answer(e, env, paths=np.zeros((3, 4, 5))), "wrong_shape"),
    "two paths": (lambda e, env: answer(e, env, paths=np.zeros((2, 9, 5))), "wrong_shape"),
    "ragged": (lambda e, env: answer(e, env, paths=[[1.0], [2.0, 3.0]]), "wrong_shape"),
    "words": (lambda e, env: answer(e, env, grasp="yes"), "wrong_shape"),
    "NaN": (lambda e, env: answer(e, env, paths=np.full((3, MotionConfig().control_points, 5), math.nan)), "not_finite"),
    "one NaN": (lambda e, env: shifted(e, env, 1, 4, math.nan), "not_finite"),
    "beyond all limits": (lambda e, env: shifted(e, env, 1, 4, 1e6), "joint_limits"),
    "does not grasp": (lambda e, env: answer(e, env, grasp=0), "declined"),
    "does not release": (lambda e, env: answer(e, env, release=0), "declined"),
    "object elsewhere": (stale, "object_elsewhere"),
    "another place": (lambda e, env: e[LEFT].act({**env.observe(LEFT), "target": np.float32([10.0, 0.0])}), "wrong_place"),
    "cannot park": (lambda e, env: shifted(e, env, 2, -1, [0.2, 0, 0, 0, 0]), "cannot_park"),
    "torn apart": (lambda e, env: shifted(e, env, 1, 0, [-0.2, 0, 0, 0, 0]), "not_continuous"),
}


@architectures
@pytest.mark.parametrize(("make", "reason"), BAD_ANSWERS.values(), ids=BAD_ANSWERS)
def test_an_arms_bad_answer_is_refused_by_name(architecture, make, reason, model, executors):
    env = begun(model, architecture, FAR)
    env.step({**MIDDLE, "arm": 0})
    env.step(make(executors, env))
    assert result(env)[:2] == refused(architecture)
    assert env.infos[SUPERVISOR]["refusal"] == env.infos[LEFT]["refusal"] == reason
    assert env.rewards[LEFT] == -10.0
    np.testing.assert_array_equal(env._pose, FAR["state"])
    if architecture == "A":  # it goes on, and a right answer is carried out
        command(env, executors, 0)
        assert result(env) == (0, True, False, {"refusal": None, "transfers": 3, "outcome": "success"})


NUMBERS = st.one_of(st.floats(), st.floats(width=32), st.integers(), st.integers(-1, 2), st.complex_numbers(), st.booleans())
JUNK = st.recursive(
    st.one_of(st.none(), NUMBERS, st.text(max_size=3), st.just(10**400), st.just(torch.ones(2, requires_grad=True))),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.sampled_from(KEYS), inner)),
    max_leaves=6,
)
ACTIONS = st.one_of(JUNK, st.fixed_dictionaries({key: st.one_of(JUNK, st.sampled_from([0, 1])) for key in KEYS}))


@architectures
@given(actions=st.lists(ACTIONS, min_size=4, max_size=4))
def test_nothing_a_policy_says_raises(architecture, actions, model):
    """Every turn goes on to another agent or ends the episode; the object stays where it was."""
    env = begun(model, architecture, FAR)
    for action in actions:
        if env.terminations[SUPERVISOR]:
            break
        env.step(action)
        assert env.infos[SUPERVISOR].get("refusal", "declined") is not None
    np.testing.assert_array_equal(env._pose, FAR["state"])


def test_commands_beyond_the_box_are_those_at_its_edge(model, executors):
    poses = []
    for place in ((5.0, -9.0), (1.0, -1.0)):
        env = begun(model, "B", FAR)
        command(env, executors, 0, place=place)
        poses.append(env._pose)
    np.testing.assert_array_equal(*poses)


@architectures
def test_an_episode_has_no_more_than_twenty_decisions(architecture, model, executors):
    env = begun(model, architecture, {"state": [0.0, 0.0, 0.0], "goal": [200.0, 180.0, -math.pi / 2]})
    for transfers in range(1, 21):
        command(env, executors, 0)
        reward, terminated, truncated, info = result(env)
        assert (reward, terminated, truncated) == (-1, False, transfers == 20)
        assert info["outcome"] == ("timeout" if transfers == 20 else "none")
    for _ in range(3):
        env.step(None)
    assert env.agents == []


def test_a_missed_grasp_goes_on_and_the_object_is_seen_again(model, executors):
    """In architecture B too: it was tried, and nothing is lost but a transfer. A final one that missed is over."""
    options = {"missed_grasps": 1.0}
    env = begun(model, "B", FAR, backend="noisy", backend_options=options)
    command(env, executors, 0)
    assert result(env) == (-1, False, False, {"refusal": "missed_grasp", "transfers": 1, "outcome": "none"})
    assert env.rewards[LEFT] == -10
    np.testing.assert_allclose(env.observe(SUPERVISOR)["state"], FAR["state"])
    env = begun(model, "B", EASY, backend="noisy", backend_options=options)
    command(env, executors, 0, final=1)
    assert result(env) == (-30, True, False, {"refusal": "missed_grasp", "transfers": 1, "outcome": "wrong_position"})


class Tipping(KinematicBackend):
    """The object falls over wherever it is put."""

    exact = False

    def execute(self, arm, paths):
        return super().execute(arm, paths)._replace(refusal=Refusal.TIPPED)


@pytest.mark.parametrize("final", [0, 1])
@architectures
def test_an_object_that_tipped_over_is_lost(architecture, final, model, executors):
    """At the goal or not: no arm can grip it any more."""
    env = begun(model, architecture, EASY, backend=Tipping(model, MotionConfig()))
    if architecture == "B":
        command(env, executors, 0, final=final)
    else:  # solved at its start: whatever the supervisor says, an arm finishes
        env.step({**MIDDLE, "arm": 0})
        obey(env, executors)
    reward, terminated, truncated, info = result(env)
    assert (reward, terminated, truncated) == (-30 if architecture == "B" else -1, True, False)
    assert (info["refusal"], info["outcome"]) == ("tipped", "wrong_position")


@architectures
def test_noisy_placements_within_the_tolerance_are_at_the_goal(architecture, model, executors):
    """2 mm a axis, tolerance 5 mm: exp(-25/8) = 4.4 % land outside of it; the measured pose is what is seen and judged."""
    task = TaskConfig(architecture=architecture, epsilon_deg=20.0, noise=NoiseConfig(position_mm=2.0))
    env = handover_aec.raw_env(cell=model, task=task, backend="noisy", backend_options={"missed_grasps": 0.0})
    missed, count = 0, 400
    for seed in range(count):
        env.reset(seed=seed, options=EASY)
        command(env, executors, 0, final=1)
        reward, terminated, _, info = result(env)
        offset = math.dist(env._pose[:2], EASY["goal"][:2])
        assert terminated
        assert 0 < offset < 12
        assert info["outcome"] == ("success" if offset <= 5 else "wrong_position")
        assert reward == {"A": (0, -1), "B": (20, -30)}[architecture][offset > 5]
        missed += offset > 5
    assert missed / count == pytest.approx(math.exp(-25 / 8), abs=0.03)


@pytest.mark.parametrize(("backend", "options"), [("kinematic", {}), ("noisy", {"missed_grasps": 0.0})])
@pytest.mark.parametrize("checked", [False, True])
def test_collisions_are_looked_for_if_asked(backend, options, checked, model, executors):
    """A straight line in joint space drags the block along on the table."""
    env = begun(model, "B", EASY, backend=backend, backend_options={**options, "check_collisions": checked})
    command(env, executors, 0, final=1)
    assert result(env)[3]["refusal"] == (Refusal.COLLISION if checked else None)
    env.reset(options=EASY)
    command(env, {LEFT: ExecutorAgent(LEFT, model)}, 0, final=1)
    assert result(env)[3]["refusal"] is None


class Wandering(KinematicBackend):
    """A backend of one's own: somebody moves the block by 20 mm after every transfer."""

    exact = False

    def execute(self, arm, paths):
        done = super().execute(arm, paths)
        self.put(done.pose + [20.0, 0.0, 0.0])
        return done._replace(pose=self._pose.copy())


def test_a_backend_of_ones_own(model, executors):
    """What it measures is what counts and what is seen next."""
    env = begun(model, "B", FAR, backend=Wandering(model, MotionConfig()))
    command(env, executors, 0)
    np.testing.assert_allclose(env.observe(SUPERVISOR)["state"][:2], [20.0, 0.0], atol=1e-3)
    command(env, executors, 0, place=(0.2, 0.1))
    assert env.infos[SUPERVISOR]["refusal"] is None


def test_refusals_are_plain_text(model):
    env = begun(model, "B", FAR)
    env.step(None)
    assert env.infos[SUPERVISOR]["refusal"] is Refusal.WRONG_SHAPE
    assert f"{env.infos[SUPERVISOR]['refusal']}" == "wrong_shape"


def test_programming_errors_raise(model):
    env = handover_aec.env(cell=model)
    with pytest.raises(AttributeError):
        env.agent_selection  # noqa: B018  # before reset
    env.reset(seed=0)
    with pytest.raises(ValueError, match="arm_middle|not in"):
        env.observe("arm_middle")
    with pytest.raises(KeyError):
        env.action_space("arm_middle")


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"backend": "gazebo"}, UnknownChoice, "backend"),
        ({"render_mode": "ansi"}, UnknownChoice, "render_mode"),
        ({"architecture": "C"}, UnknownChoice, "architecture"),
        ({"cell": "moon"}, UnknownChoice, "cell"),
        ({"motion": MotionConfig(lift_mm=-5.0)}, InvalidSetting, "motion.lift_mm"),
        ({"motion": MotionConfig(velocity_scale=math.nan)}, InvalidSetting, "motion.velocity_scale"),
        ({"backend_options": {"check_collisions": "often"}}, InvalidSetting, "check_collisions"),
        ({"refused_reward": 1.0}, InvalidSetting, "refused_reward"),
        ({"refused_reward": math.nan}, InvalidSetting, "refused_reward"),
    ],
)
def test_bad_settings_are_named(settings, error, words, model):
    with pytest.raises(error, match=words):
        handover_aec.env(**{"cell": model, **settings})


@pytest.mark.parametrize(
    ("problem", "error", "says"),
    [
        ({"state": [0.0, 0.0]}, InvalidSetting, r"state = \[0.0, 0.0\].*three numbers"),
        ({"goal": "somewhere"}, InvalidSetting, "goal = 'somewhere'.*three numbers"),
        ({"goal": None}, InvalidSetting, "goal = None.*three numbers"),
        ({"state": {"x": 1}}, InvalidSetting, "state.*three numbers"),
        ({"start": [0.0, 0.0, 0.0]}, UnknownKey, "'start'.*state, goal"),
        ([0.0, 0.0, 0.0], InvalidSetting, "options.*mapping"),
        ({"goal": [math.nan, 0.0, 0.0]}, NotFinite, "goal.*finite"),
        ({"state": [500.0, 0.0, 0.0]}, OutOfReach, "state.*reach"),
    ],
)
def test_problems_that_cannot_be_are_named(problem, error, says, model):
    with pytest.raises(error, match=says):
        begun(model, "B", problem)


@pytest.mark.parametrize(("backend", "inset"), [("kinematic", 1.0), ("noisy", LoopConfig().chart_inset)])
def test_hand_overs_on_inexact_arms_keep_to_the_loops_part_of_the_chart(backend, inset, model, executors):
    """As the closed loop's own rules have it; the far corner of the chart is that much nearer to its middle."""
    env = begun(model, "B", FAR, backend=backend)
    assert env.rules.cell.config.chart_inset == inset
    loop = make_loop(load("exact", model.cell), backend)
    assert loop.rules.cell.config.chart_inset == inset
    corner = np.array([-1.0, -1.0, 1.0, 1.0])
    np.testing.assert_array_equal(env.rules.decode(corner).place_mm, loop.rules.decode(corner).place_mm)


def test_a_cell_that_keeps_farther_from_its_edge_stays_so(model):
    narrow = model._replace(cell=model.cell.with_inset(0.9))
    assert begun(narrow, backend="noisy").rules.cell.config.chart_inset == 0.9
