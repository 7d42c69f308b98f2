"""The Gymnasium goal environment: the API's own checks, rewards that a hindsight buffer can recompute, named errors."""

from __future__ import annotations

import math
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

import marl_handover
from marl_handover.arrays import namespace
from marl_handover.config import LAYOUTS, NoiseConfig, RewardConfig, TaskConfig
from marl_handover.envs import SupervisorEnv, SupervisorGoalEnv, goal_env
from marl_handover.envs.top_view import TopView, rgb
from marl_handover.errors import GoalInObservation, InvalidSetting, NotFinite, NoWindow, OutOfReach, UnknownChoice, UnknownKey
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.palette import arm_colour
from marl_handover.task.observations import Layout, observe
from marl_handover.task.rules import Outcome

architectures = pytest.mark.parametrize("architecture", ["A", "B"])
EASY = {"state": [0.0, 0.0, 0.0], "goal": [200.0, 180.0, math.pi / 2]}  # the left arm can finish at once


def made(architecture="B", **keywords):
    return gymnasium.make(f"marl_handover/Supervisor{architecture}-v0", **keywords)


def walk(env, steps, seed=0):
    """Random transitions (observation, action, next observation, reward, terminated, truncated, info), final every other time."""
    random = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    for _ in range(steps):
        action = random.uniform(-1, 1, 4).astype(np.float32)
        after, *rest = env.step(action)
        yield (observation, action, after, *rest)
        observation = env.reset()[0] if rest[1] or rest[2] else after


@architectures
def test_the_api_checker_has_nothing_to_say(architecture):
    """Through ``gymnasium.make``, as a user gets it; the one notice let through says just that: it was given wrapped."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(made(architecture))
        wrapped = [str(warning.message) for warning in caught]
        caught.clear()
        check_env(made(architecture).unwrapped)
    assert [text for text in wrapped if "different from the unwrapped version" not in text] == []
    assert [str(warning.message) for warning in caught] == []


def test_importing_the_package_registers_both():
    assert marl_handover.__version__
    for architecture in ("A", "B"):
        env = made(architecture).unwrapped
        assert isinstance(env, SupervisorGoalEnv)
        assert env.rules.config.architecture == architecture
        assert env.action_space == gymnasium.spaces.Box(-1, 1, (4,), np.float32)
        assert set(env.observation_space) == {"observation", "achieved_goal", "desired_goal"}


@architectures
def test_observations_are_in_their_space(architecture):
    env = SupervisorGoalEnv(architecture, task=TaskConfig(layout="object", noise=NoiseConfig(5.0, 3.0)))
    for before, _, after, *_ in walk(env, 300):
        assert env.observation_space.contains(before)
        assert env.observation_space.contains(after)


@pytest.mark.parametrize("layout", ["raw", "relative"])
def test_a_layout_with_the_goal_in_it_is_refused(layout):
    with pytest.raises(InvalidSetting, match="contain the goal"):
        SupervisorGoalEnv("B", task=TaskConfig(layout=layout))
    with pytest.raises(InvalidSetting, match="contain the goal"):
        made("B", layout=layout)


def test_single_settings_of_the_task_can_be_given_to_make():
    env = made("A", epsilon_deg=1.0, max_steps=7, cell="al5a", noise=NoiseConfig(1.0))
    config = env.unwrapped.rules.config
    assert (config.epsilon_deg, config.max_steps, config.architecture, config.layout) == (1.0, 7, "A", "object")
    assert env.unwrapped.rules.cell.config.name == "al5a"
    assert env.unwrapped.rules.noisy
    with pytest.raises(UnknownKey, match="epsilon_deg"):
        made(epsilon=1.0)
    with pytest.raises(InvalidSetting, match="epsilon_deg = -1"):
        made(epsilon_deg=-1)


def test_the_step_limit_is_in_the_specification_and_no_wrapper_cuts_it():
    assert made().spec.max_episode_steps == TaskConfig().max_steps
    env = made(max_steps=40)
    assert env.spec.max_episode_steps == 40
    env.reset(options={"state": EASY["state"], "goal": [-200.0, -180.0, 3.0]})
    ends = [env.step(np.array([-1, 1, 0, 0], np.float32))[3] for _ in range(40)]  # the right arm puts it down where it lies, ever again
    assert ends == [False] * 39 + [True]


def test_pictures_or_a_refusal_when_it_is_made(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    env = made(render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.reset(seed=1)
    assert first.dtype == np.uint8
    assert first.shape[2] == 3
    assert (first != env.render()).any()
    with pytest.raises(UnknownChoice, match="rgb_array"):
        SupervisorGoalEnv(render_mode="human")
    with pytest.raises(NoWindow, match="DISPLAY"):
        made(render_mode="human")
    with pytest.raises(UnknownChoice, match="choose one of: rgb_array, human"):
        SupervisorGoalEnv(render_mode="ansi")


def test_the_window_is_shown_every_step(monkeypatch):
    pictures = []

    class Screen:
        def __init__(self, fps):
            assert fps == SupervisorGoalEnv.metadata["render_fps"]

        def show(self, picture):
            pictures.append(picture)

        def close(self):
            pictures.append("closed")

    monkeypatch.setattr(goal_env, "Window", Screen)
    env = made(render_mode="human")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    assert len(pictures) == 3
    assert pictures[0].shape == (320, 320, 3)
    assert pictures[-1] == "closed"


def test_the_hand_is_where_the_block_was_put():
    """Architecture B, the left arm takes the block to the goal; the arm's colour is around it, and was not before."""
    env = made(render_mode="rgb_array")
    env.reset(options=EASY)
    assert not around(env, EASY["goal"], rgb(arm_colour(0)))
    env.step(np.array([1, -1, 0, 0], np.float32))
    assert around(env, EASY["goal"], rgb(arm_colour(0)))


