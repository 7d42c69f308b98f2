"""The exact planner: the fewest transfers that solve a problem, by interval arithmetic (method section 5).

Along alternating arms b_1 .. b_n with hand-overs p_1 .. p_{n-1} in the shared space, the object's turn is a sum of hand-over angles
gamma(p) = psi_L(p) - psi_R(p), with + for L -> R and - for R -> L. On the shared space gamma fills [gamma_min, 2 pi - gamma_min] and
takes every value on the axis y = 0, at x = -(d/2) cot(gamma / 2). So n transfers suffice iff the required sum lies within
epsilon, modulo the block's symmetry, in a sum of n - 1 intervals.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from marl_handover.arrays import Array, namespace, one_where
from marl_handover.cell.symmetry import LEFT, RIGHT
from marl_handover.errors import InvalidSetting
from marl_handover.task.rules import Rules


class Plan(NamedTuple):
    """Optimal plans of a batch.

    Attributes:
        transfers: int (...), fewest transfers, the final one included; 0 where no plan within ``max_steps`` exists.
        first_arm: int (...).
        fraction: (...), where in each hand-over's interval (0 = its lower end, 1 = its upper end) the plan lies.
        error_rad: (...), orientation error left at the goal.
    """

    transfers: Array
    first_arm: Array
    fraction: Array
    error_rad: Array


class ExactPlanner:
    """Batched optimal plans for a mirrored pair of arms."""

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        cell = rules.cell
        chart = cell.chart
        if chart.base_distance_mm**2 + cell.r_min_mm**2 < cell.r_max_mm**2:
            # Only then is the smallest hand-over angle at the tips of the shared space, on the axis y = 0.
            limit = math.sqrt(cell.r_max_mm**2 - cell.r_min_mm**2)
            raise InvalidSetting("base_distance_mm", chart.base_distance_mm, f"at least {limit:.1f} for the exact planner")
        self.gamma_min_rad = 2 * math.atan2(chart.base_distance_mm / 2, chart.inset * chart.x_max_mm)

    def interval(self, transfers: int, first_arm: int) -> tuple[float, float]:
        """Lowest and highest sum of the ``transfers`` - 1 signed hand-over angles, in rad."""
        low, high = self.gamma_min_rad, 2 * math.pi - self.gamma_min_rad
        total_low = total_high = 0.0
        for hand_over in range(transfers - 1):
            from_left = (first_arm + hand_over) % 2 == LEFT
            total_low += low if from_left else -high
            total_high += high if from_left else -low
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
        best = Plan(integer, integer, zero, zero)
        best_slack = zero - math.inf
        for transfers in range(1, self.rules.config.max_steps + 1):
            found = best.transfers > 0
            if bool(found.all()):
                break
            for first in (LEFT, RIGHT):
                last = (first + transfers - 1) % 2
                needed = turn + psi[..., first] - goal_psi[..., last]
                fraction, error, slack = self._fit(needed, transfers, first)
                allowed = ~found & start_in[..., first] & goal_in[..., last] & (abs(error) <= epsilon) & (slack > best_slack)
                best = Plan(
                    xp.where(allowed, transfers, best.transfers),
                    xp.where(allowed, first, best.first_arm),
                    xp.where(allowed, fraction, best.fraction),
                    xp.where(allowed, error, best.error_rad),
                )
                best_slack = xp.where(allowed, slack, best_slack)
        return best

    def _fit(self, needed_rad: Array, transfers: int, first: int) -> tuple[Array, Array, Array]:
        """Fraction of the interval, orientation error left, and slack in rad (negative outside), each (...)."""
        xp = namespace(needed_rad)
        low, high = self.interval(transfers, first)
        period = 2 * math.pi / self.rules.config.symmetry_order
        centre, half = (low + high) / 2, (high - low) / 2
        # The representative nearest to the interval's centre is the one with the most slack.
        offset = xp.remainder(needed_rad - centre + period / 2, period) - period / 2
        inside = xp.clip(offset, -half, half)
        fraction = (inside + half) / (2 * half) if half > 0 else 0 * offset
        return fraction, inside - offset, half - abs(offset)

    def hand_over_mm(self, plan: Plan, index: int) -> Array:
        """Position (..., 2) in mm of hand-over number ``index`` (0 is the first), on the axis y = 0."""
        xp = namespace(plan.fraction)
        width = 2 * (math.pi - self.gamma_min_rad)
        from_left = (plan.first_arm + index) % 2 == LEFT
        upward = self.gamma_min_rad + plan.fraction * width
        gamma = xp.where(from_left, upward, 2 * math.pi - upward)
        x_mm = -(self.rules.cell.chart.base_distance_mm / 2) / xp.tan(gamma / 2)
        return xp.stack([x_mm, 0 * x_mm], -1)

    def act(self, pose: Array, goal: Array, epsilon_rad: float | None = None) -> Array:
        """The optimal next action (..., 4); in closed loop this re-plans at every step."""
        xp = namespace(pose)
        plan = self.plan(pose, goal, epsilon_rad)
        alpha, beta = self.rules.cell.chart.from_table(self.hand_over_mm(plan, 0))
        one = xp.ones_like(alpha)
        final = xp.where(plan.transfers == 1, one, -one)
        arm = xp.where(plan.first_arm == RIGHT, one, -one)
        single = plan.transfers <= 1
        place = one_where(single, xp.stack([0 * one, 0 * one], -1), xp.stack([alpha, beta], -1))
        return xp.concat([xp.stack([final, arm], -1), xp.clip(place, -1.0, 1.0)], -1)
