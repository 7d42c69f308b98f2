"""Small settings, and replay memories filled by playing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from marl_handover.compose import compose
from marl_handover.config import NoiseConfig
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.replay import EpisodeWriter, HindsightReplayBuffer
from marl_handover.learning.settings import ALGORITHMS, HindsightConfig, ReplayConfig, TrainConfig

SMALL = (
    "compile=off",
    "progress=false",
    "num_envs=16",
    "steps=1024",
    "evaluation_interval=512",
    "evaluation_episodes=50",
    "checkpoint_interval=100000",
)
SMALL_NETWORKS = {
    "sac": ("actor_hidden=[32,32]", "critic_hidden=[32,32]", "learning_starts=200", "batch_size=32", "env_steps_per_gradient_step=16"),
    "flat_sac": ("hidden=[32,32]", "learning_starts=200", "batch_size=32", "env_steps_per_gradient_step=16"),
    "td3": ("hidden=[32,32]", "learning_starts=200", "batch_size=32", "env_steps_per_gradient_step=16"),
    "dqn": ("hidden=[32,32]", "learning_starts=200", "batch_size=32", "env_steps_per_gradient_step=16"),
    "graph_sac": (
        *("width=16", "rounds=2", "layouts_at_once=12", "layouts_interval=320"),
        *("learning_starts=200", "batch_size=32", "env_steps_per_gradient_step=16"),
    ),
    "ppo": ("hidden=[32,32]", "rollout_steps=16", "batch_size=160", "epochs=2"),
}


@pytest.fixture(scope="session")
def small():
    """``small("sac", "seed=1", ...)``: settings of a training run of seconds."""

    def make(algorithm="sac", *overrides):
        networks = [f"algorithm.{setting}" for setting in SMALL_NETWORKS[algorithm]]
        return compose(TrainConfig, [*SMALL, f"algorithm={algorithm}", *networks, *overrides], groups={"algorithm": ALGORITHMS})

    return make


@pytest.fixture(scope="session")
def table():
    """Rows of ``metrics.csv`` as dictionaries, without the wall-clock."""
    import csv

    def read(folder):
        with (folder / "metrics.csv").open(newline="") as stream:
            return [{key: value for key, value in row.items() if key != "wall_s"} for row in csv.DictReader(stream)]

    return read


@pytest.fixture(scope="session")
def replay_of(paper, rules_of):
    """``replay_of(architecture, steps, **settings)``: a memory of 16 cells that were played by arms that do reach the object.

    Keywords of :class:`HindsightConfig` and of :class:`ReplayConfig`; ``finals``: the share of final actions; ``noise`` of the task.
    """

    def make(architecture="B", steps=60, finals=0.1, seed=0, epsilon_deg=5.0, noise=None, **settings):
        hindsight = HindsightConfig(**{key: settings.pop(key) for key in list(settings) if key in HindsightConfig.__annotations__})
        config = ReplayConfig(**{"capacity": 4000, **settings}, hindsight=hindsight)
        task = replace(rules_of(paper, architecture, epsilon_deg=epsilon_deg).config, noise=noise or NoiseConfig())
        env = SupervisorEnv(16, paper, task, seed=seed)
        random = torch.Generator().manual_seed(seed + 1)
        replay = HindsightReplayBuffer(env.rules, config, env, random)
        writer = EpisodeWriter(16, task.max_steps, env.device)
        current = env.reset()
        for _ in range(steps):
            action = torch.rand(16, 4, generator=random) * 2 - 1
            reach = paper.reaches(current["achieved_goal"])
            only = torch.where(reach[:, 0], torch.where(reach[:, 1], action[:, 1], -1.0), 1.0)
            refused = torch.rand(16, generator=random) < 0.05
            action[:, 1] = torch.where(refused, action[:, 1], only)
            action[:, 0] = torch.where(torch.rand(16, generator=random) < finals, 1.0, -1.0)
            current["action"] = action
            transition, current = env.step_and_maybe_reset(current)
            finished = writer.add(transition)
            if finished is not None:
                replay.extend(finished)
        return replay

    return make


def episode_rows(lengths, first=0):
    """Stored rows of made-up episodes: episode ``i``, step ``j`` was left at (i, j, 0); its own goal is (-1, -1, 0)."""
    number = np.repeat(np.arange(first, first + len(lengths)), lengths)
    step = np.concatenate([np.arange(length) for length in lengths])
    whole = np.repeat(lengths, lengths)
    count = len(number)
    pose = torch.tensor(np.stack([number, step, 0 * step], -1), dtype=torch.float32)
    flag = torch.zeros(count, 1, dtype=torch.bool)
    return TensorDict(
        {
            "achieved_goal": pose - torch.tensor([0.0, 1.0, 0.0]),
            "desired_goal": torch.tensor([[-1.0, -1.0, 0.0]]).expand(count, 3).clone(),
            "previous_arm": torch.zeros(count, 1, dtype=torch.int64),
            "action": torch.tensor([[-1.0, -1.0, 0.0, 0.0]]).expand(count, 4).clone(),
            "placed": pose,
            "feasible": ~flag,
            "epsilon": torch.full((count, 1), 0.1),
            "terminated": flag,
            "remaining": torch.tensor(whole - 1 - step)[:, None],
            "elapsed": torch.tensor(step)[:, None],
        },
        [count],
    )


@pytest.fixture(scope="session")
def made_up_episodes():
    return episode_rows
