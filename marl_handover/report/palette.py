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
