"""Every learner learns. Marks leave slack; in brackets what two or three seeds reached."""

from __future__ import annotations

import pytest
import torch

from marl_handover.errors import Diverged
from marl_handover.learning.trainer import Trainer
from marl_handover.policies import RandomPolicy
from marl_handover.task.episode import play
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome


def learned(small, folder, algorithm, steps, epsilon_deg, *settings):
    """A finished run, and its success rate on 300 unseen problems."""
    stage = f"curriculum=[{{epsilon_low_deg:{epsilon_deg},epsilon_high_deg:{epsilon_deg}}}]"
    watch = ("num_envs=32", "evaluation_episodes=300", "evaluation_interval=100000")
    own = [f"algorithm.{setting}" for setting in ("layout=relative", "hidden=[64,64]", "batch_size=128", *settings)]
    if algorithm == "sac":
        own = [setting for setting in own if not setting.startswith("algorithm.hidden")]
    trainer = Trainer(small(algorithm, f"steps={steps}", f"task.epsilon_deg={epsilon_deg}", stage, *watch, *own), folder)
    return trainer, trainer.run()["validation"]["success_rate"]


def random_rate(rules):
    """Success of uniform actions."""
    problems = [part.numpy() for part in sample_problems(rules.cell, 1000, torch.Generator().manual_seed(11))]
    return float((play(rules, RandomPolicy(rules).act, *problems).outcome == int(Outcome.SUCCESS)).mean())


def test_hybrid_sac_solves_15_degrees_in_3072_steps(small, tmp_path):
    networks = (
        "actor_hidden=[64,64]",
        "critic_hidden=[64,64]",
        "candidates=4",
        "mixture_components=1",
        "learning_rate=1e-3",
        "actor_tau=0.05",
    )
    pace = ("learning_starts=500", "env_steps_per_gradient_step=8", "batch_size=96", "gamma=0.95", "reward_scale=0.5")
    trainer, rate = learned(small, tmp_path, "sac", 3072, 15, *networks, *pace)
    assert rate > 0.8  # (0.98, 0.98, 0.99)
    assert random_rate(trainer.rules) < 0.1


def test_ppo_beats_random_actions(small, tmp_path):
    trainer, rate = learned(small, tmp_path, "ppo", 12_288, 60, "learning_rate=2e-3", "rollout_steps=16", "epochs=4")
    assert rate > random_rate(trainer.rules) + 0.1  # (0.47, 0.79; random 0.12)


def test_a_training_that_diverges_says_so_and_stops(small, tmp_path):
    made = Trainer(small("flat_sac", "steps=512", "evaluation_interval=256"), tmp_path)
    made.config.algorithm.learning_rate = 1e30  # beyond the bounds of the setting: within them nothing diverges so soon
    with pytest.raises(Diverged, match=r"diverged before step 256: loss_\w+ = (nan|inf).*learning_rate") as told:
        made.run()
    assert told.value.step == 256
    assert "nan" not in (tmp_path / "metrics.csv").read_text()


@pytest.mark.slow
def test_td3_beats_random_actions(small, tmp_path):
    trainer, rate = learned(small, tmp_path, "td3", 6144, 60, "learning_rate=1e-3", "learning_starts=1000", "env_steps_per_gradient_step=4")
    assert rate > random_rate(trainer.rules) + 0.1  # (0.59, 0.42 at 4096 steps; random 0.12)


@pytest.mark.slow
def test_flat_sac_beats_random_actions(small, tmp_path):
    pace = ("learning_rate=1e-3", "learning_starts=1000", "env_steps_per_gradient_step=5", "reward_scale=0.2", "gamma=0.9")
    trainer, rate = learned(small, tmp_path, "flat_sac", 10_240, 60, *pace)
    assert rate > random_rate(trainer.rules) + 0.07  # (0.31, 0.27; random 0.12)