def around(env, pose, colour):
    """Whether pixels near a pose have a colour."""
    picture, half = env.render(), TopView(env.unwrapped.rules.cell).half_mm
    column, row = ((np.array([pose[0], -pose[1]]) / half + 1) / 2 * len(picture)).astype(int)
    return (picture[row - 20 : row + 20, column - 20 : column + 20] == colour).all(-1).sum() > 20


def test_a_film_of_an_episode_is_recorded(tmp_path):
    pytest.importorskip("moviepy")
    env = gymnasium.wrappers.RecordVideo(made(render_mode="rgb_array"), str(tmp_path / "films"), episode_trigger=lambda number: number == 0)
    env.reset(options=EASY)
    env.step(np.array([1, -1, 0, 0], np.float32))
    env.close()
    assert (tmp_path / "films" / "rl-video-episode-0.mp4").stat().st_size > 1000


def test_the_observation_has_no_goal():
    """A hindsight buffer swaps only ``desired_goal``."""
    env = made("B")
    seen = [env.reset(options={"state": EASY["state"], "goal": goal})[0] for goal in (EASY["goal"], [-200, -180, 1])]
    np.testing.assert_array_equal(seen[0]["observation"], seen[1]["observation"])
    assert not np.array_equal(seen[0]["desired_goal"], seen[1]["desired_goal"])


@pytest.mark.parametrize("noise", [NoiseConfig(), NoiseConfig(2.0, 2.0)])
def test_the_reward_of_a_step_can_be_recomputed(noise):
    env = SupervisorGoalEnv("B", task=TaskConfig(layout="object", epsilon_deg=40.0, noise=noise))
    rewards = []
    for _, _, after, reward, terminated, _, info in walk(env, 3000):
        assert env.compute_reward(after["achieved_goal"], after["desired_goal"], info) == reward
        assert env.compute_terminated(after["achieved_goal"], after["desired_goal"], info) == terminated
        rewards.append(reward)
    assert set(rewards) == {20, -1, -30}


def test_relabelled_placements_succeed():
    env = made("B").unwrapped
    count = 0
    for _, _, after, _, _, _, info in walk(env, 1000):
        if info["feasible"]:
            assert env.compute_reward(after["achieved_goal"], after["achieved_goal"], {**info, "final": True}) == 20
            count += 1
    assert count > 100


