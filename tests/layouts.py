"""Cells of 2 to 8 arms that tests share."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from marl_handover.cell import build_cell
from marl_handover.config import ArmConfig, CellConfig

SHIPPED = {"triangle": 3, "line4": 4, "ring6": 6}
"""Cells of many arms that travel with the package."""

BLOCKED = """name: blocked
robot: al5a_paper
arms:
  - {name: west, x_mm: -180.0, facing_deg: 0.0}
  - {name: east, x_mm: 180.0, facing_deg: 180.0}
  - {name: a rather long name, y_mm: 310.0, facing_deg: -90.0}
obstacles:
  - {x_mm: 0.0, y_mm: -60.0, radius_mm: 15.0}
  - {x_mm: -100.0, y_mm: 190.0, radius_mm: 12.0, height_mm: 80.0}
"""
"""A cell with obstacles, as a file of settings."""


def ring(count, side_mm=360.0):
    """Arms on a regular polygon, each facing its middle; two of them are a mirrored pair."""
    radius, angles = side_mm / (2 * math.sin(math.pi / count)), 2 * math.pi / count * np.arange(count)
    return [ArmConfig(f"a{k}", radius * math.cos(a), radius * math.sin(a), math.degrees(a) - 180.0) for k, a in enumerate(angles)]


def line(count, side_mm=340.0):
    """Arms in a zigzag row: only neighbours share a place."""
    x, y = side_mm * math.cos(math.radians(35.0)), side_mm * math.sin(math.radians(35.0))
    return [ArmConfig(f"b{k}", k * x, (k % 2) * y, 90.0 if k % 2 == 0 else -90.0) for k in range(count)]


MODELS = {}


def model_of(count, layout=ring):
    """A cell of so many arms, built once."""
    key = count, layout
    if key not in MODELS:
        MODELS[key] = build_cell(replace(CellConfig(name="many", grid_mm=10.0, chart="angle"), arms=layout(count)))
    return MODELS[key]


def moved(arms, discs, poses, angle, shift, flip):
    """Layout and poses after a reflection of the table (y -> -y) if ``flip`` says so, then a turn and a shift."""
    arms, discs, poses = arms.copy(), discs.copy(), [pose.copy() for pose in poses]
    cos, sin = math.cos(angle), math.sin(angle)
    sign = -1.0 if flip else 1.0
    for points in (arms[:, :2], discs[:, :2], *(pose[:, :2] for pose in poses)):
        points[:] = np.stack([cos * points[:, 0] - sin * sign * points[:, 1], sin * points[:, 0] + cos * sign * points[:, 1]], -1) + shift
    for directions in (arms[:, 2], *(pose[:, 2] for pose in poses)):
        directions[:] = sign * directions + angle
    if flip:
        arms[:, 5:7] = -arms[:, [6, 5]]
    return arms, discs, poses
