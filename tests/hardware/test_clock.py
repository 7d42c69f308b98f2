"""A virtual clock held to the computer's: the order and times of what happens stay as they are."""

from __future__ import annotations

import time

from marl_handover.hardware.clock import LAGGING_S, RealClock, VirtualClock, follow_real_time


def test_virtual_time_does_not_run_ahead_of_the_computer_s():
    clock = VirtualClock()
    clock.sleep_s(100.0)
    follow_real_time(clock)
    begun = time.monotonic()
    clock.sleep_s(0.3)
    assert time.monotonic() - begun >= 0.27
    assert clock.now_s() == 100.3


def test_lost_time_is_not_made_up_for():
    clock = VirtualClock()
    follow_real_time(clock)
    time.sleep(5 * LAGGING_S)
    begun = time.monotonic()
    clock.sleep_s(0.3)
    assert time.monotonic() - begun >= 0.3 - LAGGING_S - 0.05


def test_what_is_scheduled_happens_as_without():
    def times(paced):
        clock, seen = VirtualClock(), []
        if paced:
            follow_real_time(clock)
        for t_s in (0.05, 0.013, 0.08):
            clock.at(t_s, lambda: seen.append(clock.now_s()))
        clock.sleep_s(0.1)
        return [*seen, clock.now_s()]

    assert times(True) == times(False)


def test_a_real_clock_is_left_alone():
    follow_real_time(RealClock())
