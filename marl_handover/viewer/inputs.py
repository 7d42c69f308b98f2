"""Reading and writing the inputs of a page's panel."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine
from typing import Any

import viser


def by_hand(event: viser.GuiEvent[Any]) -> bool:
    """Whether somebody changed an input, not this program."""
    return event.client_id is not None


def number(handle: Any, low: float, high: float) -> float:
    """What an input says, between ``low`` and ``high``: a viewer may send anything."""
    value = float(handle.value)
    return min(max(value, low), high) if math.isfinite(value) else low


def write(handle: Any, value: object) -> None:
    """Set an input to ``value``; typed loosely, as type checkers take viser's ``value`` for read-only."""
    handle.value = value


def at_once(act: Callable[[], object]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """A callback that calls ``act`` in the server's own thread: it waits for no other callback. ``act`` has to be quick."""

    async def act_now(_: object) -> None:
        act()

    return act_now
