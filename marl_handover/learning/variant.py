"""Formulations of the problem, by name: what each brings to training.

``hierarchical``: a supervisor decides, executors carry out. The others are what it is compared with.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from marl_handover.cell import Cell, load_cell
from marl_handover.config import NoiseConfig, TaskConfig
from marl_handover.envs.backends import NoisyBackend
from marl_handover.envs.handover_aec import HandoverEnv
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.errors import UnknownChoice
from marl_handover.learning.algorithm import LEARNERS, Algorithm
from marl_handover.learning.collector import BatchedCollector, Collector
from marl_handover.learning.replay import HindsightReplayBuffer
from marl_handover.learning.settings import ALGORITHMS, VARIANTS, OffPolicyConfig, TrainConfig
from marl_handover.task.episode import Act, Episodes, play
from marl_handover.task.observations import observe
from marl_handover.task.rules import Rules, carried

VALIDATION_NOISE_SEED = 2_000_000_001


class Variant:
    """The hierarchical formulation, and the base of the others."""

    algorithms: ClassVar[Mapping[str, type[Algorithm]]] = LEARNERS
    """Learners by the name of their algorithm."""

    def rules(self, cell: Cell, task: TaskConfig, config: TrainConfig) -> Rules:
        """The rule book that actions are judged by; prices of motions are the environment's matter."""
        return Rules(cell, task)

    def env(self, config: TrainConfig, device: torch.device) -> SupervisorEnv:
        """The batch of cells to train in."""
        rules = None
        if config.source == "aec" and config.backend != "kinematic":
            # Arms that are not exact keep to a part of the chart and are judged by what is measured; all of them alike.
            arms = HandoverEnv(backend="noisy", cell=config.cell, task=config.task)
            assert isinstance(arms.backend, NoisyBackend)
            task = replace(arms.rules.config, noise=arms.backend.noise if config.backend == "noisy" else NoiseConfig())
            rules = Rules(arms.rules.cell, task, arms.rules.motion_cost, physical=True)
        return SupervisorEnv(config.num_envs, load_cell(config.cell), config.task, device, seed=config.seed + 1, rules=rules)

    def collector(self, env: SupervisorEnv, config: TrainConfig) -> Collector:
        """Where transitions come from."""
        if config.source == "aec":
            aec: type[Collector] = importlib.import_module("marl_handover.learning.aec_collector").AecCollector
            return aec(env, config)  # type: ignore[call-arg]
        return BatchedCollector(env, isinstance(config.algorithm, OffPolicyConfig))

    def replay(self, env: SupervisorEnv, config: TrainConfig, generator: torch.Generator) -> HindsightReplayBuffer:
        """The memory that off-policy learners draw from."""
        return HindsightReplayBuffer(env.rules, config.replay, env, generator)

    def algorithm(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> Algorithm:
        """The learner that ``config``, which is valid, names. Raises :class:`UnknownChoice` if this variant has none of that name."""
        name = config.algorithm.name
        if name in ALGORITHMS:
            ALGORITHMS[name]  # registers its learner
        if name not in self.algorithms:
            raise UnknownChoice(f"algorithm of variant={config.variant}", name, tuple(self.algorithms))
        return self.algorithms[name](rules, config, generator)

    def play(self, algorithm: Algorithm, start: Tensor, goal: Tensor) -> Episodes:
        """Episodes of the deterministic policy on problems (n, 3), (n, 3), for validation, with all noise of the task, always the same."""
        rules = algorithm.rules
        settings, generator = rules.config.noise, torch.Generator(device=start.device).manual_seed(VALIDATION_NOISE_SEED)

        def offsets(count: int, position_mm: float, yaw_deg: float) -> Tensor:
            scale = start.new_tensor([position_mm, position_mm, math.radians(yaw_deg)])
            return torch.randn(count, 3, generator=generator, device=start.device) * scale

        def noise(count: int) -> Tensor:
            return offsets(count, settings.position_mm, settings.yaw_deg)

        act = self.policy(algorithm)

        def mistaken(pose: Tensor, goal: Tensor, previous: Tensor) -> Tensor:
            offset = offsets(len(pose), settings.observed_mm, settings.observed_deg)
            return act(carried(pose, pose[:, :2] + offset[:, :2], offset[:, 2]), goal, previous)

        return play(rules, mistaken if settings.observed else act, start, goal, noise=noise if rules.noisy else None)

    def policy(self, algorithm: Algorithm) -> Act:
        """The deterministic policy as a function of batches, torch: pose (n, 3), goal (n, 3), previous arm (n,) -> action (n, 4)."""
        rules = algorithm.rules
        layout, epsilon = rules.config.layout, rules.epsilon_rad

        def act(pose: Tensor, goal: Tensor, previous: Tensor) -> Tensor:
            return algorithm.act(observe(rules, layout, pose, goal, previous, epsilon))

        return act


def make_variant(name: str) -> Variant:
    """The formulation of that name. Modules of the others are imported when they are asked for.

    Raises:
        UnknownChoice: no such variant.
    """
    if name not in VARIANTS:
        raise UnknownChoice("variant", name, tuple(VARIANTS))
    if name == "hierarchical":
        return Variant()
    module = importlib.import_module(f"marl_handover.baselines.{name}")
    variant: Variant = getattr(module, name.capitalize())()
    return variant
