"""Turn-to-turn transitions: a step-by-step reader agrees, batch borders do not matter, and the AEC environment's are the rule book's."""

from __future__ import annotations

import warnings
from itertools import chain, pairwise

import numpy as np
import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

from marl_handover.cell import build_cell, cell_config
from marl_handover.config import TaskConfig
from marl_handover.envs import handover_aec
from marl_handover.learning.collector import TransitionReader
from marl_handover.motion.executor import ExecutorAgent
from marl_handover.task.rules import Rules

AGENTS = ("supervisor", "arm_left", "arm_right")
KEYS = ("observation", "action", "reward", "after", "terminated", "truncated")


@st.composite
def plays(draw):
    """Steps of some environments: whose turn, what each agent is given and sees, and how episodes end; some are cut off."""
    steps = []
    for cell in range(draw(st.integers(1, 3))):
        turn, trajectory, rows = draw(st.integers(0, 2)), 10 * cell, []
        for time in range(draw(st.just(12))):
            ends = draw(st.sampled_from(["", "", "", "", "terminated", "truncated", "cut"]))
            following = draw(st.integers(0, 2))
            rewards = draw(st.lists(st.integers(-30, 20), min_size=3, max_size=3))
            rows.append((cell, time, turn, following, ends, rewards, trajectory))
            turn = draw(st.integers(0, 2)) if ends else following
            trajectory += bool(ends)
        steps.append(rows)
    return steps


def rolled(steps):
    """The same as a roll-out; what an agent sees is (cell, time), after a step (cell, time + 1/2)."""

    def flag(function):
        return torch.tensor([[function(step) for step in rows] for rows in steps])

    shape = (len(steps), len(steps[0]))
    data = TensorDict({"next": TensorDict({}, shape), "collector": {"traj_ids": flag(lambda step: step[6])}}, shape)
    data["next", "done"] = flag(lambda step: step[4] in ("terminated", "truncated"))[..., None]
    turn, following = flag(lambda step: step[2]), flag(lambda step: step[3])
    reward = flag(lambda step: [float(number) for number in step[5]])
    seen = flag(lambda step: [[float(step[0]), float(step[1])]])
    ends = {name: flag(lambda step, name=name: [[step[4] == name]]) for name in ("terminated", "truncated")}
    for number, agent in enumerate(AGENTS):
        mine = {"mask": (turn == number)[..., None], "observation": seen, "action": seen * 2}
        after = {"mask": (following == number)[..., None], "observation": seen + torch.tensor([0, 0.5])}
        after |= {"reward": reward[..., number, None, None], "done": ends["terminated"] | ends["truncated"], **ends}
        data[agent] = TensorDict(mine, (*shape, 1))
        data["next", agent] = TensorDict(after, (*shape, 1))
    return data


def by_hand(steps, number):
    """Each environment's transitions of one agent, read step by step."""
    found = []
    for rows in steps:
        begun, earned = None, 0.0
        for cell, time, turn, following, ends, rewards, _ in rows:
            if turn == number:
                begun, earned = (float(cell), float(time)), 0.0
            earned += rewards[number]
            if begun is not None and (following == number or ends in ("terminated", "truncated")):
                found.append((*begun, earned, float(time) + 0.5, ends == "terminated", ends == "truncated"))
                begun = None
            if ends == "cut":
                begun = None
    return found


def read(turns):
    following = turns["next"]
    assert (turns["action"] == 2 * turns["observation"]).all()
    assert (following["observation"][:, 0] == turns["cell"]).all()
    assert (following["done"] == (following["terminated"] | following["truncated"])).all()
    parts = (*turns["observation"].T, following["reward"][:, 0], following["observation"][:, 1])
    flags = (following["terminated"][:, 0], following["truncated"][:, 0])
    return list(zip(*(part.tolist() for part in (*parts, *flags)), strict=True))


@given(steps=plays(), number=st.integers(0, 2))
def test_a_reader_that_goes_step_by_step_finds_the_same(steps, number):
    """An agent's decision that is followed by its own turn at once ends there; one that is cut off before is dropped."""
    assert read(TransitionReader(AGENTS[number]).read(rolled(steps))) == by_hand(steps, number)


@given(steps=plays(), number=st.integers(0, 2), borders=st.sets(st.integers(1, 11)))
def test_batch_borders_do_not_matter(steps, number, borders):
    whole, reader = rolled(steps), TransitionReader(AGENTS[number])
    edges = [0, *sorted(borders), 12]
    batches = [read(reader.read(whole[:, first:last])) for first, last in pairwise(edges)]
    assert sorted(chain(*batches)) == sorted(read(TransitionReader(AGENTS[number]).read(whole)))
    ends = [[(row[0], row[3]) for row in batch] for batch in batches]
    for batch, (first, last) in zip(ends, pairwise(edges), strict=True):
        assert batch == sorted(batch)
        assert all(first < end < last for _, end in batch)


def test_several_leading_dimensions_and_none_are_environments():
    steps = [[(0, time, time % 3, (time + 1) % 3, "", [1, 2, 3], 0) for time in range(12)]] * 4
    four = rolled(steps)
    square = TransitionReader("supervisor").read(four.reshape(2, 2, 12))
    assert square["cell"].tolist() == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4
    one = TransitionReader("supervisor").read(four[0])
    assert read(one) == [(0.0, 3.0 * turn, 3.0, 3 * turn + 2.5, False, False) for turn in range(4)]


