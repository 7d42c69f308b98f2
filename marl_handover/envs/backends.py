"""What carries out a transfer: the protocol, its exact and its noisy kinematic form, and all of them by name.

A backend knows the arms and the object, nothing of goals and rewards. It is given one cycle of one arm and says where the object is then.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats, wrap
from marl_handover.cell import CellModel
from marl_handover.config import BACKENDS, MotionConfig, NoiseConfig, TaskConfig, require_at_least, require_between
from marl_handover.envs.cycle_check import CycleCheck, Refusal, welded
from marl_handover.envs.top_view import TopView
from marl_handover.errors import InvalidSetting
from marl_handover.motion.trajectory import PickPlacePaths
from marl_handover.task.rules import carried

__all__ = ["BACKENDS", "Backend", "Correctable", "Execution", "KinematicBackend", "NoisyBackend", "Refusal", "make_backend"]


class Execution(NamedTuple):
    """What came of a transfer.

    Attributes:
        pose: (3,) the object's pose afterwards as it is measured: mm, mm, rad.
        joints_rad: (num_arms, 5) afterwards.
        path_mm: length of the grip's path between grasp and release.
        refusal: why it was refused or failed, a value of :class:`Refusal`; None if neither.
        duration_s: of the motion that was carried out; None from a backend that does not time motions, or did not come so far.
    """

    pose: Floats
    joints_rad: Floats
    path_mm: float
    refusal: str | None
    duration_s: float | None = None


class Backend(Protocol):
    """A cell whose arms can be told to move."""

    exact: bool
    """Whether placements are exact; else "at the goal" is within ``position_tolerance_mm``."""

    def reset(self, pose: Floats, seed: int) -> Floats:
        """Park the arms, put the object at ``pose`` (3,) and return its measured pose (3,); ``seed`` decides all that is random."""

    def joints_rad(self) -> Floats:
        """Joints of all arms now (num_arms, 5)."""

    def execute(self, arm: int, paths: PickPlacePaths) -> Execution:
        """Carry out one cycle of ``arm``; the others hold still."""

    def render(self) -> NDArray[np.uint8]:
        """A picture (height, width, 3)."""

    def close(self) -> None:
        """Release what the backend holds."""


@runtime_checkable
class Correctable(Protocol):
    """A backend whose object can be put anywhere at any time."""

    def put(self, pose: Floats) -> None:
        """Put the object at ``pose`` (3,)."""


CollisionCheck = Callable[[int, PickPlacePaths, Floats], bool]
"""Whether a cycle of an arm touches anything, the joints of all arms being (num_arms, 5) before it."""


class KinematicBackend:
    """Exact arms: a cycle that can be carried out takes the object with it, any other is refused and leaves it.

    Args:
        model: the cell.
        motion: the parked pose and the splines' degree.
        check_collisions: True: a cycle that touches anything is refused (:class:`~marl_handover.envs.collision_check.CollisionFinder`).
            False: that is left to the arms, and a path through the table or the other arm is carried out. Or a check of one's own.
    """

    exact = True

    def __init__(self, model: CellModel, motion: MotionConfig, *, check_collisions: CollisionCheck | bool = False) -> None:
        self.model, self.motion = model, motion
        self.check = CycleCheck(model, motion)
        self.check_collisions = _collision_check(check_collisions, model, motion)
        self._joints = self.check.homes_rad.copy()
        self._pose = np.zeros(3)
        self._view: TopView | None = None

    def reset(self, pose: Floats, seed: int) -> Floats:
        """Park the arms and put the object at ``pose`` (3,): it is measured there."""
        self._joints[:] = self.check.homes_rad
        self.put(pose)
        return self._pose.copy()

    def put(self, pose: Floats) -> None:
        """Put the object at ``pose`` (3,)."""
        self._pose = np.array(pose, float)

    def joints_rad(self) -> Floats:
        """Joints of all arms (num_arms, 5)."""
        return self._joints.copy()

    def execute(self, arm: int, paths: PickPlacePaths) -> Execution:
        """Carry out one cycle, if :class:`CycleCheck` has nothing against it."""
        refusal = self.check(arm, paths, self._joints[arm], self._pose[:2])
        if refusal is None and self.check_collisions is not None and self.check_collisions(arm, paths, self.joints_rad()):
            refusal = Refusal.COLLISION
        if refusal is not None:
            return Execution(self._pose.copy(), self.joints_rad(), 0.0, refusal)
        paths = welded(paths)
        self._joints[arm] = paths.retreat[-1]
        return self._moved(arm, paths.transfer)

    def render(self, goal: Floats | None = None, place_mm: Floats | None = None) -> NDArray[np.uint8]:
        """The table from above with the arms; with the goal's outline and a cross at the last commanded place, if given."""
        self._view = self._view or TopView(self.model.cell)
        hands = np.stack([self.check.grip_mm(arm, joints)[:2] for arm, joints in enumerate(self._joints)])
        return self._view.draw(self._pose, goal, place_mm, hands)

    def close(self) -> None:
        """Nothing is held."""

    def _moved(self, arm: int, transfer: Floats) -> Execution:
        """The transfer itself: the object follows the grip and turns with it."""
        end = self.check.grip_mm(arm, transfer[-1])
        self._pose = carried(self._pose, end[:2], transfer[-1, 0] - transfer[0, 0])
        return Execution(self._pose.copy(), self.joints_rad(), self.check.path_mm(arm, transfer), None)


