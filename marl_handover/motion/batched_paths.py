"""From a policy's numbers to the control points of a path, for thousands of transfers at once, in torch.

Start and end are the joints that hold the pin at pick and place (pitch = roll = 0, pick height); the numbers say where the control points
between them are, point by point, four joints each: base yaw, shoulder, elbow, wrist pitch. Wrist roll stays 0: it is 0 at both ends and
turns the block about the hand's own axis, which only brings it nearer to the table; the executors keep it 0 too.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from marl_handover.arrays import select
from marl_handover.cell import Cell
from marl_handover.cell.build import CellModel
from marl_handover.config import CentralisedConfig, MotionConfig
from marl_handover.geometry.closed_form import planar_ik
from marl_handover.motion.batched_collision import Ends
from marl_handover.motion.collision_model import arm_collision_model
from marl_handover.motion.initial_guesses import GRIP_LEAST_MM, RUN_UP_MM, SAMPLES, WRIST_LEAST_MM
from marl_handover.motion.splines import sample_places, sampled_basis
from marl_handover.motion.transfer_features import JOINTS

END_WEIGHT, END_WIDTH = 100.0, 0.08
"""How much more the ends of the straight guess weigh when few control points are fitted to it, and how far into the path.

At the ends a block that tilts goes into the table: with even weights 73 % of the zeros pass the check, with these 94 %.
"""


def ends_of(cell: Cell, arm: Tensor, from_mm: Tensor, to_mm: Tensor) -> Ends:
    """Both ends, world positions (n, 2) in mm, as the acting arms (n,) see them."""
    seen = [cell.polar(place) for place in (from_mm, to_mm)]
    square, yaw = (torch.stack([select(parts[which], arm) for parts in seen], -1) for which in range(2))
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
        body = arm_collision_model(model, motion)
        self.settings, self.motion = settings, motion
        self.planar = model.arm.planar
        self.pick_height_mm = float(model.cell.config.pick_height_mm)
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
        radius = ends.radius_mm.float()
        joints = self._elbow_up(radius, torch.full_like(radius, self.pick_height_mm), torch.zeros_like(radius), ends.yaw_rad.float())
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
        radius = places.square().sum(-1).sqrt().clamp_min(GRIP_LEAST_MM)
        lift = self.motion.lift_mm * ends.share(self.motion.lift_scale_mm).float()[:, None]
        height = self.pick_height_mm + lift * (torch.minimum(t, 1 - t) * distance / RUN_UP_MM).clamp_max(1.0)
        tool = math.hypot(*self.planar[6:8])
        down = -((radius - WRIST_LEAST_MM) / tool).clamp(0.0, 1.0).arccos()
        samples = self._elbow_up(radius, height, down, torch.atan2(places[..., 1], places[..., 0]))
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
