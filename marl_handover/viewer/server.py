"""The web server of the browser pages: on this machine only, for pages of this machine only."""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server
from viser.infra import _infra

from marl_handover.config import require_between
from marl_handover.errors import HandoverError
from marl_handover.viewer.guard import Buffer, guarded

HOST = "127.0.0.1"
"""There is no login, so nobody but this machine's users gets in; from elsewhere: an SSH tunnel."""

LOG = logging.getLogger(__name__)

LAGGING_S = 0.1
"""A loop that is later than this goes on from there; it does not catch up."""

REPEATED_S = 60.0
"""The same error is written in full once; how often it came again, once in so many seconds."""


class PortTaken(HandoverError):
    """The page cannot be served at that port."""

    def __init__(self, port: int, reason: str) -> None:
        super().__init__(f"port = {port} of {HOST} cannot be used ({reason}); choose another one, or port=0 for any that is free")
        self.port, self.reason = port, reason


class LocalServer(viser.ViserServer):
    """A server that never publishes itself: viser's pages may otherwise ask it for a public address."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Refused."""


@contextlib.contextmanager
def open_server(port: int, label: str) -> Iterator[viser.ViserServer]:
    """A running server, stopped at the end.

    Args:
        port: 0 for any that is free.
        label: above the panel of the page.

    Raises:
        InvalidSetting: there is no such port.
        PortTaken: it is in use, or not for this user.
    """
    require_between("port", port, 0, 65535)
    _require_free(port)
    # Browsers open spare connections and close them unused, of which this logger would tell with a traceback.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    server = _started(port, label)
    try:
        if port and server.get_port() != port:  # somebody took it since; viser goes on to the next one
            raise PortTaken(port, "it is in use")
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        yield server
    finally:
        with _quiet():
            server.stop()


def address(server: viser.ViserServer) -> str:
    """Where a browser on this machine finds the page."""
    return f"http://{HOST}:{server.get_port()}"


class Failures:
    """Writes to the log what goes wrong again and again, without filling it."""

    def __init__(self, what: str) -> None:
        self._what, self._last, self._again, self._written_s = what, "", 0, 0.0

    def note(self, error: Exception) -> None:
        """An error that is not to end anything."""
        text, now_s = f"{type(error).__name__}: {error}", time.monotonic()
        if text != self._last:
            LOG.error("%s failed and goes on: %s", self._what, text, exc_info=error)
            self._last, self._again, self._written_s = text, 0, now_s
            return
        self._again += 1
        if now_s - self._written_s >= REPEATED_S:
            LOG.error("%s failed %d times more: %s", self._what, self._again, text)
            self._again, self._written_s = 0, now_s


def keep_updating(update: Callable[[float], None], rate_hz: float, ended: threading.Event, hurry: threading.Event | None = None) -> None:
    """Call ``update`` with the wall time in s since the call before, ``rate_hz`` times a second, until ``ended`` is set.

    Whoever sets ``hurry`` is attended to at once. An update that raises is written to the log, and the next one comes all the same: a page
    with a STOP button has to stay.
    """
    period_s, pause, failures = 1.0 / rate_hz, hurry or ended, Failures("an update of the page")
    before = due = time.perf_counter()
    while not ended.is_set():
        if hurry is not None:
            hurry.clear()
        now = time.perf_counter()
        try:
            update(min(now - before, LAGGING_S))
        except Exception as error:
            failures.note(error)
        before = now
        due = min(max(due + period_s, now + period_s - LAGGING_S), now + period_s)
        pause.wait(max(0.0, due - time.perf_counter()))


def _require_free(port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
            probe.listen()
        except OSError as error:
            raise PortTaken(port, error.strerror or str(error)) from error


def _started(port: int, label: str) -> viser.ViserServer:
    """The guard is put in where viser opens its socket and makes its buffers; the constructor waits for both."""
    sockets: Any = websockets.asyncio.server
    infra: Any = _infra
    serve = sockets.serve
    infra.AsyncMessageBuffer = Buffer  # for good: every viewer that connects gets one, too
    sockets.serve = guarded(serve)
    try:
        with _quiet():
            server = LocalServer(host=HOST, port=port, label=label, verbose=False)
    finally:
        sockets.serve = serve
    server.get_event_loop().call_soon_threadsafe(_log_failures, server.get_event_loop())
    return server


def _log_failures(loop: asyncio.AbstractEventLoop) -> None:
    """What viewers send may be nonsense, as often as they like: it is written once."""
    failures = Failures("a message from a viewer")
    loop.set_exception_handler(lambda _, context: failures.note(context.get("exception") or RuntimeError(context["message"])))


def _quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """Without the tables that viser prints."""
    return contextlib.redirect_stdout(io.StringIO())
