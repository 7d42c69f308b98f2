"""Thousands of different cells at once: layouts drawn at random, their edges, and the same rules for a batch with a layout a row."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence, Sized
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Array, Floats, as_kind, kind_of, namespace
from marl_handover.cell.arm import REACH_TOLERANCE_MM
from marl_handover.cell.cell import Cell
from marl_handover.cell.chart import EdgeTable, arm_row
from marl_handover.cell.layouts import layout_cell
from marl_handover.cell.sectors import Sectors, sector_limits
from marl_handover.config import BlockConfig, LayoutConfig
from marl_handover.errors import InvalidSetting

LEAST_ROOM = 3
"""Arms that a batch has room for at least: actions of two arms have a form of their own."""

Layout = tuple[Floats, Floats]
"""Arms (N, 8) and keep-out discs (M, 3), as :class:`LayoutPool` has them."""

_MOST_ARCS = 32
_TRIES = 2000


class LayoutPool:
    """Layouts that a batch of cells draws from, with all that their arms share; padded to the one with the most arms.

    Args:
        layouts: see :meth:`extend`.
        block: what is handed over.
        room: arms that there is room for at least.

    Attributes:
        arms: (L, N, 8) x, y, facing, least and greatest radius, least and greatest yaw, lateral offset; what is not there is 0.
        n_arms: (L,).
        discs: (L, M, 3) x, y and radius of keep-out discs, half the block's diagonal included; a radius of 0 is none.
        number: (L, N, N) row of ``table`` of what two arms share, -1 where they share nothing.
        table: the edges of all layouts.
    """

    def __init__(self, layouts: Sequence[Layout], block: BlockConfig | None = None, room: int = LEAST_ROOM) -> None:
        self.block, self.room = block or BlockConfig(), max(room, LEAST_ROOM)
        self.layouts: list[Layout] = []
        self._edges: list[tuple[NDArray[np.int64], Floats, Floats, list[Floats]]] = []
        self.extend(layouts)

    def extend(self, layouts: Sequence[Layout]) -> None:
        """Add layouts: arms (N, 8) and discs (M, 3) each. Those that are there keep their numbers."""
        self.layouts += layouts
        self._edges += [_edges(standing, discs) for standing, discs in layouts]
        count, room = len(self.layouts), max(self.room, *(len(arms) for arms, _ in self.layouts))
        self.arms, self.n_arms = np.zeros((count, room, 8)), np.array([len(arms) for arms, _ in self.layouts])
        self.discs = np.zeros((count, max(len(discs) for _, discs in self.layouts), 3))
        self.number = np.full((count, room, room), -1)
        pairs: list[Floats] = []
        there: list[Floats] = []
        arcs: list[Floats] = []
        for row, ((standing, discs), (number, of_pairs, of_discs, of_arcs)) in enumerate(zip(self.layouts, self._edges, strict=True)):
            self.arms[row, : len(standing)], self.discs[row, : len(discs)] = standing, discs
            self.number[row, : len(standing), : len(standing)] = np.where(number >= 0, number + len(pairs), -1)
            pairs += list(of_pairs)
            there += list(of_discs)
            arcs += of_arcs
        self.table = EdgeTable(np.array(pairs).reshape(-1, 15), there, arcs, 1.0)
        for name in ("facts", "arcs"):
            self.__dict__.pop(name, None)

    @classmethod
    def random(
        cls,
        config: LayoutConfig | Sequence[LayoutConfig],
        count: int,
        generator: np.random.Generator,
        on_layout: Callable[[int], None] = lambda made: None,
    ) -> LayoutPool:
        """``count`` connected layouts; ``on_layout`` is told how many are made. Of several kinds, each is as likely for every layout."""
        most = max(kind.arms[1] for kind in ([config] if isinstance(config, LayoutConfig) else config))
        return cls(random_layouts(config, count, generator, on_layout), room=most)

    @classmethod
    def of_cell(cls, cell: Cell) -> LayoutPool:
        """One cell as the only layout. Raises :class:`InvalidSetting` if a grip is beside its arm's plane."""
        if any(arm.lateral_mm for arm in cell.arms):
            raise InvalidSetting("cell.arms", list(cell.names), "arms whose grip is in their plane, for a batch of cells")
        discs = np.array([[*disc] for disc in cell.keep_out]).reshape(-1, 3)
        return cls([(np.stack([arm_row(arm) for arm in cell.arms]), discs)], cell.config.block)

    def __len__(self) -> int:
        return len(self.arms)

    def cell(self, layout: int) -> Cell:
        """One of the layouts as a cell of its own, with arms ``a0``, ``a1`` ..."""
        margin_mm = self.block.side_mm / math.sqrt(2)
        arms = [
            {"name": f"a{number}", "x_mm": row[0], "y_mm": row[1], "facing_rad": row[2], "r_min_mm": row[3], "r_max_mm": row[4]}
            | {"yaw_range_rad": [row[5], row[6]]}
            for number, row in enumerate(self.arms[layout, : self.n_arms[layout]].tolist())
        ]
        discs = [{"x_mm": x, "y_mm": y, "radius_mm": r - margin_mm} for x, y, r in self.discs[layout].tolist() if r > 0]
        return layout_cell(arms, discs)

    @cached_property
    def facts(self) -> Floats:
        """What :meth:`Sectors._constants` is made of (10, L, N); an arm that is not there reaches nothing."""
        table = np.zeros((10, *self.arms.shape[:2]))
        table[2], table[5], table[6], table[7], table[8] = 1.0, 4e12, 9e12, -1.0, 1.0
        for row, count in enumerate(self.n_arms):
            for arm in range(count):
                x, y, facing, r_min, r_max, low, high, lateral = self.arms[row, arm]
                limits = sector_limits(r_min, r_max, low, high)
                table[:, row, arm] = (
                    x,
                    y,
                    math.cos(facing),
                    math.sin(facing),
                    math.atan2(math.sin(facing), math.cos(facing)),
                    *limits,
                    lateral,
                )
        return table

    @cached_property
    def arcs(self) -> Floats:
        """Middle and half of hand-over angles (2, L, N, N, K), as :meth:`Sectors.hand_over_arcs` has them."""
        rows, most = self.table.arcs, self.table.arcs.shape[1]
        table = np.zeros((2, *self.number.shape, most))
        table[1] = -1.0
        shared = self.number >= 0
        used = np.arange(most) < self.table.n_arcs[self.number[shared]][:, None]
        first = np.tril(np.ones(self.number.shape[1:], bool)).T[None] & shared  # i < j: as counted; the other way round the opposite
        table[0][shared] = math.pi + rows[self.number[shared], :, 0]
        table[0] = np.where(first[..., None], table[0], -table[0])
        table[1][shared] = np.where(used, rows[self.number[shared], :, 1], -1.0)
        return table


