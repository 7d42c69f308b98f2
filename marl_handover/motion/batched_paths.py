"""From a policy's numbers to the control points of a path, for thousands of transfers at once, in torch.

Start and end are the joints that hold the pin at pick and place (pitch = roll = 0, pick height); the numbers say where the control points
between them are, point by point, four joints each: base yaw, shoulder, elbow, wrist pitch. Wrist roll stays 0: it is 0 at both ends and
turns the block about the hand's own axis, which only brings it nearer to the table; the executors keep it 0 too.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_handover.arrays import Array, length, namespace, select
from marl_handover.cell import Cell
from marl_handover.cell.build import CellModel
from marl_handover.config import CentralisedConfig, MotionConfig
from marl_handover.geometry.capsules import segment_distance
from marl_handover.geometry.closed_form import into_plane, pitch_frames, planar_ik
from marl_handover.motion.collision_model import arm_collision_model, out_of_reach
from marl_handover.motion.initial_guesses import RUN_UP_MM, SAMPLES, hand_pitch
from marl_handover.motion.objective import first_moving
from marl_handover.motion.planner import STILL_MM, MotionPlanner
from marl_handover.motion.proportions import proportions
from marl_handover.motion.trajectory import basis, sample_places, sampled_basis

FIELDS = ("from_radius", "from_cos", "from_sin", "to_radius", "to_cos", "to_sin", "turn", "distance")
"""Radius and direction of both ends from the arm's base, the yaw between them, and their distance; all scaled to about [-1, 1]."""

JOINTS = 4
"""Numbers of a control point: base yaw, shoulder, elbow, wrist pitch."""


def transfer_features(cell: Cell, arm: Array, from_mm: Array, to_mm: Array, fold: bool) -> tuple[Array, Array]:
    """Features (..., 8) of ways between world positions (..., 2) as the arms (...) see them, and the sign (...) of their base yaw.

    ``fold``: M_x mirrors an arm's own frame, so a way that turns right is seen as its image, which turns left; the sign is then -1, and
    the base yaws of a motion that belongs to these features are those of the arm times the sign.
    """
    xp = namespace(from_mm)
    (square_1, yaw_1), (square_2, yaw_2) = cell.polar(from_mm), cell.polar(to_mm)
    radius_1, radius_2 = xp.sqrt(select(square_1, arm)), xp.sqrt(select(square_2, arm))
    yaw_1, yaw_2 = select(yaw_1, arm), select(yaw_2, arm)
    one = xp.ones_like(yaw_1)
    sign = xp.where(yaw_2 < yaw_1, -one, one) if fold else one
    middle, half = (cell.r_max_mm + cell.r_min_mm) / 2, (cell.r_max_mm - cell.r_min_mm) / 2
    distance = length(to_mm - from_mm)
    fields = [
        xp.clip((radius_1 - middle) / half, -3.0, 3.0),
        xp.cos(yaw_1),
        sign * xp.sin(yaw_1),
        xp.clip((radius_2 - middle) / half, -3.0, 3.0),
        xp.cos(yaw_2),
        sign * xp.sin(yaw_2),
        sign * (yaw_2 - yaw_1) / math.pi,
        distance / (2 * cell.r_max_mm),
    ]
    return xp.stack(fields, -1), sign


def mirrored_numbers(numbers: Array, sign: Array) -> Array:
    """A motion's numbers (..., M), their base yaws times ``sign`` (...)."""
    xp = namespace(numbers)
    points = numbers.reshape(*numbers.shape[:-1], -1, JOINTS)
    turned = xp.concat([points[..., :1] * sign[..., None, None], points[..., 1:]], -1)
    return turned.reshape(*numbers.shape)


CHUNK = 1024
"""Rows judged together: their samples stay in the processor's cache."""

CROWDING = 0.6
"""Samples are denser towards both ends, where a block is near the table; see :func:`marl_handover.motion.initial_guesses.sample_places`."""

