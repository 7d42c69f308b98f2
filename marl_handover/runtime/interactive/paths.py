"""Ways for an arm from wherever it is: to a pin, on with the block, or home; the other arm is parked.

Planned, checked and timed as :class:`~marl_handover.motion.planner.MotionPlanner` does, for arms that do not start at a park or a pin.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from marl_handover.motion.collision_model import ball_around, standing_block
from marl_handover.motion.initial_guesses import GRIP_LEAST_MM, SAMPLES, carrying_guesses, reaching_guesses
from marl_handover.motion.path_optimizer import FoundPath, Segment, find_path
from marl_handover.motion.pick_place import motion_limits
from marl_handover.motion.planner import STILL_MM, MotionPlanner, detour_length, string_length
from marl_handover.motion.time_parametrization import time_path
from marl_handover.motion.trajectory import JointTrajectory, still
from marl_handover.runtime.interactive.tracks import STEP_S

Floats = NDArray[np.float64]

EASE_MM = 0.01
MOST_EASE_MM = 0.5
"""An arm stopped between the samples of a checked way may be a little short of a clearance: the next way is asked for that much less, by
steps of the first; a start that lacks more than the second has no way."""

THERE_RAD = 1e-6


class FreePaths:
    """Ways of a cell's arms from any posture to the next rest, as timed tracks.

    Attributes:
        planned: how many tracks have been made.

    Args:
        planner: of whole cycles, for the same cell.
    """

    def __init__(self, planner: MotionPlanner) -> None:
        self.planner, self.motion, self.collision_model = planner, planner.motion, planner.collision_model
        model = planner.model
        self.home_rad = planner.home_rad
        self.planned = 0
        self.velocity_rad_s, self.acceleration_rad_s2 = motion_limits(model.arm, self.motion)
        middle = (model.cell.r_min_mm + model.cell.r_max_mm) / 2
        self._empty, self._loaded = [], []
        for arm, base in enumerate(model.cell.bases):
            ahead = base.to_world([middle, 0.0])
            self._empty.append(planner.reaching(arm, self.home_rad, ahead, self.home_rad, leaving=True)[0])
            self._loaded.append(planner.carrying(arm, ahead, ahead, self.home_rad)[0])

    def parked(self, joints_rad: Floats) -> bool:
        """Whether an arm at ``joints_rad`` (5,) is parked."""
        return self._same(joints_rad, self.home_rad)

    def to_pin(self, arm: int, joints_rad: Floats, pin_mm: Floats) -> JointTrajectory:
        """The empty hand from ``joints_rad`` (5,) to the pin of a block lying at ``pin_mm`` (2,). Raises as ``MotionPlanner.cycle``."""
        if self.parked(joints_rad):
            return self.timed(self.planner.reach(arm, joints_rad, pin_mm, self.home_rad, leaving=False))
        end = self.planner.grasp_joints(arm, "pick up", pin_mm)
        pin, scale = self.planner.in_base(arm, pin_mm), self.motion.approach_scale_mm
        profile = self._profile(joints_rad, pin, scale, self.motion.lift_mm, self.motion.ground_clearance_mm)
        ends = np.stack([joints_rad, end])[:, :4]
        segment = self._eased(self._around_block(arm, pin_mm, ends, profile))
        guesses = reaching_guesses(self.collision_model, ends, np.array([*pin, self.planner.pick_height_mm]), self.motion.lift_mm, True)
        return self.timed(self._found(segment, self._chained(self._hops(ends), guesses), wanted=1))

    def home(self, arm: int, joints_rad: Floats, block_mm: Floats) -> JointTrajectory:
        """The empty hand from ``joints_rad`` (5,) to the parked pose, past a block lying at ``block_mm`` (2,)."""
        if self.parked(joints_rad):
            return still(self.home_rad, STEP_S)
        ends = np.stack([joints_rad, self.home_rad])[:, :4]
        profile = self._profile(joints_rad, np.zeros(2), self.motion.approach_scale_mm, 0.0, self.motion.ground_clearance_mm)
        segment = self._eased(self._around_block(arm, block_mm, ends, profile))
        return self.timed(self._found(segment, self._hops(ends), wanted=1))

    def from_pin(self, arm: int, pin_mm: Floats) -> JointTrajectory:
        """The opened hand from the pin at ``pin_mm`` (2,) to the parked pose."""
        return self.timed(self.planner.reach(arm, self.home_rad, pin_mm, self.home_rad, leaving=True))

    def carry(self, arm: int, pick_mm: Floats, place_mm: Floats) -> JointTrajectory:
        """The hand with the block from where it lay to where it is to lie, both (2,)."""
        return self.timed(self.planner.transfer(arm, pick_mm, place_mm, self.home_rad))

    def carry_on(self, arm: int, joints_rad: Floats, place_mm: Floats) -> JointTrajectory:
        """The hand with the block from ``joints_rad`` (5,) in mid-air to ``place_mm`` (2,)."""
        planner, motion = self.planner, self.motion
        ends = np.stack([joints_rad, planner.grasp_joints(arm, "place", place_mm)])[:, :4]
        if self._same(ends[0], ends[1]):
            return still(joints_rad, STEP_S)
        ends_mm = np.stack([self._hand_mm(joints_rad), planner.in_base(arm, place_mm)])
        distance = max(math.dist(*ends_mm), STILL_MM)
        share = min(1.0, distance / (2 * motion.lift_scale_mm))
        scale, lift_mm = share * motion.lift_scale_mm, share * motion.lift_mm
        profile = np.array([*ends_mm[0], *ends_mm[1], scale, scale, lift_mm, share * motion.ground_clearance_mm])
        loaded = self._loaded[arm]
        bound = string_length(distance, scale, lift_mm)
        expected = bound + detour_length(ends_mm, GRIP_LEAST_MM)
        segment = replace(loaded, ends=ends, scene=loaded.scene._replace(profile=profile), lower_bound_mm=distance, expected_mm=expected)
        guesses = carrying_guesses(self.collision_model, ends, ends_mm, planner.pick_height_mm, lift_mm)
        return self.timed(self._found(self._eased(segment), self._chained(guesses, self._hops(ends))))

    def clear_of_block(self, arm: int, joints_rad: Floats, block_mm: Floats) -> bool:
        """Whether an arm at all of ``joints_rad`` (n, 5), its hand empty, keeps off a block lying at ``block_mm`` (2,)."""
        segment = self._around_block(arm, block_mm, joints_rad[[0, -1], :4], self._empty[arm].scene.profile)
        margins, _ = segment.check(joints_rad[:, :4])
        return margins.block >= 0.0

    def allows(self, arm: int, joints_rad: Floats, block_mm: Floats | None) -> bool:
        """Whether ``joints_rad`` (n, 5) keep their limits and all clearances; ``block_mm`` (2,): where it lies, None: in the hand."""
        arm_model = self.planner.model.arm
        if (joints_rad < arm_model.lower_rad).any() or (joints_rad > arm_model.upper_rad).any():
            return False
        profile = np.zeros(8)  # how high a hand travels is no matter of touching
        if block_mm is None:
            loaded = self._loaded[arm]
            segment = replace(loaded, scene=loaded.scene._replace(profile=profile))
        else:
            segment = self._around_block(arm, block_mm, joints_rad[[0, -1], :4], profile)
        margins, _ = segment.check(joints_rad[:, :4])
        return min(margins.arm, margins.block, margins.itself, margins.ground, margins.edge) >= 0.0

    def timed(self, found: FoundPath) -> JointTrajectory:
        """A path with its time law."""
        self.planned += 1
        return time_path(found.points, self.motion.degree, self.velocity_rad_s, self.acceleration_rad_s2, STEP_S)

    def _found(self, segment: Segment, guesses: Iterator[Floats], wanted: int = 2) -> FoundPath:
        return find_path(segment, guesses, self.motion.control_points, self.motion.degree, self.motion.num_initial_guesses, wanted=wanted)

    def _profile(self, joints_rad: Floats, end_mm: Floats, scale_mm: float, lift_mm: float, ground_mm: float) -> Floats:
        """The lift-over of an empty hand: it asks for nothing where the hand is, nor near a pin."""
        return np.array([*self._hand_mm(joints_rad), *end_mm, scale_mm, scale_mm, lift_mm, ground_mm])

    def _around_block(self, arm: int, block_mm: Floats, ends: Floats, profile: Floats) -> Segment:
        """A way of the empty hand past a block that lies at a world position."""
        empty = self._empty[arm]
        block = standing_block(self.planner.model, self.motion, self.planner.in_base(arm, block_mm))
        obstacles = np.concatenate([empty.scene.obstacles[: empty.scene.arm_rows], block])
        scene = empty.scene._replace(obstacles=obstacles, group=ball_around(obstacles), profile=profile)
        return replace(empty, ends=ends, scene=scene)

    def _eased(self, segment: Segment) -> Segment:
        """The segment with a start that was stopped at made allowed, if it lacks hardly anything."""
        margins, _ = segment.check(segment.ends[:1])
        short = -margins.worst
        if not 0.0 < short <= MOST_EASE_MM:
            return segment
        less, scene = short + EASE_MM, segment.scene
        scene = scene._replace(
            obstacles=(obstacles := scene.obstacles - less * (np.arange(9) == 7)),
            group=ball_around(obstacles),
            clearance=scene.clearance - less,
            pick_height=scene.pick_height - less,
            edges=scene.edges + np.array([0.0, less]),
        )
        return replace(segment, scene=scene)

    def _hops(self, ends: Floats) -> Iterator[Floats]:
        """Guesses (SAMPLES, 4): straight; or drawn in towards the parked posture half-way, a little or nearly all of it."""
        t = np.linspace(0.0, 1.0, SAMPLES)[:, None]
        line = ends[0] + (ends[1] - ends[0]) * t
        yield line
        for share in (0.4, 0.9):
            path = line.copy()
            path[:, 1:] += share * (self.home_rad[1:4] - path[:, 1:]) * np.sin(math.pi * t) ** 0.5
            path[0], path[-1] = ends
            yield path

    def _hand_mm(self, joints_rad: Floats) -> Floats:
        """Where the grip is over the table (2,), in the arm's base frame."""
        return self.planner.model.arm.grip_mm(joints_rad)[:2]

    @staticmethod
    def _same(one: Floats, other: Floats) -> bool:
        return bool(abs(one - other).max() <= THERE_RAD)

    @staticmethod
    def _chained(first: Iterator[Floats], second: Iterator[Floats]) -> Iterator[Floats]:
        yield from first
        yield from second
