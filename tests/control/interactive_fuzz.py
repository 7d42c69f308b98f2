"""Changes at random moments, and everything the cell was seen to do in it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from marl_handover import policies
from marl_handover.control.interactive.cell import InteractiveCell, Snapshot
from marl_handover.geometry.capsules import block_capsules, capsule_pairs, segment_distance
from marl_handover.geometry.urdf import ARM_JOINTS

DT_S = 0.02
EXACT_MM = 0.05
"""Hands are exact to rounding, but for the edge of their reach."""

HELD = ("lift", "transfer", "lower")


class Seen(NamedTuple):
    """Snapshots at intervals of 20 ms; ``dragged``: the block was put elsewhere before this one."""

    snapshots: list[Snapshot]
    dragged: list[bool]


def make(model, name="exact", seed=0):
    return InteractiveCell(policies.load(name), model, seed=seed)


def place(cell, radius_mm, yaw_deg, arm=0, turn_deg=0.0):
    """A pose at polar coordinates of an arm."""
    base = cell.model.cell.bases[arm]
    angle = base.facing_rad + math.radians(yaw_deg)
    return np.array([base.x_mm + radius_mm * math.cos(angle), base.y_mm + radius_mm * math.sin(angle), math.radians(turn_deg)])


def one_transfer(cell, from_deg=-70.0, to_deg=60.0):
    """A problem that the left arm solves alone, in its own part of the table."""
    start, goal = place(cell, 190.0, from_deg), place(cell, 190.0, to_deg, turn_deg=to_deg - from_deg)
    cell.set_block(start)
    cell.set_goal(goal)
    return start, goal


def some_pose(cell, random, near=None):
    """A pose that an arm reaches, half the time near a given one."""
    while True:
        pose = np.array([random.uniform(-230, 230), random.uniform(-410, 410), random.uniform(-math.pi, math.pi)])
        if near is not None and random.random() < 0.5:
            pose = near + random.normal(size=3) * (40.0, 40.0, 1.0)
        if cell.reaches(pose).any():
            return pose


def settle(cell: InteractiveCell, limit_s: float = 400.0) -> list[Snapshot]:
    """Until the episode has ended."""
    seen = [cell.advance(DT_S)]
    while seen[-1].state not in ("done", "stuck"):
        seen.append(cell.advance(DT_S))
        assert len(seen) * DT_S < limit_s, f"still {seen[-1].state} after {limit_s} s: {seen[-1].message}"
    return seen


def until(cell: InteractiveCell, *phases: str, steps: int = 0) -> Snapshot:
    """Until one of these phases, and so many steps on."""
    seen = cell.advance(DT_S)
    for _ in range(2000):
        if seen.phase in phases:
            break
        seen = cell.advance(DT_S)
    else:
        raise AssertionError(f"never came to {phases}")
    for _ in range(steps):
        seen = cell.advance(DT_S)
    return seen


def fuzz(cell: InteractiveCell, changes: int, seed: int, rest_every: int = 20) -> Seen:
    """Goals, blocks and problems at random moments, some of them in bursts; now and then the cell is left alone until the end."""
    random, snapshots, dragged = np.random.default_rng(seed), [cell.advance(DT_S)], [False]

    def tick(drag=False):
        snapshots.append(cell.advance(DT_S))
        dragged.append(drag)

    for count in range(1, changes + 1):
        for _ in range(random.integers(1, 60)):
            tick()
        kind = random.random()
        for _ in range(random.integers(2, 6) if random.random() < 0.3 else 1):
            if kind < 0.5:
                cell.set_goal(some_pose(cell.model.cell, random))
            elif kind < 0.9:
                cell.set_block(some_pose(cell.model.cell, random, snapshots[-1].block))
            else:
                cell.new_problem()
            tick(kind >= 0.5)
        if count % rest_every == 0:
            rest = settle(cell)
            snapshots += rest
            dragged += [False] * len(rest)
    return Seen(snapshots, dragged)


def joints_of(seen: Seen):
    """(n, num_arms, 5)."""
    return np.stack([it.joints_rad for it in seen.snapshots])


def rates_limits(cell: InteractiveCell):
    """Velocity and acceleration limits (5,), from the URDF and the settings."""
    velocities = np.array([cell.model.arm.description.joint(name).velocity for name in ARM_JOINTS])
    return cell.motion.velocity_scale * velocities, math.radians(cell.motion.acceleration_deg_s2)


def least_gaps_mm(cell: InteractiveCell, seen: Seen):
    """The arms' least distance from each other (n,), and the hands' from a block that nobody holds (n,), inf where a hand holds it."""
    config, arms, to_block = cell.model.cell.config, [], []
    places = np.stack([np.append(it.block[:2], cell.model.cell.pick_height_mm) for it in seen.snapshots])
    capsules = block_capsules(config.block, cell.model.cell.pick_height_mm)
    joints = joints_of(seen)
    for index, base in enumerate(cell.model.cell.bases):
        frames = cell.model.arm.link_transforms(joints[:, index], cell.motion.finger_travel_mm)
        cos, sin = base.facing
        turn, shift = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]), np.array([base.x_mm, base.y_mm, 0])
        shapes = []
        for capsule in capsule_pairs(cell.model.arm.description)[0]:
            T = frames[capsule.link]
            ends = [(T[..., :3, :3] @ np.array(end) + T[..., :3, 3]) @ turn.T + shift for end in (capsule.start_mm, capsule.end_mm)]
            shapes.append((*ends, capsule.radius_mm))
        arms.append(shapes)
        # Capsules that cover the block however it is turned: they lie as the arm sees them, and are no disc.
        block = [(places + turn @ it.start_mm, places + turn @ it.end_mm, it.radius_mm) for it in capsules]
        to_block.append(_least(shapes, block))
    between = _least(*arms)
    held = np.array([it.T_world_block[2, 3] > 1e-6 or it.phase in (*HELD, "grasp", "release") for it in seen.snapshots])
    return between, np.where(held, np.inf, np.minimum(*to_block))


def _least(ones, others):
    """Least distance (n,) of the capsules (start, end, radius) of two bodies."""
    least = np.inf
    for a, b, r in ones:
        for c, d, s in others:
            least = np.minimum(least, segment_distance(a, b, c, d) - r - s)
    return least
