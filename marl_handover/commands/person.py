"""The person at a real cell: asked before first moves, told what to hold and what to lay down."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from marl_handover.errors import WorkFailed

if TYPE_CHECKING:
    from marl_handover.control.settings import CardConfig
    from marl_handover.perception.sheets import Sheet


class NobodyThere(WorkFailed):
    """A question for a person, and no terminal to ask it on."""


def confirmed(question: str) -> bool:
    """Ask, and take nothing but a whole yes for one. Without a terminal: False, nobody is there."""
    if not sys.stdin.isatty():
        return False
    return input(f"{question} Type yes: ").strip().lower() == "yes"


def laid_anew() -> None:
    """Wait until somebody has laid block and goal for the next episode. Without a terminal: they stay as they are."""
    if sys.stdin.isatty():
        input("lay the block, and the goal's marker, where the next episode is to find them, hands off the table; then press Enter ")


class Person:
    """Does what :class:`~marl_handover.control.calibration.Operator` asks, after Enter was pressed."""

    def __init__(self, cards: CardConfig) -> None:
        self._cards = cards

    def hold_board(self, sheet: Sheet, number: int, count: int) -> None:
        """See the protocol."""
        _wait(
            f"{number + 1} of {count}: hold the board before the camera, slanted by 20 to 40 degrees, every time elsewhere in the picture"
        )

    def lay_board(self, sheet: Sheet, place: Sequence[float]) -> None:
        """See the protocol."""
        _wait(
            f"lay the board flat, its middle at x = {place[0]:g} mm, y = {place[1]:g} mm, its rows turned by {math.degrees(place[2]):z.0f} "
            "degrees from +x"
        )

    def take_board_away(self) -> None:
        """See the protocol."""
        _wait("take the board away")

    def glue_cards(self) -> None:
        """See the protocol."""
        x, y, z = self._cards.place_mm
        _wait(
            f"fix marker {self._cards.ids[0]} flat on the left hand, {self._cards.ids[1]} on the right one: middle {-x:g} mm "
            f"behind the grip, {y:g} mm to its left, {z:g} mm above it, its upper edge to the left"
        )

    def take_cards_off(self) -> None:
        """See the protocol."""
        _wait("take the markers off the hands")

    def stand_block(self, place: Sequence[float]) -> None:
        """See the protocol."""
        _wait(f"stand the block, its marker up, at about x = {place[0]:g} mm, y = {place[1]:g} mm, hands off the table")


def _wait(text: str) -> None:
    if not sys.stdin.isatty():
        raise NobodyThere(f"this needs a person at a terminal: {text}")
    input(f"{text}; then press Enter ")
