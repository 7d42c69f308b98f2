"""Programs of the interactive cell: motions that carry out a transfer, from the parked pose or from the midst of another program.

A motion may be stopped at any time, and joined to the next one without a stop. Ways lead an arm from wherever it is to a pin, on with the
block, or home; they are planned, checked and timed as :class:`~marl_handover.motion.planner.MotionPlanner` does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import takewhile

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.control.interactive.world_state import MotionSegment, WorldState
from marl_handover.control.transfers import TransferCommand
from marl_handover.errors import WorkFailed
from marl_handover.motion.collision_model import ball_around, standing_block
from marl_handover.motion.initial_guesses import SAMPLES, carrying_guesses, reaching_guesses
from marl_handover.motion.path_optimizer import FoundPath, Segment, find_path
from marl_handover.motion.pick_place import motion_limits
from marl_handover.motion.planner import STILL_MM, MotionPlanner, detour_length, string_length
from marl_handover.motion.proportions import proportions
from marl_handover.motion.time_parametrization import time_path
from marl_handover.motion.trajectory import JointTrajectory, still

STEP_S = 0.002
"""Between samples: accelerations jump in time-optimal motions, and a cubic across such a jump is off for no longer than this."""

BRAKE_SHARE = 0.97
"""Of the acceleration limits that a stop makes use of; the rest is for what happens between samples."""

EXCESS = 1.005
"""Sums of two motions that are within limits may pass them by this factor: each of them is checked as closely as that."""

DELAYS = (0.0, 0.25, 0.5, 0.75)
"""Parts of a stop after which the next motion may set out."""


def stopped(track: JointTrajectory, t_s: float, acceleration_rad_s2: Floats) -> JointTrajectory:
    """The quickest stop along the way of ``track`` from time ``t_s`` on.

    It is the same way with another clock s(t): a joint's acceleration is q'' s'^2 + q' s''. As s' is at most 1, to let it be is always
    allowed, so no braking can get trapped; with x = s'^2, each joint lets x fall at 2 (limit / |q'| + x q'' / q') a unit of s.
    """
    if track.duration_s - t_s < 1e-9:
        return still(track.end_rad, STEP_S)
    clock = t_s + _even(track.duration_s - t_s)
    _, rates = track.at(clock)
    steps = np.diff(clock)
    way, bend = np.sign(rates[1:] + rates[:-1]), np.diff(rates, axis=0) / steps[:, None]
    fastest = np.maximum(np.maximum(abs(rates[1:]), abs(rates[:-1])), 1e-9)
    room, slope = BRAKE_SHARE * acceleration_rad_s2 / fastest, way * bend / fastest
    places, speeds, times = [float(clock[0])], [1.0], [0.0]
    x = 1.0
    for step, limit, change in zip(steps.tolist(), room.tolist(), slope.tolist(), strict=True):
        # What falls with x is taken at the end of the step, what rises at its beginning: neither is overrated.
        pairs = list(zip(limit, change, strict=True))
        fall = 2 * max(0.0, min((c + d * x) / (1 + 2 * step * max(d, 0.0)) for c, d in pairs))
        if fall * step >= x:
            fall = 2 * min(c + min(d, 0.0) * x for c, d in pairs)
            part = x / fall
            places.append(places[-1] + part)
            times.append(times[-1] + max(2 * part / speeds[-1], 1e-6))
            speeds.append(0.0)
            break
        x -= fall * step
        places.append(places[-1] + step)
        speeds.append(math.sqrt(x))
        times.append(times[-1] + 2 * step / (speeds[-1] + speeds[-2]))
    if times[-1] >= track.duration_s - t_s:  # it slows down by itself about as fast as it can
        return track.rest(t_s)
    knots, place, speed = np.array(times), np.array(places), np.array(speeds)
    t = _even(knots[-1])
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    since, change = t - knots[i], (np.diff(speed) / np.diff(knots))[i]
    joints, rates = track.at(np.minimum(place[i] + since * (speed[i] + since * change / 2), place[-1]))
    rates = rates * (speed[i] + since * change)[:, None]
    rates[-1] = 0.0
    return JointTrajectory(t, joints, rates)


def _even(duration_s: float) -> Floats:
    """Times (n,) from 0 to ``duration_s``, :data:`STEP_S` apart at most."""
    return np.linspace(0.0, duration_s, 1 + max(1, math.ceil(duration_s / STEP_S - 1e-9)))


def joined(
    first: JointTrajectory, second: JointTrajectory, velocity_rad_s: Floats, acceleration_rad_s2: Floats, allowed: Callable[[Floats], bool]
) -> JointTrajectory:
    """A stop and the motion from there as one, the second setting out before the first has ended if it can.

    While both are under way they are added up: where one slows down and the other speeds up alike, the arm goes on without slowing down.

    Args:
        first: ends where ``second`` begins, both at rest there.
        second: see above.
        velocity_rad_s: limits (5,).
        acceleration_rad_s2: limits (5,).
        allowed: whether joint samples (n, 5) touch nothing and are within the joint limits.
    """
    for share in DELAYS:
        delay = share * first.duration_s
        if first.duration_s > delay + second.duration_s:
            continue
        t = _even(delay + second.duration_s)
        (joints, rates), (more, added) = first.at(t), second.at(t - delay)
        joints, rates = joints + more - second.joints_rad[0], rates + added
        both = t <= first.duration_s + STEP_S
        bends = np.diff(rates, axis=0)[both[1:]] / np.diff(t)[both[1:], None]
        if (abs(rates[both]) > EXCESS * velocity_rad_s).any() or (abs(bends) > EXCESS * acceleration_rad_s2).any():
            continue
        if allowed(joints[both]):
            return JointTrajectory(t, joints, rates)
    t = np.concatenate([first.t_s, first.duration_s + second.t_s[1:]])
    joints = np.concatenate([first.joints_rad, second.joints_rad[1:]])
    return JointTrajectory(t, joints, np.concatenate([first.velocities_rad_s, second.velocities_rad_s[1:]]))


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
        self.planner, self.motion, self.homes_rad = planner, planner.motion, planner.homes_rad
        self.planned = 0
        self.limits = tuple(motion_limits(arm, self.motion) for arm in planner.model.arms)
        """Velocity and acceleration limits (5,) of each arm, in rad/s and rad/s^2."""
        self._segments: dict[tuple[int, bool], Segment] = {}

    def parked(self, arm: int, joints_rad: Floats) -> bool:
        """Whether an arm at ``joints_rad`` (5,) is parked."""
        return self._same(joints_rad, self.homes_rad[arm])

    def to_pin(self, arm: int, joints_rad: Floats, pin_mm: Floats) -> JointTrajectory:
        """The empty hand from ``joints_rad`` (5,) to the pin of a block lying at ``pin_mm`` (2,). Raises as ``MotionPlanner.cycle``."""
        if self.parked(arm, joints_rad):
            return self.timed(arm, self.planner.reach(arm, joints_rad, pin_mm, self.planner.others_home_rad(arm), leaving=False))
        end = self.planner.grasp_joints(arm, "pick up", pin_mm)
        pin, scale = self.planner.in_base(arm, pin_mm), self.motion.approach_scale_mm
        profile = self._profile(arm, joints_rad, pin, scale, self.motion.lift_mm, self.motion.ground_clearance_mm)
        ends = np.stack([joints_rad, end])[:, :4]
        segment = self._eased(self._around_block(arm, pin_mm, ends, profile))
        body, pin_mm = self.planner.collision_models[arm], np.array([*pin, self.planner.model.cell.pick_heights_mm[arm]])
        guesses = reaching_guesses(body, ends, pin_mm, self.motion.lift_mm, True)
        return self.timed(arm, self._found(segment, self._chained(self._hops(arm, ends), guesses), wanted=1))

    def home(self, arm: int, joints_rad: Floats, block_mm: Floats) -> JointTrajectory:
        """The empty hand from ``joints_rad`` (5,) to the parked pose, past a block lying at ``block_mm`` (2,)."""
        if self.parked(arm, joints_rad):
            return still(self.homes_rad[arm], STEP_S)
        ends = np.stack([joints_rad, self.homes_rad[arm]])[:, :4]
        profile = self._profile(arm, joints_rad, np.zeros(2), self.motion.approach_scale_mm, 0.0, self.motion.ground_clearance_mm)
        segment = self._eased(self._around_block(arm, block_mm, ends, profile))
        return self.timed(arm, self._found(segment, self._hops(arm, ends), wanted=1))

    def from_pin(self, arm: int, pin_mm: Floats) -> JointTrajectory:
        """The opened hand from the pin at ``pin_mm`` (2,) to the parked pose."""
        own, others = self.homes_rad[arm], self.planner.others_home_rad(arm)
        return self.timed(arm, self.planner.reach(arm, own, pin_mm, others, leaving=True))

    def carry(self, arm: int, pick_mm: Floats, place_mm: Floats) -> JointTrajectory:
        """The hand with the block from where it lay to where it is to lie, both (2,)."""
        return self.timed(arm, self.planner.transfer(arm, pick_mm, place_mm, self.planner.others_home_rad(arm)))

    def carry_on(self, arm: int, joints_rad: Floats, place_mm: Floats) -> JointTrajectory:
        """The hand with the block from ``joints_rad`` (5,) in mid-air to ``place_mm`` (2,)."""
        planner, motion = self.planner, self.motion
        ends = np.stack([joints_rad, planner.grasp_joints(arm, "place", place_mm)])[:, :4]
        if self._same(ends[0], ends[1]):
            return still(joints_rad, STEP_S)
        ends_mm = np.stack([self._hand_mm(arm, joints_rad), planner.in_base(arm, place_mm)])
        distance = max(math.dist(*ends_mm), STILL_MM)
        share = min(1.0, distance / (2 * motion.lift_scale_mm))
        scale, lift_mm = share * motion.lift_scale_mm, share * motion.lift_mm
        profile = np.array([*ends_mm[0], *ends_mm[1], scale, scale, lift_mm, share * motion.ground_clearance_mm])
        loaded, body = self._segment(arm, loaded=True), planner.collision_models[arm]
        bound = string_length(distance, scale, lift_mm)
        expected = bound + detour_length(ends_mm, proportions(body.planar).grip_least_mm)
        segment = replace(loaded, ends=ends, scene=loaded.scene._replace(profile=profile), lower_bound_mm=distance, expected_mm=expected)
        guesses = carrying_guesses(body, ends, ends_mm, planner.model.cell.pick_heights_mm[arm], lift_mm)
        return self.timed(arm, self._found(self._eased(segment), self._chained(guesses, self._hops(arm, ends))))

    def clear_of_block(self, arm: int, joints_rad: Floats, block_mm: Floats) -> bool:
        """Whether an arm at all of ``joints_rad`` (n, 5), its hand empty, keeps off a block lying at ``block_mm`` (2,)."""
        segment = self._around_block(arm, block_mm, joints_rad[[0, -1], :4], self._segment(arm, loaded=False).scene.profile)
        margins, _ = segment.check(joints_rad[:, :4])
        return margins.block >= 0.0

    def allows(self, arm: int, joints_rad: Floats, block_mm: Floats | None) -> bool:
        """Whether ``joints_rad`` (n, 5) keep their limits and all clearances; ``block_mm`` (2,): where it lies, None: in the hand."""
        arm_model = self.planner.model.arms[arm]
        if (joints_rad < arm_model.lower_rad).any() or (joints_rad > arm_model.upper_rad).any():
            return False
        profile = np.zeros(8)  # how high a hand travels is no matter of touching
        if block_mm is None:
            loaded = self._segment(arm, loaded=True)
            segment = replace(loaded, scene=loaded.scene._replace(profile=profile))
        else:
            segment = self._around_block(arm, block_mm, joints_rad[[0, -1], :4], profile)
        margins, _ = segment.check(joints_rad[:, :4])
        return min(margins.arm, margins.block, margins.itself, margins.ground, margins.edge) >= 0.0

    def timed(self, arm: int, found: FoundPath) -> JointTrajectory:
        """A path of an arm with its time law."""
        self.planned += 1
        return time_path(found.points, self.motion.degree, *self.limits[arm], STEP_S)

    def _segment(self, arm: int, loaded: bool) -> Segment:
        """A way of an arm, its hand empty or with the block, whose ends and lift-over are to be replaced; made when it is asked for."""
        key = arm, loaded
        if key not in self._segments:
            planner, its = self.planner, self.planner.model.cell.arms[arm]
            ahead, others = its.base.to_world([(its.r_min_mm + its.r_max_mm) / 2, 0.0]), planner.others_home_rad(arm)
            made = (
                planner.carrying(arm, ahead, ahead, others)
                if loaded
                else planner.reaching(arm, self.homes_rad[arm], ahead, others, leaving=True)
            )
            self._segments[key] = made[0]
        return self._segments[key]

    def _found(self, segment: Segment, guesses: Iterator[Floats], wanted: int = 2) -> FoundPath:
        return find_path(segment, guesses, self.motion.control_points, self.motion.degree, self.motion.num_initial_guesses, wanted=wanted)

    def _profile(self, arm: int, joints_rad: Floats, end_mm: Floats, scale_mm: float, lift_mm: float, ground_mm: float) -> Floats:
        """The lift-over of an empty hand: it asks for nothing where the hand is, nor near a pin."""
        return np.array([*self._hand_mm(arm, joints_rad), *end_mm, scale_mm, scale_mm, lift_mm, ground_mm])

    def _around_block(self, arm: int, block_mm: Floats, ends: Floats, profile: Floats) -> Segment:
        """A way of the empty hand past a block that lies at a world position."""
        empty = self._segment(arm, loaded=False)
        block = standing_block(self.planner.collision_models[arm], self.planner.model, self.planner.in_base(arm, block_mm))
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

    def _hops(self, arm: int, ends: Floats) -> Iterator[Floats]:
        """Guesses (SAMPLES, 4): straight; or drawn in towards the parked posture half-way, a little or nearly all of it."""
        t = np.linspace(0.0, 1.0, SAMPLES)[:, None]
        line = ends[0] + (ends[1] - ends[0]) * t
        yield line
        for share in (0.4, 0.9):
            path = line.copy()
            path[:, 1:] += share * (self.homes_rad[arm, 1:4] - path[:, 1:]) * np.sin(math.pi * t) ** 0.5
            path[0], path[-1] = ends
            yield path

    def _hand_mm(self, arm: int, joints_rad: Floats) -> Floats:
        """Where an arm's grip is over the table (2,), in its base frame."""
        return self.planner.model.arms[arm].grip_mm(joints_rad)[:2]

    @staticmethod
    def _same(one: Floats, other: Floats) -> bool:
        return bool(abs(one - other).max() <= THERE_RAD)

    @staticmethod
    def _chained(first: Iterator[Floats], second: Iterator[Floats]) -> Iterator[Floats]:
        yield from first
        yield from second


