"""The exact planner: the fewest transfers that solve a problem, by interval arithmetic (method section 5).

Along arms b_1 .. b_n, each sharing a space with the next, with hand-overs p_1 .. p_{n-1} in those spaces, the object's turn is a sum of
hand-over angles gamma(p) = psi_i(p) - psi_j(p), counted + from i to j, - from j to i, i < j. On a shared space gamma fills one interval or
more, the arcs of its chart. So the arms b_1 .. b_n can do it iff the required sum lies within epsilon, modulo the block's symmetry, in a
sum of n - 1 of these. What can be reached in n transfers from one arm to another is a union of such intervals, which depends on the cell
only and is computed once; of ways whose sums others have too, only what adds something is kept.
"""

from __future__ import annotations

import math
from functools import cache, cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Array, as_kind, namespace, one_where
from marl_handover.cell.batch import CellBatch
from marl_handover.errors import BlockedPlace, OutOfReach, counted
from marl_handover.progress import working
from marl_handover.task.plan_kernels import all_ways, shortest
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
        rules: the rule book.

    Raises:
        NoSharedSpace, InvalidSetting: a shared space of the cell has no chart, or hand-over angles for which the plans are not optimal.
    """

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self._period = 2 * math.pi / rules.config.symmetry_order
        self._arcs = {pair: space.chart.arcs for pair, space in rules.cell.graph.edges.items()}
        self._tables: dict[Any, Array] = {}

    @cached_property
    def _found(self) -> tuple[Any, Any]:
        """What :func:`all_ways` finds, and the receiver and the arc of each hop."""
        hops = []
        for (i, j), arcs in self._arcs.items():
            for number, arc in enumerate(arcs):
                low, high = arc.low_rad, 2 * math.pi - arc.back_low_rad
                hops += [(i, j, number, low, high), (j, i, number, -high, -low)]
        hops.sort(key=lambda hop: hop[:3])
        columns = zip(*hops, strict=True) if hops else ((),) * 5
        start, end, arc_number, least, most = (np.array(column, float if number > 2 else int) for number, column in enumerate(columns))
        _compile()
        rules, period = self.rules, self._period
        found = all_ways(rules.cell.num_arms, start, end, least, most, rules.config.max_steps, period)
        return found, (end, arc_number)

    @cached_property
    def walks(self) -> list[Walk]:
        """The sequences of arms that are looked at, the shortest first; one may come several times, with other arcs."""
        return [way[0] for way in self._ways]

    @cached_property
    def _ways(self) -> list[tuple[Walk, tuple[int, ...]]]:
        """Arms, and the arc of each hand-over, of all ways."""
        found: list[tuple[Walk, tuple[int, ...]]] = []
        (parents, hops, *_), (end, arc_number) = self._found
        for parent, hop in zip(parents.tolist(), hops.tolist(), strict=True):
            if parent < 0:
                found.append(((len(found),), ()))
            else:
                walk, arcs = found[parent]
                found.append(((*walk, int(end[hop])), (*arcs, int(arc_number[hop]))))
        return found

    def interval(self, walk: Walk) -> tuple[float, float]:
        """Lowest and highest sum of the signed hand-over angles along a walk, in rad, with the first arc of each shared space."""
        low = high = 0.0
        for giver, receiver in pairwise(walk):
            arc = self._arcs[min(giver, receiver), max(giver, receiver)][0]
            least, most = arc.low_rad, 2 * math.pi - arc.back_low_rad
            low, high = (low + least, high + most) if giver < receiver else (low - most, high - least)
        return low, high

    def plan(self, pose: Array, goal: Array, epsilon_rad: float | None = None) -> Plan:
        """Optimal plans from ``pose`` to ``goal``, both (..., 3). Among equally short ones, the one with the most slack."""
        epsilon = self.rules.epsilon_rad if epsilon_rad is None else epsilon_rad
        cell = self.rules.cell
        start_in, yaw = cell.seen(pose)
        goal_in, goal_yaw = cell.seen(goal)
        turn = goal[..., 2] - pose[..., 2]
        shape, count = tuple(turn.shape), cell.num_arms
        out, fit = np.empty((*shape, 3), np.int64), np.empty((*shape, 2))
        starts, goals = (_numpy(each, bool).reshape(-1, count) for each in (start_in, goal_in))
        psi, goal_psi = (_numpy(cell.gripper_yaw(each), float).reshape(-1, count) for each in (yaw, goal_yaw))
        turns = _numpy(turn, float).reshape(-1)
        epsilons = np.broadcast_to(_numpy(epsilon, float).reshape(shape if np.ndim(epsilon) else ()), shape).reshape(-1).copy()
        _, _, low, high, start = self._found[0]
        ways = low, high, start, self._period
        shortest(starts, goals, psi, goal_psi, turns, epsilons, *ways, out.reshape(-1, 3), fit.reshape(-1, 2))
        if isinstance(pose, (np.ndarray, np.generic)):
            return Plan(out[..., 0], out[..., 1], out[..., 2], *fit.astype(pose.dtype, copy=False).transpose(-1, *range(len(shape))))
        xp = namespace(pose)
        whole, parts = xp.from_numpy(out).to(pose.device), xp.from_numpy(fit).to(pose.device, pose.dtype)
        return Plan(whole[..., 0], whole[..., 1], whole[..., 2], parts[..., 0], parts[..., 1])

    def unsolvable_because(self, pose: Array, goal: Array, epsilon_rad: float | None = None) -> str:
        """Why there is no plan from ``pose`` to ``goal``, each (3,); empty if there is one."""
        for what, where in (("start", pose), ("goal", goal)):
            try:
                self.rules.cell.require_reached(what, where)
            except (BlockedPlace, OutOfReach) as error:
                return str(error)
        if int(self.plan(pose, goal, epsilon_rad).transfers):
            return ""
        cell = self.rules.cell
        ends = [np.flatnonzero(cell.reaches(np.asarray(where, float))) for where in (pose, goal)]
        if not any(set(group) & set(ends[0]) and set(group) & set(ends[1]) for group in cell.graph.components):
            start_arms, goal_arms = (", ".join(cell.names[arm] for arm in end) for end in ends)
            return f"of the arms that reach the start ({start_arms}) none can pass to one that reaches the goal ({goal_arms})"
        epsilon_deg = math.degrees(self.rules.epsilon_rad if epsilon_rad is None else epsilon_rad)
        turn_deg = math.degrees(float(goal[2]) - float(pose[2]))
        most = self.rules.config.max_steps
        return f"no sequence of up to {counted(most, 'transfer')} turns the object by {turn_deg:.4g} deg to within {epsilon_deg:g} deg"

    def hand_over_mm(self, plan: Plan, index: int) -> Array:
        """Position (..., 2) in mm of hand-over number ``index`` (0 is the first), in the middle of those with the angle that it is to have.

        Where a plan has no such hand-over the place means nothing.
        """
        xp, cell = namespace(plan.fraction), self.rules.cell
        giver, receiver, taken = self._movers(plan, index)
        edge, lows, back_lows, widths = self._arc_table(plan.fraction)
        if not self._arcs:
            return math.nan * xp.stack([plan.fraction, plan.fraction], -1)
        number = edge[giver, receiver]
        upward = xp.where(giver < receiver, lows[number, taken], back_lows[number, taken]) + plan.fraction * widths[number, taken]
        return cell.at_angle(giver, receiver, xp.where(giver < receiver, upward, upward - 2 * math.pi))

    def _movers(self, plan: Plan, index: int) -> tuple[Array, Array, Array]:
        """The arm that moves the object ``index`` transfers after the first, the one after that, and the arc of their hand-over."""
        arms, arcs = self._as_kind("ways", self._way_table, plan.walk)
        last = arms.shape[1] - 1
        return arms[plan.walk, min(index, last)], arms[plan.walk, min(index + 1, last)], arcs[plan.walk, min(index, last)]

    def _arc_table(self, like: Array) -> Any:
        """Row of the edge of two arms, and lowest angles there and back and widths of its arcs, (num_arms, num_arms) and (edges, arcs)."""
        most = max((len(arcs) for arcs in self._arcs.values()), default=1)
        rows = np.zeros((3, len(self._arcs), most))
        for number, arcs in enumerate(self._arcs.values()):
            for arc, each in enumerate(arcs):
                rows[:, number, arc] = each.low_rad, each.back_low_rad, each.width_rad
        lows, back_lows, widths = as_kind(rows, like)
        return self._as_kind("edge", self.rules.cell.graph.number, like), lows, back_lows, widths

    def _as_kind(self, name: str, table: Any, like: Array) -> Any:
        """A table of whole numbers as numpy, or as torch on the device of ``like``; made once."""
        if isinstance(like, (np.ndarray, np.generic)):
            return table
        key = (name, like.device)
        if key not in self._tables:
            self._tables[key] = namespace(like).as_tensor(table, device=like.device)
        return self._tables[key]

    @cached_property
    def _way_table(self) -> Any:
        """Arms, and arcs taken, of all ways (2, ways, max_steps); what comes after a walk's end repeats its last arms, to and fro."""
        longest = max(len(walk) for walk in self.walks)
        table = np.zeros((2, len(self._ways), longest), np.int64)
        graph = self.rules.cell.graph
        onward = [next(iter(graph.neighbours(arm)), arm) for arm in range(len(graph.names))]
        for row, (walk, arcs) in enumerate(self._ways):
            arms = list(walk)
            while len(arms) < longest:
                arms.append(onward[arms[-1]])
            table[0, row], table[1, row, : len(arcs)] = arms, arcs
        return table

    def act(self, pose: Array, goal: Array, epsilon_rad: float | None = None) -> Array:
        """The optimal next action, for :meth:`~marl_handover.task.rules.Rules.decode`; in closed loop this re-plans at every step."""
        xp, cell = namespace(pose), self.rules.cell
        plan = self.plan(pose, goal, epsilon_rad)
        place_mm = self.hand_over_mm(plan, 0)
        giver, receiver, _ = self._movers(plan, 0)
        one = xp.ones_like(plan.fraction)
        final = xp.where(plan.transfers == 1, one, -one)
        passed = cell.coordinates(giver, receiver, place_mm) if self._arcs else place_mm
        chart = one_where(plan.transfers > 1, passed, xp.zeros_like(passed))
        if cell.num_arms == 2:
            scores = [xp.where(plan.first_arm == 1, one, -one)]
        else:
            scores = [xp.where(who == arm, one, -one) for who in (giver, receiver) for arm in range(cell.num_arms)]
        return xp.concat([xp.stack([final, *scores], -1), xp.clip(chart, -1.0, 1.0)], -1)


