"""Signals as exceptions while arms are connected, and waiting while they are being stopped."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from marl_handover.hardware.connection import State, TerminationSignals, deferred_signals

ENDINGS = (signal.SIGTERM, signal.SIGHUP)


def handlers():
    return [signal.getsignal(number) for number in (signal.SIGINT, *ENDINGS)]


def test_endings_are_exceptions_for_as_long_as_somebody_is_connected(rig, two_boards):
    before = handlers()
    made = rig(two_boards)
    made.driver.connect()
    second = TerminationSignals()
    second.begin()
    second.begin()
    made.driver.close()
    for number in ENDINGS:
        with pytest.raises(KeyboardInterrupt, match=number.name):
            os.kill(os.getpid(), number)
    second.end()
    second.end()
    assert handlers() == before


def test_handlers_of_others_and_nohup_are_left_alone():
    own = {signal.SIGTERM: lambda number, frame: None, signal.SIGHUP: signal.SIG_IGN}
    before = {number: signal.signal(number, handler) for number, handler in own.items()}
    try:
        endings = TerminationSignals()
        endings.begin()
        assert {number: signal.getsignal(number) for number in own} == own
        endings.end()
        assert {number: signal.getsignal(number) for number in own} == own
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("error", [None, ValueError])
def test_a_deferred_signal_comes_at_the_end(error):
    done, before = [], handlers()

    def block():
        with deferred_signals():
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            done.append(1)
            if error:
                raise error

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == [1]
    assert handlers() == before


def test_other_threads_are_not_concerned():
    before, failed = handlers(), []

    def work():
        try:
            endings = TerminationSignals()
            endings.begin()
            with deferred_signals():
                failed.extend([] if handlers() == before else [1])
            endings.end()
        except ValueError as error:
            failed.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not failed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_first_board_is_stopped_does_not_spare_the_second(rig, two_boards, number):
    made = rig(two_boards)

    def interrupted():
        with made.driver as driver:
            driver.arm()
            driver.drive(1, driver.parked_rad + 0.05, 12.0, 30.0)
            wire = driver.boards.by_name["west"].wire
            inner = wire.write

            def again(data):
                if b"STOP" in data:
                    os.kill(os.getpid(), number)
                return inner(data)

            wire.write = again
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    made.clock.sleep_s(0.1)
    for device in made.cell.devices.values():
        device.advance(made.clock.now_s())
        assert len({line for _, line in device.lines if b"STOP" in line}) >= 6
    assert made.driver.state is State.DISCONNECTED
    assert not any(board.connected for board in made.driver.boards.by_name.values())