class MotionPrograms:
    """Makes programs. Only what an arm in motion goes on with is planned at once; what comes later is planned when it is asked for.

    Planning raises :class:`WorkFailed` where there is no collision-free motion.

    Args:
        paths: of the arms.
    """

    def __init__(self, paths: FreePaths) -> None:
        self.paths, self.motion = paths, paths.motion

    def cycle(self, command: TransferCommand, pose: Floats) -> list[MotionSegment]:
        """The whole transfer of a block lying at ``pose`` (3,), all arms being parked."""
        arm, pin = command.arm, pose[:2].copy()
        approach = MotionSegment("approach", arm, 1.0, 1.0, None, lambda: self.paths.to_pin(arm, self.paths.homes_rad[arm], pin))
        return [approach, *self._from_grasp(command, pose)]

    def home(self, arm: int, joints_rad: Floats, pose: Floats) -> MotionSegment:
        """An empty hand goes from ``joints_rad`` (5,), where it rests, to the parked pose, past a block lying at ``pose`` (3,)."""
        start, block = joints_rad.copy(), pose[:2].copy()
        return MotionSegment("retreat", arm, 1.0, 1.0, None, lambda: self.paths.home(arm, start, block))

    def redirected(self, world: WorldState, command: TransferCommand | None, moved: bool) -> list[MotionSegment]:
        """What an empty hand under way is to do now; without an order, it parks. ``moved``: the block is not where it was."""
        segment, pose = world.program[0], world.pose
        rest = self._rest(world)
        ours = command if command is not None and command.arm == segment.arm else None
        theirs = self.cycle(command, pose) if command is not None and ours is None else []
        if not moved:
            if segment.kind in ("approach", "grasp") and ours is not None:
                kept = takewhile(lambda it: it.kind in ("approach", "grasp"), list(world.program)[1:])
                return [rest, *kept, *self._from_carry(ours, pose)]
            if segment.kind == "release":
                return [rest, *([self._leave(segment.arm, pose[:2]), *theirs] if ours is None else self._from_grasp(ours, pose))]
            if segment.kind == "grasp":
                opening = self._fingers("release", segment.arm, world.joints_rad[segment.arm], rest.open_from, 1.0)
                return [opening, self._leave(segment.arm, pose[:2]), *theirs]
        if segment.kind == "retreat" and ours is None and self._passes(world, rest):
            return [rest, *theirs]
        if ours is not None:
            try:
                return [self._onward(world, "approach"), *self._from_grasp(ours, pose)]
            except WorkFailed:
                theirs = self.cycle(ours, pose)
        return [self._onward(world, "retreat"), *theirs]

    def diverted(self, world: WorldState, command: TransferCommand) -> list[MotionSegment]:
        """The block in the hand goes to another place."""
        segment, stop = world.program[0], self.stop(world)
        onward = self.paths.carry_on(segment.arm, stop.end_rad, command.place_mm)
        carry = self._joined(segment.arm, stop, onward, None)
        return [MotionSegment("carry", segment.arm, 0.0, 0.0, carry), *self._from_carry(command, world.pose)[1:]]

    def stop(self, world: WorldState) -> JointTrajectory:
        """The quickest stop of what is under way."""
        segment = world.program[0]
        if segment.track is None:
            return still(world.joints_rad[segment.arm].copy(), STEP_S)
        _, acceleration_rad_s2 = self.paths.limits[segment.arm]
        return stopped(segment.track, world.clock_s, acceleration_rad_s2)

    def _onward(self, world: WorldState, kind: str) -> MotionSegment:
        """From where the empty hand is to the pin (approach) or home (retreat)."""
        segment, stop, block = world.program[0], self.stop(world), world.pose[:2]
        ways = {"approach": self.paths.to_pin, "retreat": self.paths.home}
        onward = ways[kind](segment.arm, stop.end_rad, block)
        return MotionSegment(kind, segment.arm, float(world.opened[segment.arm]), 1.0, self._joined(segment.arm, stop, onward, block))

    def _joined(self, arm: int, stop: JointTrajectory, onward: JointTrajectory, block_mm: Floats | None) -> JointTrajectory:
        return joined(stop, onward, *self.paths.limits[arm], lambda joints: self.paths.allows(arm, joints, block_mm))

    def _from_grasp(self, command: TransferCommand, pose: Floats) -> list[MotionSegment]:
        """From the open hand at the pin on."""
        joints = self.paths.planner.grasp_joints(command.arm, "pick up", pose[:2])
        return [self._fingers("grasp", command.arm, joints, 1.0, 0.0), *self._from_carry(command, pose)]

    def _from_carry(self, command: TransferCommand, pose: Floats) -> list[MotionSegment]:
        """From the closed hand on, which has taken the block from ``pose`` (3,)."""
        arm, pick, place = command.arm, pose[:2].copy(), command.place_mm.copy()
        joints = self.paths.planner.grasp_joints(arm, "place", place)
        carry = MotionSegment("carry", arm, 0.0, 0.0, None, lambda: self.paths.carry(arm, pick, place))
        return [carry, self._fingers("release", arm, joints, 0.0, 1.0), self._leave(arm, place)]

    def _leave(self, arm: int, pin_mm: Floats) -> MotionSegment:
        """From a pin to the parked pose."""
        pin = pin_mm.copy()
        return MotionSegment("retreat", arm, 1.0, 1.0, None, lambda: self.paths.from_pin(arm, pin))

    def _fingers(self, kind: str, arm: int, joints_rad: Floats, open_from: float, open_to: float) -> MotionSegment:
        whole_s = self.motion.grasp_s if kind == "grasp" else self.motion.release_s
        track = still(joints_rad.copy(), max(whole_s * abs(open_to - open_from), STEP_S))
        return MotionSegment(kind, arm, open_from, open_to, track)

    def _passes(self, world: WorldState, rest: MotionSegment) -> bool:
        """Whether the rest of a retreat keeps off the block where it lies now."""
        return rest.track is not None and self.paths.clear_of_block(rest.arm, rest.track.joints_rad, world.pose[:2])

    @staticmethod
    def _rest(world: WorldState) -> MotionSegment:
        """What is left of the piece under way."""
        segment = world.program[0]
        track = None if segment.track is None else segment.track.rest(world.clock_s)
        return segment._replace(track=track, open_from=float(world.opened[segment.arm]))
