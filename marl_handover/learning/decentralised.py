"""The decentralised formulation: no supervisor; the arms take turns and each decides for itself. What it brings to training."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from marl_handover.arrays import one_where
from marl_handover.cell import NO_ARM, Cell, load_cell
from marl_handover.config import TaskConfig
from marl_handover.envs.decentralised import DecentralisedEnv, TurnRules, own_view
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.algorithm import Algorithm
from marl_handover.learning.decentralised_sac import DecentralisedSac
from marl_handover.learning.experience import BatchedExperience, Experience
from marl_handover.learning.settings import TrainConfig
from marl_handover.learning.turn_replay import TurnReplay
from marl_handover.learning.variants import Variant
from marl_handover.task.episode import Act
from marl_handover.task.observations import observe


class Decentralised(Variant):
    """Arms that take turns (see :mod:`marl_handover.envs.decentralised`) and learn as ``decentralised.learners`` says."""

    algorithms: ClassVar[dict[str, type[Algorithm]]] = {"sac": DecentralisedSac}

    def rules(self, cell: Cell, task: TaskConfig, config: TrainConfig) -> TurnRules:
        """The rule book with its skin for turns."""
        return TurnRules(cell, task, config.decentralised)

    def env(self, config: TrainConfig, device: torch.device) -> DecentralisedEnv:
        """The batch of cells to train in."""
        return DecentralisedEnv(config.num_envs, load_cell(config.cell), config.task, device, config.seed + 1, config.decentralised)

    def experience(self, env: SupervisorEnv, config: TrainConfig) -> Experience:
        """Steps of all cells, of which only transfers count as steps."""
        return BatchedExperience(env, max_decisions=_turn_rules(env.rules).max_decisions)

    def replay(self, env: SupervisorEnv, config: TrainConfig, generator: torch.Generator) -> TurnReplay:
        """From turn to turn, or for a centralised critic from decision to decision."""
        learners = config.decentralised.learners
        return TurnReplay(_turn_rules(env.rules), config.replay, env, generator, learners != "ctde", learners == "independent")

    def policy(self, algorithm: Algorithm) -> Act:
        """The deterministic policies as one supervisor, L first. Two passes in a row: no arm moves."""
        rules = _turn_rules(algorithm.rules)

        def asked(pose: Tensor, goal: Tensor, turn: Tensor) -> Tensor:
            both = observe(rules, "relative", pose, goal, torch.full_like(turn, NO_ARM))
            return algorithm.act(own_view(both, turn, torch.zeros_like(turn)))

        def act(pose: Tensor, goal: Tensor, previous: Tensor) -> Tensor:
            first = rules.turn_of(previous)
            answer = asked(pose, goal, first)
            passed = rules.passes(answer)
            turn = torch.where(passed, 1 - first, first)
            answer = one_where(passed, asked(pose, goal, 1 - first), answer)
            return one_where(rules.passes(answer), torch.full_like(pose[:, :1], torch.nan), rules.supervisor_action(answer, turn))

        return act


def _turn_rules(rules: object) -> TurnRules:
    """The rule book as what it is here."""
    assert isinstance(rules, TurnRules)
    return rules