class CellBatch(Sectors):
    """Cells of their own, one a row: what the rules need of them.

    Attributes:
        pool: where the layouts are.
        layout: (n,) which of them each row has.
    """

    def __init__(self, pool: LayoutPool, layout: NDArray[np.int64]) -> None:
        self.pool, self.layout = pool, np.asarray(layout, np.int64)
        self._kinds: dict[Any, Array] = {}

    def __len__(self) -> int:
        return len(self.layout)

    def take(self, rows: Array) -> Self:
        """The cells of some rows, by number or by a mask (n,)."""
        return type(self)(self.pool, self.layout[rows.cpu().numpy() if hasattr(rows, "cpu") else rows])

    @property
    def num_arms(self) -> int:
        """How many arms there is room for."""
        return int(self.pool.arms.shape[1])

    @property
    def keep_out(self) -> Sized:
        """The discs (M, ...); empty if no layout has any."""
        return range(self.pool.discs.shape[1])

    @cached_property
    def extent_mm(self) -> tuple[float, float]:
        """How far from the origin, along x and along y, any arm of the pool reaches at most."""
        far = abs(self.pool.arms[..., :2]) + self.pool.arms[..., 4:5]
        return float(far[..., 0].max()), float(far[..., 1].max())

    def is_clear(self, position_mm: Array) -> Array:
        """Whether an object may stand at positions (n, ..., >= 2) of each row: bool (n, ...)."""
        discs = self._of_rows("discs", self.pool.discs.swapaxes(0, 1)[..., None, :], position_mm)
        clear = position_mm[..., 0] == position_mm[..., 0]
        for disc in discs:
            there = disc[..., 0, :]
            dx, dy = position_mm[..., 0] - there[..., 0], position_mm[..., 1] - there[..., 1]
            least = namespace(position_mm).clip(there[..., 2] - REACH_TOLERANCE_MM, 0.0, None)
            clear = clear & (dx * dx + dy * dy >= least * least)
        return clear

    def place_mm(self, arm: Array, receiver: Array, alpha: Array, beta: Array) -> Array:
        """World position (n, ..., 2) in mm of chart coordinates in what two arms of a row share; NaN where they share nothing."""
        return self.pool.table.to_world(self.edge(arm, receiver), alpha, beta)

    def at_angle(self, giver: Array, receiver: Array, angle_rad: Array) -> Array:
        """As :class:`Sectors` says."""
        upward = namespace(angle_rad).where(giver < receiver, angle_rad, -angle_rad)
        return self.pool.table.at_angle(self.edge(giver, receiver), upward)

    def coordinates(self, giver: Array, receiver: Array, place_mm: Array) -> Array:
        """As :class:`Sectors` says."""
        return namespace(place_mm).stack(list(self.pool.table.from_world(self.edge(giver, receiver), place_mm)), -1)

    def edge(self, arm: Array, receiver: Array) -> NDArray[np.int64]:
        """Row of the pool's table of what ``arm`` and ``receiver`` (n, ...) share, or -1."""
        giver, taker = (each.cpu().numpy() if hasattr(each, "cpu") else np.asarray(each) for each in (arm, receiver))
        rows = self.layout.reshape(-1, *[1] * (giver.ndim - 1))
        return np.asarray(self.pool.number[rows, giver, taker])

    def hand_over_arcs(self, like: Array) -> tuple[Array, Array]:
        """As :class:`Sectors` says: (n, ..., num_arms, num_arms, K) for angles ``like`` (n, ..., num_arms, num_arms)."""
        key = ("arcs", *kind_of(like))
        if key not in self._kinds:
            self._kinds[key] = as_kind(self.pool.arcs[:, self.layout], like)
        middle, half = self._kinds[key]
        shape = len(self), *[1] * (like.ndim - 3), *middle.shape[1:]
        return middle.reshape(shape), half.reshape(shape)

    def standing(self, yaw_rad: Array) -> Array:
        """Which arms are there at all: bool (n, ..., num_arms)."""
        there = np.arange(self.num_arms) < self.pool.n_arms[:, None]
        return self._of_rows("standing", there[None].astype(float), yaw_rad)[0] > 0

    @property
    def _has_lateral(self) -> bool:
        return False

    def _constants(self, like: Array) -> Array:
        """As :class:`Sectors` says (10, n, ..., num_arms)."""
        return self._of_rows("facts", self.pool.facts, like)

    def _of_rows(self, name: str, table: Floats, like: Array) -> Array:
        """Rows of a table (k, L, ...), with axes of length 1 between for those that ``like`` has more; made once for each kind."""
        key = (name, *kind_of(like))
        if key not in self._kinds:
            self._kinds[key] = as_kind(table[:, self.layout], like)
        rows = self._kinds[key]
        between = like.ndim - 2
        return rows.reshape(*rows.shape[:2], *[1] * between, *rows.shape[2:]) if between > 0 else rows


