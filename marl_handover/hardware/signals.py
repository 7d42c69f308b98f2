"""Signals that end a process, while arms hang on it: they become exceptions, and wait where an interrupted step would be dangerous.

Python ends at SIGTERM and SIGHUP (a terminal that is closed) without another line of its code, so nobody would stop the arms. Both come
out as :class:`KeyboardInterrupt` here, as Ctrl-C does. Signals reach the main thread only; in another one nothing here does anything.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any
from weakref import WeakSet

_ENDINGS = (signal.SIGTERM, signal.SIGHUP)


class Endings:
    """One session's wish that SIGTERM and SIGHUP be exceptions. Handlers that somebody has set are left alone, as is ``nohup``."""

    def begin(self) -> None:
        """From now on. Again is fine."""
        if _is_main():
            _wishes.add(self)
            for number in _ENDINGS:
                if signal.getsignal(number) is signal.SIG_DFL:
                    signal.signal(number, _interrupt)

    def end(self) -> None:
        """No more, unless another session wishes it. Again is fine."""
        _wishes.discard(self)
        if _is_main() and not _wishes:
            for number in _ENDINGS:
                if signal.getsignal(number) is _interrupt:
                    signal.signal(number, signal.SIG_DFL)


_wishes: WeakSet[Endings] = WeakSet()


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Inside, a signal that would be an exception waits; the first of them comes at the end, after an exception of the block's own too.

    Handlers must not be changed inside: they are put back as they were.
    """
    if not _is_main():
        yield
        return
    arrived: list[int] = []
    before: dict[int, Callable[[int, FrameType | None], Any]] = {}
    for deferrable in (signal.SIGINT, *_ENDINGS):
        handler = signal.getsignal(deferrable)
        if callable(handler):
            before[deferrable] = handler
            signal.signal(deferrable, lambda number, _: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if arrived:
            before[arrived[0]](arrived[0], None)


def _interrupt(number: int, _: FrameType | None) -> None:
    raise KeyboardInterrupt(signal.Signals(number).name)


def _is_main() -> bool:
    return threading.current_thread() is threading.main_thread()