def optimal_transfers(rules: Rules, pose: Array, goal: Array) -> NDArray[np.int64]:
    """The fewest transfers (n,) from each pose to each goal (n, 3), 0 where no plan exists; of a batch of cells, each in its own."""
    if not isinstance(rules.cell, CellBatch):
        return np.asarray(ExactPlanner(rules).plan(pose, goal).transfers)
    found = np.zeros(len(pose), np.int64)
    for layout in np.unique(rules.cell.layout):
        rows = rules.cell.layout == layout
        found[rows] = np.asarray(ExactPlanner(rules.on(rules.cell.pool.cell(int(layout)))).plan(pose[rows], goal[rows]).transfers)
    return found


@cache
def _compile() -> None:
    """Call what is compiled on first use; where that takes long, say so on stderr."""
    with working("compiling the planner; once, it is cached"):
        ends, angles = np.array([1, 0]), np.array([2.0, -4.0])
        *_, low, high, start = all_ways(2, ends[::-1].copy(), ends, angles, angles + 2.0, 2, 2 * math.pi)
        reached, yaw, turn = np.ones((1, 2), bool), np.zeros((1, 2)), np.zeros(1)
        shortest(reached, reached, yaw, yaw, turn, turn, low, high, start, 2 * math.pi, np.empty((1, 3), np.int64), np.empty((1, 2)))


def _numpy(values: Any, dtype: type) -> Any:
    array = values.detach().cpu().numpy() if hasattr(values, "detach") else np.asarray(values)
    return np.ascontiguousarray(array, dtype)
