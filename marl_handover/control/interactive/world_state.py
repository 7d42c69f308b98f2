"""What is there in the interactive cell: the arms' joints, the block, who holds it, and the motion that one arm is carrying out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.geometry.se3 import transform
from marl_handover.motion.pick_place import LIFTED_MM
from marl_handover.motion.trajectory import JointTrajectory

NOBODY = -1


class MotionSegment(NamedTuple):
    """A piece of an arm's program.

    ``kind``: approach, grasp, carry, release or retreat; ``open_from`` and ``open_to``: how far the hand is open, as a share; ``track``:
    None until it is planned, which ``way`` does.
    """

    kind: str
    arm: int
    open_from: float
    open_to: float
    track: JointTrajectory | None
    way: Callable[[], JointTrajectory] | None = None


class WorldState:
    """Arms and block, moved by programs; knows nothing of goals.

    Attributes:
        joints_rad: (num_arms, 5).
        opened: (num_arms,) how far each hand is open, as a share.
        pose: (3,) of the block where it lies or, while it is held, lay last.
        held: whether it is in the hand of ``arm``.
        program: what is under way, piece by piece.
        clock_s: time in its first piece.
    """

    def __init__(self, model: CellModel, homes_rad: Floats, pose: Floats) -> None:
        self.model = model
        self.joints_rad = homes_rad.copy()
        self.opened = np.ones(model.cell.num_arms)
        self.pose = np.array(pose, float)
        self.held = False
        self.program: deque[MotionSegment] = deque()
        self.clock_s = 0.0
        self._T_grip_block = np.eye(4)

    @property
    def arm(self) -> int:
        """The arm that moves; -1 for none."""
        return self.program[0].arm if self.program else NOBODY

    def start(self, segments: Iterable[MotionSegment]) -> None:
        """Carry out ``pieces`` from now on, in the place of what was under way; the first begins where its arm is."""
        self.program, self.clock_s = deque(segments), 0.0

    def relaid(self, model: CellModel, homes_rad: Floats) -> WorldState:
        """The same block among arms that stand as ``model`` has them, in the middle of a program's first piece if its arm has stayed.

        An arm with the same name, robot and base keeps its posture, and what it holds; every other one is at its pose of ``homes_rad``
        (num_arms, 5).
        """
        world = WorldState(model, homes_rad, self.pose)
        known = {arm.name: (arm.base, arm.robot) for arm in self.model.cell.arms}
        for index, arm in enumerate(model.cell.arms):
            if known.get(arm.name) != (arm.base, arm.robot):
                continue
            before = self.model.cell.names.index(arm.name)
            world.joints_rad[index], world.opened[index] = self.joints_rad[before], self.opened[before]
            if before == self.arm:
                world.program.append(self.program[0]._replace(arm=index))
                world.clock_s, world.held, world._T_grip_block = self.clock_s, self.held, self._T_grip_block
        return world

    def step(self, dt_s: float) -> tuple[float, str]:
        """Move for at most ``dt_s``, to the end of a piece at most.

        Returns:
            The time left over, and the kind of piece that ended; "" if none did, also where the next one is not planned yet. A hand does
            not close on the block before it is known where to.
        """
        if not self.ready:
            return dt_s, ""
        segment, track = self.program[0], self.program[0].track
        assert track is not None
        left = track.duration_s - self.clock_s
        self.clock_s = min(self.clock_s + dt_s, track.duration_s)
        share = self.clock_s / track.duration_s
        self.joints_rad[segment.arm] = track.at(self.clock_s)[0]
        self.opened[segment.arm] = segment.open_from + share * (segment.open_to - segment.open_from)
        if dt_s < left:
            return 0.0, ""
        if segment.kind == "grasp":
            self._T_grip_block, self.held = np.linalg.inv(self.grip(segment.arm)) @ lying(self.pose), True
        self.program.popleft()
        self.clock_s = 0.0
        return dt_s - left, segment.kind

    @property
    def ready(self) -> bool:
        """Whether there is something to do that is planned."""
        program = self.program
        return bool(program) and program[0].track is not None and (program[0].kind != "grasp" or program[1].track is not None)

    def put(self, pose: Floats) -> None:
        """The block lies at ``pose`` (3,), in nobody's hand."""
        self.pose, self.held = np.array(pose, float), False

    def T_world_block(self) -> Floats:
        """(4, 4) in mm: the frame in the middle of the block's underside, x along its yaw."""
        return self.grip(self.arm) @ self._T_grip_block if self.held else lying(self.pose)

    def grip(self, arm: int) -> Floats:
        """T_world_grip (4, 4) in mm."""
        return np.asarray(self.model.cell.bases[arm].matrix() @ self.model.arms[arm].fk(self.joints_rad[arm]))

    def phase(self) -> str:
        """Name of what is under way, as in a planned cycle; "" for nothing."""
        if not self.program:
            return ""
        segment = self.program[0]
        if segment.kind != "carry":
            return segment.kind
        if self.grip(self.arm)[2, 3] >= self.model.cell.pick_heights_mm[self.arm] + LIFTED_MM:
            return "transfer"
        return "lift" if segment.track is None or self.clock_s < segment.track.duration_s / 2 else "lower"


def lying(pose: Floats) -> Floats:
    """T_world_block (4, 4) in mm of a block that lies at ``pose`` (3,)."""
    return transform((float(pose[0]), float(pose[1]), 0.0), (0.0, 0.0, float(pose[2])))


def projected(T_world_block: Floats) -> Floats:
    """Pose (3,) of a block seen from above."""
    return np.array([T_world_block[0, 3], T_world_block[1, 3], math.atan2(T_world_block[1, 0], T_world_block[0, 0])])
