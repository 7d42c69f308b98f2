"""One palette for figures and browser: Paul Tol's high-contrast colours, told apart by colour-blind readers and in grey print."""

from __future__ import annotations

BLUE, YELLOW, RED = "#004488", "#DDAA33", "#BB5566"
INK, GREY, FAINT, PAPER = "#222222", "#777777", "#CCCCCC", "#FFFFFF"
ALERT = "#CC3311"
"""What cannot be, and what stops."""

ARMS = (BLUE, RED, "#228833", "#EE7733", "#AA3377", "#33BBEE", "#7A5C3E", "#888800")
"""Colour of each arm, by its index."""

SHARED = YELLOW
GOAL = INK

OUTCOMES = {"success": BLUE, "wrong_orientation": YELLOW, "wrong_position": RED, "timeout": GREY}
"""Colour of each way an episode ends."""


def arm_colour(index: int) -> str:
    """Colour of an arm; further arms start over."""
    return ARMS[index % len(ARMS)]
