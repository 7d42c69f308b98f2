"""The AEC environment in vectors is the environment."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from pettingzoo.test import api_test
from torchrl.envs.utils import check_env_specs

from marl_handover.cell import build_cell, cell_config
from marl_handover.envs import handover_aec
from marl_handover.envs.flat_aec import FlatAEC, FlatHandover
from marl_handover.motion.executor import ExecutorAgent

architectures = pytest.mark.parametrize("architecture", ["A", "B"])


@pytest.fixture(scope="module")
def model():
    return build_cell(cell_config("paper"))


@architectures
def test_flat_spaces_hold_what_the_nested_ones_do(architecture, model):
    """PettingZoo's and TorchRL's own tests pass, and both forms of the environment go the same way."""
    flat = FlatAEC(handover_aec.raw_env(cell=model, architecture=architecture))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        api_test(flat, num_cycles=50)
        check_env_specs(FlatHandover(FlatAEC(handover_aec.env(cell=model, architecture=architecture)), 0))
    nested = handover_aec.raw_env(cell=model, architecture=architecture)
    arms = {agent: ExecutorAgent(agent, model, "direct") for agent in ("arm_left", "arm_right")}
    random = np.random.default_rng(0)
    for env in (flat, nested):
        env.reset(seed=1)
    for _ in range(60):
        agent = nested.agent_selection
        assert flat.agent_selection == agent
        for name in nested.possible_agents:
            expected = np.concatenate([np.ravel(value) for value in nested.observe(name).values()])
            np.testing.assert_array_equal(flat.observe(name), expected.astype(np.float32))
            assert (flat.rewards[name], flat.terminations[name]) == (nested.rewards[name], nested.terminations[name])
        if nested.terminations[agent] or nested.truncations[agent]:
            flat.reset()
            nested.reset()
            continue
        if agent == "supervisor":
            numbers = random.uniform(-1, 1, 4).astype(np.float32)
            action = {"final": int(numbers[0] > 0), "arm": int(numbers[1] > 0), "place": numbers[2:]}
        else:
            action = arms[agent].act(nested.observe(agent))
            numbers = np.concatenate([np.ravel(value) for value in action.values()])
        flat.step(numbers)
        nested.step(action)
