"""Random problems: start and goal poses, uniform on M x (-pi, pi]."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from marl_handover.cell.cell import Cell


def sample_positions(cell: Cell, count: int, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> Tensor:
    """``count`` positions (count, 2) in mm, uniform on the union of the arms' annulus sectors.

    Draws from a sector chosen at random, the larger the more often; a point that an arm of lower index reaches too counts for that arm
    only and is drawn again, so that the shared space is not twice as dense.
    """
    device = generator.device
    kept: list[Tensor] = []
    missing = count
    rows, sizes = [], []
    for each in cell.arms:
        low, span, turn = each.r_min_mm**2, each.r_max_mm**2 - each.r_min_mm**2, each.yaw_rad[1] - each.yaw_rad[0]
        rows.append((each.base.x_mm, each.base.y_mm, each.base.facing_rad, low, span, each.yaw_rad[0], turn, each.lateral_mm))
        sizes.append(span * turn)
    of_arm = torch.tensor(rows, dtype=dtype, device=device)
    alike, beside = all(row[3:] == rows[0][3:] for row in rows), any(row[7] for row in rows)
    shares = torch.tensor([sum(sizes[: index + 1]) / sum(sizes) for index in range(len(sizes) - 1)], dtype=dtype, device=device)
    while missing > 0:
        draw = math.ceil(1.5 * missing) + 8
        uniform = torch.rand(3, draw, generator=generator, dtype=dtype, device=device)
        arm = torch.bucketize(uniform[0], shares, right=True)
        low_mm2, span_mm2, yaw, yaws = rows[0][3:7] if alike else of_arm[arm, 3:7].unbind(-1)
        radius = (low_mm2 + uniform[1] * span_mm2).sqrt()
        angle = of_arm[arm, 2] + yaw + uniform[2] * yaws
        if beside:
            angle = angle + torch.asin(of_arm[arm, 7] / radius)
        points = of_arm[arm, :2] + radius[:, None] * torch.stack([angle.cos(), angle.sin()], -1)
        owner = cell.reaches(points).to(torch.uint8).argmax(-1)
        points = points[owner == arm][:missing]
        kept.append(points)
        missing -= len(points)
    return torch.cat([of_arm[:0, :2], *kept])


def sample_poses(cell: Cell, count: int, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> Tensor:
    """``count`` poses (count, 3): x_mm, y_mm, theta_rad, uniform on M x [-pi, pi)."""
    positions = sample_positions(cell, count, generator, dtype)
    theta = torch.rand(count, 1, generator=generator, dtype=dtype, device=generator.device) * (2 * math.pi) - math.pi
    return torch.cat([positions, theta], -1)


def sample_problems(cell: Cell, count: int, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """``count`` starts and goals, each (count, 3)."""
    poses = sample_poses(cell, 2 * count, generator, dtype)
    return poses[:count], poses[count:]
