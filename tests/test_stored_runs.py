"""What version 0.1 wrote is still read: a run directory, its checkpoint and its policy."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import torch

from marl_handover import policies
from marl_handover.commands.train import resumed

RUN = Path(__file__).parent / "data" / "run_0_1"


def test_a_policy_of_version_0_1_acts_as_it_did():
    rows = json.loads((RUN / "actions.json").read_text())
    pose, goal, previous, action = (np.array([row[key] for row in rows]) for key in ("pose", "goal", "previous_arm", "action"))
    np.testing.assert_allclose(policies.load(str(RUN)).act(pose, goal, previous), action, atol=1e-5)


def test_a_run_of_version_0_1_goes_on(tmp_path):
    folder = shutil.copytree(RUN, tmp_path / "run")
    trainer = resumed(folder)
    stored = torch.load(RUN / "checkpoint.pt", weights_only=True)
    assert trainer.counters.step == stored["counters"]["step"] == 1024