ROUNDING_MM = 0.03
"""A block on the table may be this much in it: single precision, and poses at the edge of the reach, which are some 20 um off."""

LIMIT_RAD = 1e-5
"""Joints may pass a limit by single precision's rounding."""

FAR_MM = 1e9


class Ends(NamedTuple):
    """Both ends of transfers, seen from the base of the arm that makes them: ``radius_mm`` and ``yaw_rad``, both (n, 2), from and to."""

    radius_mm: Tensor
    yaw_rad: Tensor

    @property
    def places_mm(self) -> Tensor:
        """(n, 2, 2): x, y in the arm's base frame of from and to."""
        return torch.stack([self.radius_mm * self.yaw_rad.cos(), self.radius_mm * self.yaw_rad.sin()], -1)

    def share(self, lift_scale_mm: float) -> Tensor:
        """Part (n,) of the demanded heights that a short way is asked for, as the executors' planner has it."""
        start, end = self.places_mm.unbind(-2)
        distance = (end - start).square().sum(-1).sqrt()
        return (distance.clamp_min(STILL_MM) / (2 * lift_scale_mm)).clamp_max(1.0)


class Frames(NamedTuple):
    """Pivot (r, z) and (cos, sin) of the pitch of every level, each (..., 5), and (cos, sin) of the yaw, each (...)."""

    r: Tensor
    z: Tensor
    cos: Tensor
    sin: Tensor
    cos_yaw: Tensor
    sin_yaw: Tensor

    def at(self, level: int, x: float, z: float) -> tuple[Tensor, Tensor]:
        """A point (x, z) of a level's frame as (r, z) in mm."""
        cos, sin = self.cos[..., level], self.sin[..., level]
        return self.r[..., level] + cos * x - sin * z, self.z[..., level] + sin * x + cos * z

    def rows(self, index: Tensor) -> Frames:
        """Those of flat sample numbers (m,)."""
        return Frames(*(part.flatten(0, 1)[index] for part in self))