@architectures
def test_vectorised_rewards_equal_a_loop(architecture):
    env = made(architecture).unwrapped
    rows = [(after["achieved_goal"], after["desired_goal"], info) for _, _, after, _, _, _, info in walk(env, 500)]
    achieved, desired = (np.stack([row[i] for row in rows]) for i in (0, 1))
    desired[::2] = achieved[::2]
    infos = [row[2] for row in rows]
    rewards = env.compute_reward(achieved, desired, infos)
    ends = env.compute_terminated(achieved, desired, infos)
    assert rewards.shape == ends.shape == (500,)
    assert len(set(rewards)) > 1
    loop = [env.compute_reward(*row) for row in zip(achieved, desired, infos, strict=True)]
    assert all(isinstance(value, float) for value in loop)
    np.testing.assert_array_equal(rewards, loop)
    np.testing.assert_array_equal(ends, [env.compute_terminated(*row) for row in zip(achieved, desired, infos, strict=True)])
    one_info = env.compute_reward(achieved, desired, infos[0])
    np.testing.assert_array_equal(one_info, env.compute_reward(achieved, desired, [infos[0]] * 500))
    np.testing.assert_array_equal(env.compute_reward(achieved, desired, {}), env.compute_reward(achieved, desired, [{}] * 500))


def test_options_set_the_problem():
    env = made("B")
    observation, info = env.reset(seed=0, options={"state": [10.0, 20.0, 2 * math.pi + 0.25], "goal": [200.0, 180.0, -0.5]})
    np.testing.assert_allclose(observation["achieved_goal"], [10, 20, 0.25], atol=1e-5)
    np.testing.assert_allclose(observation["desired_goal"], [200, 180, -0.5], atol=1e-5)
    assert (info["transfers"], info["outcome"], info["is_success"]) == (0, "none", False)
    only_goal, _ = env.reset(seed=7, options={"goal": [200.0, 180.0, -0.5]})
    np.testing.assert_array_equal(only_goal["achieved_goal"], env.reset(seed=7)[0]["achieved_goal"])
    env.reset(options=EASY)
    _, reward, terminated, truncated, info = env.step(np.array([1, -1, 0, 0], np.float32))
    assert (reward, terminated, truncated, info["outcome"], info["is_success"]) == (20, True, False, "success", True)


@pytest.mark.parametrize("what", ["state", "goal"])
@pytest.mark.parametrize("position", [(0.0, 500.0), (0.0, 180.0), (230.0, 0.0)])
def test_poses_out_of_reach_are_named(what, position):
    with pytest.raises(OutOfReach, match=rf"{what} \({position[0]:g}, {position[1]:g}\) mm.*150 to 230"):
        made().reset(options={what: [*position, 0.0]})


@pytest.mark.parametrize("what", ["state", "goal"])
@pytest.mark.parametrize("pose", [(math.nan, 0, 0), (0, 0, math.nan), (0, math.inf, 0)])
def test_poses_that_are_not_finite_are_named(what, pose):
    with pytest.raises(NotFinite, match=what):
        made().reset(options={what: pose})


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("index", range(4))
def test_actions_that_are_not_finite_are_named_and_change_nothing(bad, index):
    env = made().unwrapped
    env.reset(seed=0, options=EASY)
    action = np.array([1, -1, 0, 0], np.float32)
    action[index] = bad
    with pytest.raises(NotFinite, match="action"):
        env.step(action)
    assert env.step(np.array([1, -1, 0, 0], np.float32))[-1]["transfers"] == 1


@architectures
def test_the_seed_decides(architecture):
    task = TaskConfig(layout="object", noise=NoiseConfig(1.0, 1.0))
    first, again, other = (list(walk(SupervisorGoalEnv(architecture, task=task), 60, seed)) for seed in (5, 5, 6))
    for one, same in zip(first, again, strict=True):
        assert one[3:] == same[3:]
        np.testing.assert_array_equal(one[2]["achieved_goal"], same[2]["achieved_goal"])
    assert any((one[0]["desired_goal"] != two[0]["desired_goal"]).any() for one, two in zip(first, other, strict=True))
    env = SupervisorGoalEnv(architecture, task=task)
    starts = [env.reset(seed=5)[0]["achieved_goal"], env.reset()[0]["achieved_goal"], env.reset(seed=5)[0]["achieved_goal"]]
    np.testing.assert_array_equal(starts[0], starts[2])
    assert not np.array_equal(starts[0], starts[1])


