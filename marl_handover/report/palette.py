"""The palette of figures: the package's colours, and the line styles that go with them.

Colour never stands alone: the arms also differ in line style, outcomes in their labels.
"""

from __future__ import annotations

from marl_handover.palette import ARMS, BLUE, FAINT, GOAL, GREY, INK, OUTCOMES, PAPER, RED, SHARED, YELLOW, arm_colour

__all__ = [
    "ARMS",
    "ARM_LINES",
    "BLUE",
    "FAINT",
    "GOAL",
    "GREY",
    "HATCHES",
    "INK",
    "OUTCOMES",
    "PAPER",
    "RED",
    "SERIES",
    "SERIES_LINES",
    "SERIES_MARKERS",
    "SHARED",
    "YELLOW",
    "arm_colour",
    "arm_line",
    "series_marker",
    "series_style",
]

ARM_LINES = ("-", "--")
"""Line style of each arm, by its index."""


def arm_line(index: int) -> str:
    """Line style of an arm; further arms start over."""
    return ARM_LINES[index % len(ARM_LINES)]


HATCHES = {"success": "", "wrong_orientation": "//", "wrong_position": "xx", "timeout": ".."}
"""Hatching of each way an episode ends."""

SERIES = ("#4477AA", "#EE6677", "#228833", "#CCBB44", "#66CCEE", "#AA3377", "#555555")
SERIES_LINES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)))
"""Paul Tol's bright colours for many curves in one picture, and the line styles that go with them; 35 differ."""


def series_style(index: int) -> dict[str, object]:
    """Colour and line style of the curve of that index: no two neighbours share either."""
    return {"color": SERIES[index % len(SERIES)], "linestyle": SERIES_LINES[index % len(SERIES_LINES)]}


SERIES_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
"""What tells curves apart where they are printed in grey and too short for their line style."""


def series_marker(index: int) -> str:
    """Marker of the curve of that index."""
    return SERIES_MARKERS[index % len(SERIES_MARKERS)]