class MotionCheck:
    """Which motions an arm may make with the block in its hand.

    Args:
        model: the cell.
        motion: clearances and the parked pose.
        settings: control points, degree and samples of the splines.

    Raises:
        InvalidSetting: on a motion setting out of its limits.
    """

    def __init__(self, model: CellModel, motion: MotionConfig, settings: CentralisedConfig) -> None:
        planner = MotionPlanner(model, motion)
        body = planner.collision_model
        self.motion = motion
        self.planar, self.capsules, self.edges = body.planar, body.held, body.edges
        self.carried, self.first = len(body.capsules), int(first_moving(body.held))
        self.pairs = [(int(one), int(other)) for one, other in body.held_pairs]
        self.link_balls = self._balls_of_links()
        # What the planner sets around the path of a loaded hand; the middle of the shared space is in every arm's reach.
        arms = range(model.cell.num_arms)
        scenes = [planner.carrying(arm, np.zeros(2), np.zeros(2), planner.others_home_rad(arm))[0].scene for arm in arms]
        others = np.stack([scene.obstacles for scene in scenes])
        others = others[:, ~np.all([out_of_reach(body, rows) for rows in others], axis=0)]
        self.constants = {
            "basis": basis(sample_places(settings.samples, CROWDING), settings.control_points, settings.degree),
            "limits": body.limits,
            "capsules": body.held,
            "pairs": body.held_pairs,
            "obstacles": others,
        }
        self._placed: dict[torch.device, dict[str, Tensor]] = {}

    @torch.no_grad()
    def passes(self, arm: Tensor, points: Tensor, ends: Ends) -> Tensor:
        """Whether motions are allowed, bool (n,).

        Args:
            arm: int (n,), who makes them.
            points: (n, N, 4) control points in rad, wrist roll 0 left out; the first and the last are the joints at the ends.
            ends: of the transfers.
        """
        parts = [self._passes(*(part[first : first + CHUNK] for part in (arm, points, *ends))) for first in range(0, len(arm), CHUNK)]
        return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.bool, device=arm.device)

    def _passes(self, arm: Tensor, points: Tensor, radius_mm: Tensor, yaw_rad: Tensor) -> Tensor:
        known = self._constants(points.device)
        joints = torch.einsum("sp,npj->nsj", known["basis"], points.float())
        low, high = known["limits"].unbind(-1)
        good = ((points >= low - LIMIT_RAD) & (points <= high + LIMIT_RAD)).all(-1).all(-1)
        frames = self._frames(joints)
        good &= self._heights(frames, Ends(radius_mm.float(), yaw_rad.float()))
        for judge in (self._itself, self._others):
            left = good.nonzero()[:, 0]
            if len(left):
                some = frames if len(left) == len(good) else Frames(*(part[left] for part in frames))
                good[left] = judge(some, arm[left], known)
        return good

    def _frames(self, joints: Tensor) -> Frames:
        """Of joint samples (n, S, 4)."""
        r, z, cos, sin = pitch_frames(self.planar, joints)
        standing = torch.zeros_like(r[..., :2])  # base and turret do not pitch
        r, z, cos, sin = (torch.cat(pair, -1) for pair in ((standing, r), (standing, z), (standing + 1, cos), (standing, sin)))
        return Frames(r, z, cos, sin, joints[..., 0].cos(), joints[..., 0].sin())

    def _heights(self, frames: Frames, ends: Ends) -> Tensor:
        """Whether every moving body is clear of the table, and the block's lower edges as high as they must be, bool (n,)."""
        lowest = torch.full_like(frames.cos_yaw, FAR_MM)
        for row in self.capsules[self.first : self.carried]:
            for x, z in ((row[1], row[3]), (row[4], row[6])):
                lowest = torch.minimum(lowest, frames.at(int(row[0]), x, z)[1] - (row[7] + self.motion.ground_clearance_mm))
        r, _ = frames.at(4, self.planar[6], self.planar[7])
        share = ends.share(self.motion.lift_scale_mm)
        ramp = torch.ones_like(r)
        aside = float(self.planar[8])
        x_mm, y_mm = r * frames.cos_yaw - aside * frames.sin_yaw, r * frames.sin_yaw + aside * frames.cos_yaw
        for place in ends.places_mm.unbind(-2):
            away = (x_mm - place[:, None, 0]).square() + (y_mm - place[:, None, 1]).square()
            ramp = ramp * (1 - (-away / (share * self.motion.lift_scale_mm).square()[:, None]).exp())
        asked = (share * self.motion.ground_clearance_mm)[:, None] * ramp - ROUNDING_MM
        for x, z in self.edges:
            lowest = torch.minimum(lowest, frames.at(4, x, z)[1] - asked)
        return (lowest >= 0).all(-1)

    def _itself(self, frames: Frames, arm: Tensor, known: dict[str, Tensor]) -> Tensor:
        """Whether the arm and what it holds keep clear of itself, bool (n,)."""
        clearance = self.motion.self_clearance_mm
        middles = [self._middle(frames, row) for row in self.capsules]
        close = []
        for one, other in self.pairs:
            (r_1, t_1, z_1), (r_2, t_2, z_2), first, second = middles[one], middles[other], self.capsules[one], self.capsules[other]
            away = first[7] + second[7] + first[8] + second[8] + clearance
            close.append((r_1 - r_2).square() + (z_1 - z_2).square() <= away**2 - (t_1 - t_2) ** 2)
        if not close:
            return torch.ones_like(arm, dtype=torch.bool)
        pair, sample = torch.stack(close).flatten(1).nonzero().unbind(-1)
        some = frames.rows(sample)
        first, second = (_segments(some, known["capsules"][known["pairs"][pair, which]][:, None])[:, 0] for which in range(2))
        return _none_of(sample[nearer(first, second, clearance)], frames)

    @staticmethod
    def _middle(frames: Frames, row: NDArray[np.float64]) -> tuple[Tensor, Tensor | float, Tensor]:
        """Where the middle (r, t, z) of a capsule is; one of the base turns against the yaw."""
        x, y, z = ((row[axis] + row[axis + 3]) / 2 for axis in (1, 2, 3))
        if row[0] == 0 and (x != 0 or y != 0):
            return x * frames.cos_yaw + y * frames.sin_yaw, y * frames.cos_yaw - x * frames.sin_yaw, torch.full_like(frames.cos_yaw, z)
        r, height = frames.at(int(row[0]), x, z)
        return r, y, height

    def _others(self, frames: Frames, arm: Tensor, known: dict[str, Tensor]) -> Tensor:
        """Whether the moving arm and what it holds keep clear of the parked ones, bool (n,)."""
        ball = known["balls"][arm][:, None]
        near = torch.zeros_like(frames.cos_yaw, dtype=torch.bool)
        for level, x, z, radius in self.link_balls:
            r, height = frames.at(level, x, z)
            away = (r * frames.cos_yaw - ball[..., 0]).square() + (r * frames.sin_yaw - ball[..., 1]).square()
            near |= away + (height - ball[..., 2]).square() <= (ball[..., 3] + radius).square()
        sample = near.flatten().nonzero()[:, 0]
        some = frames.rows(sample)
        capsules = known["capsules"][self.first :]
        moving = _segments(some, capsules.expand(len(sample), *capsules.shape))
        standing = _turned(known["obstacles"][arm[_row(sample, frames)]], some.cos_yaw, some.sin_yaw)
        shape = (len(sample), moving.shape[1], standing.shape[1], 8)
        first, second = moving[:, :, None].expand(shape), standing[:, None].expand(shape)
        clearance = self.motion.arm_clearance_mm
        middle = (first[..., :3] + first[..., 3:6] - second[..., :3] - second[..., 3:6]) / 2
        away = first[..., 6] + second[..., 6] + first[..., 7] + second[..., 7] + clearance
        close = (middle.square().sum(-1) <= away.square()).nonzero()
        index = close.unbind(-1)
        return _none_of(sample[close[nearer(first[index], second[index], clearance), 0]], frames)

    def _balls_of_links(self) -> list[tuple[int, float, float, float]]:
        """Level, (x, z) in its frame and radius in mm of a ball around each moving link."""
        balls = []
        for level in sorted({int(level) for level in self.capsules[self.first :, 0]}):
            rows = self.capsules[self.capsules[:, 0] == level]
            points = rows[:, 1:7].reshape(-1, 3)
            centre = (points.min(axis=0) + points.max(axis=0)) / 2 * np.array([1.0, 0.0, 1.0])
            away = np.linalg.norm(rows[:, 1:7].reshape(-1, 2, 3) - centre, axis=-1).max(axis=1) + rows[:, 7]
            balls.append((level, float(centre[0]), float(centre[2]), float(away.max())))
        return balls

    def _constants(self, device: torch.device) -> dict[str, Tensor]:
        """The packed geometry on a device; made once for each."""
        if device not in self._placed:
            placed: dict[str, Tensor] = {}
            for name, value in self.constants.items():
                kind: Any = torch.int64 if name == "pairs" else torch.float32
                placed[name] = torch.as_tensor(np.asarray(value), dtype=kind, device=device)
            placed["balls"] = torch.stack([_ball_around(rows) for rows in placed["obstacles"]])
            self._placed[device] = placed
        return self._placed[device]


