"""From a command to a motion: the three paths of a cycle, collision-free, and their timing."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.errors import InvalidSetting, NotFinite, UnequalArms, WorkFailed
from marl_handover.motion.collision_model import CollisionModel, Scene, ball_around, collision_models, standing_arm, standing_block
from marl_handover.motion.home import parked_poses
from marl_handover.motion.initial_guesses import SAMPLES, carrying_guesses, reaching_guesses
from marl_handover.motion.path_optimizer import FoundPath, Segment, find_path
from marl_handover.motion.proportions import proportions
from marl_handover.motion.trajectory import OutOfArmsReach, PickPlacePaths, TransferMotion
from marl_handover.progress import working

Floats = NDArray[np.float64]

PAPER_TOLERANCE_MM = 1.0
"""The paper's formulation holds its demands at its samples; in between it may fall short by this much."""

EDGE_RAD = 1e-4
"""A pose at the very edge may need a joint this far past its limit; the joint stays at the limit, the grip is some 20 um off."""

STILL_MM = 1e-3
"""A transfer shorter than this is none."""


class MotionPlanner:
    """Plans the motions of a cell's arms.

    Args:
        model: the cell.
        motion: clearances, lift and limits.

    Attributes:
        homes_rad: (num_arms, 5) where each arm parks.
        collision_models: each arm's shapes; arms of one robot share theirs.

    Raises:
        InvalidSetting: on a setting out of its limits, or a parked pose an arm cannot take.
    """

    def __init__(self, model: CellModel, motion: MotionConfig | None = None) -> None:
        self.model, self.motion = model, motion or MotionConfig()
        self.motion.validate()
        model.cell.require_grip(self.motion.finger_travel_mm)
        if model.cell.keep_out:
            count = len(model.cell.keep_out)
            raise InvalidSetting("cell.obstacles", f"{count} of them", "none where arms move: motions do not go around obstacles yet")
        self.homes_rad = parked_poses(model, self.motion)
        self.collision_models = collision_models(model, self.motion)
        self.clearance_mm = np.array([self.motion.self_clearance_mm, self.motion.ground_clearance_mm])
        self._standing: tuple[tuple[int, bytes], Floats] = ((-1, b""), np.zeros((0, 9)))  # the last one asked for

    def relaid(self, model: CellModel) -> MotionPlanner:
        """The planner of a cell whose arms stand elsewhere. Robots that are here keep shapes and parked pose. Raises as the class."""
        here = {id(arm): index for index, arm in reversed(list(enumerate(self.model.arms)))}
        if model.cell.keep_out or not all(id(arm) in here for arm in model.arms):
            return MotionPlanner(model, self.motion)
        other, known = copy(self), [here[id(arm)] for arm in model.arms]
        other.model, other.homes_rad = model, self.homes_rad[known]
        other.collision_models = tuple(self.collision_models[index] for index in known)
        other._standing = ((-1, b""), np.zeros((0, 9)))
        return other

    @property
    def home_rad(self) -> Floats:
        """The parked pose (5,) that all arms have. Raises :class:`UnequalArms` where they differ, as the next one does."""
        if (self.homes_rad != self.homes_rad[0]).any():
            raise UnequalArms("parked pose", dict(zip(self.model.cell.names, np.degrees(self.homes_rad).round(3).tolist(), strict=True)))
        return np.asarray(self.homes_rad[0])

    @property
    def collision_model(self) -> CollisionModel:
        """The shapes that all arms have."""
        _ = self.model.arm
        return self.collision_models[0]

    @property
    def pick_height_mm(self) -> float:
        """How high over the table all arms pick and place."""
        return self.model.cell.pick_height_mm

    def others_home_rad(self, arm: int) -> Floats:
        """Where the other arms of ``arm`` park, in their order: (others, 5)."""
        return np.delete(self.homes_rad, arm, axis=0)

    def pick_place(
        self, arm: int, pick_mm: ArrayLike, place_mm: ArrayLike, joints_rad: ArrayLike, other_joints_rad: ArrayLike
    ) -> TransferMotion:
        """One transfer, planned, checked and timed. Arguments and errors as :meth:`plan_paths`."""
        begun = time.perf_counter()
        motion = self.timed(self.plan_paths(arm, pick_mm, place_mm, joints_rad, other_joints_rad))
        return replace(motion, planning_ms=1e3 * (time.perf_counter() - begun))

    def timed(self, motion: TransferMotion) -> TransferMotion:
        """The motion with its phases."""
        from marl_handover.motion.pick_place import timed_phases

        height_mm = self.model.cell.pick_heights_mm[motion.arm]
        return replace(motion, phases=timed_phases(motion.paths, self.model.arms[motion.arm], self.motion, height_mm))

    def plan_paths(
        self, arm: int, pick_mm: ArrayLike, place_mm: ArrayLike, joints_rad: ArrayLike, other_joints_rad: ArrayLike
    ) -> TransferMotion:
        """The paths of one transfer, planned and checked; its ``phases`` are empty until somebody times them.

        Args:
            arm: index.
            pick_mm: (2,) world position of the pin.
            place_mm: (2,) where it goes.
            joints_rad: (5,) where the arm is now; it ends at its home pose.
            other_joints_rad: (others, 5) where each other arm holds still, in their order; (5,) where there is one.

        Raises:
            OutOfArmsReach, NoPath, NotFinite: why there is no such motion.
        """
        begun = time.perf_counter()
        pick, place = (self._finite(name, value, (2,)) for name, value in (("pick_mm", pick_mm), ("place_mm", place_mm)))
        joints, other = (
            self._finite(name, value, size)
            for name, value, size in (
                ("joints_rad", joints_rad, (5,)),
                ("other_joints_rad", other_joints_rad, self._of_others(other_joints_rad)),
            )
        )
        transfer = self.transfer(arm, pick, place, other)
        approach = self.reach(arm, joints, pick, other, leaving=False)
        retreat = self.reach(arm, self.homes_rad[arm], place, other, leaving=True)
        paths = PickPlacePaths(approach.points, transfer.points, retreat.points)
        clearance = min(found.margins.arm for found in (approach, transfer, retreat)) + self.motion.arm_clearance_mm
        spent = 1e3 * (time.perf_counter() - begun)
        return TransferMotion(arm, pick, place, paths, (), other, transfer.length_mm, clearance, spent)

    def warm_up(self) -> None:
        """Plan and time one cycle, so that what is compiled on first use is; where that takes long, say so on stderr."""
        with working("compiling the motion kernels; once, they are cached"):
            cell = self.model.cell
            first = cell.arms[0]
            pick, place = first.base.around((first.r_min_mm + first.r_max_mm) / 2, (-0.3, 0.3))
            with suppress(WorkFailed):  # settings under which nothing can move are for the first real command to name
                self.pick_place(0, pick, place, self.homes_rad[0], self.others_home_rad(0))

    def transfer(self, arm: int, pick_mm: Floats, place_mm: Floats, other_joints_rad: Floats) -> FoundPath:
        """The path of the loaded hand from pick to place (world, mm). Raises as :meth:`plan_paths`."""
        segment, guesses = self.carrying(arm, pick_mm, place_mm, other_joints_rad)
        if self.motion.method == "paper":
            from marl_handover.motion.slsqp_planner import plan_slsqp

            return plan_slsqp(segment, tolerance_mm=PAPER_TOLERANCE_MM)
        if math.dist(pick_mm, place_mm) < STILL_MM:
            guesses = iter([np.linspace(segment.ends[0], segment.ends[1], SAMPLES)])
        return find_path(segment, guesses, self.motion.control_points, self.motion.degree, self.motion.num_initial_guesses)

    def carrying(self, arm: int, pick_mm: Floats, place_mm: Floats, other_joints_rad: Floats) -> tuple[Segment, Iterator[Floats]]:
        """The segment of a transfer and its first guesses."""
        ends_mm = np.stack([self.in_base(arm, pick_mm), self.in_base(arm, place_mm)])
        ends = np.stack([self.grasp_joints(arm, "pick up", pick_mm), self.grasp_joints(arm, "place", place_mm)])[:, :4]
        distance = math.dist(*ends_mm)
        # Over a short way the same profile is asked for, only smaller: it would be a spike otherwise.
        share = min(1.0, max(distance, STILL_MM) / (2 * self.motion.lift_scale_mm))
        scale, lift_mm = share * self.motion.lift_scale_mm, share * self.motion.lift_mm
        profile = np.array([*ends_mm[0], *ends_mm[1], scale, scale, lift_mm, share * self.motion.ground_clearance_mm])
        others = self._other(arm, other_joints_rad)
        bound = string_length(distance, scale, lift_mm)
        body, height_mm = self.collision_models[arm], self.model.cell.pick_heights_mm[arm]
        expected = bound + detour_length(ends_mm, proportions(body.planar).grip_least_mm)
        segment = Segment(body, self._scene(arm, True, others, len(others), profile), ends, bound, expected)
        return segment, carrying_guesses(body, ends, ends_mm, height_mm, lift_mm)

    def reach(self, arm: int, joints_rad: Floats, pin_mm: Floats, other_joints_rad: Floats, *, leaving: bool) -> FoundPath:
        """The path of the empty hand from ``joints_rad`` to the pin, or, ``leaving``, from it to them. Raises as :meth:`plan_paths`."""
        segment, guesses = self.reaching(arm, joints_rad, pin_mm, other_joints_rad, leaving=leaving)
        return find_path(segment, guesses, self.motion.control_points, self.motion.degree, self.motion.num_initial_guesses, wanted=1)

    def reaching(
        self, arm: int, joints_rad: Floats, pin_mm: Floats, other_joints_rad: Floats, *, leaving: bool
    ) -> tuple[Segment, Iterator[Floats]]:
        """The segment of :meth:`reach` and its first guesses."""
        if abs(joints_rad[4]) > 1e-6 or not self.model.arms[arm].within_limits(joints_rad):
            raise InvalidSetting("joints_rad", np.round(joints_rad, 4).tolist(), "within the joint limits, with wrist roll 0")
        pin = self.in_base(arm, pin_mm)
        grasp = self.grasp_joints(arm, "place" if leaving else "pick up", pin_mm)
        ends = np.stack([grasp, joints_rad] if leaving else [joints_rad, grasp])[:, :4]
        scale = self.motion.approach_scale_mm
        scales = (scale, 0.0) if leaving else (0.0, scale)
        profile = np.array([*pin, *pin, *scales, self.motion.lift_mm, self.motion.ground_clearance_mm])
        others = self._other(arm, other_joints_rad)
        body, pin_mm = self.collision_models[arm], np.array([*pin, self.model.cell.pick_heights_mm[arm]])
        obstacles = np.concatenate([others, standing_block(body, self.model, pin)])
        segment = Segment(body, self._scene(arm, False, obstacles, len(others), profile), ends, 0.0, 0.0)
        return segment, reaching_guesses(body, ends, pin_mm, self.motion.lift_mm, not leaving)

    def grasp_joints(self, arm: int, what: str, position_mm: Floats) -> Floats:
        """Joints (5,) that hold the pin at a world position (2,) with pitch = roll = 0. Raises :class:`OutOfArmsReach`."""
        return grasp_joints(self.model, arm, what, position_mm)

    def _scene(self, arm: int, holding: bool, obstacles: Floats, arm_rows: int, profile: Floats) -> Scene:
        """An arm, empty or with the block, among obstacles."""
        body, height_mm = self.collision_models[arm], self.model.cell.pick_heights_mm[arm]
        capsules, pairs, edges = (body.held, body.held_pairs, body.edges) if holding else (body.capsules, body.pairs, body.edges[:0])
        carried, group = len(body.capsules), ball_around(obstacles)
        return Scene(body.planar, capsules, carried, pairs, obstacles, arm_rows, group, self.clearance_mm, height_mm, edges, profile)

    def in_base(self, arm: int, position_mm: Floats) -> Floats:
        """A world position (2,) in the frame of an arm's base."""
        return self.model.cell.bases[arm].to_local(position_mm)

    def _other(self, arm: int, joints_rad: Floats) -> Floats:
        """Obstacle rows of every other arm at its joints, (others, 5), or (5,) of the one there is."""
        key = (arm, joints_rad.tobytes())
        if self._standing[0] == key:
            return self._standing[1]
        bases = self.model.cell.bases
        rows = []
        for index, its_rad in zip(np.delete(np.arange(len(bases)), arm), np.atleast_2d(joints_rad), strict=True):
            base = bases[index]
            turn = base.facing_rad - bases[arm].facing_rad
            x_mm, y_mm = self.in_base(arm, base.position_mm)
            body, kinematics = self.collision_models[index], self.model.arms[index]
            rows.append(standing_arm(body, kinematics, self.motion, its_rad, float(x_mm), float(y_mm), turn))
        self._standing = (key, np.concatenate(rows))
        return self._standing[1]

    def _of_others(self, joints_rad: ArrayLike) -> tuple[int, ...]:
        """The shape of joints of all other arms: that of one vector, if it is one, and one arm's."""
        others = self.model.cell.num_arms - 1
        return (5,) if others == 1 and np.ndim(joints_rad) == 1 else (others, 5)

    @staticmethod
    def _finite(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
        array = np.asarray(value, dtype=float)
        if array.shape != shape:
            raise InvalidSetting(name, np.shape(value), f"an array of shape {shape}")
        if not np.isfinite(array).all():
            raise NotFinite(name, array.tolist())
        return array


@lru_cache(maxsize=4096)
def string_length(distance_mm: float, scale_mm: float, lift_mm: float) -> float:
    """Length in mm of a taut string over the lift-over profile, the arm left out: no transfer over ``distance_mm`` is shorter."""
    s = np.linspace(0.0, distance_mm, 200)
    z = lift_mm * (1 - np.exp(-((s / scale_mm) ** 2))) * (1 - np.exp(-(((distance_mm - s) / scale_mm) ** 2)))
    hull: list[int] = []
    for i in range(len(s)):
        while len(hull) > 1 and _turns_left(s, z, hull[-2], hull[-1], i):
            hull.pop()
        hull.append(i)
    return float(np.hypot(np.diff(s[hull]), np.diff(z[hull])).sum())


def detour_length(ends_mm: Floats, radius_mm: float) -> float:
    """How much longer than the straight line between ``ends_mm`` (2, 2) a taut string around a disc at the origin is, in mm."""
    a, b = ends_mm
    distance, (r_a, r_b) = math.dist(a, b), np.hypot(ends_mm[:, 0], ends_mm[:, 1])
    if distance == 0.0 or min(r_a, r_b) <= radius_mm:
        return 0.0
    foot = a + float(np.clip(-a @ (b - a) / distance**2, 0.0, 1.0)) * (b - a)
    if math.hypot(*foot) >= radius_mm:
        return 0.0
    around = abs(math.atan2(a[0] * b[1] - a[1] * b[0], a @ b)) - math.acos(radius_mm / r_a) - math.acos(radius_mm / r_b)
    tangents = math.sqrt(r_a**2 - radius_mm**2) + math.sqrt(r_b**2 - radius_mm**2)
    return tangents + radius_mm * max(around, 0.0) - distance


def _turns_left(s: Floats, z: Floats, a: int, b: int, c: int) -> bool:
    return bool((s[b] - s[a]) * (z[c] - z[a]) - (z[b] - z[a]) * (s[c] - s[a]) >= 0.0)


def grasp_joints(model: CellModel, arm: int, what: str, position_mm: Floats) -> Floats:
    """Joints (5,) with the grip at the pick height over a world position (2,), pitch = roll = 0; ``what`` the arm is to do there.

    Raises:
        OutOfArmsReach: no joint vector within the limits does it.
    """
    base, arm_model = model.cell.bases[arm], model.arms[arm]
    x, y = base.to_local(position_mm)
    q = arm_model.ik(np.array([x, y, model.cell.pick_heights_mm[arm]]))
    inside = np.clip(q, arm_model.lower_rad, arm_model.upper_rad)
    good = (np.abs(q - inside) <= EDGE_RAD).all(axis=-1)  # NaN, out of reach, is not
    if not good.any():
        raise OutOfArmsReach(arm, what, position_mm)
    return np.asarray(inside[int(np.argmax(good))])
