"""Training on two arms that differ: what is learned is what the stored policy does, in every kind of view."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_handover import policies
from marl_handover.cell import load_cell
from marl_handover.compose import to_yaml
from marl_handover.config import ArmConfig, CellConfig
from marl_handover.learning.trainer import Trainer
from marl_handover.task.problems import sample_problems

MIXED = CellConfig(name="mixed", grid_mm=10.0, arms=[ArmConfig("small"), ArmConfig("large", robot="al5a")])
TURNED = CellConfig(name="turned", robot="so101", grid_mm=10.0)  # grips beside their planes: the arms are each other's image by half a turn
ASKEW = CellConfig(name="askew", grid_mm=10.0, arms=[ArmConfig("a", 100.0, 200.0, -120.0), ArmConfig("b", -80.0, -190.0, 70.0, "al5a")])


@pytest.mark.parametrize("cell", [MIXED, TURNED, ASKEW], ids=lambda cell: cell.name)
def test_a_stored_policy_does_what_was_learned(cell, small, tmp_path):
    (tmp_path / "cell.yaml").write_text(to_yaml(cell))
    config = small("sac", "steps=256", "evaluation_interval=256")
    config.cell = cell
    trainer = Trainer(config, tmp_path / "run")
    trainer.run()
    policy = policies.load(str(tmp_path / "run"))
    assert policy.rules.cell.arms == load_cell(cell).arms
    start, goal = sample_problems(policy.rules.cell, 300, torch.Generator().manual_seed(0))
    previous = torch.arange(300) % 3 - 1
    trainer.algorithm.actor().load_state_dict(trainer.best["actor"])
    learned = trainer.variant.policy(trainer.algorithm)(start.float(), goal.float(), previous)
    stored = policy.act(start.float().numpy(), goal.float().numpy(), previous.numpy())
    np.testing.assert_allclose(stored, learned.detach().numpy(), atol=1e-4)
    result = policy.rules.step(start.numpy(), goal.numpy(), previous.numpy(), stored)
    handed = ~result.command.final & policy.rules.cell.reaches(start.numpy())[np.arange(300), result.command.arm]
    assert handed.any()
    assert result.feasible[handed].all()  # every place that is commanded is one that both arms reach
