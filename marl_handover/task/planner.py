"""The exact planner: the fewest transfers that solve a problem, by interval arithmetic (method section 5).

Along arms b_1 .. b_n, each sharing a space with the next, with hand-overs p_1 .. p_{n-1} in those spaces, the object's turn is a sum of
hand-over angles gamma(p) = psi_i(p) - psi_j(p), counted + from i to j, - from j to i, i < j. On a shared space gamma fills one interval or
more, the arcs of its chart. So the arms b_1 .. b_n can do it iff the required sum lies within epsilon, modulo the block's symmetry, in a
sum of n - 1 of these. A way from b_1 to b_n whose sum lies within that of another, modulo the symmetry, need not be looked at: of arms that
stand alike it is always the widest that is left.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from marl_handover.arrays import Array, namespace, one_where
from marl_handover.task.rules import Rules

Walk = tuple[int, ...]
"""Arms in the order in which they move the object."""

_SAME_RAD = 1e-9


class _Way(NamedTuple):
    """A walk, the arc of each hand-over, and the lowest and highest sum of the signed hand-over angles in rad."""

    walk: Walk
    arcs: tuple[int, ...] = ()
    low_rad: float = 0.0
    high_rad: float = 0.0


class Plan(NamedTuple):
    """Optimal plans of a batch.

    Attributes:
        transfers: int (...), fewest transfers, the final one included; 0 where no plan within ``max_steps`` exists.
        first_arm: int (...).
        walk: int (...), index into :attr:`ExactPlanner.walks`: which arms move the object, one after the other.
        fraction: (...), where in each hand-over's interval (0 = its lower end, 1 = its upper end) the plan lies.
        error_rad: (...), orientation error left at the goal.
    """

    transfers: Array
    first_arm: Array
    walk: Array
    fraction: Array
    error_rad: Array


class ExactPlanner:
    """Batched optimal plans.

    Attributes:
        walks: the sequences of arms that are looked at, the shortest first; one may come several times, with other arcs.

    Raises:
        NoSharedSpace, InvalidSetting: a shared space of the cell has no chart, or hand-over angles for which the plans are not optimal.
    """

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self._arcs = {pair: space.chart.arcs for pair, space in rules.cell.graph.edges.items()}
        self._ways: list[_Way] = []
        self._tables: dict[Any, Array] = {}
        self._of_length: list[range] = [range(0)]
        ways = [_Way((arm,)) for arm in range(rules.cell.num_arms)]
        for transfers in range(1, rules.config.max_steps + 1):
            if transfers > 1:
                ways = self._worth_trying(longer for way in ways for longer in self._longer(way))
            self._of_length.append(range(len(self._ways), len(self._ways) + len(ways)))
            self._ways += ways
        self.walks: list[Walk] = [way.walk for way in self._ways]

    def _longer(self, way: _Way) -> Iterator[_Way]:
        """The ways with one more arm."""
        giver = way.walk[-1]
        for receiver in self.rules.cell.graph.neighbours(giver):
            for number, arc in enumerate(self._arcs[min(giver, receiver), max(giver, receiver)]):
                low, high = arc.low_rad, 2 * math.pi - arc.back_low_rad
                least, most = (low, high) if giver < receiver else (-high, -low)
                yield _Way((*way.walk, receiver), (*way.arcs, number), way.low_rad + least, way.high_rad + most)

    def interval(self, walk: Walk) -> tuple[float, float]:
        """Lowest and highest sum of the signed hand-over angles along a walk, in rad, with the first arc of each shared space."""
        way = _Way(walk[:1])
        while len(way.walk) < len(walk):
            way = next(longer for longer in self._longer(way) if longer.walk[-1] == walk[len(way.walk)])
        return way.low_rad, way.high_rad

    def _worth_trying(self, ways: Iterable[_Way]) -> list[_Way]:
        """Those of ``ways`` whose sums do not all lie within those of another one from the same arm to the same."""
        kept: dict[tuple[int, int], list[_Way]] = {}
        for way in ways:
            rivals = kept.setdefault((way.walk[0], way.walk[-1]), [])
            if not any(self._covers(rival, way) for rival in rivals):
                rivals[:] = [*(rival for rival in rivals if not self._covers(way, rival)), way]
        return [way for rivals in kept.values() for way in rivals]

    def _covers(self, wide: _Way, other: _Way) -> bool:
        """Whether all sums of ``other`` are sums of ``wide``, modulo the block's symmetry."""
        period = 2 * math.pi / self.rules.config.symmetry_order
        widths = wide.high_rad - wide.low_rad, other.high_rad - other.low_rad
        apart = (wide.low_rad + wide.high_rad - other.low_rad - other.high_rad) / 2
        return abs(math.remainder(apart, period)) + widths[1] / 2 <= widths[0] / 2 + _SAME_RAD or widths[0] >= period

    def plan(self, pose: Array, goal: Array, epsilon_rad: float | None = None) -> Plan:
        """Optimal plans from ``pose`` to ``goal``, both (..., 3). Among equally short ones, the one with the most slack."""
        xp = namespace(pose)
        epsilon = self.rules.epsilon_rad if epsilon_rad is None else epsilon_rad
        cell = self.rules.cell
        square, yaw = cell.polar(pose)
        goal_square, goal_yaw = cell.polar(goal)
        start_in, goal_in = cell.within(square, yaw), cell.within(goal_square, goal_yaw)
        psi, goal_psi = cell.gripper_yaw(yaw), cell.gripper_yaw(goal_yaw)
        turn = goal[..., 2] - pose[..., 2]
        zero = 0 * turn
        integer = xp.where(start_in[..., 0], 0, 0)
        best = Plan(integer, integer, integer, zero, zero)
        best_slack = zero - math.inf
        for transfers in range(1, self.rules.config.max_steps + 1):
            found = best.transfers > 0
            if bool(found.all()):
                break
            for number in self._of_length[transfers]:
                way = self._ways[number]
                first, last = way.walk[0], way.walk[-1]
                needed = turn + psi[..., first] - goal_psi[..., last]
                fraction, error, slack = self._fit(needed, way)
                allowed = ~found & start_in[..., first] & goal_in[..., last] & (abs(error) <= epsilon) & (slack > best_slack)
                best = Plan(
                    xp.where(allowed, transfers, best.transfers),
                    xp.where(allowed, first, best.first_arm),
                    xp.where(allowed, number, best.walk),
                    xp.where(allowed, fraction, best.fraction),
                    xp.where(allowed, error, best.error_rad),
                )
                best_slack = xp.where(allowed, slack, best_slack)
        return best

    def _fit(self, needed_rad: Array, way: _Way) -> tuple[Array, Array, Array]:
        """Fraction of the interval, orientation error left, and slack in rad (negative outside), each (...)."""
        xp = namespace(needed_rad)
        low, high = way.low_rad, way.high_rad
        period = 2 * math.pi / self.rules.config.symmetry_order
        centre, half = (low + high) / 2, (high - low) / 2
        # The representative nearest to the interval's centre is the one with the most slack.
        offset = xp.remainder(needed_rad - centre + period / 2, period) - period / 2
        inside = xp.clip(offset, -half, half)
        fraction = (inside + half) / (2 * half) if half > 0 else 0 * offset
        return fraction, inside - offset, half - abs(offset)

    def hand_over_mm(self, plan: Plan, index: int) -> Array:
        """Position (..., 2) in mm of hand-over number ``index`` (0 is the first), in the middle of those with the angle that it is to have.

        Where a plan has no such hand-over the place means nothing.
        """
        xp = namespace(plan.fraction)
        giver, receiver, taken = self._movers(plan, index)
        place = None
        for (i, j), space in self.rules.cell.graph.edges.items():
            asked = ((giver == i) & (receiver == j)) | ((giver == j) & (receiver == i))
            for number, arc in enumerate(self._arcs[i, j]):
                lowest = arc.low_rad
                if arc.back_low_rad != lowest:
                    lowest = xp.where(giver == i, arc.low_rad + 0 * plan.fraction, arc.back_low_rad + 0 * plan.fraction)
                upward = lowest + plan.fraction * arc.width_rad
                gamma = xp.where(giver == i, upward, 2 * math.pi - upward)
                there = space.in_world(space.chart.at_angle(gamma))
                place = there if place is None else one_where(asked & (taken == number), there, place)
        return place

    def _movers(self, plan: Plan, index: int) -> tuple[Array, Array, Array]:
        """The arm that moves the object ``index`` transfers after the first, the one after that, and the arc of their hand-over."""
        numpy = isinstance(plan.walk, (np.ndarray, np.generic))
        key = None if numpy else plan.walk.device
        if key not in self._tables:
            self._tables[key] = self._way_table if numpy else plan.walk.new_tensor(self._way_table.tolist())
        arms, arcs = self._tables[key]
        last = arms.shape[1] - 1
        return arms[plan.walk, min(index, last)], arms[plan.walk, min(index + 1, last)], arcs[plan.walk, min(index, last)]

    @cached_property
    def _way_table(self) -> Any:
        """Arms, and arcs taken, of all ways (2, ways, max_steps); what comes after a walk's end repeats its last arms, to and fro."""
        longest = max(len(walk) for walk in self.walks)
        rows = []
        for way in self._ways:
            arms = list(way.walk)
            while len(arms) < longest:
                arms.append(self.rules.cell.graph.neighbours(arms[-1])[0])
            rows.append((arms, [*way.arcs, *[0] * (longest - len(way.arcs))]))
        return np.array(rows).swapaxes(0, 1)

    def act(self, pose: Array, goal: Array, epsilon_rad: float | None = None) -> Array:
        """The optimal next action, for :meth:`~marl_handover.task.rules.Rules.decode`; in closed loop this re-plans at every step."""
        xp, cell = namespace(pose), self.rules.cell
        plan = self.plan(pose, goal, epsilon_rad)
        place_mm = self.hand_over_mm(plan, 0)
        giver, receiver, _ = self._movers(plan, 0)
        one = xp.ones_like(plan.fraction)
        final = xp.where(plan.transfers == 1, one, -one)
        chart = xp.stack([0 * one, 0 * one], -1)
        for (i, j), space in cell.graph.edges.items():
            asked = (plan.transfers > 1) & (((giver == i) & (receiver == j)) | ((giver == j) & (receiver == i)))
            chart = one_where(asked, xp.stack(list(space.from_table(place_mm)), -1), chart)
        if cell.num_arms == 2:
            scores = [xp.where(plan.first_arm == 1, one, -one)]
        else:
            scores = [xp.where(who == arm, one, -one) for who in (giver, receiver) for arm in range(cell.num_arms)]
        return xp.concat([xp.stack([final, *scores], -1), xp.clip(chart, -1.0, 1.0)], -1)