def nearer(first: Tensor, second: Tensor, clearance_mm: float) -> Tensor:
    """Whether segments (m, 8), see :func:`_segments`, are nearer to each other than their radii and the clearance allow, bool (m,)."""
    one, other = first.double(), second.double()
    return segment_distance(one[:, :3], one[:, 3:6], other[:, :3], other[:, 3:6]) < one[:, 6] + other[:, 6] + clearance_mm


def _segments(frames: Frames, capsules: Tensor) -> Tensor:
    """Placed capsules (m, K, 8): both ends (r, t, z), radius, half the length; of flat samples (m,) and capsule rows (m, K, 9)."""
    level = capsules[..., 0].long()
    # Seen from the arm's plane, the base turns against the yaw.
    cos_yaw, sin_yaw = (torch.where(level == 0, part[:, None], one) for part, one in ((frames.cos_yaw, 1.0), (frames.sin_yaw, 0.0)))
    r, z, cos, sin = (part.gather(1, level) for part in (frames.r, frames.z, frames.cos, frames.sin))
    columns = []
    for x, y, height in (capsules[..., 1:4].unbind(-1), capsules[..., 4:7].unbind(-1)):
        ahead, t = cos_yaw * x + sin_yaw * y, cos_yaw * y - sin_yaw * x
        columns += [r + cos * ahead - sin * height, t, z + sin * ahead + cos * height]
    return torch.stack([*columns, capsules[..., 7], capsules[..., 8]], -1)


