"""The simulated cell as a backend of the environments: it carries out cycles, and says what came of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.envs.backends import Execution
from marl_handover.envs.cycle_check import CycleCheck, Refusal, welded
from marl_handover.motion.pick_place import timed_phases
from marl_handover.motion.trajectory import Phase, PickPlacePaths
from marl_handover.simulation.camera import TOP, Camera
from marl_handover.simulation.world import RunReport, SimulatedCell

UPRIGHT_RAD = math.radians(3.0)
"""A block that leans more than this has tipped over."""

_PICTURE_WIDTH, _PICTURE_HEIGHT = 640, 360


class PhysicsBackend:
    """Transfers carried out in simulated physics, measured by ground truth.

    A cycle that makes no sense (:class:`CycleCheck`) is refused and nothing moves. One that fails on the way is carried out to its end, so
    that the arm parks, and the object is reported where it came to lie.

    Args:
        model: the cell.
        motion: degree, limits and times of the motion.
        engine: by name; None: PyBullet where it is installed, else MuJoCo.
        grasp: "friction", "constraint" or None, as for :class:`SimulatedCell`.
        gui: open the engine's window.
        camera: what :meth:`render` looks through.
        size: width and height of its pictures.
    """

    exact = False

    def __init__(
        self,
        model: CellModel,
        motion: MotionConfig,
        *,
        engine: str | None = None,
        grasp: str | None = None,
        gui: bool = False,
        camera: Camera = TOP,
        size: tuple[int, int] = (_PICTURE_WIDTH, _PICTURE_HEIGHT),
    ) -> None:
        self.model, self.motion, self.camera, self.size = model, motion, camera, size
        self.check = CycleCheck(model, motion)
        self.cell = SimulatedCell(model, motion, engine=engine, grasp=grasp, gui=gui)
        self.on_step: Callable[[], None] | None = None
        """Called every 20 ms of simulated time while arms move."""
        self.last: RunReport | None = None
        """What happened in the last cycle that was carried out."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was made up for physics, in words."""
        return self.cell.notes

    def reset(self, pose: Floats, seed: int) -> Floats:
        """Park the arms and stand the object at ``pose`` (3,); its measured pose (3,). Nothing is random: ``seed`` changes nothing."""
        self.cell.reset(pose)
        return self.cell.object_pose()

    def joints_rad(self) -> Floats:
        """Where the joints of all arms are: (num_arms, 5)."""
        return self.cell.joints_rad()

    def execute(self, arm: int, paths: PickPlacePaths) -> Execution:
        """Time one cycle of ``arm`` and carry it out; the others hold still."""
        refusal = self.check(arm, paths, self.joints_rad()[arm], self.cell.object_pose()[:2])
        if refusal is not None:
            return Execution(self.cell.object_pose(), self.joints_rad(), 0.0, refusal)
        return self.carry_out(arm, timed_phases(welded(paths), self.model.arms[arm], self.motion, self.model.cell.pick_heights_mm[arm]))

    def carry_out(self, arm: int, phases: tuple[Phase, ...]) -> Execution:
        """The same for a cycle that is timed already, and taken as it is."""
        self.last = self.cell.run(arm, phases, self.on_step)
        trace = np.array(self.last.arms[arm].trace_rad).reshape(-1, 5)
        steps = np.diff(self.check.grip_mm(arm, trace), axis=0)
        length_mm = float(np.sqrt((steps**2).sum(-1)).sum())
        duration_s = float(phases[-1].t_s[-1] - phases[0].t_s[0])
        return Execution(self.cell.object_pose(), self.joints_rad(), length_mm, self._failure(arm, self.last), duration_s)

    def _failure(self, arm: int, report: RunReport) -> Refusal | None:
        """What went wrong, worst first: whatever else happened, nobody can grip a block that has tipped over."""
        if self.cell.tilt_rad() > UPRIGHT_RAD:
            return Refusal.TIPPED
        if report.collisions:
            return Refusal.COLLISION
        if not report.arms[arm].grasped:
            return Refusal.MISSED_GRASP
        return None if report.arms[arm].kept else Refusal.DROPPED

    def render(self) -> NDArray[np.uint8]:
        """A picture through :attr:`camera`: RGB (height, width, 3)."""
        return self.cell.camera_image(*self.size, self.camera)

    def close(self) -> None:
        """Let the world go."""
        self.cell.close()


BulletBackend = partial(PhysicsBackend, engine="bullet")
MujocoBackend = partial(PhysicsBackend, engine="mujoco")
