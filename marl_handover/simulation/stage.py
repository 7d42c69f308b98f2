"""What a video shows beside the cell itself: what each arm reaches, on the table, and whose base is whose. Nothing can touch it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.cell import Cell
from marl_handover.palette import SHARED, arm_colour
from marl_handover.simulation.engine import Engine, length, pybullet
from marl_handover.simulation.world import BulletCell

Floats = NDArray[np.float64]

_TINT, _SHARED_TINT = 0.22, 0.4
_TABLE = np.array([0.93, 0.93, 0.91])
_STRIP = 96


def dress(cell: BulletCell) -> None:
    """Tint the sectors of the table that the arms reach and the part they share, and colour the bases, until the next reset."""
    model = cell.model.cell
    for index, arm in enumerate(cell.arms):
        colour = arm_colour(index)
        _lay(cell.engine, *_sector_mm(model, index), 0.1 + 0.05 * index, _tinted(colour, _TINT))
        for link in (-1, 0):
            rgba = [*_rgb(colour), 1.0]
            pybullet.changeVisualShape(arm.body, link, rgbaColor=rgba, physicsClientId=cell.engine.client)
    _lay(cell.engine, *_shared_mm(model), 0.2, _tinted(SHARED, _SHARED_TINT))


def _sector_mm(cell: Cell, arm: int) -> tuple[Floats, Floats]:
    """Inner and outer edge (n, 2) of an arm's annulus sector."""
    base = cell.bases[arm]
    angle = base.facing_rad + np.linspace(*cell.yaw_rad, _STRIP)
    ray = np.stack([np.cos(angle), np.sin(angle)], -1)
    at = base.position_mm
    return at + cell.r_min_mm * ray, at + cell.r_max_mm * ray


def _shared_mm(cell: Cell) -> tuple[Floats, Floats]:
    """Lower and upper edge (n, 2) of the chart."""
    along = np.linspace(-1.0, 1.0, _STRIP)
    return np.asarray(cell.chart.to_table(along, 0 * along - 1)), np.asarray(cell.chart.to_table(along, 0 * along + 1))


def _lay(engine: Engine, one_mm: Floats, other_mm: Floats, height_mm: float, rgb: Floats) -> None:
    """A flat strip between two edges, seen from both sides."""
    edges = np.concatenate([one_mm, other_mm])
    vertices = [[length(x), length(y), 0.0] for x, y in edges]
    first = np.arange(len(one_mm) - 1)
    corners = np.stack([first, first + 1, first + len(one_mm), first + 1, first + len(one_mm) + 1, first + len(one_mm)], -1).reshape(-1, 3)
    indices = np.concatenate([corners, corners[:, ::-1]]).ravel().tolist()
    shape = pybullet.createVisualShape(
        pybullet.GEOM_MESH,
        vertices=vertices,
        indices=indices,
        normals=[[0, 0, 1]] * len(vertices),
        rgbaColor=[*rgb, 1.0],
        physicsClientId=engine.client,
    )
    pybullet.createMultiBody(baseMass=0, baseVisualShapeIndex=shape, basePosition=[0, 0, length(height_mm)], physicsClientId=engine.client)


def _rgb(colour: str) -> Floats:
    return np.array([int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)])


def _tinted(colour: str, share: float) -> Floats:
    """The table with so much of a colour over it."""
    return share * _rgb(colour) + (1 - share) * _TABLE
