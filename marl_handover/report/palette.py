"""One palette for every figure: Paul Tol's high-contrast colours, told apart by colour-blind readers and in grey print.

Colour never stands alone: the arms also differ in line style, outcomes in their labels.
"""

from __future__ import annotations

BLUE, YELLOW, RED = "#004488", "#DDAA33", "#BB5566"
INK, GREY, FAINT, PAPER = "#222222", "#777777", "#CCCCCC", "#FFFFFF"

ARMS = (BLUE, RED)
"""Colour of each arm, by its index."""

ARM_LINES = ("-", "--")
"""Line style of each arm, by its index."""

SHARED = YELLOW
GOAL = INK

OUTCOMES = {"success": BLUE, "wrong_orientation": YELLOW, "wrong_position": RED, "timeout": GREY}
"""Colour of each way an episode ends."""


def arm_colour(index: int) -> str:
    """Colour of an arm; further arms start over."""
    return ARMS[index % len(ARMS)]


def arm_line(index: int) -> str:
    """Line style of an arm; further arms start over."""
    return ARM_LINES[index % len(ARM_LINES)]


SERIES = ("#4477AA", "#EE6677", "#228833", "#CCBB44", "#66CCEE", "#AA3377", "#555555")
SERIES_LINES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)))
"""Paul Tol's bright colours for many curves in one picture, and the line styles that go with them; 35 differ."""


def series_style(index: int) -> dict[str, object]:
    """Colour and line style of the curve of that index: no two neighbours share either."""
    return {"color": SERIES[index % len(SERIES)], "linestyle": SERIES_LINES[index % len(SERIES_LINES)]}