def _row(sample: Tensor, frames: Frames) -> Tensor:
    """The motions to which flat sample numbers belong."""
    return torch.div(sample, frames.cos_yaw.shape[1], rounding_mode="floor")


def _none_of(sample: Tensor, frames: Frames) -> Tensor:
    """Which motions have none of these flat samples, bool (n,)."""
    good = torch.ones(len(frames.cos_yaw), dtype=torch.bool, device=sample.device)
    good[_row(sample, frames)] = False
    return good


def _turned(obstacles: Tensor, cos_yaw: Tensor, sin_yaw: Tensor) -> Tensor:
    """Obstacle rows (m, M, 9) as segments (m, M, 8) in the plane of an arm turned by a yaw, (m,)."""
    cos, sin = cos_yaw[:, None], sin_yaw[:, None]
    columns = []
    for x, y, z in (obstacles[..., 0:3].unbind(-1), obstacles[..., 3:6].unbind(-1)):
        columns += [cos * x + sin * y, cos * y - sin * x, z]
    return torch.stack([*columns, obstacles[..., 6], obstacles[..., 8]], -1)


def _ball_around(obstacles: Tensor) -> Tensor:
    """A ball (x, y, z, radius) in mm around obstacle rows (M, 9), the clearance they demand included."""
    points = obstacles[:, :6].reshape(-1, 2, 3)
    centre = (points.amin((0, 1)) + points.amax((0, 1))) / 2
    away = (points - centre).square().sum(-1).sqrt().amax(1) + obstacles[:, 6] + obstacles[:, 7]
    return torch.cat([centre, away.amax()[None]])


END_WEIGHT, END_WIDTH = 100.0, 0.08
"""How much more the ends of the straight guess weigh when few control points are fitted to it, and how far into the path.

At the ends a block that tilts goes into the table: with even weights 73 % of the zeros pass the check, with these 94 %.
"""


def ends_of(cell: Cell, arm: Tensor, from_mm: Tensor, to_mm: Tensor) -> Ends:
    """Both ends, world positions (n, 2) in mm, as the acting arms (n,) see them."""
    seen = [cell.polar(place) for place in (from_mm, to_mm)]
    square, yaw = (torch.stack([select(parts[which], arm) for parts in seen], -1) for which in range(2))
    if any(each.lateral_mm for each in cell.arms):  # the cell counts base yaws; ends are where the places are seen
        aside = square.new_tensor([each.lateral_mm for each in cell.arms])[arm][:, None]
        yaw = yaw + torch.atan2(aside, (square - aside.square()).clamp_min(0.0).sqrt())
    return Ends(square.sqrt(), yaw)


