"""What the trainer asks of an algorithm."""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from marl_handover.learning.settings import AlgorithmConfig, TrainConfig
from marl_handover.task.rules import Rules


class Algorithm(ABC):
    """A learner of the supervisor's policy.

    ``kind`` names the form of its exported actor (see :mod:`marl_handover.learning.export`); ``on_policy`` tells the trainer
    how to feed it.
    """

    kind: ClassVar[str]
    on_policy: ClassVar[bool] = False

    config: AlgorithmConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        self.rules, self.config, self.generator = rules, config.algorithm, generator
        self.device = torch.device(config.device)

    @abstractmethod
    def explore(self, observation: Tensor) -> Tensor:
        """Actions (n, 4) to train with, drawn with the algorithm's own generator."""

    @abstractmethod
    def act(self, observation: Tensor) -> Tensor:
        """Deterministic actions (n, 4)."""

    @abstractmethod
    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Learn from a batch; return detached scalars to log."""

    @abstractmethod
    def modules(self) -> dict[str, nn.Module | torch.optim.Optimizer]:
        """Everything whose state a checkpoint must hold, by name."""

    @abstractmethod
    def actor(self) -> nn.Module:
        """The network that :meth:`act` evaluates."""

    def schedule(self, fraction: float) -> None:
        """Set what changes in the course of training; ``fraction`` of it is done. Here: the learning rate."""
        start = self.config.decay_from
        left = 1.0 if fraction <= start or start >= 1.0 else max(0.0, (1.0 - fraction) / (1.0 - start))
        for part in self.modules().values():
            if isinstance(part, torch.optim.Optimizer):
                for group in part.param_groups:
                    group["lr"] = self.config.learning_rate * left

    def state_dict(self) -> dict[str, Any]:
        """Plain state dicts of all parts."""
        return {name: part.state_dict() for name, part in self.modules().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        for name, part in self.modules().items():
            part.load_state_dict(state[name])


def compiled(function: Callable[..., Any], mode: str) -> Callable[..., Any]:
    """``function`` compiled, or itself: ``mode`` is ``on``, ``off`` or ``auto`` (compile where a C++ compiler is found)."""
    if mode == "off" or (mode == "auto" and not can_compile()):
        return function
    return torch.compile(function, dynamic=False)


def can_compile() -> bool:
    """Whether ``torch.compile`` has the C++ compiler it needs on this machine."""
    return any(shutil.which(name) for name in ("g++", "clang++"))