def _collision_check(check: CollisionCheck | bool, model: CellModel, motion: MotionConfig) -> CollisionCheck | None:
    if callable(check):
        return check
    if not isinstance(check, bool):
        raise InvalidSetting("check_collisions", check, "true, false, or a function")
    if not check:
        return None
    from marl_handover.envs.collision_check import CollisionFinder  # compiles; without it the environments need no compiler

    return CollisionFinder(model, motion)


class NoisyBackend(KinematicBackend):
    """Kinematic arms that put the object down a little off, and sometimes grasp nothing.

    Args:
        model: the cell.
        motion: the parked pose and the splines' degree.
        noise: standard deviations of a placement; a hobby arm's if None.
        missed_grasps: probability that the fingers close on nothing.
        check_collisions: as for :class:`KinematicBackend`.
    """

    exact = False

    def __init__(
        self,
        model: CellModel,
        motion: MotionConfig,
        *,
        noise: NoiseConfig | None = None,
        missed_grasps: float = 0.01,
        check_collisions: CollisionCheck | bool = False,
    ) -> None:
        super().__init__(model, motion, check_collisions=check_collisions)
        noise = noise or NoiseConfig(position_mm=1.0, yaw_deg=0.5)
        require_at_least("noise.position_mm", noise.position_mm, 0)
        require_at_least("noise.yaw_deg", noise.yaw_deg, 0)
        require_between("missed_grasps", missed_grasps, 0, 1)
        self.noise, self.missed_grasps = noise, missed_grasps
        self._generator = np.random.default_rng(0)

    def reset(self, pose: Floats, seed: int) -> Floats:
        """As the kinematic one; ``seed`` decides all noise to come."""
        self._generator = np.random.default_rng(seed)
        return super().reset(pose, seed)

    def _moved(self, arm: int, transfer: Floats) -> Execution:
        draw, missed = self._generator.normal(size=3), self._generator.random() < self.missed_grasps
        if missed:
            return Execution(self._pose.copy(), self.joints_rad(), 0.0, Refusal.MISSED_GRASP)
        done = super()._moved(arm, transfer)
        moved = done.pose + draw * (self.noise.position_mm, self.noise.position_mm, math.radians(self.noise.yaw_deg))
        self.put(np.array([moved[0], moved[1], wrap(moved[2])]))
        return done._replace(pose=self._pose.copy())


def make_backend(name: str, model: CellModel, task: TaskConfig, motion: MotionConfig, **options: Any) -> Backend:
    """A backend by name; ``noisy`` takes the task's noise, if there is any.

    Args:
        name: ``kinematic``, ``noisy``, ``bullet``, ``mujoco``, ``twin``, ``hardware``, or one that a plugin registered.
        model: the cell.
        task: the task's settings.
        motion: how the arms move.
        options: for that backend's class.

    Raises:
        UnknownChoice: for another name.
    """
    if name == "noisy" and (task.noise.position_mm > 0 or task.noise.yaw_deg > 0):
        options.setdefault("noise", task.noise)
    backend: Backend = BACKENDS[name](model, motion, **options)
    return backend
