"""The exact planner: the fewest transfers that solve a problem, by interval arithmetic (method section 5).

Along arms b_1 .. b_n, each sharing a space with the next, with hand-overs p_1 .. p_{n-1} in those spaces, the object's turn is a sum of
hand-over angles gamma(p) = psi_i(p) - psi_j(p), counted + from i to j, - from j to i, i < j. On a shared space gamma fills
[gamma_min, 2 pi - gamma_min] and takes every value on the axis y = 0 of its frame, at x = -(d/2) cot(gamma / 2). So the arms b_1 .. b_n
can do it iff the required sum lies within epsilon, modulo the block's symmetry, in a sum of n - 1 intervals. As all intervals are centred
at pi, of all ways from b_1 to b_n with n arms the one with the widest sum can do whatever the others can.
"""

from __future__ import annotations

import math
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from marl_handover.arrays import Array, namespace, one_where
from marl_handover.errors import InvalidSetting
from marl_handover.task.rules import Rules

Walk = tuple[int, ...]
"""Arms in the order in which they move the object."""


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
        walks: the sequences of arms that are looked at, the shortest first.

    Raises:
        NoSharedSpace, InvalidSetting: a shared space of the cell has no chart, or hand-over angles for which the plans are not optimal.
    """

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self._gamma_min_rad: dict[tuple[int, int], float] = {}
        for pair, space in rules.cell.graph.edges.items():
            chart = space.chart
            if chart.base_distance_mm**2 + chart.r_min_mm**2 < chart.r_max_mm**2:
                # Only then is the smallest hand-over angle at the tips of the shared space, on the axis y = 0.
                limit = math.sqrt(chart.r_max_mm**2 - chart.r_min_mm**2)
                raise InvalidSetting("base_distance_mm", chart.base_distance_mm, f"at least {limit:.1f} for the exact planner")
            self._gamma_min_rad[pair] = 2 * math.atan2(chart.base_distance_mm / 2, chart.inset * chart.x_max_mm)
        self.walks: list[Walk] = []
        self._tables: dict[Any, Array] = {}
        self._of_length: list[range] = [range(0)]
        for walks in self._widest_walks(rules.config.max_steps):
            self._of_length.append(range(len(self.walks), len(self.walks) + len(walks)))
            self.walks += walks

    def _widest_walks(self, longest: int) -> list[list[Walk]]:
        """Of 1 .. ``longest`` arms: from each arm to each, the walk with the widest sum of hand-over angles."""
        graph = self.rules.cell.graph
        lengths: list[list[Walk]] = [[(arm,) for arm in range(self.rules.cell.num_arms)]]
        while len(lengths) < longest:
            best: dict[tuple[int, int], Walk] = {}
            for walk in lengths[-1]:
                for arm in graph.neighbours(walk[-1]):
                    longer, ends = (*walk, arm), (walk[0], arm)
                    if ends not in best or self._width_rad(longer) > self._width_rad(best[ends]):
                        best[ends] = longer
            lengths.append(list(best.values()))
        return lengths

    def _width_rad(self, walk: Walk) -> float:
        low, high = self.interval(walk)
        return high - low

    def interval(self, walk: Walk) -> tuple[float, float]:
        """Lowest and highest sum of the signed hand-over angles along a walk, in rad."""
        total_low = total_high = 0.0
        for giver, receiver in pairwise(walk):
            low = self._gamma_min_rad[min(giver, receiver), max(giver, receiver)]
            high = 2 * math.pi - low
            total_low += low if giver < receiver else -high
            total_high += high if giver < receiver else -low
        return total_low, total_high

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
                first, last = self.walks[number][0], self.walks[number][-1]
                needed = turn + psi[..., first] - goal_psi[..., last]
                fraction, error, slack = self._fit(needed, self.walks[number])
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

    def _fit(self, needed_rad: Array, walk: Walk) -> tuple[Array, Array, Array]:
        """Fraction of the interval, orientation error left, and slack in rad (negative outside), each (...)."""
        xp = namespace(needed_rad)
        low, high = self.interval(walk)
        period = 2 * math.pi / self.rules.config.symmetry_order
        centre, half = (low + high) / 2, (high - low) / 2
        # The representative nearest to the interval's centre is the one with the most slack.
        offset = xp.remainder(needed_rad - centre + period / 2, period) - period / 2
        inside = xp.clip(offset, -half, half)
        fraction = (inside + half) / (2 * half) if half > 0 else 0 * offset
        return fraction, inside - offset, half - abs(offset)

    def hand_over_mm(self, plan: Plan, index: int) -> Array:
        """Position (..., 2) in mm of hand-over number ``index`` (0 is the first), on the axis y = 0 of the frame of what two arms share.

        Where a plan has no such hand-over the place means nothing.
        """
        giver, receiver = self._movers(plan, index)
        place = None
        for (i, j), space in self.rules.cell.graph.edges.items():
            there = self._on_axis_mm(space.chart.base_distance_mm, self._gamma_min_rad[i, j], plan.fraction, giver == i)
            there = space.in_world(there)
            asked = ((giver == i) & (receiver == j)) | ((giver == j) & (receiver == i))
            place = there if place is None else one_where(asked, there, place)
        return place

    def _on_axis_mm(self, base_distance_mm: float, gamma_min_rad: float, fraction: Array, upwards: Array) -> Array:
        xp = namespace(fraction)
        width = 2 * (math.pi - gamma_min_rad)
        upward = gamma_min_rad + fraction * width
        gamma = xp.where(upwards, upward, 2 * math.pi - upward)
        x_mm = -(base_distance_mm / 2) / xp.tan(gamma / 2)
        return xp.stack([x_mm, 0 * x_mm], -1)

    def _movers(self, plan: Plan, index: int) -> tuple[Array, Array]:
        """The arm that moves the object ``index`` transfers after the first, and the one after that."""
        numpy = isinstance(plan.walk, (np.ndarray, np.generic))
        key = None if numpy else plan.walk.device
        if key not in self._tables:
            self._tables[key] = self._walk_table if numpy else plan.walk.new_tensor(self._walk_table.tolist())
        table = self._tables[key]
        last = table.shape[1] - 1
        return table[plan.walk, min(index, last)], table[plan.walk, min(index + 1, last)]

    @cached_property
    def _walk_table(self) -> Any:
        """Arms of all walks (walks, max_steps); what comes after a walk's end repeats its last arms, to and fro."""
        longest = max(len(walk) for walk in self.walks)
        rows = []
        for walk in self.walks:
            row = list(walk)
            while len(row) < longest:
                row.append(self.rules.cell.graph.neighbours(row[-1])[0])
            rows.append(row)
        return np.array(rows)

    def act(self, pose: Array, goal: Array, epsilon_rad: float | None = None) -> Array:
        """The optimal next action, for :meth:`~marl_handover.task.rules.Rules.decode`; in closed loop this re-plans at every step."""
        xp, cell = namespace(pose), self.rules.cell
        plan = self.plan(pose, goal, epsilon_rad)
        place_mm = self.hand_over_mm(plan, 0)
        giver, receiver = self._movers(plan, 0)
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