@architectures
def test_reaching_the_limit_truncates(architecture):
    env = made(architecture)
    env.reset(options={"state": [0, 0, 0], "goal": [200, 180, -math.pi / 2]})
    for count in range(1, 21):
        _, reward, terminated, truncated, info = env.step(np.array([-1, -1, 0, 0], np.float32))
        assert (reward, terminated, truncated, info["transfers"]) == (-1, False, count == 20, count)
        assert info["outcome"] == ("timeout" if count == 20 else "none")


@architectures
def test_it_equals_the_batched_environment(architecture):
    task = {"architecture": architecture, "layout": "object", "epsilon_deg": 30.0, "max_steps": 6}
    env, batched = SupervisorGoalEnv(architecture, task=TaskConfig(**task)), SupervisorEnv(1, task=TaskConfig(**task), seed=0)
    previous, transfers, outcomes = -1, 0, set()
    template = batched.reset()
    for before, action, after, reward, terminated, truncated, info in walk(env, 400):
        state = TensorDict({**template}, [1])
        state["achieved_goal"], state["desired_goal"] = (torch.tensor(before[key])[None] for key in ("achieved_goal", "desired_goal"))
        state["previous_arm"], state["transfers"] = torch.tensor([[previous]]), torch.tensor([[transfers]])
        state["action"] = torch.tensor(action)[None]
        twin = batched.step(state)["next"]
        apart = np.remainder(twin["achieved_goal"][0].numpy() - after["achieved_goal"] + math.pi, 2 * math.pi) - math.pi
        assert np.abs(apart).max() < 2e-3
        unlike = twin["observation"][0].numpy() - after["observation"]
        unlike[2] = np.remainder(unlike[2] + 1, 2) - 1  # theta / pi
        np.testing.assert_allclose(unlike, 0, atol=1e-4)
        assert (twin["reward"].item(), twin["terminated"].item(), twin["truncated"].item()) == (reward, terminated, truncated)
        assert (twin["feasible"].item(), twin["transfers"].item()) == (info["feasible"], info["transfers"])
        assert Outcome(twin["outcome"].item()).name.lower() == info["outcome"]
        outcomes.add(info["outcome"])
        previous, transfers = (-1, 0) if terminated or truncated else (twin["previous_arm"].item(), info["transfers"])
    assert {"none", "success"} <= outcomes


def test_an_environment_leaves_the_settings_it_was_given_alone():
    """Two environments made from one task, each with its own architecture."""
    task = TaskConfig(layout="object")
    first = SupervisorGoalEnv("B", task=task)
    SupervisorGoalEnv("A", task=task)
    assert first.rules.config.architecture == "B"
    assert task.architecture == TaskConfig().architecture


def test_the_motion_cost_is_recomputed_too():
    """With the coupled reward a step's reward is still the one that ``compute_reward`` gives from what a buffer stores."""
    task = TaskConfig(layout="object", reward=RewardConfig(motion_weight=1.0))
    env = SupervisorGoalEnv("B", task=task)
    env.reset(options={"state": [200.0, 180.0, 0.0], "goal": [-200.0, -180.0, 0.0]})
    after, reward, *_, info = env.step(np.array([-1, -1, 0, 0], np.float32))
    length = motion_cost(env.rules.cell, task)(
        env.rules.cell, np.int64(0), np.array([200.0, 180.0]), after["achieved_goal"][:2].astype(float)
    )
    assert length > math.hypot(200, 180)
    assert reward == pytest.approx(-1 - length / 100)
    assert env.compute_reward(after["achieved_goal"], after["desired_goal"], info) == pytest.approx(reward)


def test_a_final_command_is_judged_as_if_the_other_goal_had_been_there():
    """The oracle sets the same block and the other goal, gives the same command, and looks."""
    env, twin = SupervisorGoalEnv("B", epsilon_deg=40.0), SupervisorGoalEnv("B", epsilon_deg=40.0)
    rows = [(action, after, info) for _, action, after, _, _, _, info in walk(env, 1500)]
    random, rewards = np.random.default_rng(1), []
    for action, after, info in rows:
        if not info["final"]:
            continue
        goal = rows[random.integers(len(rows))][1]["achieved_goal"]
        twin.reset(options={"state": info["start"], "goal": goal})
        _, reward, terminated, _, _ = twin.step(action)
        assert env.compute_reward(after["achieved_goal"], goal, info) == reward
        assert terminated
        rewards.append(reward)
    assert set(rewards) == {20, -30}