def random_layouts(
    config: LayoutConfig | Sequence[LayoutConfig],
    count: int,
    generator: np.random.Generator,
    on_layout: Callable[[int], None] = lambda made: None,
) -> list[Layout]:
    """As :meth:`LayoutPool.random` says."""
    kinds = [config] if isinstance(config, LayoutConfig) else list(config)
    for kind in kinds:
        kind.validate()
    block = BlockConfig()
    layouts: list[Layout] = []
    while len(layouts) < count:
        kind = kinds[int(generator.integers(len(kinds)))] if len(kinds) > 1 else kinds[0]
        layouts.append(random_layout(kind, generator, block))
        on_layout(len(layouts))
    return layouts


def random_layout(config: LayoutConfig, generator: np.random.Generator, block: BlockConfig) -> Layout:
    """Arms (N, 8) and keep-out discs (M, 3) of one connected layout, as :class:`LayoutPool` has them.

    Raises :class:`InvalidSetting` if none is found.
    """
    size = int(generator.integers(config.arms[0], config.arms[1] + 1))  # once: many arms are harder to stand, and as likely
    for _ in range(_TRIES):
        arms = _random_arms(config, size, generator)
        if arms is None or not _is_connected(_edges(arms, np.empty((0, 3)))[0]):
            continue
        count = int(generator.integers(config.obstacles[0], config.obstacles[1] + 1))
        if count == 0:
            return arms, np.empty((0, 3))
        for _ in range(20):
            discs = np.array([_random_disc(arms, config, generator, block) for _ in range(count)])
            if _is_connected(_edges(arms, discs)[0]):
                return arms, discs
    limit = f"such that arms can pass to each other; {_TRIES} layouts were tried"
    raise InvalidSetting("layouts", f"spacing_mm {config.spacing_mm}, yaw_deg {config.yaw_deg}", limit)


