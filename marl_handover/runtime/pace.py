"""Holding a twin to real time, for people who watch."""

from __future__ import annotations

import time

from marl_handover.hardware.clock import Clock, VirtualClock

STEP_S = 0.02
LAGGING_S = 0.1
"""Time lost by more than this, in computing or in a pause, is not made up for."""


def keep_pace(clock: Clock) -> None:
    """From now on, a virtual ``clock`` waits for the computer's. Any other keeps its own pace."""
    if not isinstance(clock, VirtualClock):
        return
    ahead_s = clock.now_s() - time.monotonic()

    def wait() -> None:
        nonlocal ahead_s
        early_s = clock.now_s() - time.monotonic() - ahead_s
        if early_s > 0:
            time.sleep(early_s)
        elif early_s < -LAGGING_S:
            ahead_s += early_s
        clock.at(clock.now_s() + STEP_S, wait)

    clock.at(clock.now_s() + STEP_S, wait)