@pytest.fixture(scope="module")
def model():
    return build_cell(cell_config("paper"))


class Players:
    """Random commands, obedient arms, on TorchRL's own wrapper with its nested observations and actions."""

    def __init__(self, env, model, finals, seed):
        self.env, self.random, self.finals = env, np.random.default_rng(seed), finals
        self.arms = {agent: ExecutorAgent(agent, model, "direct") for agent in AGENTS[1:]}
        self.idle = {agent: env.full_action_spec[agent, "action"].zero() for agent in AGENTS}

    def __call__(self, state):
        for agent in AGENTS:
            action = self.idle[agent].clone()
            if state[agent, "mask"]:
                seen = {key: value[0].numpy() for key, value in state[agent, "observation"].items()}
                chosen = self.command(seen) if agent == "supervisor" else self.arms[agent].act(seen)
                for key, value in chosen.items():
                    action[key][0] = torch.as_tensor(value)
            state[agent, "action"] = action
        return state

    def command(self, seen):
        """Mostly an arm that reaches the object."""
        reaching = [arm for arm in range(2) if seen["legal"][2 * arm]]
        arm = int(self.random.choice(reaching)) if self.random.random() < 0.9 else int(self.random.integers(2))
        return {"final": int(self.random.random() < self.finals), "arm": arm, "place": self.random.uniform(-1, 1, 2)}


def batches_of(model, architecture, seed, frames, count, finals=0.2, max_steps=4):
    """Batches of TorchRL's collector, and the rule book they were played by."""
    task = TaskConfig(architecture=architecture, epsilon_deg=30.0, max_steps=max_steps)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = PettingZooWrapper(handover_aec.env(cell=model, task=task), use_mask=True, seed=seed)
        collector = Collector(
            env,
            Players(env, model, finals, seed),
            frames_per_batch=frames,
            total_frames=frames * count,
            auto_register_policy_transforms=False,
            trust_policy=True,
        )
    try:
        return list(collector), Rules(model.cell, task)
    finally:
        collector.shutdown()


def numbers(seen):
    return seen["state"].double(), seen["goal"].double(), seen["previous_arm"].argmax(-1) - 1


@pytest.mark.parametrize("architecture", ["A", "B"])
@settings(max_examples=6, phases=[Phase.explicit, Phase.generate])
@given(seed=st.integers(0, 1000), frames=st.sampled_from([1, 5, 7, 40]))
def test_the_supervisors_are_the_rule_books_transition_for_transition(architecture, model, seed, frames):
    """State at its next turn, not at the arm's; the reward that came late; the end, whether terminated or truncated.

    The state is seen in float32: rounding at a threshold would show as another verdict, and does in none of these.
    """
    batches, rules = batches_of(model, architecture, seed, frames, 40 // frames)
    reader = TransitionReader("supervisor")
    turns = torch.cat([reader.read(batch) for batch in batches])
    steps = torch.cat(batches)
    asked = int(steps["supervisor", "mask"].sum())
    assert asked - 1 <= len(turns) <= asked
    pose, goal, previous = numbers(turns["observation"])
    command = turns["action"]
    action = torch.cat([2.0 * torch.stack([command["final"], command["arm"]], -1) - 1, command["place"]], -1)
    following, made = turns["next"], 0
    after, _, after_previous = numbers(following["observation"])
    for row in range(len(turns)):
        left = torch.tensor(rules.config.max_steps - made)
        expected = rules.step(pose[row], goal[row], previous[row], action[row].double(), transfers_left=left)
        made += int(expected.transfers)
        truncated = not expected.terminated and made >= rules.config.max_steps
        np.testing.assert_allclose(after[row], expected.pose, atol=1e-3)
        assert after_previous[row] == expected.previous_arm
        assert following["reward"][row].item() == pytest.approx(float(expected.reward))
        assert (bool(following["terminated"][row]), bool(following["truncated"][row])) == (bool(expected.terminated), truncated)
        ends = bool(following["done"][row])
        if not ends and row + 1 < len(turns):
            torch.testing.assert_close(after[row], pose[row + 1], rtol=0, atol=0)
            torch.testing.assert_close(goal[row], goal[row + 1], rtol=0, atol=0)
        made = 0 if ends else made
    assert int(following["done"].sum()) == int(steps["next", "done"].sum())


@pytest.mark.parametrize("arm", [0, 1])
def test_arms_have_turns_of_their_own(arm, model):
    """From one of its turns to its next, be there others' between; what it earned is its path, paid at once."""
    (steps,), _ = batches_of(model, "B", 3, 200, 1, finals=0.02)
    agent = AGENTS[1 + arm]
    turns = TransitionReader(agent).read(steps)
    asked = steps[agent, "mask"][:, 0].nonzero()[:, 0]
    assert 15 < len(turns) <= len(asked)
    torch.testing.assert_close(turns["action", "paths"], steps[agent, "action", "paths"][asked[: len(turns)], 0])
    torch.testing.assert_close(turns["next", "reward"][:, 0], steps["next", agent, "reward"][asked[: len(turns)], 0, 0])
    assert turns["observation", "active"][:, 1].all()
    going = ~turns["next", "done"][:, 0]
    assert int(going.sum()) > 5
    assert turns["next", "observation", "active"][going][:, 1].all()
    between = asked[1 : len(turns)][going[:-1]] - asked[: len(turns) - 1][going[:-1]]
    assert set(between.tolist()) >= {2, 4}, "turns that others' lie between"
