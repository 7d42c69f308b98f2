"""The block and the table, as every engine has them: masses, shapes, colours."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.config import BlockConfig

TABLE_MM = 50.0
"""Half of how thick the table is."""

TABLE_RGB = (0.93, 0.93, 0.91)
GOAL_RGB, BAR_RGB = (0.45, 0.75, 0.45), (0.84, 0.15, 0.16)

_BEAD_SPACING_MM = 6.0
_WOOD_KG_MM3 = 650e-9


class Part(NamedTuple):
    """What one part of the block looks like, in the block's frame: a box, or a cylinder along z; ``half_mm``: half of its sides."""

    kind: str
    half_mm: tuple[float, float, float]
    at_mm: tuple[float, float, float]
    rgb: tuple[float, float, float]


def block_look(config: BlockConfig) -> tuple[Part, ...]:
    """Wood, a white marker with a red bar towards +x and a blue dot towards +y, the pin."""
    side, up, pin, top = config.side_mm / 2, config.height_mm, config.pin_diameter_mm / 2, config.pin_top_mm
    marker = config.marker_mm / 2
    patches = (
        (marker, marker, 0.0, 0.0, (0.97, 0.97, 0.97)),
        (marker * 0.25, marker * 0.8, marker * 0.6, 0.0, BAR_RGB),
        (marker * 0.25, marker * 0.25, -marker * 0.4, marker * 0.5, (0.12, 0.35, 0.75)),
    )
    flat = [Part("box", (half_x, half_y, 0.2 * layer), (x, y, up), rgb) for layer, (half_x, half_y, x, y, rgb) in enumerate(patches, 1)]
    wood = Part("box", (side, side, up / 2), (0.0, 0.0, up / 2), (0.76, 0.60, 0.42))
    return wood, *flat, Part("cylinder", (pin, pin, (top - up) / 2), (0.0, 0.0, (up + top) / 2), (0.88, 0.78, 0.58))


def beads_mm(config: BlockConfig) -> Floats:
    """Heights of the beads that make up the pin's shape where an engine needs them.

    Between a thin cylinder and a flat finger Bullet finds the points of a line contact anew at each step, here and there along the line,
    and the pin works itself loose. A string of beads touches a flat finger in the same places all the time.
    """
    radius = config.pin_diameter_mm / 2
    lowest, highest = config.height_mm + radius, config.pin_top_mm - radius
    return np.linspace(highest, lowest, max(2, math.ceil((highest - lowest) / _BEAD_SPACING_MM) + 1))


def mass_properties(config: BlockConfig) -> tuple[float, float, tuple[float, float, float]]:
    """Mass in kg, height of the centre of mass in mm, and the principal moments in kg mm^2 about it, of solid wood."""
    side, height, radius, pin = config.side_mm, config.height_mm, config.pin_diameter_mm / 2, config.pin_top_mm - config.height_mm
    m_body, m_pin = _WOOD_KG_MM3 * side**2 * height, _WOOD_KG_MM3 * math.pi * radius**2 * pin
    z_body, z_pin = height / 2, height + pin / 2
    centre = (m_body * z_body + m_pin * z_pin) / (m_body + m_pin)
    across = m_body * ((side**2 + height**2) / 12 + (z_body - centre) ** 2) + m_pin * (
        (3 * radius**2 + pin**2) / 12 + (z_pin - centre) ** 2
    )
    along = m_body * side**2 / 6 + m_pin * radius**2 / 2
    return m_body + m_pin, centre, (across, across, along)
