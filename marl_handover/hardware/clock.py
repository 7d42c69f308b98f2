"""Time as something that is passed in: the computer's for devices, a virtual one for tests and accelerated runs."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Seconds from some beginning, and a way to wait."""

    def now_s(self) -> float:
        """Seconds since the clock's own beginning; never goes back."""

    def sleep_s(self, duration_s: float) -> None:
        """Wait."""


class RealClock:
    """The computer's monotonic clock."""

    def now_s(self) -> float:
        """Seconds of ``time.monotonic``."""
        return time.monotonic()

    def sleep_s(self, duration_s: float) -> None:
        """Sleep; returns at once for what is not positive."""
        if duration_s > 0:
            time.sleep(duration_s)


class VirtualClock:
    """A clock that only moves when somebody waits; what was scheduled in between happens on the way, in order."""

    def __init__(self) -> None:
        self._now_s = 0.0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0

    def now_s(self) -> float:
        """Virtual seconds since the beginning."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Move on by ``duration_s``; nothing happens for what is not positive."""
        self.until(self._now_s + max(duration_s, 0.0))

    def until(self, t_s: float) -> None:
        """Move on to ``t_s``, calling what is scheduled up to then at its own time."""
        while self._events and self._events[0][0] <= t_s:
            due_s, _, call = heapq.heappop(self._events)
            self._now_s = max(self._now_s, due_s)
            call()
        self._now_s = max(self._now_s, t_s)

    def at(self, t_s: float, call: Callable[[], None]) -> None:
        """Schedule ``call`` at ``t_s``."""
        self._count += 1
        heapq.heappush(self._events, (t_s, self._count, call))


STEP_S = 0.02
LAGGING_S = 0.1
"""Time lost by more than this, in computing or in a pause, is not made up for."""


def follow_real_time(clock: Clock) -> None:
    """From now on, a virtual ``clock`` waits for the computer's. Any other keeps its own pace."""
    if not isinstance(clock, VirtualClock):
        return
    ahead_s = clock.now_s() - time.monotonic()

    def wait() -> None:
        """Sleep until the computer's clock has caught up, and come again."""
        nonlocal ahead_s
        early_s = clock.now_s() - time.monotonic() - ahead_s
        if early_s > 0:
            time.sleep(early_s)
        elif early_s < -LAGGING_S:
            ahead_s += early_s
        clock.at(clock.now_s() + STEP_S, wait)

    clock.at(clock.now_s() + STEP_S, wait)
