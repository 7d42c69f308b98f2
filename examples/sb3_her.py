"""Stable-Baselines3's own SAC and hindsight buffer on SupervisorB: python examples/sb3_her.py [steps] [folder].

Everything is stock; ours are the environment and what the networks see of it. ``pip install 'marl_handover[peers]'`` first.
"""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium
import torch
from gymnasium.spaces import Dict
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

import marl_handover  # noqa: F401  # registers the environments

ID = "marl_handover/SupervisorB-v0"
SETTINGS = {"epsilon_deg": 5.0, "reward": {"success": 2.0, "step": -0.4, "failure": -3.0}}
"""A transfer costs more than it usually does beside a success. Hindsight shows hand-overs to where they went, as if to goals, so one
to near the goal looks better than it is: a learner to which transfers are cheap goes on with them for ever and does not finish.
"""


class Relative(BaseFeaturesExtractor):
    """Which arm reaches what, and the error it would leave: computed after hindsight has swapped the goal."""

    def __init__(self, space: Dict) -> None:
        self.of = gymnasium.make(ID).unwrapped.features
        super().__init__(space, self.of(space.sample()).shape[-1])

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        """The layout ``relative``, (n, 38)."""
        return self.of(observation)


def train(
    steps: int = 150_000, folder: str = "runs/sb3_her", cells: int = 16, hidden: int = 256, every: int = 10_000, seed: int = 0
) -> SAC:
    """Train for ``steps`` transfers; ``folder`` gets the best model and ``evaluations.npz``, the curve."""
    torch.set_num_threads(1)
    model = SAC(
        "MultiInputPolicy",
        make_vec_env(ID, cells, seed=seed, env_kwargs=SETTINGS),
        learning_rate=5e-4,
        gamma=0.95,
        ent_coef="auto_0.1",
        batch_size=256,
        buffer_size=50_000,
        learning_starts=2000,
        train_freq=1,
        gradient_steps=4,  # every 16 transfers
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 1, "goal_selection_strategy": "final"},  # what a hand-over did itself is seldom final
        policy_kwargs={"features_extractor_class": Relative, "net_arch": [hidden, hidden]},
        seed=seed,
        device="cpu",
    )
    judge = make_vec_env(ID, 50, seed=12345, env_kwargs=SETTINGS)
    judged = EvalCallback(judge, n_eval_episodes=500, eval_freq=every // cells, best_model_save_path=folder, log_path=folder)
    return model.learn(steps, judged)


if __name__ == "__main__":
    model = train(*(int(word) for word in sys.argv[1:2]), *sys.argv[2:3])
    model.save(Path(sys.argv[2] if len(sys.argv) > 2 else "runs/sb3_her") / "last_model")
