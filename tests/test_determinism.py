"""The same seed gives the same run, to the last bit."""

from __future__ import annotations

import csv

import pytest
import torch

from marl_handover.compose import compose
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.learning.trainer import Trainer

SHORT = ("compile=off", "progress=false", "num_envs=16", "steps=640", "evaluation_interval=320", "evaluation_episodes=50")
OWN = {
    "sac": ("actor_hidden=[32]", "critic_hidden=[32]", "learning_starts=160", "batch_size=32", "env_steps_per_gradient_step=32"),
    "td3": ("hidden=[32]", "learning_starts=160", "batch_size=32", "env_steps_per_gradient_step=32"),
    "flat_sac": ("hidden=[32]", "learning_starts=160", "batch_size=32", "env_steps_per_gradient_step=32"),
    "ppo": ("hidden=[32]", "rollout_steps=10", "batch_size=80"),
}


def trained(folder, algorithm, seed):
    """The table without the wall-clock, and the weights, of a short run."""
    own = [f"algorithm.{setting}" for setting in OWN[algorithm]]
    config = compose(TrainConfig, [*SHORT, f"seed={seed}", f"algorithm={algorithm}", *own], groups={"algorithm": ALGORITHMS})
    trainer = Trainer(config, folder)
    trainer.run()
    with (folder / "metrics.csv").open(newline="") as stream:
        rows = [{key: value for key, value in row.items() if key != "wall_s"} for row in csv.DictReader(stream)]
    return rows, trainer.algorithm.actor().state_dict()


@pytest.mark.parametrize(
    "algorithm", ["sac", "ppo", pytest.param("td3", marks=pytest.mark.slow), pytest.param("flat_sac", marks=pytest.mark.slow)]
)
def test_same_seed_same_run_other_seed_another(tmp_path, algorithm):
    rows, weights = trained(tmp_path / "one", algorithm, 1)
    torch.rand(7)  # what others draw meanwhile does not matter
    again, same_weights = trained(tmp_path / "again", algorithm, 1)
    assert len(rows) == 2
    assert rows == again
    assert all(torch.equal(value, same_weights[key]) for key, value in weights.items())
    other, other_weights = trained(tmp_path / "other", algorithm, 2)
    assert rows != other
    assert any(not torch.equal(value, other_weights[key]) for key, value in weights.items())
