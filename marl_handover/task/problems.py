"""Problems: start and goal poses, random ones uniform on M x (-pi, pi], and those that are given to an environment of one cell."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_handover.arrays import Array, Floats, namespace, wrap
from marl_handover.cell.batch import CellBatch
from marl_handover.cell.cell import Cell
from marl_handover.errors import InvalidSetting, NotFinite, UnknownKey
from marl_handover.task.rules import Outcome

KEYS = ("state", "goal")
"""Of the options that set a problem."""

IGNORED = "options"
"""A key that PettingZoo's own API test sends."""

FIRST_DRAW, LARGEST_DRAW = 16, 1024
"""Problems are drawn in blocks, since one batched draw costs as much as one single draw: small ones first, for who seeds every episode."""


def regret(outcome: Array, transfers: Array, optimum: Array | int, max_steps: int) -> Array:
    """Transfers beyond the optimum (...) of episodes that are over: ``transfers`` - ``optimum``; if failed ``max_steps`` - ``optimum``.

    A failure is so never better than a solution, however late, and it does not matter how soon it came. Where placements are noisy, luck
    may solve a problem in less than the optimum of exact arms: the regret is negative then.

    Args:
        outcome: values of :class:`~marl_handover.task.rules.Outcome`, (...), numpy or torch.
        transfers: made, (...).
        optimum: (...).
        max_steps: transfers allowed.
    """
    return namespace(transfers).where(outcome == int(Outcome.SUCCESS), transfers, max_steps) - optimum


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
        reached = cell.reaches(points)
        mine = reached.to(torch.uint8).argmax(-1) == arm
        if cell.keep_out:
            mine &= reached.any(-1)
        points = points[mine][:missing]
        kept.append(points)
        missing -= len(points)
    return torch.cat([of_arm[:0, :2], *kept])


def sample_poses(cell: Cell, count: int, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> Tensor:
    """``count`` poses (count, 3): x_mm, y_mm, theta_rad, uniform on M x [-pi, pi)."""
    positions = sample_positions(cell, count, generator, dtype)
    theta = torch.rand(count, 1, generator=generator, dtype=dtype, device=generator.device) * (2 * math.pi) - math.pi
    return torch.cat([positions, theta], -1)


def sample_problems(
    cell: Cell | CellBatch, count: int, generator: torch.Generator, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """``count`` starts and goals, each (count, 3); of a batch of ``count`` cells one problem in each."""
    if isinstance(cell, CellBatch):
        start, goal = (_poses_in_each(cell, generator, dtype) for _ in range(2))
        return start, goal
    poses = sample_poses(cell, 2 * count, generator, dtype)
    return poses[:count], poses[count:]


def _poses_in_each(cells: CellBatch, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """A pose (n, 3) in each cell, uniform on what its arms reach; as :func:`sample_positions` draws them."""
    device, count = generator.device, len(cells)
    of_arm = torch.as_tensor(cells.pool.arms[cells.layout], dtype=dtype, device=device)
    square, span = of_arm[..., 3] ** 2, of_arm[..., 4] ** 2 - of_arm[..., 3] ** 2
    shares = (span * (of_arm[..., 6] - of_arm[..., 5])).cumsum(-1)
    shares = shares / shares[:, -1:]
    positions = torch.zeros(count, 2, dtype=dtype, device=device)
    missing = torch.arange(count, device=device)
    while len(missing):
        uniform = torch.rand(len(missing), 3, generator=generator, dtype=dtype, device=device)
        arm = torch.searchsorted(shares[missing], uniform[:, :1].contiguous(), right=True)[:, 0]
        base = of_arm[missing, arm]
        radius = (square[missing, arm] + uniform[:, 1] * span[missing, arm]).sqrt()
        angle = base[:, 2] + base[:, 5] + uniform[:, 2] * (base[:, 6] - base[:, 5])
        points = base[:, :2] + radius[:, None] * torch.stack([angle.cos(), angle.sin()], -1)
        reached = cells.take(missing).reaches(points)
        kept = (reached.to(torch.uint8).argmax(-1) == arm) & reached.any(-1)
        positions[missing[kept]] = points[kept]
        missing = missing[~kept]
    theta = torch.rand(count, 1, generator=generator, dtype=dtype, device=device) * (2 * math.pi) - math.pi
    return torch.cat([positions, theta], -1)


class ProblemSource:
    """Starts and goals of one cell; the generator it is given decides them.

    Attributes:
        seed: that an environment begins with if it is given none; None: any.
        optimum: fewest transfers of the problem that came last, 0 if none are enough; None: not known.
    """

    seed: int | None = None
    optimum: int | None = None

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.clear()

    def clear(self) -> None:
        """Forget what is drawn already, because the generator was seeded anew."""
        self._drawn: list[tuple[Floats, Floats]] = []
        self._block = FIRST_DRAW

    def told(self, outcome: Outcome, transfers: int, over: bool, max_steps: int) -> dict[str, int]:
        """What ``info`` says of the problem that came last: ``optimum`` where it is known, and ``regret`` when the episode is over."""
        if self.optimum is None:
            return {}
        known = {"optimum": self.optimum}
        return known | {"regret": int(regret(np.int64(outcome), np.int64(transfers), self.optimum, max_steps))} if over else known

    def next(self, generator: np.random.Generator, options: Mapping[str, Any] | None = None) -> tuple[Floats, Floats]:
        """Start and goal, each (3,): random, or as ``options`` say under ``state`` and ``goal``.

        Raises:
            UnknownKey: for another key.
            InvalidSetting: for a state or goal that is not three numbers.
            NotFinite, OutOfReach: for one that cannot be.
        """
        given = self._given({} if options is None else options)
        if not self._drawn:
            drawn = sample_problems(self.cell, self._block, torch.Generator().manual_seed(int(generator.integers(2**62))))
            self._drawn = list(zip(*(poses.numpy() for poses in drawn), strict=True))
            self._block = min(8 * self._block, LARGEST_DRAW)
        start, goal = self._drawn.pop()
        return given.get("state", start), given.get("goal", goal)

    def _given(self, options: Mapping[str, Any]) -> dict[str, Floats]:
        if not isinstance(options, Mapping):
            raise InvalidSetting("options", options, "a mapping with the keys state and goal, or None")
        for key in options:
            if key not in (*KEYS, IGNORED):
                raise UnknownKey(str(key), KEYS)
        return {key: self._checked(key, options[key]) for key in KEYS if key in options}

    def _checked(self, what: str, pose: Any) -> Floats:
        expected = "three numbers: [x_mm, y_mm, theta_rad]"
        try:
            array = np.asarray(pose, np.float64)
        except (TypeError, ValueError, ArithmeticError, RuntimeError) as error:  # what numpy and torch find wrong with it
            raise InvalidSetting(what, pose, expected) from error
        if array.shape != (3,):
            raise InvalidSetting(what, pose, expected)
        if not np.isfinite(array).all():
            raise NotFinite(what, array.tolist())
        self.cell.require_reached(what, array)
        return np.array([array[0], array[1], wrap(array[2])])
