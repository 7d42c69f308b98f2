"""The cell as data: its arms, what each can reach, what they share, and the symmetries of all that.

World frame: on the table, +z up; a mirrored pair has its origin midway between the bases, the base line is the y axis. Lengths in mm,
angles in rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import Array, Floats, as_kind, kind_of, namespace, one_where
from marl_handover.cell.arm import PAIR_NAMES, REACH_TOLERANCE_MM, Arm, Disc, lateral_rad
from marl_handover.cell.chart import Chart, PaperChart
from marl_handover.cell.sectors import Sectors, sector_limits
from marl_handover.cell.shared_space import HandoverGraph, SharedSpace
from marl_handover.cell.symmetry import ARM_LETTERS, NO_ARM, Symmetry, View, pair_views, symmetries
from marl_handover.config import CellConfig, require_choice
from marl_handover.errors import BlockedPlace, InvalidSetting, OutOfReach, TwoArmsOnly, UnconnectedArms, UnequalArms
from marl_handover.geometry.se2 import SE2


@dataclass(frozen=True)
class Cell(Sectors):
    """Continuous model of the cell: an annulus sector an arm, and what they have in common.

    Attributes:
        arms: in the order of the arm indices.
        config: the settings the cell was built from.

    Raises:
        NoSharedSpace: the two arms of a pair have no chart in common.
        UnconnectedArms: there are arms that cannot pass anything to the others, however long the way; not where arms are out of order.
    """

    arms: tuple[Arm, ...]
    config: CellConfig

    def __post_init__(self) -> None:
        if self.config.enabled is not None:
            return  # that arms are out of order is nobody's mistake: what is left may be one arm, or arms that share nothing
        if self.num_arms != 2 and self.config.chart == "paper":
            raise InvalidSetting("cell.chart", "paper", f"'angle' or null for {self.num_arms} arms: the paper's chart is for two")
        if self.num_arms == 2:
            _ = self.chart
        elif not self.graph.is_connected:
            raise UnconnectedArms([[self.names[arm] for arm in group] for group in self.graph.components], bool(self.keep_out))

    @property
    def num_arms(self) -> int:
        """Number of arms."""
        return len(self.arms)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The arms' names."""
        return tuple(arm.name for arm in self.arms)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """What traces and pictures call the arms: L and R in a mirrored pair, else by name."""
        return self.names if self.config.arms else tuple(ARM_LETTERS[PAIR_NAMES.index(name)] for name in self.names)

    @cached_property
    def bases(self) -> tuple[SE2, ...]:
        """The arms' base frames."""
        return tuple(arm.base for arm in self.arms)

    @cached_property
    def base_distance_mm(self) -> float:
        """How far apart the bases of a pair stand."""
        return self.shared.base_distance_mm

    @property
    def r_min_mm(self) -> float:
        """The inner radius, where all arms have the same; else raises :class:`UnequalArms`, as the next two do."""
        return float(self._common("r_min_mm"))

    @property
    def r_max_mm(self) -> float:
        """The outer radius that all arms have."""
        return float(self._common("r_max_mm"))

    @property
    def yaw_rad(self) -> tuple[float, float]:
        """The base yaw (lower, upper) that all arms have."""
        low, high = self._common("yaw_rad")
        return low, high

    @cached_property
    def pick_heights_mm(self) -> tuple[float, ...]:
        """How high over the table each arm's grip is where it picks and places: what the cell says, or the arm's own."""
        asked = self.config.pick_height_mm
        return tuple(float(arm.pick_height_mm if asked is None else asked) for arm in self.arms)

    @property
    def pick_height_mm(self) -> float:
        """The pick height that all arms have; else raises :class:`UnequalArms`."""
        if len(set(self.pick_heights_mm)) > 1:
            raise UnequalArms("pick_height_mm", dict(zip(self.names, self.pick_heights_mm, strict=True)))
        return self.pick_heights_mm[0]

    @cached_property
    def extent_mm(self) -> tuple[float, float]:
        """How far from the origin, along x and along y, any arm reaches at most."""
        along_x = max(abs(arm.base.x_mm) + arm.r_max_mm for arm in self.arms)
        return along_x, max(abs(arm.base.y_mm) + arm.r_max_mm for arm in self.arms)

    @cached_property
    def graph(self) -> HandoverGraph:
        """Who can pass to whom."""
        pairs = [(i, j) for i in range(self.num_arms) for j in range(i + 1, self.num_arms)]
        charted = self.config.chart if self.num_arms == 2 else "angle"
        rest = self.config.chart_inset, charted, self.keep_out
        spaces = {(i, j): SharedSpace(self.arms[i], self.arms[j], *rest) for i, j in pairs}
        # What two arms share has to be something, or there is no pair; its chart says why it is nothing.
        needed = self.num_arms == 2 and self.config.enabled is None
        return HandoverGraph(self.names, {pair: space for pair, space in spaces.items() if needed or not space.is_empty})

    @cached_property
    def keep_out(self) -> tuple[Disc, ...]:
        """Where the centre of the block may not be put: every obstacle, and half the block's diagonal around it."""
        margin_mm = self.config.block.side_mm / math.sqrt(2)
        return tuple(Disc(each.x_mm, each.y_mm, each.radius_mm + margin_mm) for each in self.config.obstacles)

    def hand_over_arcs(self, like: Array) -> tuple[Array, Array]:
        """As :class:`Sectors` says; made once for each kind."""
        key = ("arcs", *kind_of(like))
        if key not in self._kinds:
            self._kinds[key] = as_kind(self._arc_table, like)
        middle, half = self._kinds[key]
        return middle, half

    @cached_property
    def _arc_table(self) -> Floats:
        found = {pair: space.chart.arcs for pair, space in self.graph.edges.items()}
        table = np.zeros((2, self.num_arms, self.num_arms, max((len(arcs) for arcs in found.values()), default=1)))
        table[1] = -1.0
        for (i, j), arcs in found.items():
            for number, arc in enumerate(arcs):
                middle = arc.low_rad + arc.width_rad / 2
                table[:, i, j, number], table[:, j, i, number] = (middle, arc.width_rad / 2), (-middle, arc.width_rad / 2)
        return table

    @cached_property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """The isometries that take the cell onto itself, the identity first."""
        return symmetries(self.arms, self.graph.edges, self.keep_out)

    @cached_property
    def chart(self) -> Chart:
        """The chart of what the two arms of a pair share; in any other cell, where each pair has its own, raises :class:`TwoArmsOnly`."""
        return self.shared.chart

    @cached_property
    def shared(self) -> SharedSpace:
        """What the two arms of a pair share. Raises :class:`TwoArmsOnly` in any other cell, :class:`UnconnectedArms` if it is nothing."""
        self.require_pair("the one chart of a cell")
        if not self.graph.edges:
            raise UnconnectedArms([[name] for name in self.names], bool(self.keep_out))
        return self.graph.edges[(0, 1)]

    @property
    def chart_name(self) -> str:
        """As the base class; a pair that has the paper's chart says so."""
        return "paper" if self.num_arms == 2 and isinstance(self.chart, PaperChart) else "angle"

    def paper_chart(self, what: str) -> PaperChart:
        """The chart of a pair, which ``what`` needs to be the paper's. Raises :class:`InvalidSetting` if it is another one."""
        if not isinstance(self.chart, PaperChart):
            limit = f"'paper', which takes two arms with the same ring, for {what}"
            raise InvalidSetting("cell.chart", "angle", limit)
        return self.chart

    @cached_property
    def views(self) -> tuple[View, View]:
        """How each of two arms sees the shared space's frame; in any other cell raises :class:`TwoArmsOnly`."""
        self.require_pair("an arm's own view")
        return pair_views(self.symmetries)

    @cached_property
    def is_foldable(self) -> bool:
        """Whether to turn a block the other way round is the mirrored problem for either arm of a pair, positions apart.

        So it is if the hand-over angles fill a single interval, of which each arm is shown the middle as pi; else if the cell is its own
        mirror image along the base line.
        """
        return self.chart.skew_rad is not None or any(element.reflects and not element.swaps for element in self.symmetries)

    def place_mm(self, arm: Array, receiver: Array, alpha: Array, beta: Array) -> Array:
        """World position (..., 2) in mm of chart coordinates in what ``arm`` and ``receiver`` (...) share; NaN where they share nothing."""
        if self.num_arms == 2 and self.graph.edges:
            apart = arm != receiver
            return one_where(apart, self.shared.to_table(alpha, beta), math.nan * namespace(alpha).stack([alpha, beta], -1))
        return self.graph.table.to_world(self.edge(arm, receiver), alpha, beta)

    def at_angle(self, giver: Array, receiver: Array, angle_rad: Array) -> Array:
        """As :class:`Sectors` says."""
        upward = namespace(angle_rad).where(giver < receiver, angle_rad, -angle_rad)
        if self.num_arms == 2 and self.graph.edges:
            return self.shared.in_world(self.chart.at_angle(upward))
        return self.graph.table.at_angle(self.edge(giver, receiver), upward)

    def coordinates(self, giver: Array, receiver: Array, place_mm: Array) -> Array:
        """As :class:`Sectors` says."""
        if self.num_arms == 2 and self.graph.edges:
            return namespace(place_mm).stack(list(self.shared.from_table(place_mm)), -1)
        return namespace(place_mm).stack(list(self.graph.table.from_world(self.edge(giver, receiver), place_mm)), -1)

    def edge(self, arm: Array, receiver: Array) -> Array:
        """Row of the graph's table of what ``arm`` and ``receiver`` (...) share, or -1; a pair has a chart of its own instead."""
        number: Array = self.graph.number
        if isinstance(arm, (np.ndarray, np.generic)):
            return number[arm, receiver]
        return number[arm.cpu().numpy(), receiver.cpu().numpy()]

    def require_pair(self, what: str, instead: str = "") -> None:
        """Raise :class:`TwoArmsOnly` unless the cell has two arms; ``what`` needs them. ``instead`` says what more arms can have."""
        if self.num_arms != 2:
            raise TwoArmsOnly(what, self.names, instead if self.num_arms > 2 else "")

    def require_grip(self, finger_travel_mm: float) -> None:
        """Raise :class:`InvalidSetting` if hands that open so far cannot close on the pin; for whatever carries the block."""
        block = self.config.block
        low, high = block.height_mm, block.pin_top_mm
        for height in self.pick_heights_mm:
            if not low < height < high:
                limit = f"between cell.block.height_mm = {low:g} and cell.block.pin_top_mm = {high:g}: the hand closes on the pin"
                raise InvalidSetting("cell.pick_height_mm", height, limit)
        if block.pin_diameter_mm >= 2 * finger_travel_mm:
            limit = f"above {block.pin_diameter_mm / 2:g}, half of cell.block.pin_diameter_mm: fingers have to pass the pin"
            raise InvalidSetting("motion.finger_travel_mm", finger_travel_mm, limit)

    def with_arms(self, names: Sequence[str]) -> Cell:
        """The cell while only the arms ``names`` are in order: the graph without the others. All of them: the cell itself.

        They keep their order, their places and what any two share. They may be a single arm, and need not be able to pass to each other.
        They are counted anew: :meth:`numbered`.

        Raises:
            UnknownChoice, InvalidSetting: no arm has a name, one comes twice, or there is none.
        """
        for number, name in enumerate(names):
            require_choice("cell.enabled", name, self.names)
            if name in names[:number]:
                raise InvalidSetting("cell.enabled", list(names), f"arms that are in order, each once; {name!r} comes twice")
        if not names:
            raise InvalidSetting("cell.enabled", [], f"at least one of: {', '.join(self.names)}")
        left = tuple(arm for arm in self.arms if arm.name in names)
        if len(left) == self.num_arms:
            return self
        return replace(self, arms=left, config=replace(self.config, enabled=[arm.name for arm in left]))

    def numbered(self, arm: ArrayLike, cell: Cell) -> NDArray[np.int64]:
        """Indices (...) here of the arms that have the indices ``arm`` (...) in ``cell``, which has other arms of the same cell in order.

        NO_ARM stays, and is what one that is out of order here becomes.
        """
        here = [self.names.index(name) if name in self.names else NO_ARM for name in cell.names]
        return np.array([*here, NO_ARM])[np.asarray(arm)]

    def with_inset(self, chart_inset: float) -> Cell:
        """The same cell with another part of the chart in use."""
        if chart_inset == self.config.chart_inset:
            return self
        return replace(self, config=replace(self.config, chart_inset=chart_inset))

    def is_clear(self, position_mm: Array) -> Array:
        """Whether an object may stand at positions (..., >= 2), whoever puts it there: bool (...)."""
        clear = position_mm[..., 0] == position_mm[..., 0]
        for disc in self.keep_out:
            dx, dy = position_mm[..., 0] - disc.x_mm, position_mm[..., 1] - disc.y_mm
            clear &= dx * dx + dy * dy >= max(disc.radius_mm - REACH_TOLERANCE_MM, 0.0) ** 2
        return clear

    def require_reached(self, what: str, pose: Array) -> None:
        """Raise :class:`OutOfReach`, or :class:`BlockedPlace`, unless an arm can put the pose ``what``, (2,) or (3,) in mm and rad."""
        with np.errstate(over="ignore"):  # of absurd coordinates; infinitely far is out of reach too
            reached = bool(self.reaches(np.asarray(pose, float)).any())
        if not reached:
            place = float(pose[0]), float(pose[1])
            for disc in self.keep_out:
                if math.dist(place, disc[:2]) < disc.radius_mm - REACH_TOLERANCE_MM:
                    raise BlockedPlace(what, place, disc)
            raise OutOfReach(what, place, {arm.name: (arm.r_min_mm, arm.r_max_mm) for arm in self.arms})

    def clamp_to_workspace(self, pose: Array, slack_mm: float) -> Array:
        """``pose`` (3,) as a supervisor is to see it.

        One up to ``slack_mm`` outside every arm's sector, as placement noise may leave it, is shown at the nearest place inside, so that
        the rule book lets an arm take it; the arm still goes for where it was measured, if its joints allow. Every other one is shown
        where it is, also farther out: no arm can reach it.
        """
        square, yaw = self.polar(pose)
        if self.within(square, yaw).any():
            return pose
        sectors = [(arm.r_min_mm, arm.r_max_mm, *arm.yaw_rad, arm.lateral_mm) for arm in self.arms]
        r_min, r_max, low, high, lateral = np.array(sectors).T
        radius = np.clip(np.sqrt(square), r_min, r_max)
        angle = self.gripper_yaw(np.clip(yaw, low, high) + lateral_rad(lateral, radius))
        bases = np.array([base.position_mm for base in self.bases])
        places = bases + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        away = np.hypot(*(places - pose[:2]).T)
        nearest = int(away.argmin())
        return np.array([*places[nearest], pose[2]]) if away[nearest] <= slack_mm else pose

    def _common(self, name: str) -> Any:
        values = [getattr(arm, name) for arm in self.arms]
        if any(value != values[0] for value in values):
            raise UnequalArms(name, dict(zip(self.names, values, strict=True)))
        return values[0]

    def _constants(self, like: Array) -> Array:
        """As :class:`Sectors` says; made once for each kind."""
        key = kind_of(like)
        if key not in self._kinds:
            self._kinds[key] = as_kind(np.array([_facts(arm) for arm in self.arms], np.float64).T, like)
        return self._kinds[key]

    @cached_property
    def _sector(self) -> tuple[float, float, float, float] | None:
        """The limits of every arm's sector, if they are the same: comparing with numbers is quicker than with rows of them."""
        sectors = {sector_limits(arm.r_min_mm, arm.r_max_mm, *arm.yaw_rad) for arm in self.arms}
        return sectors.pop() if len(sectors) == 1 else None

    @cached_property
    def _has_lateral(self) -> bool:
        return any(arm.lateral_mm for arm in self.arms)

    @cached_property
    def _kinds(self) -> dict[Any, Any]:
        return {}


def _facts(arm: Arm) -> list[float]:
    base = arm.base
    limits = sector_limits(arm.r_min_mm, arm.r_max_mm, *arm.yaw_rad)
    return [base.x_mm, base.y_mm, *base.facing, base.facing_rad, *limits, arm.lateral_mm]