class MotionNumbers:
    """What a policy's numbers, each in [-1, 1], mean.

    Attributes:
        count: numbers of a motion.

    Args:
        model: the cell.
        motion: lift of the straight first guess.
        settings: which meaning, and the splines.
    """

    def __init__(self, model: CellModel, motion: MotionConfig, settings: CentralisedConfig) -> None:
        self.settings, self.motion, self.planar = settings, motion, model.arm.planar
        body = arm_collision_model(model, motion, 0)
        self.pick_height_mm = float(model.cell.pick_height_mm)
        self.count = JOINTS * (settings.control_points - 2)
        self.limits = torch.tensor(body.limits, dtype=torch.float32)
        B, tau = np.array(sampled_basis(SAMPLES, settings.control_points, settings.degree)), np.linspace(0.0, 1.0, SAMPLES)
        weight = 1 + END_WEIGHT * np.exp(-((np.minimum(tau, 1 - tau) / END_WIDTH) ** 2))
        self.first, self.last = (torch.tensor(B[:, column], dtype=torch.float32)[:, None] for column in (0, -1))
        self.inverse = torch.tensor(np.linalg.pinv(weight[:, None] * B[:, 1:-1]) * weight, dtype=torch.float32)
        self.along = torch.tensor(sample_places(SAMPLES, 0.5), dtype=torch.float32)

    @torch.no_grad()
    def points(self, ends: Ends, numbers: Tensor) -> Tensor:
        """Control points (n, N, 4) in rad, within the joint limits, of ``numbers`` (n, count)."""
        device = numbers.device
        low, high = self.limits.to(device).unbind(-1)
        joints = self.end_joints(ends)
        given = numbers.float().unflatten(-1, (-1, JOINTS))
        if self.settings.motion == "flat":
            inner = low + (given + 1) / 2 * (high - low)
        else:
            inner = self.straight(ends, joints) + self.settings.offset_rad * given
        return torch.cat([joints[:, :1], inner.clamp(low, high), joints[:, 1:]], 1)

    def end_joints(self, ends: Ends) -> Tensor:
        """Joints (n, 2, 4) with the grip at both ends, level and at the pick height; at the limits where rounding would pass them."""
        radius, yaw = into_plane(self.planar, ends.radius_mm.float(), ends.yaw_rad.float())
        joints = self._elbow_up(radius, torch.full_like(radius, self.pick_height_mm), torch.zeros_like(radius), yaw)
        low, high = self.limits.to(radius.device).unbind(-1)
        return joints.clamp(low, high)

    def straight(self, ends: Ends, joints: Tensor) -> Tensor:
        """Inner control points (n, N - 2, 4) of the executors' straight first guess: up, along the line over the table, and down.

        The batched twin of the first of :func:`marl_handover.motion.initial_guesses.carrying_guesses`, fitted with weights.
        """
        device = joints.device
        t = self.along.to(device)
        start, end = ends.places_mm.float().unbind(-2)
        places = start[:, None] + (end - start)[:, None] * t[:, None]
        distance = (end - start).square().sum(-1).sqrt()[:, None]
        radius, yaw = into_plane(self.planar, places.square().sum(-1).sqrt(), torch.atan2(places[..., 1], places[..., 0]))
        radius = radius.clamp_min(proportions(self.planar).grip_least_mm)
        lift = self.motion.lift_mm * ends.share(self.motion.lift_scale_mm).float()[:, None]
        height = self.pick_height_mm + lift * (torch.minimum(t, 1 - t) * distance / RUN_UP_MM).clamp_max(1.0)
        samples = self._elbow_up(radius, height, hand_pitch(self.planar, radius), yaw)
        low, high = self.limits.to(device).unbind(-1)
        even = torch.linspace(0.0, 1.0, SAMPLES, device=device)[:, None]
        line = joints[:, :1] + (joints[:, 1:] - joints[:, :1]) * even
        samples = torch.where(samples.isnan(), line, samples.clamp(low, high))
        samples = torch.cat([joints[:, :1], samples[:, 1:-1], joints[:, 1:]], 1)
        outer = self.first.to(device) * joints[:, :1] + self.last.to(device) * joints[:, 1:]
        return torch.einsum("ks,nsj->nkj", self.inverse.to(device), samples - outer)

    def _elbow_up(self, radius: Tensor, height: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
        """Joints (..., 4) with the grip at radius and height in mm and this pitch; NaN out of reach."""
        return torch.cat([yaw[..., None], planar_ik(self.planar, radius, height, pitch, -1)], -1)
