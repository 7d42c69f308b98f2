"""Algorithms by name."""

from __future__ import annotations

import torch

from marl_handover.errors import InvalidSetting, UnknownChoice
from marl_handover.learning.algorithm import Algorithm
from marl_handover.learning.box import BoxSac, Td3
from marl_handover.learning.hybrid_sac import HybridSac
from marl_handover.learning.ppo import Ppo
from marl_handover.learning.settings import ALGORITHMS, TrainConfig
from marl_handover.task.rules import Rules

_CLASSES: dict[str, type[Algorithm]] = {"sac": HybridSac, "box_sac": BoxSac, "td3": Td3, "ppo": Ppo}


def make_algorithm(rules: Rules, config: TrainConfig, generator: torch.Generator) -> Algorithm:
    """The algorithm that ``config`` names.

    Raises:
        UnknownChoice: no such algorithm.
        InvalidSetting: the hybrid one with a layout that has no block an arm.
    """
    name = config.algorithm.name
    if name not in _CLASSES:
        raise UnknownChoice("algorithm", name, ALGORITHMS)
    if name == "sac" and config.algorithm.layout != "relative":
        raise InvalidSetting("algorithm.layout", config.algorithm.layout, "'relative' for algorithm=sac; box_sac takes any layout")
    return _CLASSES[name](rules, config, generator)
