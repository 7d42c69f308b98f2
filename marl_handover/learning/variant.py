"""Formulations of the problem, by name: what each brings to training.

``hierarchical``: a supervisor decides, executors carry out. The others are what it is compared with.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from marl_handover.cell import Cell, load_cell
from marl_handover.cell.batch import CellBatch, LayoutPool
from marl_handover.config import NoiseConfig, TaskConfig
from marl_handover.envs.backends import NoisyBackend
from marl_handover.envs.handover_aec import HandoverEnv
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.errors import UnknownChoice
from marl_handover.learning.algorithm import LEARNERS, Algorithm
from marl_handover.learning.collector import BatchedCollector, Collector, LayoutStream
from marl_handover.learning.replay import HindsightReplayBuffer
from marl_handover.learning.settings import ALGORITHMS, VARIANTS, GraphSacConfig, OffPolicyConfig, TrainConfig
from marl_handover.progress import working
from marl_handover.task.episode import Act, Episodes, play
from marl_handover.task.observations import observe
from marl_handover.task.planner import optimal_transfers
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules, carried

VALIDATION_NOISE_SEED = 2_000_000_001

PROBLEMS_A_LAYOUT = 4
"""Of those that a training in random cells is watched on."""


class Validation(NamedTuple):
    """Problems that a run is watched on: starts and goals (n, 3), fewest transfers (n,), and the rules that they are posed under."""

    rules: Rules
    start: Tensor
    goal: Tensor
    optimal: Tensor


def _first_layouts(config: TrainConfig) -> LayoutPool:
    """The cells that a training of any cell begins with: random ones, or the one that it is for."""
    assert isinstance(config.algorithm, GraphSacConfig)
    if not config.layouts:
        return LayoutPool.of_cell(load_cell(config.cell))
    with working("drawing cells"):
        return LayoutPool.random(config.layouts, config.algorithm.layouts_at_once, np.random.default_rng([config.seed, 0]))


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
        if isinstance(config.algorithm, GraphSacConfig):
            return SupervisorEnv(config.num_envs, task=config.task, device=device, seed=config.seed + 1, layouts=_first_layouts(config))
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
        stream = None
        if config.layouts and isinstance(config.algorithm, GraphSacConfig):
            assert env.layouts is not None
            generator = np.random.default_rng([config.seed, 1])  # not that of the first ones
            stream = LayoutStream(env.layouts, config.layouts, config.algorithm.layouts_interval, generator)
        return BatchedCollector(env, isinstance(config.algorithm, OffPolicyConfig), layouts=stream)

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

    def validation(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> Validation:
        """Problems of one cell, or of cells that training has not seen; there, only those that can be solved."""
        count, cell = config.evaluation_episodes, rules.cell
        if isinstance(cell, CellBatch):
            pool = cell.pool
            if config.layouts:
                pool = LayoutPool.random(
                    config.layouts, math.ceil(count / PROBLEMS_A_LAYOUT), np.random.default_rng(generator.initial_seed())
                )
            rules = rules.on(CellBatch(pool, np.arange(count) * len(pool) // count))
        start, goal = sample_problems(rules.cell, count, generator, torch.float32)
        optimal = torch.as_tensor(optimal_transfers(rules, start.double(), goal.double()), device=start.device)
        if isinstance(cell, CellBatch):
            kept = optimal > 0
            rules, start, goal, optimal = rules.of_rows(kept), start[kept], goal[kept], optimal[kept]
        return Validation(rules, start, goal, optimal)

    def play(self, algorithm: Algorithm, start: Tensor, goal: Tensor, rules: Rules | None = None) -> Episodes:
        """Episodes of the deterministic policy on problems (n, 3), (n, 3), for validation, with all noise of the task, always the same.

        ``rules``: of other cells than those that it is trained in.
        """
        rules = rules or algorithm.rules
        settings, generator = rules.config.noise, torch.Generator(device=start.device).manual_seed(VALIDATION_NOISE_SEED)

        def offsets(count: int, position_mm: float, yaw_deg: float) -> Tensor:
            scale = start.new_tensor([position_mm, position_mm, math.radians(yaw_deg)])
            return torch.randn(count, 3, generator=generator, device=start.device) * scale

        def noise(count: int) -> Tensor:
            return offsets(count, settings.position_mm, settings.yaw_deg)

        if isinstance(rules.cell, CellBatch):
            return play(rules, lambda rows: self.policy(algorithm, rows), start, goal)
        act = self.policy(algorithm)

        def mistaken(pose: Tensor, goal: Tensor, previous: Tensor) -> Tensor:
            offset = offsets(len(pose), settings.observed_mm, settings.observed_deg)
            return act(carried(pose, pose[:, :2] + offset[:, :2], offset[:, 2]), goal, previous)

        return play(rules, mistaken if settings.observed else act, start, goal, noise=noise if rules.noisy else None)

    def policy(self, algorithm: Algorithm, rules: Rules | None = None) -> Act:
        """The deterministic policy as a function of batches, torch: pose (n, 3), goal (n, 3), previous arm (n,) -> action (n, size)."""
        rules = rules or algorithm.rules
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