def _random_arms(config: LayoutConfig, count: int, generator: np.random.Generator) -> Floats | None:
    """Arms one after the other, each some way from one that stands and turned towards it within its yaws; None if one has no room."""
    arms = np.zeros((count, 8))
    for number in range(count):
        half = math.radians(_drawn(generator, config.yaw_deg))
        arms[number, 3:7] = _drawn(generator, config.r_min_mm), _drawn(generator, config.r_max_mm), -half, half
        if number == 0:
            arms[0, 2] = generator.uniform(-math.pi, math.pi)
            continue
        for _ in range(50):
            beside = arms[int(generator.integers(number))]
            angle, distance = generator.uniform(-math.pi, math.pi), _drawn(generator, config.spacing_mm)
            arms[number, :2] = beside[0] + distance * math.cos(angle), beside[1] + distance * math.sin(angle)
            if np.hypot(*(arms[:number, :2] - arms[number, :2]).T).min() >= config.apart_mm:
                arms[number, 2] = angle + math.pi + generator.uniform(-half, half)
                break
        else:
            return None
    return arms


def _random_disc(arms: Floats, config: LayoutConfig, generator: np.random.Generator, block: BlockConfig) -> tuple[float, float, float]:
    """A disc somewhere in the reach of an arm."""
    x, y, facing, r_min, r_max, low, high, _ = arms[int(generator.integers(len(arms)))]
    radius, angle = generator.uniform(r_min, r_max), facing + generator.uniform(low, high)
    return x + radius * math.cos(angle), y + radius * math.sin(angle), _drawn(generator, config.radius_mm) + block.side_mm / math.sqrt(2)


def _edges(arms: Floats, discs: Floats) -> tuple[NDArray[np.int64], Floats, Floats, list[Floats]]:
    """The edge of each two arms (N, N), and of each edge its geometry, discs and arcs."""
    from marl_handover.cell.angle_arcs import layout_edges  # here: one cell with the paper's chart needs no compiler

    most = len(arms) * (len(arms) - 1) // 2
    number, pairs, there = np.empty((len(arms), len(arms)), np.int64), np.empty((most, 15)), np.empty((most, len(discs), 3))
    arcs, n_arcs = np.empty((most, _MOST_ARCS, 2)), np.zeros(most, np.int64)
    count = layout_edges(arms, discs, number, pairs, there, arcs, n_arcs)
    if count < 0:
        raise InvalidSetting(
            "layouts.obstacles", len(discs), f"so few that two arms have at most {_MOST_ARCS} intervals of hand-over angles"
        )
    return number, pairs[:count], there[:count], [arcs[edge, : n_arcs[edge]] for edge in range(count)]


def _drawn(generator: np.random.Generator, limits: Sequence[float]) -> float:
    return float(generator.uniform(limits[0], limits[1]))


def _is_connected(number: NDArray[np.int64]) -> bool:
    reached = np.zeros(len(number), bool)
    reached[0] = True
    for _ in range(len(number)):
        reached |= (number[reached] >= 0).any(0)
    return bool(reached.all())
