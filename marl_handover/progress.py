"""What a person sees while work goes on: bars, and a word on what takes long.

On a terminal a bar moves. In a file (``nohup``, CI, a pipe) it is a line now and then, so that a log stays a log.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

LOG_S = 20.0
"""Between two lines of a bar in a file."""

QUIET_S = 2.0
"""What takes longer says what it is."""


_silent: list[bool] = []
"""Not empty: nothing is shown. Set by the command line, whose key ``progress`` is for all that its process shows."""


@contextmanager
def showing(shown: bool) -> Iterator[None]:
    """Show bars and words on what takes long, or not, until the block ends."""
    if not shown:
        _silent.append(True)
    try:
        yield
    finally:
        if not shown:
            _silent.pop()


class Bar(tqdm):
    """A bar on stderr.

    Args:
        shown: whether it is shown at all.
        options: of tqdm.
    """

    disable: bool

    def __init__(self, *args: Any, shown: bool = True, **options: Any) -> None:
        self._terminal, self._due_s, self._over = sys.stderr.isatty(), 0.0, False
        # A terminal that has no size says 0 columns, in which a bar would be nothing.
        sized = self._terminal and os.get_terminal_size(sys.stderr.fileno()).columns > 0
        size: dict[str, Any] = {"dynamic_ncols": True} if sized else {"ncols": 100, "nrows": 24}
        super().__init__(*args, disable=bool(_silent) or not shown, file=sys.stderr, **size, **options)

    @staticmethod
    def status_printer(file: Any) -> Any:
        """What writes the bar: over itself, or in a line of its own."""
        if file.isatty():
            return tqdm.status_printer(file)

        def line(text: str) -> None:
            if text:
                file.write(f"{text}\n")
                file.flush()

        return line

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Show the bar; in a file, where it is time for it, and at its end."""
        if self._terminal:
            return bool(super().display(msg, pos))
        if self.disable:
            return False
        over, now_s = self.total is not None and self.n >= self.total, time.monotonic()
        if msg == "" or self._over or not (over or now_s >= self._due_s):
            return False
        self._over, self._due_s = over, now_s + LOG_S
        return bool(super().display(msg, 0))

    def close(self) -> None:
        """End the bar; in a file with a line that tells how far it came."""
        if not self._terminal and not self.disable:
            self._due_s = 0.0
            self.display()
            self._decr_instances(self)
            self.disable = True  # so that tqdm adds nothing
        super().close()

    def clear(self, nolock: bool = False) -> None:
        """Make room for a line; in a file there is nothing to clear."""
        if self._terminal:
            super().clear(nolock)


def say(text: str) -> None:
    """A line on stderr, above the bars."""
    Bar.write(text, file=sys.stderr)


@contextmanager
def working(what: str, *, logged: bool = True) -> Iterator[None]:
    """Tell on stderr ``what`` is being done, with the time it has taken, if that is longer than :data:`QUIET_S`.

    ``logged``: also if stderr is no terminal, in one line.
    """
    if _silent or not (logged or sys.stderr.isatty()):
        yield
        return
    ended = threading.Event()
    teller = threading.Thread(target=_tell, args=(what, ended), daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()


def _tell(what: str, ended: threading.Event) -> None:
    begun = time.time()
    if ended.wait(QUIET_S):
        return
    if not sys.stderr.isatty():
        say(f"{what} ...")
        return
    with Bar(bar_format=f"{what} ... {{elapsed}}", leave=False) as bar:
        bar.start_t = begun
        while not ended.wait(0.5):
            bar.refresh()
