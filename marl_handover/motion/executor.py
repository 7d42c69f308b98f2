"""The agent that plays an arm: it turns what the arm is asked for into the control points of a whole cycle, or declines."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell import Cell, CellModel, build_whole_cell, cell_config
from marl_handover.config import CellConfig, MotionConfig, require_choice
from marl_handover.errors import HandoverError, InvalidSetting
from marl_handover.motion.home import parked_poses
from marl_handover.motion.trajectory import NoPath, OutOfArmsReach, PickPlacePaths

if TYPE_CHECKING:
    from marl_handover.motion.planner import MotionPlanner

Floats = NDArray[np.float64]

METHODS = ("optimised", "direct")

DECLINED, OUT_OF_REACH, NO_PATH = range(3)
"""Why an arm declines, as its action's ``reason`` says it: none given, no joints for one of the ends, no collision-free path."""

ROLL_RAD = 0.02
"""The planner starts from wrist roll 0; a measured roll up to this is taken for it."""


def arm_agents(cell: Cell) -> tuple[str, ...]:
    """Names of the arms' agents, by arm index: ``arm_left`` and ``arm_right`` of a mirrored pair."""
    return tuple(f"arm_{name}" for name in cell.names)


class ExecutorAgent:
    """Plays one arm of the AEC environment.

    ``last_refusal`` says why the last call of :meth:`act` declined; None if it did not.

    Args:
        agent: one of :func:`arm_agents`: ``"arm_left"`` or ``"arm_right"`` of a mirrored pair.
        cell: a shipped cell's name, a YAML path, settings, or a cell that is built already.
        method: ``"optimised"``: collision-free shortest paths; ``"direct"``: straight lines in joint space between the ends, which may
            touch anything, for kinematic backends.
        motion: how the arms move; the environment's own has to be the same.
    """

    def __init__(
        self, agent: str, cell: str | CellConfig | CellModel = "paper", method: str = "optimised", motion: MotionConfig | None = None
    ) -> None:
        require_choice("method", method, METHODS)
        self.agent, self.method, self.motion = agent, method, motion or MotionConfig()
        if self.motion.method != "optimised":  # its splines have another number of control points than the action space
            raise InvalidSetting("motion.method", self.motion.method, "optimised for an agent of the AEC environment")
        self.model = cell if isinstance(cell, CellModel) else build_whole_cell(cell_config(cell) if isinstance(cell, str) else cell)
        agents = arm_agents(self.model.cell)
        require_choice("agent", agent, agents)
        self.arm = agents.index(agent)
        self.last_refusal: str | None = None
        self._planner: MotionPlanner | None = None

    def act(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The arm's action: ``paths`` float32 (3, N, 5) in rad; ``grasp`` and ``release``, both 0 where no cycle was found; ``reason``."""
        joints, others = np.asarray(observation["joints"], float), np.asarray(observation["other_joints"], float)
        pick, place = np.asarray(observation["object"], float)[:2], np.asarray(observation["target"], float)
        planner = self._made_planner() if self.method == "optimised" else None
        try:
            paths = self._direct(pick, place, joints) if planner is None else self._optimised(planner, pick, place, joints, others)
            self.last_refusal, reason = None, DECLINED
        except HandoverError as failure:
            self.last_refusal, reason = str(failure), _code(failure)
            paths = PickPlacePaths(*(np.tile(joints, (self.motion.control_points, 1)) for _ in range(3)))
        arm = self.model.arms[self.arm]
        lower, upper = arm.lower_rad.astype(np.float32), arm.upper_rad.astype(np.float32)
        willing = np.int64(self.last_refusal is None)
        points = np.clip(np.stack(paths).astype(np.float32), lower, upper)
        return {"paths": points, "grasp": willing, "release": willing, "reason": np.int64(reason)}

    def _direct(self, pick_mm: Floats, place_mm: Floats, joints_rad: Floats) -> PickPlacePaths:
        from marl_handover.motion.planner import grasp_joints  # here, as below: environments that plan no motion compile nothing

        ends = (
            joints_rad,
            grasp_joints(self.model, self.arm, "pick up", pick_mm),
            grasp_joints(self.model, self.arm, "place", place_mm),
            parked_poses(self.model, self.motion)[self.arm],
        )
        return PickPlacePaths(*(np.linspace(start, end, self.motion.control_points) for start, end in pairwise(ends)))

    def _made_planner(self) -> MotionPlanner:
        if self._planner is None:
            from marl_handover.motion.planner import MotionPlanner  # compiles, or loads what was compiled before

            self._planner = MotionPlanner(self.model, self.motion)
        return self._planner

    def _optimised(
        self, planner: MotionPlanner, pick_mm: Floats, place_mm: Floats, joints_rad: Floats, others_rad: Floats
    ) -> PickPlacePaths:
        joints = joints_rad.copy()
        joints[4] = joints[4] if abs(joints[4]) > ROLL_RAD else 0.0
        return planner.plan_paths(self.arm, pick_mm, place_mm, joints, others_rad.reshape(-1, len(joints))).paths


def _code(failure: HandoverError) -> int:
    return OUT_OF_REACH if isinstance(failure, OutOfArmsReach) else NO_PATH if isinstance(failure, NoPath) else DECLINED
