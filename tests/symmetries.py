"""The symmetries of a mirrored pair, as tests name them."""

from __future__ import annotations

from marl_handover.cell import Symmetry, load_cell

GROUP = load_cell("paper").symmetries


def mirror(*, x: bool = False, y: bool = False) -> Symmetry:
    """The element that mirrors along the base line (``x``), in the plane between the arms (``y``), or both."""
    return next(element for element in GROUP if (flips_x(element), element.swaps) == (x, y))


def flips_x(element: Symmetry) -> bool:
    """Whether x, and alpha with it, changes its sign."""
    return element.chart_signs[(0, 1)][0] < 0
