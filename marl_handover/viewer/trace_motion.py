"""How arms and block move in one transfer of a trace: as recorded, as planned afresh, or, where neither can be had, straight."""

from __future__ import annotations

from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell import CellModel
from marl_handover.config import MotionConfig
from marl_handover.errors import HandoverError
from marl_handover.motion.grasp_ik import grasp_joints
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import LOADED_PHASES
from marl_handover.runtime.interactive.body import lying
from marl_handover.viewer.trace_file import Recorded, Step

Floats = NDArray[np.float64]

STRAIGHT_S = 1.5
_STRAIGHT_SAMPLES = 31
_OPEN_MM = 0.5
"""Fingers that have come together by more than this from their widest in a transfer are closing on the pin."""


class Motion(NamedTuple):
    """A transfer, sampled.

    ``t_s`` (m,) from 0 on; ``joints_rad`` (m, n, 5); ``grip_open`` (m, n); ``T_world_block`` (m, 4, 4) in mm.
    """

    t_s: Floats
    joints_rad: Floats
    grip_open: NDArray[np.bool_]
    T_world_block: Floats

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return float(self.t_s[-1])

    def at(self, t_s: float) -> int:
        """The sample at a time."""
        return int(np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 1))


class Motions:
    """The motions of a trace's steps, made in another thread when they are asked for; the latest are kept.

    Args:
        model: the cell.
        motion: how the arms move.
        kept: how many.
    """

    def __init__(self, model: CellModel, motion: MotionConfig | None = None, kept: int = 32) -> None:
        self.model, self._kept = model, kept
        self.planner = MotionPlanner(model, motion)
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="motions")
        self._made: OrderedDict[int, Future[Motion]] = OrderedDict()

    def close(self) -> None:
        """Make no more."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def ask(self, number: int, step: Step) -> Future[Motion]:
        """The motion of a step, now or soon."""
        future = self._made.get(number)
        if future is None or future.cancelled():
            while len(self._made) >= self._kept:
                self._made.popitem(last=False)[1].cancel()
            future = self._made[number] = self._worker.submit(self._make, step)
        self._made.move_to_end(number)
        return future

    def placed(self, step: Step) -> Floats:
        """Joints (n, 5) of the arms as a transfer ends: the one holds what it has put down, if it has; the others are parked."""
        joints = np.tile(self.planner.home_rad, (self.model.cell.num_arms, 1))
        if not step.trouble:
            with suppress(HandoverError):  # put down beyond what exact arms reach
                joints[step.arm] = grasp_joints(self.model, step.arm, "place", step.next_state[:2])
        return joints

    def _make(self, step: Step) -> Motion:
        with suppress(HandoverError, ArithmeticError, LookupError, ValueError):  # a place that exact arms do not reach, another cell's arms
            if step.recorded is not None:
                return self._as_recorded(step, step.recorded)
            if not step.trouble:
                return self._planned(step)
        return self._straight(step)

    def _planned(self, step: Step) -> Motion:
        parked = self.planner.home_rad
        planned = self.planner.pick_place(step.arm, step.state[:2], step.next_state[:2], parked, parked)
        names = [phase.name for phase in planned.phases for _ in phase.t_s]
        own = np.concatenate([phase.joints_rad for phase in planned.phases])
        held = np.array([name in LOADED_PHASES for name in names])
        opened = np.concatenate([phase.gripper_mm for phase in planned.phases]) > self.planner.motion.finger_travel_mm / 2
        joints = np.tile(parked, (len(own), self.model.cell.num_arms, 1))
        joints[:, step.arm] = own
        grips = np.ones((len(own), self.model.cell.num_arms), bool)
        grips[:, step.arm] = opened
        t_s = np.concatenate([phase.t_s for phase in planned.phases])
        return Motion(t_s - t_s[0], joints, grips, self._carried(step, own, held))

    def _as_recorded(self, step: Step, recorded: Recorded) -> Motion:
        fingers = recorded.gripper_mm
        opened = fingers >= fingers.max(0) - _OPEN_MM
        held = ~opened[:, step.arm] & (not step.trouble)
        return Motion(recorded.t_s, recorded.joints_rad, opened, self._carried(step, recorded.joints_rad[:, step.arm], held))

    def _straight(self, step: Step) -> Motion:
        """The block slides by itself, or stays if nothing came of the transfer."""
        share = np.linspace(0.0, 1.0, _STRAIGHT_SAMPLES)
        turn = np.angle(np.exp(1j * (step.next_state[2] - step.state[2])))
        poses = step.state + share[:, None] * np.array([*(step.next_state[:2] - step.state[:2]), turn])
        joints = np.tile(self.planner.home_rad, (len(share), self.model.cell.num_arms, 1))
        grips = np.ones(joints.shape[:2], bool)
        return Motion(STRAIGHT_S * share, joints, grips, np.stack([lying(pose) for pose in poses]))

    def _carried(self, step: Step, own: Floats, held: NDArray[np.bool_]) -> Floats:
        """T_world_block (m, 4, 4): where it was, then with the hand for as long as that is closed, then where it came to lie."""
        T = np.tile(lying(step.next_state), (len(own), 1, 1))
        inside = np.flatnonzero(held)
        first = int(inside[0]) if len(inside) else len(own)
        T[: min(first, len(own) - 1)] = lying(step.state)
        if len(inside):
            T_world_grip = self.model.cell.bases[step.arm].matrix() @ self.model.arm.fk(own)
            T[held] = T_world_grip[held] @ np.linalg.inv(T_world_grip[first]) @ lying(step.state)
        return T
