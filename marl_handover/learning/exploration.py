"""Uniform actions, for exploration: uniform in the chart, or on the table."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_handover.cell.chart import Chart
from marl_handover.errors import InvalidSetting
from marl_handover.learning.algorithm_settings import OffPolicyConfig
from marl_handover.learning.settings import TrainConfig
from marl_handover.task.rules import Rules

KNOTS = 4097
"""Of the table that turns chart coordinates that are uniform into ones whose places are."""


class Places:
    """Chart coordinates whose places are uniform on the table.

    The chart is one-to-one, and its stretch at (alpha, beta) is the width of the shared space at alpha; so beta stays, and alpha goes
    through the inverse of the width's cumulative sum.

    Args:
        chart: of the shared space.
        device: of the coordinates.
    """

    def __init__(self, chart: Chart, device: torch.device | str = "cpu") -> None:
        knots = torch.linspace(-1.0, 1.0, KNOTS, dtype=torch.float64)
        width = chart.y_max_mm(knots * (chart.inset * chart.x_max_mm))
        share = torch.cat([width.new_zeros(1), torch.cumulative_trapezoid(width, knots)])
        self.knots = knots.float().to(device)
        self.levels = (2 * share / share[-1] - 1).float().to(device)

    def spread(self, place: Tensor) -> Tensor:
        """Coordinates (..., 2), uniform on [-1, 1]^2, as ones that are uniform on the table; monotone, edges stay edges."""
        level = place[..., 0].contiguous()
        upper = torch.searchsorted(self.levels, level).clamp(1, KNOTS - 1)
        low, high = self.levels[upper - 1], self.levels[upper]
        part = ((level - low) / (high - low)).clamp(0.0, 1.0)
        alpha = torch.lerp(self.knots[upper - 1], self.knots[upper], part)
        return torch.stack([alpha, place[..., 1]], -1)


class UniformActions:
    """Draws uniform actions as ``algorithm.exploration`` says.

    Args:
        rules: for the size of an action and the chart.
        config: settings of training.

    Raises:
        InvalidSetting: ``area`` for actions that are more than (final, arm, alpha, beta).
    """

    def __init__(self, rules: Rules, config: TrainConfig) -> None:
        own = config.algorithm
        self.size = rules.action_size
        self.places = None
        if isinstance(own, OffPolicyConfig) and own.exploration == "area":
            if self.size != Rules.action_size:
                raise InvalidSetting("algorithm.exploration", own.exploration, f"'chart' for variant={config.variant}")
            self.places = Places(rules.cell.chart, config.device)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Actions (count, size)."""
        action = torch.rand(count, self.size, generator=generator, device=generator.device) * 2 - 1
        return torch.cat([action[:, :2], self.spread(action[:, 2:])], -1) if self.places else action

    def spread(self, place: Tensor) -> Tensor:
        """Places (..., 2), uniform in the chart, as ``exploration`` wants them."""
        return self.places.spread(place) if self.places else place