def test_no_end_of_an_episode_depends_on_the_goal():
    """So a hindsight buffer that keeps ``done`` as it was is right."""
    env = made("B").unwrapped
    for _, _, after, _, terminated, _, info in walk(env, 500):
        for goal in (after["achieved_goal"], after["desired_goal"], np.array([200.0, 180.0, 1.0], np.float32)):
            assert env.compute_terminated(after["achieved_goal"], goal, info) == terminated


@pytest.mark.parametrize("cell", ["paper", "triangle"])
def test_features_are_the_layout_of_the_goal_that_is_there(cell):
    layout = "relative" if cell == "paper" else "graph"
    env, other = SupervisorGoalEnv(cell=cell), SupervisorGoalEnv(cell=cell, scale_goals=True)
    seen = [step[2] for step in walk(env, 100)] if cell == "paper" else [env.reset(seed=seed)[0] for seed in range(20)]
    batch = {key: np.stack([each[key] for each in seen]) for key in seen[0]}
    previous = batch["observation"][:, 3:]
    arm = np.where(previous[:, 0] == 0, -1, np.where(previous[:, 0] > 0, 1, 0)) if cell == "paper" else np.full(len(seen), -1)
    expected = observe(env.rules, layout, batch["achieved_goal"], batch["desired_goal"], arm)
    np.testing.assert_array_equal(env.features(batch, layout), expected)
    tensors = {key: torch.tensor(value) for key, value in batch.items()}
    np.testing.assert_allclose(env.features(tensors, layout).numpy(), expected, atol=2e-3)
    scaled = {key: value if key == "observation" else (value / other._unit).astype(np.float32) for key, value in batch.items()}
    np.testing.assert_allclose(other.features(scaled, layout), expected, atol=2e-3)


def test_scaled_goals_are_the_same_problem():
    env, scaled = SupervisorGoalEnv("B", epsilon_deg=40.0), SupervisorGoalEnv("B", epsilon_deg=40.0, scale_goals=True)
    for one, same in zip(walk(env, 300), walk(scaled, 300), strict=True):
        np.testing.assert_allclose(same[2]["achieved_goal"] * scaled._unit, one[2]["achieved_goal"], atol=1e-4)
        assert np.abs(same[2]["desired_goal"]).max() <= 1.01
        assert scaled.observation_space.contains(same[2])
        assert one[3:] == same[3:]
        assert scaled.compute_reward(same[2]["achieved_goal"], same[2]["desired_goal"], same[6]) == same[3]


def test_single_rewards_can_be_given_to_make():
    reward = made(reward={"success": 2.0}).unwrapped.rules.config.reward
    assert (reward.success, reward.step) == (2.0, RewardConfig().step)
    with pytest.raises(UnknownKey, match=r"reward\.sucess.*reward\.success"):
        made(reward={"sucess": 2.0})


def test_a_layout_of_ones_own_is_taken_if_it_does_not_show_the_goal(no_new_plugins):
    def polar(rules, pose, goal, previous_arm, epsilon_rad):
        xp = namespace(pose)
        return xp.stack([pose[..., 0] / 100, xp.cos(pose[..., 2])], -1)

    def sneaky(rules, pose, goal, previous_arm, epsilon_rad):
        return polar(rules, pose, goal, previous_arm, epsilon_rad) + 1e-6 * goal[..., :2]

    LAYOUTS.register("polar")(Layout(polar, lambda num_arms: 2))
    LAYOUTS.register("sneaky")(Layout(sneaky, lambda num_arms: 2))
    env = made(layout="polar")
    assert env.reset(seed=0)[0]["observation"].shape == (2,)
    with pytest.raises(GoalInObservation):
        made(layout="sneaky")
    with pytest.raises(InvalidSetting, match="object"):
        env.unwrapped.features(env.reset()[0])


def test_it_says_what_it_is():
    assert repr(SupervisorGoalEnv("A", epsilon_deg=1.0)) == (
        "SupervisorGoalEnv(architecture='A', cell='paper', epsilon_deg=1, max_steps=20, layout='object')"
    )
    assert repr(SupervisorEnv(3)).startswith(
        "SupervisorEnv(num_envs=3, architecture='B', cell='paper', epsilon_deg=5, max_steps=20, layout='relative'"
    )
